"""The term in mjlab itself, on a CPU: `make test-mjlab` runs this in an environment of its own."""

import dataclasses
from unittest.mock import Mock

import pytest
import torch

pytest.importorskip("mjlab", reason="needs mjlab: make test-mjlab")

from mjlab.envs import mdp
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
from mjlab.sensor import (
    CameraSensorCfg,
    ObjRef,
    PinholeCameraPatternCfg,
    RayCastSensorCfg,
    RingPatternCfg,
    TerrainHeightSensorCfg,
)

from benchmarks.quality import mjlab_task
from tests.docs.markdown import DOCS, code_blocks
from tests.integrations.examples import run_example
from torchelev import HeightScan, MapImage
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


class FootScan(MapObservation):
    """The height of each foot over the map, at the rays of the task's `foot_height_scan`."""

    read = HeightScan.feet(rings=((0.0, 1), (0.04, 4)))


@dataclasses.dataclass
class Stretched:
    """A pattern whose directions are no unit vectors."""

    def generate_rays(self, mj_model, device):
        starts, directions = PinholeCameraPatternCfg(8, 6, 58.0).generate_rays(mj_model, device)
        return starts, 2 * directions


@pytest.fixture(scope="module")
def many_frames():
    """Robots with eyes ahead and behind, and a sole below each foot, after 30 steps; what the terms read is noted."""
    cfg = mjlab_task.make_config(num_envs=4)
    ground, feet = {"include_geom_groups": (0,)}, cfg.scene.sensors[1].frame

    def add_eyes(spec):
        mjlab_task.add_camera(spec)
        quat = (0.6409, 0.2988, 0.2988, 0.6409)  # the same, turned by half a turn about z
        spec.body("robot/trunk").add_site(name="robot/rear_eye", pos=(-0.28, 0.0, 0.06), quat=quat)

    cfg.scene.spec_fn = add_eyes
    eyes = tuple(ObjRef(type="site", name=name, entity="robot") for name in ("eye", "rear_eye"))
    pinhole = PinholeCameraPatternCfg(width=48, height=36, fovy=58.0)
    cfg.scene.sensors += (
        RayCastSensorCfg(name="eyes", frame=eyes, pattern=pinhole, max_distance=4.0, **ground),
        TerrainHeightSensorCfg(
            name="soles", frame=feet, pattern=RingPatternCfg(rings=()), ray_alignment="world", **ground
        ),
        RayCastSensorCfg(name="stretched", frame=eyes[0], pattern=Stretched(), **ground),
        RayCastSensorCfg(name="inwards", frame=eyes[0], pattern=pinhole, include_geom_groups=(2, 3)),
    )
    both = {"sensor_name": ["eyes", "soles"], "standing_height": 0.3}
    params = {
        "eyes": (MapObservation, {"sensor_name": "eyes"}),
        "missed": (MapObservation, both | {"miss_value": 0.7}),
        "feet": (FootScan, both | {"feet_sensor_name": "foot_height_scan"}),
    }
    for name, (func, given) in params.items():
        cfg.observations[name] = ObservationGroupCfg(terms={"map": ObservationTermCfg(func=func, params=given)})
    env, generator, noted = mjlab_task.make_env(cfg), torch.Generator().manual_seed(0), []
    for _ in range(30):
        groups, *_ = env.step(0.3 * torch.randn(4, 12, generator=generator))
        ideal = {"feet": env.scene["foot_height_scan"].data.heights, "scan": mdp.height_scan(env, "terrain_scan")}
        noted.append(groups | {f"ideal_{name}": values.clone() for name, values in ideal.items()})
    yield (
        env,
        {name: torch.stack([step[name] for step in noted]) for name in noted[0] if name not in ("actor", "critic")},
    )
    env.close()


def test_each_frame_of_a_sensor_measures(many_frames):
    env, noted = many_frames
    term = mjlab_task.find_term(env, "eyes", "map")
    values, valid = term.read(term.emap, term.maps.source.read_base(env))
    ahead, behind = valid.view(4, 11, 17)[:, :, 12:], valid.view(4, 11, 17)[:, :, :5]
    assert ahead.float().mean() > 0.3 and behind.float().mean() > 0.3
    assert (5 * values - noted["ideal_scan"][-1])[valid].abs().median() < 1e-3


def test_the_height_of_the_feet_is_that_of_the_terrain_height_sensor(many_frames):
    ours, ideal = (many_frames[1][name] for name in ("feet", "ideal_feet"))
    assert ours.shape[1:] == (4, 20) and ideal.shape[1:] == (4, 4)
    lowest = ours.unflatten(-1, (4, 5)).amin(-1)
    error, of_other_feet = ((feet - ideal).abs() for feet in (lowest, lowest.flip(-1)))
    assert error.quantile(0.99) < 2e-3
    assert error.quantile(0.9) < 0.2 * of_other_feet.quantile(0.9)


def test_unknown_points_read_the_miss_value(many_frames):
    env, noted = many_frames
    term = mjlab_task.find_term(env, "missed", "map")
    _, valid = term.read(term.emap, term.maps.source.read_base(env))
    assert 0.1 < valid.float().mean() < 0.9
    torch.testing.assert_close(noted["missed"][-1][~valid], torch.full(((~valid).sum(),), 0.7 / 5))
    assert (noted["missed"][-1][valid] != 0.7 / 5).all()


@pytest.mark.parametrize(
    "name, words",
    [
        ("stretched", "the rays of 'stretched' must have unit vectors as directions, got lengths from 2 to 2"),
        ("inwards", r"'inwards' must see more than the robot itself, got geom groups \(2, 3\)"),
        ("foot_height_scan", "the rays of 'foot_height_scan' must start at one point"),
    ],
)
def test_refuses_patterns_and_groups_that_do_not_fit(many_frames, name, words):
    with pytest.raises(ValueError, match=f"sensor_name: {words}"):
        MapObservation(ObservationTermCfg(func=MapObservation, params={"sensor_name": name}), many_frames[0])


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
    with pytest.raises((ValueError, TypeError), match=words):
        MapObservation(ObservationTermCfg(func=MapObservation, params=params), env)


def test_the_example_runs(tmp_path):
    assert "observation (8, 187)" in run_example("mjlab_term", tmp_path)
