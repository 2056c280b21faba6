"""The live view of a mission: the growing site map, and a frame for each robot."""

from __future__ import annotations

from torchelev.app.fleet.mission import Mission
from torchelev.io.export import SavedMap
from torchelev.viz.live import Page, Snapshot

_MAX_CELLS = 300  # along a side, so that a browser keeps up
_LAYERS = ("elevation", "variance", "time", "upper_bound")


class FleetView:
    """Shows the site map of a mission on a page of its own.

    Args:
        host: address that the page listens on.
        port: of the page.

    Raises:
        ModuleNotFoundError: viser is missing.
    """

    def __init__(self, host: str, port: int) -> None:
        self.page = Page("fleet", _LAYERS, host=host, port=port)
        self._num_shown = 0

    def show(self, mission: Mission) -> None:
        """Show the site map after a merge; does nothing until there is a new one."""
        if mission.saved is None or len(mission.merge_ms) == self._num_shown:
            return
        self._num_shown = len(mission.merge_ms)
        poses = mission.scan.T_map_base.numpy()
        status = f"{mission.time:.0f} s, {100 * mission.coverage:.1f} % known, version {mission.site.version}"
        self.page.draw(Snapshot(thin_out(mission.saved), T_map_sensor=poses, time=mission.time), status)


def thin_out(saved: SavedMap) -> SavedMap:
    """Return every n-th cell along x and y, so that at most `_MAX_CELLS` remain along a side."""
    shape = next(iter(saved.layers.values())).shape
    step = -(-max(shape) // _MAX_CELLS)
    layers = {name: saved.layers[name][step // 2 :: step, step // 2 :: step] for name in _LAYERS}
    return saved._replace(layers=layers, resolution=step * saved.resolution)
