"""A web page that shows a map while it grows, by viser: `LiveView` beside a loop of your own, `Player` for recordings.

Needs ``pip install 'torchelev[view]'``. `torchelev view` in `torchelev.app` starts it for files.
"""

from torchelev.viz.live.live_view import LiveView, open_view
from torchelev.viz.live.page import Page
from torchelev.viz.live.player import Player
from torchelev.viz.live.snapshot import Snapshot, take_snapshot

__all__ = ["LiveView", "Page", "Player", "Snapshot", "open_view", "take_snapshot"]
