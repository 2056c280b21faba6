"""What the library answers stays what was recorded, see `answers.py`."""

import pytest

from tests.answers import PARTS, assert_recorded


@pytest.mark.slow(30)
@pytest.mark.parametrize("part", PARTS)
def test_answers_are_those_recorded(part):
    assert_recorded(part)
