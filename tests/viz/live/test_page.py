"""The page without a browser: what it sends, and what a click says."""

import re
import socket
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tests.helpers import pose, seen_from, small_map
from torchelev import ChannelConfig
from torchelev.viz.live import Page, take_snapshot


def mapped_step():
    """A map of a step, 0.2 m high, that a sensor above sees, with a strip that it does not."""
    emap = small_map(cells=(20, 16))
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-0.99, 1, 0.02), np.arange(-0.79, 0.8, 0.02), indexing="ij"))
    seen = np.abs(y - 0.4) > 0.1
    ground = np.column_stack([x, y, 0.2 * (x > 0)])[seen]
    T = pose((0.0, 0.0, 2.0))
    for _ in range(3):
        emap.update(seen_from(T, ground), T, T, 0.1)
    return emap, T, ground


def mapped_channels():
    """The step in colours, classes and a number: red grass below, green stone above."""
    channels = {"rgb": "color", "terrain": ChannelConfig(kind="class", names=("grass", "stone")), "heat": "mean"}
    emap = small_map(cells=(20, 16), channels=channels)
    _, T, ground = mapped_step()
    upper = torch.tensor(ground[:, 0] > 0).float()[None]
    zero = torch.zeros_like(upper)
    features = {
        "rgb": torch.stack([1 - upper, upper, zero], -1),
        "terrain": torch.stack([1 - upper, upper], -1),
        "heat": upper,
    }
    for _ in range(3):
        emap.update(seen_from(T, ground), T, T, 0.1, features=features)
    return emap, T, features


@pytest.fixture
def page(port):
    page = Page("test", small_map().layers, num_envs=3, port=port)
    yield page
    page.stop()


def drawn(page):
    return set(page._scene._drawn)


def test_what_a_snapshot_has_is_drawn_and_what_it_lacks_is_removed(page):
    emap, T, _ = mapped_step()
    scan = np.zeros((4, 3))
    for _ in range(2):
        page.draw(take_snapshot(emap, T, T, scan=scan, plan=scan), "3 s")
    assert drawn(page) >= {"map", "base", "sensor 0", "policy's scan", "planned path", "path"}
    page.draw(take_snapshot(emap))
    assert drawn(page) - {"upper bound", "path"} == {"map"}


def test_parts_can_be_hidden_and_shown(page):
    emap, T, ground = mapped_step()
    page.draw(take_snapshot(emap, T, T, seen_from(T, ground)))
    assert "last cloud" not in drawn(page) and "base" in drawn(page)
    page._parts["last cloud"].value, page._parts["frames"].value = True, False
    page._parts["planes"].value = True
    assert {"last cloud", "planes"} <= drawn(page) and "base" not in drawn(page)


def test_boxes_appear_with_what_they_show(page):
    emap, T, _ = mapped_step()
    page.draw(take_snapshot(emap))
    visible = {name for name, box in page._parts.items() if box.visible}
    assert visible == {"upper bound", "planes"}
    page.draw(take_snapshot(emap, T, T, scan=np.zeros((4, 3))))
    assert {name for name, box in page._parts.items() if box.visible} == {*visible, "frames", "path", "policy's scan"}


def test_the_legend_follows_the_layer(page):
    emap, T, _ = mapped_step()
    page.draw(take_snapshot(emap, T, T))
    assert "elevation [m]" in page._legend.content
    page._layer.value = "standard deviation"
    assert "standard deviation [m]" in page._legend.content


def test_channels_colour_the_surface(port):
    """Colours and classes can be chosen as a whole, scalars by a colour map; a snapshot without them shows heights."""
    emap, T, features = mapped_channels()
    page = Page("test", emap.layers, port=port, channels=emap.cfg.channels)
    try:
        assert {"rgb", "terrain", "terrain.stone", "heat"} <= set(page._layer.options)
        seen = []
        page._scene.draw = lambda snapshot, colors, path, parts: seen.append(colors)
        page.draw(take_snapshot(emap, T, T, layers=emap.layers))
        for name, words in (("rgb", "rgb, as seen"), ("terrain", "most probable class"), ("heat", "heat")):
            page._layer.value = name
            assert words in page._legend.content
        rgb, terrain = seen[1], seen[2]
        assert rgb[2, 2].tolist() == [255, 0, 0, 255] and rgb[-3, 2].tolist() == [0, 255, 0, 255]
        assert (terrain[2, 2] != terrain[-3, 2]).any()
        page._layer.value = "rgb"
        asked = []
        page.on_change = lambda: asked.append(page.layer)
        page.draw(take_snapshot(emap, T, T))
        assert "elevation [m]" in page._legend.content
        page._layer.value = "traversability"
        page._layer.value = "terrain"
        assert asked == ["terrain"], "for a snapshot with it, as this one lacks it"
    finally:
        page.stop()


def test_a_click_says_the_values_of_the_cell(page):
    emap, T, _ = mapped_step()
    page.draw(take_snapshot(emap, T, T))
    click = SimpleNamespace(ray_origin=(0.55, -0.25, 3.0), ray_direction=(0.0, 0.0, -1.0))
    page._point_at(click)
    text = page._cell.content
    assert "Cell at (0.55 m, -0.25 m)" in text
    elevation = emap.sample(torch.tensor([[[0.55, -0.25]]]), mode="nearest")[0].item()
    assert float(re.search(r"elevation \| (\S+) m", text)[1]) == pytest.approx(elevation, abs=1e-3)
    page._point_at(SimpleNamespace(ray_origin=(9.0, 9.0, 3.0), ray_direction=(0.0, 0.0, -1.0)))
    assert "No known cell" in page._cell.content


def test_another_robot_is_asked_for(page):
    asked = []
    page.on_change = lambda: asked.append(page.env)
    page._env.value = 2
    assert asked == [2]


def test_a_taken_port_is_passed_by(port):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", port))
        taken.listen()
        page = Page("test", ("elevation",), port=port)
        assert page.url != f"http://localhost:{port}"
        page.stop()


def test_only_this_machine_can_connect_by_default(page):
    with socket.create_connection(("127.0.0.1", page.server.get_port()), timeout=5):
        pass
    others = socket.gethostbyname(socket.gethostname())
    if not others.startswith("127."):
        with pytest.raises(OSError):
            socket.create_connection((others, page.server.get_port()), timeout=2)
    assert page.server.get_host() == "127.0.0.1"


def test_a_port_must_be_one():
    with pytest.raises(ValueError, match=r"port: must lie in \[1, 65535\].*0"):
        Page("test", ("elevation",), port=0)
