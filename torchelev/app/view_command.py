"""`torchelev view`: show a recording, a simulated walk or a saved map in the browser."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from torchelev.app.config_file import load_config
from torchelev.app.mapping.fuse_scans import fuse_all, new_map
from torchelev.app.mapping.map_request import MapRequest
from torchelev.app.mapping.open_scans import open_scans
from torchelev.io import Frame, MappingRun, is_bag

if TYPE_CHECKING:
    from torchelev.channels.config import ChannelConfig
    from torchelev.io.export import SavedMap
    from torchelev.viz.live import Page, Player


def run_view(request: MapRequest | None, server: Any, is_paused: bool) -> None:
    """Show the recording, walk or map until Ctrl-C, which raises KeyboardInterrupt.

    Args:
        request: a recording, or a saved map; None: the demo's walk.
        server: of `open_server`, which serves the page.
        is_paused: wait at the first scan.

    Raises:
        RecordingError, ValueError, OSError: for bad input.
    """
    if request is None:
        _view_demo(server, is_paused)
    elif request.recording.suffix == ".npz" and request.recording.is_file():
        _refuse_options(request)
        _view_map(server, request.recording)
    elif request.recording.is_file() and not is_bag(request.recording):
        kinds = "a bag (.bag, .mcap, .db3), a folder of scans or a saved map (.npz)"
        raise ValueError(f"{request.recording}: is of no kind that can be shown; give {kinds}")
    else:
        _view_recording(server, request, is_paused)


def _make_page(server: Any, layers: tuple[str, ...], channels: Mapping[str, ChannelConfig]) -> Page:
    from torchelev.viz.live import Page

    return Page("", layers, channels=channels, server=server)


def _view_recording(server: Any, request: MapRequest, is_paused: bool) -> None:
    from torchelev.viz.live import Player

    with open_scans(request) as (scans, options):
        emap = new_map(load_config(request.config, request.resolution, request.size), request.device, options)
        page = _make_page(server, emap.layers, emap.cfg.channels)
        player, show = Player(page, len(scans), not is_paused), ShowScans()
        stopped = fuse_all(MappingRun(emap), scans, options, between=lambda run, frame: show(player, run, frame))
        if stopped is not None and not isinstance(stopped, KeyboardInterrupt) and player.num_shown:
            click.echo(f"stopped after {player.num_shown} of {len(scans)} scans: {stopped}", err=True)
        elif stopped is not None:
            raise stopped
        if not player.num_shown:
            raise ValueError(f"{request.recording}: none of the {len(scans)} scans could be used")
    player.hold()


class ShowScans:
    """Shows each scan of a recording on a player's page, at its time."""

    def __init__(self) -> None:
        self._time = 0.0  # [s] since the first scan

    def __call__(self, player: Player, run: MappingRun, frame: Frame) -> None:
        """Show the map after a scan."""
        from torchelev.viz.live import take_snapshot

        self._time += frame.dt if run.num_scans > 1 else 0.0
        base = frame.T_map_sensor if frame.T_map_base is None else frame.T_map_base
        layers, pose = run.emap.layers, frame.T_map_sensor
        player.show(take_snapshot(run.emap, base, pose, frame.points, layers=layers, time=self._time))


def _view_demo(server: Any, is_paused: bool) -> None:
    from torchelev.app.demo import DemoWalk
    from torchelev.viz.live import Player, take_snapshot

    demo = DemoWalk()
    emap = demo.emap
    player = Player(_make_page(server, emap.layers, emap.cfg.channels), len(demo), not is_paused)
    for scan in demo:
        scene = scan.T_map_base, scan.T_map_sensor, scan.points
        player.show(take_snapshot(emap, *scene, layers=emap.layers, time=scan.time))
    player.hold()


def _refuse_options(request: MapRequest) -> None:
    """Refuse options for reading and mapping recordings, as a saved map needs neither."""
    plain = MapRequest(recording=request.recording)
    names = [field.name for field in fields(plain) if getattr(request, field.name) != getattr(plain, field.name)]
    if names:
        given = ", ".join(f"--{name.replace('_', '-')}" for name in names)
        raise ValueError(f"{given}: only for recordings; {request.recording} is a map, which is shown as it is")


def _view_map(server: Any, path: Path) -> None:
    from torchelev.viz.channels import shown_channels
    from torchelev.viz.live import Snapshot

    saved = _read_map(path)
    page = _make_page(server, tuple(saved.layers), shown_channels(saved.config, saved.layers))
    page.draw(Snapshot(saved), f"{saved.resolution:g} m cells, {' x '.join(map(str, _shape(saved)))}")
    page.wait()


def _shape(saved: SavedMap) -> tuple[int, ...]:
    return next(iter(saved.layers.values())).shape


def _read_map(path: Path) -> SavedMap:
    """Read a file of `save_map`, of which the first environment counts, or of `save_npz`."""
    from torchelev.io.export import load_map, load_npz, take
    from torchelev.io.map_file import read_npz

    has_state = "header" in read_npz(path, "give a file of save_map or save_npz")
    return take(load_map(path)) if has_state else load_npz(path)
