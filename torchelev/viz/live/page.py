"""The page: a scene beside a panel with the layer, the legend, what is shown, and the values of a cell."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.channels.config import ChannelConfig
from torchelev.viz.channels import choose_channels
from torchelev.viz.live.camera import Camera
from torchelev.viz.live.colors import (
    Limits,
    channel_legend,
    choose_limits,
    colorize,
    colorize_channel,
    describe,
    legend,
    shown_layers,
)
from torchelev.viz.live.scene import Scene
from torchelev.viz.live.server import address_of, open_server, stop_server
from torchelev.viz.live.snapshot import PARTS, Snapshot
from torchelev.viz.live.surface import find_cell

_CLICK_HINT = "Click a cell to read its values."


class Page:
    """Serves one page to any number of browsers.

    Args:
        title: of the page.
        layers: names of the layers to colour by; the first one is shown first.
        num_envs: number of environments to choose from.
        host: "127.0.0.1" lets only this machine connect, "0.0.0.0" every machine that reaches it.
        port: of the page. If it is taken, the next free one is used.
        channels: of the map; those of colours and classes whose components are among the layers can be chosen, too.
        server: of `open_server`, which takes the place of title, host and port.

    Attributes:
        on_change: called, in a thread of the server, when the picture has to be drawn again.

    Raises:
        ModuleNotFoundError: viser is missing.
        ValueError: the port is invalid, or the host is not an address of this machine.
    """

    def __init__(
        self,
        title: str,
        layers: tuple[str, ...],
        num_envs: int = 1,
        host: str = "127.0.0.1",
        port: int = 8080,
        channels: Mapping[str, ChannelConfig] | None = None,
        server: Any = None,
    ) -> None:
        self.server: Any = open_server(title, host, port) if server is None else server
        self.on_change: Callable[[], None] = lambda: None
        self._scene, self._camera = Scene(self.server), Camera(self.server)
        self._lock = threading.Lock()
        self._path: list[NDArray] = []
        self._last: Snapshot | None = None
        self._limits: dict[str, Limits] = {}
        self._ray: tuple[NDArray, NDArray] | None = None
        self._channels = choose_channels(channels or {}, layers)
        self._add_controls(layers, num_envs)
        self.server.scene.on_click()(self._point_at)

    @property
    def url(self) -> str:
        """The page's address."""
        return address_of(self.server)

    @property
    def layer(self) -> str:
        """The layer, or the channel, that colours the surface."""
        return self._layer.value

    @property
    def env(self) -> int:
        """The environment to show."""
        return 0 if self._env is None else int(self._env.value)

    @property
    def last_time(self) -> float:
        """Time [s] of the snapshot on the page; 0 before the first."""
        return 0.0 if self._last is None else self._last.time

    def _add_controls(self, layers: tuple[str, ...], num_envs: int) -> None:
        gui = self.server.gui
        self._status = gui.add_markdown("Waiting for a map.")
        self._env = None
        if num_envs > 1:
            self._env = gui.add_slider("robot", 0, num_envs - 1, 1, 0)
            self._env.on_update(lambda _: self._forget_robot())
        names = (*shown_layers(dict.fromkeys(layers, np.zeros(0))), *self._channels)
        self._layer = gui.add_dropdown("colour", names, initial_value=names[0])
        self._layer.on_update(lambda _: self._recolor())
        self._legend = gui.add_html("")
        with gui.add_folder("show"):
            self._parts = {name: gui.add_checkbox(name, shown, visible=False) for name, shown in PARTS.items()}
            self._follow = gui.add_checkbox("follow the robot", False)
        for box in self._parts.values():
            box.on_update(lambda _: self.redraw())
        self._cell = gui.add_markdown(_CLICK_HINT)

    def _recolor(self) -> None:
        """Draw the last snapshot in other colours, and ask for another one if it lacks them."""
        self.redraw()
        if self._last is not None and not self._components() <= set(shown_layers(self._last.map.layers)):
            self.on_change()

    def _components(self) -> set[str]:
        """Return the layers of which the colours are made."""
        cfg = self._channels.get(self.layer)
        return {self.layer} if cfg is None else set(cfg.components(self.layer))

    def _forget_robot(self) -> None:
        self._path.clear()
        self.on_change()

    def draw(self, snapshot: Snapshot, status: str = "", path: list[NDArray] | None = None) -> None:
        """Draw a snapshot in all browsers.

        Args:
            snapshot: what to draw.
            status: a line above the controls.
            path: (3,) [m] positions of the base so far; None: those of the snapshots drawn.
        """
        with self._lock:
            if path is not None:
                self._path = list(path)
            elif snapshot.T_map_base is not None:
                self._path.append(snapshot.T_map_base[:3, 3])
            if self._last is None:
                self._scene.origin = np.append(np.round(snapshot.map.center[:2]), 0.0)
            self._last = snapshot
            if status:
                self._status.content = status
            self._draw(snapshot)
            self._camera.look_at_map(snapshot.map, self._scene.origin)
            base = snapshot.T_map_base if self._follow.value else None
            self._camera.follow(None if base is None else base[:3, 3])

    def redraw(self) -> None:
        """Draw the last snapshot again, as the controls now say."""
        with self._lock:
            if self._last is not None:
                self._draw(self._last)

    def _draw(self, snapshot: Snapshot) -> None:
        layers = shown_layers(snapshot.map.layers)
        colors, explained = self._color(layers)
        parts = {name for name, box in self._parts.items() if box.value}
        with self.server.atomic():
            for name in snapshot.parts:
                self._parts[name].visible = True
            self._legend.content = explained
            self._scene.draw(snapshot, colors, np.array(self._path), parts)
            self._cell.content = self._describe_cell(snapshot, layers)

    def _color(self, layers: dict[str, NDArray]) -> tuple[NDArray[np.uint8], str]:
        """Return the colours (H, W, 4) of the layer or channel that was chosen, and its legend."""
        cfg = self._channels.get(self.layer)
        if cfg is not None and self._components() <= set(layers):
            parts = np.stack([layers[name] for name in cfg.components(self.layer)])
            return colorize_channel(cfg, parts), channel_legend(self.layer, cfg, parts)
        layer = self.layer if self.layer in layers else "elevation"  # a filter chosen after the snapshot was taken
        values = layers[layer]
        self._limits[layer] = limits = choose_limits(layer, values, self._limits.get(layer))
        return colorize(layer, values, limits), legend(layer, limits)

    def _point_at(self, event: Any) -> None:
        self._ray = np.array(event.ray_origin) + self._scene.origin, np.array(event.ray_direction)
        self.redraw()

    def _describe_cell(self, snapshot: Snapshot, layers: dict[str, NDArray]) -> str:
        """Return the values of the cell that was clicked, a line each."""
        if self._ray is None:
            return _CLICK_HINT
        cell = find_cell(snapshot.map, *self._ray)
        if cell is None:
            return f"No known cell there. {_CLICK_HINT}"
        x, y = snapshot.map.cell_center(cell)
        rows = [f"| {name} | {describe(name, float(values[cell]))} |" for name, values in layers.items()]
        head = [f"**Cell at ({x:.2f} m, {y:.2f} m)**", "", "| layer | value |", "| --- | --- |"]
        return "\n".join(head + rows)

    def wait(self) -> None:
        """Keep the page open; returns only by Ctrl-C, which raises KeyboardInterrupt."""
        while True:
            time.sleep(0.5)

    def stop(self) -> None:
        """Close the page."""
        stop_server(self.server)
