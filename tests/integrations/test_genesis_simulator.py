"""Maps in Genesis itself, on a CPU: `make test-genesis` runs this in an environment of its own."""

from types import SimpleNamespace

import pytest
import torch

pytest.importorskip("genesis", reason="needs genesis-world: make test-genesis")

from tests.docs.markdown import DOCS, code_blocks, run_blocks
from tests.integrations.box_on_plane import errors
from tests.integrations.examples import run_example
from tests.integrations.host import no_sync
from torchelev.integrations.genesis import GenesisMaps


@pytest.fixture(scope="module")
def page():
    """What the page's code made."""
    path = DOCS / "howto/genesis.md"
    return SimpleNamespace(
        **run_blocks(path, [one for one in code_blocks(path.read_text()) if one.language == "python"])
    )


@pytest.mark.parametrize("names", [("lidar",), ("camera",), ("lidar", "camera")])
def test_heights_are_those_of_the_scene_wherever_the_robot_is(page, names):
    maps = GenesisMaps(page.robot.links[0], [getattr(page, name) for name in names], page.cfg)
    for k in range(6):
        page.robot.set_pos(torch.tensor([[0.0, 0.0, 0.5], [0.1 * k, 0.0, 0.5 + 0.02 * k]]))
        page.scene.step()
        maps.update(0.02)
    assert maps.emap.center[1, 0] == pytest.approx(0.5, abs=0.03)
    for env in (0, 1):
        found = errors(maps, env)
        assert len(found) > 200 and found.quantile(0.99) < 2e-3


def test_misses_are_no_points(page):
    cloud = page.lidar.read()
    misses = (cloud.distances == 8.0).sum()
    assert misses > 500, "the sky"
    maps = GenesisMaps(page.robot.links[0], [page.lidar], page.cfg)
    maps.update(0.02)
    assert int(maps.emap.statistics.rejected_invalid.sum()) == int(misses)


def test_environments_begin_anew_by_themselves(page):
    assert page.maps.emap.layer("elevation")[0].isnan().all() and not page.maps.emap.layer("elevation")[1].isnan().all()
    page.maps.reset(mask=torch.tensor([False, True]))
    assert page.maps.emap.layer("elevation").isnan().all()


@pytest.mark.parametrize("options", [{"return_points": False}, {"return_world_frame": True}])
def test_sensors_that_do_not_fit_are_refused(page, options):
    usual = {"return_points": True, "return_world_frame": False}
    sensor = SimpleNamespace(_options=SimpleNamespace(**usual | options), _link=page.robot.links[0])
    with pytest.raises(ValueError, match="sensors: must return points in the sensor's frame, got return_points="):
        GenesisMaps(page.robot.links[0], [sensor])
    with pytest.raises(ValueError, match="sensors: must be on a link of a scene that is built"):
        GenesisMaps(page.robot.links[0], [SimpleNamespace(_options=None, _link=None)])
    with pytest.raises(ValueError, match="sensors: must not be empty"):
        GenesisMaps(page.robot.links[0], [])


def test_a_step_does_not_wait_for_the_device(page):
    maps = GenesisMaps(page.robot.links[0], [page.lidar, page.camera], page.cfg)
    maps.update(0.02)
    page.scan(maps.emap, maps.T_map_base)
    with no_sync():
        maps.update(0.02)
        page.scan(maps.emap, maps.T_map_base)
        maps.reset(mask=torch.tensor([True, False]))


def test_the_example_runs(tmp_path):
    assert "height scans (3, 187)" in run_example("genesis_maps", tmp_path)
