"""One wording for every refusal: the argument, the rule, what came, the mend."""

from __future__ import annotations


def message(argument: str, rule: str, came: object, mend: str) -> str:
    """Compose the text of an error."""
    return f"{argument}: {rule}, got {came}; {mend}"


def require(
    holds: bool, argument: str, rule: str, came: object, mend: str, error: type[Exception] = ValueError
) -> None:
    """Raise `error` with a full message unless the rule holds."""
    if not holds:
        raise error(message(argument, rule, came, mend))
