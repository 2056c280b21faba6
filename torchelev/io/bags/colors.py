"""Whether the clouds of a bag have colours."""

from __future__ import annotations

from collections.abc import Sequence

from torchelev.io.bags.bag import Bag
from torchelev.io.errors import RecordingError
from torchelev.io.points.colors import color_fields

_HINT = "give --points with a topic whose points have rgb or rgba, or leave --colour out"


def require_colors(bag: Bag, topics: Sequence[str]) -> None:
    """Raise a RecordingError unless the points of one of the topics of clouds have colours."""
    found = {topic: field_names(bag, topic) for topic in topics}
    if not any(color_fields(names) for names in found.values()):
        have = "; ".join(f"{topic} has {', '.join(names) or 'no fields'}" for topic, names in found.items())
        reason = have or "there are depth images alone"
        raise RecordingError(bag.path, f"--colour: no points with colours: {reason}", _HINT)


def field_names(bag: Bag, topic: str) -> list[str]:
    """Return the fields of the points in the first cloud of a topic; [] if there is none."""
    first = next(bag.read([topic]), None)
    return [field.name for field in getattr(getattr(first, "data", None), "fields", ())]
