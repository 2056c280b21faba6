"""What the library answers stays what was recorded, see `answers.py`. Compiled: `test_compiled_answers.py`."""

import pytest

from tests.answers import PARTS, assert_recorded


@pytest.mark.slow(30)
@pytest.mark.parametrize("part", [part for part in PARTS if not part.startswith("compiled")])
def test_answers_are_those_recorded(part):
    assert_recorded(part)
