"""A map's picture in one line: `ElevationMap.save_png`."""

import dataclasses

import pytest

from tests.helpers import mapped
from torchelev import ElevationMap, FilterConfig
from torchelev.viz import map_picture


@pytest.fixture
def drawn(monkeypatch):
    """What is drawn: file, titles and values of the panels, extent."""
    found = {}

    def save_layers(path, panels, *, extent):
        found.update(path=path, panels={panel.title: panel.values for panel in panels}, extent=extent)

    monkeypatch.setattr(map_picture, "save_layers", save_layers)
    return found


def test_axes_are_metres_of_the_map_frame(drawn):
    emap = mapped(num_envs=2)
    emap.save_png("map.png", ("upper_bound", "elevation"), env=1)
    xy, half = emap.cell_centers()[1], emap.cfg.grid.resolution / 2
    (x0, y0), (x1, y1) = xy[0, 0].tolist(), xy[-1, -1].tolist()
    assert drawn["extent"] == pytest.approx((x0 - half, x1 + half, y0 - half, y1 + half))
    assert list(drawn["panels"]) == ["upper_bound", "elevation"]
    shown, expected = drawn["panels"]["elevation"], emap.layer("elevation")[1].numpy()
    assert ((shown == expected) | (expected != expected)).all()


def test_without_layers_it_draws_what_the_command_draws(drawn):
    emap = mapped(num_envs=1)
    cfg = dataclasses.replace(emap.cfg, filters=(FilterConfig(layer="filled", filter="inpaint_minimum"),))
    filtered = ElevationMap(cfg)
    filtered.load_state(emap.state)
    filtered.save_png("map.png")
    assert list(drawn["panels"]) == ["elevation", "standard deviation", "traversability", "upper bound", "filled"]


def test_a_picture_is_written_and_what_is_not_there_is_refused(tmp_path):
    emap = mapped(num_envs=1)
    emap.save_png(tmp_path / "map.png", ["elevation"])
    assert (tmp_path / "map.png").stat().st_size > 3000
    for layers in (["height"], [], "elevation"):
        with pytest.raises(ValueError, match="layers: must be names among elevation, .*give a list"):
            emap.save_png(tmp_path / "other.png", layers)
    with pytest.raises(ValueError, match="path: must end in .png"):
        emap.save_png(tmp_path / "other.svg")
    with pytest.raises(ValueError, match="env: must lie in"):
        emap.save_png(tmp_path / "other.png", env=1)
    assert not (tmp_path / "other.png").exists()
