"""One wording for all errors: the argument, the rule, the actual value, and a hint."""

from __future__ import annotations

import math
from numbers import Integral, Real


def message(argument: str, rule: str, actual: object, hint: str) -> str:
    """Return the text of an error."""
    return f"{argument}: {rule}, got {actual}; {hint}"


def require(
    holds: bool, argument: str, rule: str, actual: object, hint: str, error: type[Exception] = ValueError
) -> None:
    """Raise `error` unless the rule holds.

    Args:
        holds: whether the argument follows the rule.
        argument: name of the argument.
        rule: what it must be, such as "must be positive" or "expected (B, 3)".
        actual: what it is.
        hint: what to do about it.
        error: type of the error.
    """
    if not holds:
        raise error(message(argument, rule, actual, hint))


def require_count(name: str, value: object, hint: str, minimum: int = 1) -> int:
    """Return an integer of at least `minimum` as an int; ValueError for anything else. NumPy's integers count."""
    fits = isinstance(value, Integral) and not isinstance(value, bool) and int(value) >= minimum
    rule = f"must be an int of at least {minimum}" if minimum > 1 else "must be a positive int"
    require(fits, name, rule, repr(value), hint)
    return int(value)  # type: ignore[call-overload]


def require_positive(**values: object) -> None:
    """Raise ValueError unless all values are positive, finite numbers."""
    for name, value in values.items():
        # Testing for float first takes a tenth of the time; the text is composed only if needed.
        is_number = isinstance(value, (float, Real)) and not isinstance(value, bool) and math.isfinite(value)
        if not (is_number and value > 0):  # type: ignore[operator]
            raise ValueError(message(name, "must be a positive number", repr(value), "give metres"))


def whole_cells(name: str, length: float, resolution: float) -> int:
    """Return length / resolution; ValueError unless it is a whole number, up to rounding."""
    require_positive(resolution=resolution, **{name: length})
    cells = length / resolution
    is_whole = math.isfinite(cells) and round(cells) >= 1 and abs(cells - round(cells)) < 1e-6 * cells
    hint = f"try {max(1, round(cells)) * resolution:.6g}" if math.isfinite(cells) else "give metres"
    require(is_whole, name, f"must be a whole number of times {resolution:g} m", f"{cells:.6g} times", hint)
    return round(cells)
