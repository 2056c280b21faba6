"""The times of merges: checks of the given ones, and the site's own time where none is given."""

from __future__ import annotations

import math
import warnings
from numbers import Real
from typing import TYPE_CHECKING

import torch

from torchelev.errors import message, require

if TYPE_CHECKING:
    from jaxtyping import Int

    from torchelev.site.fusion.windows import Contribution

_LATEST = 1e11  # [s] the year 5138; Unix time in milliseconds or nanoseconds lies beyond
_LATE = 1e-3  # [s] more than rounding
_YEAR = 3.2e7  # [s]


def check_time(time: object) -> float | None:
    """Return the `time` of a merge [s], or None if none is given."""
    if time is None:
        return None
    is_number, hint = isinstance(time, Real) and not isinstance(time, bool), "give a float, such as time.time()"
    require(is_number, "time", "must be a number of seconds", repr(time), hint, TypeError)
    seconds = float(time)  # type: ignore[arg-type]
    require(math.isfinite(seconds), "time", "must be a finite number", seconds, "give seconds")
    hint = "convert it: nanoseconds * 1e-9, milliseconds * 1e-3"
    require(abs(seconds) < _LATEST, "time", f"must be in seconds, below {_LATEST:g}", f"{seconds:g}", hint)
    return seconds


def warn_of_other_clock(time: float, newest: float) -> None:
    """Warn if the time of a merge lies before the site's newest one, or more than a year after it."""
    passed = time - newest
    if -_LATE <= passed <= _YEAR:
        return
    where = "before" if passed < 0 else "after"
    effect = "its measurements count as that old" if passed < 0 else "all older cells lose their certainty"
    actual = f"{time:.3f}, {abs(passed):.3f} s {where} the site's newest time: {effect}"
    hint = "give all merges seconds of one clock, such as time.time()"
    text = message("time", "must be on the clock of the earlier merges and not go back", actual, hint)
    warnings.warn(text, RuntimeWarning, stacklevel=8)  # the caller of `merge`, which has two decorators


def continue_time(
    elapsed: Int[torch.Tensor, "B"], contribution: Contribution | None, time: float, opened: float
) -> float:
    """Return the default time of a merge: the site's time plus the maps' elapsed time since their last merge.

    Args:
        elapsed: [ns] of the maps' clocks.
        contribution: of the maps at their last merge; None: they have not merged yet.
        time: [s] of the site, from its epoch.
        opened: [s] its time when it was opened.
    """
    if contribution is None:
        return max(time, opened + float(elapsed.max()) * 1e-9)
    lived = torch.where(
        contribution.elapsed >= 0, elapsed - contribution.elapsed, elapsed
    )  # an environment that was reset
    return max(time, float((contribution.known.now + 1e-9 * lived.double()).max()))
