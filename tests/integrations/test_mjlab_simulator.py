"""The term in mjlab itself, on a CPU: `make test-mjlab` runs this in an environment of its own."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch

pytest.importorskip("mjlab", reason="needs mjlab: make test-mjlab")

from benchmarks.quality import mjlab_task
from tests.docs.markdown import DOCS, code_blocks
from torchelev import MapImage
from torchelev.integrations.mjlab import MapObservation


@pytest.fixture(scope="module")
def env():
    env = mjlab_task.make_env(mjlab_task.make_config(num_envs=16))
    yield env
    env.close()


@pytest.fixture(scope="module")
def walked(env):
    return mjlab_task.walk(env, steps=50)


def test_the_policy_reads_the_scan(walked):
    assert walked["observed"].shape == (50, 16, 187)
    torch.testing.assert_close(walked["observed"], walked["ours"] / 5)


def test_the_scan_is_mjlab_s_own_on_level_visible_ground(walked):
    """The rays are exact: what is left are the 2 cm that level ground may differ from one point to the next."""
    found = mjlab_task.compare(walked)
    assert found["valid"] > 0.1 and found["level"]["points"] > 10_000
    assert found["level"]["p50"] < 0.001 and found["level"]["p99"] < mjlab_task.LEVEL


def test_an_order_or_sign_that_differs_would_be_seen(walked):
    error, grid = mjlab_task.compare(walked)["all"]["p90"], walked["ours"].unflatten(-1, (11, 17))
    for wrong in (grid.flip(-1), grid.flip(-2), -grid, grid.flatten(-2).unflatten(-1, (17, 11)).mT):
        assert mjlab_task.compare({**walked, "ours": wrong.flatten(-2)})["all"]["p90"] > 5 * error


def test_a_step_later_the_observation_is_as_it_was(env):
    before = env.observation_manager.compute()["actor"]
    copy = before.clone()
    env.step(torch.zeros(16, 12))
    torch.testing.assert_close(before, copy, rtol=0, atol=0)


def test_a_reset_forgets_the_maps_of_the_environments_that_began(env):
    maps = mjlab_task.find_term(env).emap
    known = maps.layer("validity").sum((1, 2))
    env.reset(env_ids=torch.tensor([2, 5]))
    again = maps.layer("validity").sum((1, 2))
    kept = [k for k in range(16) if k not in (2, 5)]
    assert (again[kept] == known[kept]).all()
    assert (again[[2, 5]] != known[[2, 5]]).all() and (again > 0).all()


def test_learns_for_an_iteration(env):
    losses = mjlab_task.train_once(env)
    assert losses and all(torch.tensor(value).isfinite() for value in losses.values())


class Picture(MapObservation):
    """The map as an image, from a rendered depth image."""

    read = MapImage(length_x=1.6, length_y=1.6, resolution=0.1, layers=("elevation", "validity"))


def test_a_rendered_depth_image_shows_what_the_rays_show():
    from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
    from mjlab.sensor import CameraSensorCfg

    cfg = mjlab_task.make_config(num_envs=2)
    camera = {"parent_body": "robot/trunk", "pos": (0.28, 0.0, 0.06), "quat": (0.6409, 0.2988, -0.2988, -0.6409)}
    image = {"fovy": 58.0, "width": 64, "height": 48, "data_types": ("depth",), "enabled_geom_groups": (0,)}
    cfg.scene.sensors += (CameraSensorCfg(name="rendered", **camera, **image),)
    for name in ("depth_camera", "rendered"):
        term = ObservationTermCfg(func=Picture, params={"sensor_name": name})
        cfg.observations[name] = ObservationGroupCfg(terms={"map": term})
    env = mjlab_task.make_env(cfg)
    groups, *_ = env.step(torch.zeros(2, 12))
    rays, rendered = groups["depth_camera"], groups["rendered"]
    assert rays.shape == rendered.shape == (2, 2, 16, 16)
    both = (rays[:, 1] > 0) & (rendered[:, 1] > 0)
    assert both.float().mean() > 0.1
    assert (rays - rendered)[:, 0][both].abs().median() < 0.005
    # The scan of the actor and the image of the rays read one map.
    actor, picture = mjlab_task.find_term(env), mjlab_task.find_term(env, "depth_camera", "map")
    assert actor.emap is picture.emap
    env.close()


def test_the_config_of_the_page_is_this_one():
    block = next(block for block in code_blocks((DOCS / "howto/mjlab.md").read_text()) if block.language == "python")
    names = {}
    exec(block.code, names)
    cfg, ours = names["cfg"], mjlab_task.make_config(num_envs=1)
    assert cfg.scene.sensors[-1] == ours.scene.sensors[-1]
    assert cfg.observations["actor"].terms["height_scan"] == ours.observations["actor"].terms["height_scan"]
    given, own = Mock(), Mock()
    names["add_camera"](given)
    mjlab_task.add_camera(own)
    assert given.mock_calls == own.mock_calls


def test_mjlab_s_training_script_takes_the_config(tmp_path):
    import mjlab
    import tyro
    from mjlab.scripts.train import TrainConfig
    from mjlab.tasks.velocity.config.go1.rl_cfg import unitree_go1_ppo_runner_cfg
    from mjlab.utils.os import dump_yaml

    cfg = mjlab_task.make_config(num_envs=2)
    given = tyro.cli(
        TrainConfig, args=[], default=TrainConfig(cfg, unitree_go1_ppo_runner_cfg()), config=mjlab.TYRO_FLAGS
    )
    assert given.env.observations["actor"].terms["height_scan"].func is MapObservation
    dump_yaml(tmp_path / "env.yaml", dataclasses.asdict(cfg))


@pytest.mark.parametrize(
    "params, words",
    [
        ({"sensor_name": "terrain_scan"}, "the rays of 'terrain_scan' must start at one point"),
        ({"sensor_name": "eye"}, "sensor_name: must be one of .*depth_camera.*, got 'eye'"),
        ({"sensor_name": "feet_ground_contact"}, "must be a RayCastSensor or a CameraSensor, got ContactSensor"),
    ],
)
def test_refuses_sensors_that_do_not_fit(env, params, words):
    from mjlab.managers import ObservationTermCfg

    with pytest.raises((ValueError, TypeError), match=words):
        MapObservation(ObservationTermCfg(func=MapObservation, params=params), env)
