"""Every field of a public dataclass or NamedTuple says what it holds, in a `#:` comment where it stands."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "torchelev"


def is_record(node):
    """A dataclass or a NamedTuple whose name is public."""
    marks = [ast.unparse(mark) for mark in (*node.bases, *node.decorator_list)]
    return not node.name.startswith("_") and any("NamedTuple" in mark or "dataclass" in mark for mark in marks)


def has_meaning(value):
    """Whether a field's value is a call with its meaning as an argument, which programs show."""
    args = value.args if isinstance(value, ast.Call) else []
    texts = [arg.value for arg in args if isinstance(arg, ast.Constant)]
    return any(isinstance(text, str) and " " in text for text in texts)


def undocumented(source):
    """Names of the public fields of public records that have no `#:` comment behind them or in the line above."""
    lines, missing = source.split("\n"), []
    records = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef) and is_record(node)]
    for record in records:
        for field in record.body:
            if not isinstance(field, ast.AnnAssign) or "ClassVar" in ast.unparse(field.annotation):
                continue
            if has_meaning(field.value):
                continue
            behind = lines[field.end_lineno - 1].encode()[field.end_col_offset :].decode()
            above = lines[field.lineno - 2]
            if not (re.match(r"\s+#: \S", behind) or re.match(r"\s+#: \S", above) or field.target.id.startswith("_")):
                missing.append(f"{record.name}.{field.target.id}")
    return missing


@pytest.mark.slow(1)
def test_every_field_is_documented():
    missing = {path.name: names for path in ROOT.rglob("*.py") if (names := undocumented(path.read_text()))}
    assert not missing, "add a `#:` comment: unit, meaning, and of a setting when to change it"


@pytest.mark.parametrize(
    "field, names",
    [
        ("x: int", ["A.x"]),
        ("x: int  # [m]", ["A.x"]),
        ("x: int  #: [m]", []),
        ("x: int = setting(3, '[m] from the sensor')", []),
    ],
)
def test_finds_the_field_that_lacks_one(field, names):
    assert undocumented(f"@dataclass\nclass A:\n    {field}\n") == names
    assert undocumented(f"class A(NamedTuple):\n    {field}\n") == names
