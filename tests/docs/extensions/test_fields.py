"""Tables of fields say what the `#:` comments and the defaults say."""

from dataclasses import dataclass, field
from typing import NamedTuple

import pytest

pytest.importorskip("sphinx", reason="needs pip install -e '.[docs]'")
from docs.extensions.fields import comments, read_notes, table


@dataclass
class Inner:
    size: int  #: [cells] of it


@dataclass
class Settings:
    length: float = 0.5  #: [m] of the thing, |x|
    #: comment of two
    #: lines
    inner: Inner = field(default_factory=lambda: Inner(1))
    mode: str | None = None  #: alpha_n: mode


class Values(NamedTuple):
    height: float  #: [m] map frame


def test_a_config_has_defaults_units_and_notes():
    notes = read_notes("length: Raise it.\ninner: Set it,\n   always.\nmode: Never.")
    assert notes == {"length": "Raise it.", "inner": "Set it, always.", "mode": "Never."}
    assert table(Settings, ["A", "B", "C", "D"], notes).split("\n") == [
        "| A | B | C | D |",
        "| --- | --- | --- | --- |",
        "| `length` | `0.5` m | Of the thing, \\|x\\| | Raise it. |",
        "| `inner` | `<lambda>()` | Comment of two lines | Set it, always. |",
        "| `mode` | `None` | alpha_n: mode | Never. |",
    ]


def test_required_fields_say_so_and_a_named_tuple_keeps_its_unit():
    assert table(Inner, ["A", "B", "C"], {}).split("\n")[2:] == ["| `size` | required, cells | Of it |"]
    assert table(Values, ["A", "B"], {}).split("\n")[2:] == ["| `height` | [m] map frame |"]
    assert comments(Values) == {"height": "[m] map frame"}
