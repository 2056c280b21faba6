"""A web page that shows a map while it grows, by viser: `LiveView` beside a loop of your own, `Player` for recordings.

Needs ``pip install 'torchelev[view]'``. `torchelev view` in `torchelev.app` starts it for files.
"""

from torchelev.lazy_names import import_later

_LATER = {
    **dict.fromkeys(("LiveView", "open_view"), "torchelev.viz.live.live_view"),
    **dict.fromkeys(("Snapshot", "take_snapshot"), "torchelev.viz.live.snapshot"),
    "Page": "torchelev.viz.live.page",
    "Player": "torchelev.viz.live.player",
}
__all__ = ["LiveView", "Page", "Player", "Snapshot", "open_view", "take_snapshot"]
__getattr__, __dir__ = import_later(__name__, _LATER)
