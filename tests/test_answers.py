"""What the library answers stays what was recorded, see `answers.py`."""

import numpy as np
import pytest

from tests.answers import FILE, PARTS, machine

RECORDED = dict(np.load(FILE))
MACHINE = str(RECORDED.pop("machine"))
# On another CPU sums round otherwise, and a choice between two may go the other way: a way, and all that follows it.
FOLLOWS_CHOICES = ("plan", "path check", "plane", "rollout")


COMPILED = [pytest.mark.compiles, pytest.mark.slow(110)]
MARKS = {"compiled float32": [*COMPILED, pytest.mark.xdist_group("recorded update")], "compiled float64": COMPILED}
MARKS["rollout"] = [pytest.mark.slow(6)]


@pytest.mark.parametrize("part", [pytest.param(part, marks=MARKS.get(part, ())) for part in PARTS])
def test_answers_are_those_recorded(part):
    answers = PARTS[part]()
    start = f"{part}: "
    expected = {name.removeprefix(start): value for name, value in RECORDED.items() if name.startswith(start)}
    assert sorted(answers) == sorted(expected)
    for name, value in answers.items():
        if machine() == MACHINE:
            assert value.dtype == expected[name].dtype, name
            np.testing.assert_array_equal(value, expected[name], err_msg=name)
        elif not name.startswith(FOLLOWS_CHOICES):
            assert_close(value, expected[name], name)


def assert_close(value, expected, name):
    """All but 1 % of the values agree to 1e-4 of the answer's range."""
    assert value.shape == expected.shape and value.dtype == expected.dtype, name
    value, expected = value.astype(np.float64), expected.astype(np.float64)
    finite = np.isfinite(expected)
    tolerance = 1e-4 * max(np.ptp(expected[finite]), 1e-3) if finite.any() else 0.0
    with np.errstate(invalid="ignore"):
        agrees = (np.abs(value - expected) <= tolerance) | (~finite & ~np.isfinite(value))
    assert agrees.mean() >= 0.99, f"{name}: {1 - agrees.mean():.1%} differ"
