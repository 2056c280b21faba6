"""One wording for every error: the argument, the rule, the actual value, a hint."""

from __future__ import annotations

import math
from numbers import Integral, Real


def message(argument: str, rule: str, actual: object, hint: str) -> str:
    """Compose the text of an error."""
    return f"{argument}: {rule}, got {actual}; {hint}"


def require(
    holds: bool, argument: str, rule: str, actual: object, hint: str, error: type[Exception] = ValueError
) -> None:
    """Raise `error` with a full message unless the rule holds."""
    if not holds:
        raise error(message(argument, rule, actual, hint))


def require_count(name: str, value: object, hint: str, least: int = 1) -> int:
    """Return a whole number, Python's or NumPy's, of at least so many as an int; refuse all else."""
    good = isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= least
    rule = f"must be an int of at least {least}" if least > 1 else "must be a positive int"
    require(good, name, rule, repr(value), hint)
    return int(value)  # type: ignore[call-overload]


def require_positive(**values: object) -> None:
    """Refuse what is no positive, finite number."""
    for name, value in values.items():
        # To ask for a float first takes a tenth of the time; the text is composed only if it is needed.
        number = isinstance(value, (float, Real)) and not isinstance(value, bool) and math.isfinite(value)
        if not (number and value > 0):  # type: ignore[operator]
            raise ValueError(message(name, "must be a positive number", repr(value), "give metres"))


def whole_cells(name: str, length: float, resolution: float) -> int:
    """Return length / resolution, which must be a whole number."""
    require_positive(resolution=resolution, **{name: length})
    cells = length / resolution
    whole = math.isfinite(cells) and round(cells) >= 1 and abs(cells - round(cells)) < 1e-6 * cells
    hint = f"try {max(1, round(cells)) * resolution:.6g}" if math.isfinite(cells) else "give metres"
    require(whole, name, f"must be a whole number of times {resolution:g} m", f"{cells:.6g} times", hint)
    return round(cells)
