"""Two iterations of training, export, evaluation, and what is refused."""

import dataclasses
import json
import math

import pytest
import torch
from click.testing import CliRunner

from envs.quadruped import Quadruped
from envs.quadruped.config import TerrainConfig
from tests.envs.quadruped.cases import CFG
from torchelev.app.results import write_json
from torchelev.sim import terrain_grid
from training.quadruped import evaluate, play, policy, train
from training.resume import write_result


def small_task(held_out=False):
    return dataclasses.replace(CFG, episode_length=0.5)


def invoke(*options):
    return CliRunner().invoke(train.main, options, obj=small_task)


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Train for two iterations on small terrains."""
    out = tmp_path_factory.mktemp("quadruped")
    command = ["--num-envs", "4", "--iterations", "2", "--episodes", "4", "--no-compile", "--perception", "truth"]
    result = invoke(*command, "--out", str(out))
    assert result.exit_code == 0, result.output
    return out, result.output


@pytest.mark.slow(12)
def test_two_iterations_leave_result_policies_and_logs(small):
    out, printed = small
    result = json.loads((out / "result.json").read_text())
    assert result["training"]["steps"] == 2 * 24 * 4 and result["evaluation"]["episodes"] == 4
    assert set(result["evaluation"]["by_kind"]) == {"flat", "stairs down"}, "what the robot meets"
    assert {"policy.pt", "policy.onnx", "checkpoint.pt"} <= {path.name for path in out.iterdir()}
    assert list(out.glob("events.*")) and "speed by command" in printed


@pytest.mark.slow(3)
def test_a_policy_is_loaded_onto_the_scans_that_it_was_trained_with(small):
    out, _ = small
    loaded = policy.load_policy(out / "policy.pt", CFG)
    actions = loaded(Quadruped(CFG, 2, perception="map").observe())
    assert actions.shape == (2, 12) and actions.isfinite().all()


def test_a_policy_on_other_scans_is_refused_by_name(small):
    out, _ = small
    rings = dataclasses.replace(CFG, sight=dataclasses.replace(CFG.sight, rings=((0.1, 4),)))
    with pytest.raises(ValueError, match="feet.pattern: must have the points"):
        policy.load_policy(out / "policy.pt", rings)
    lower = dataclasses.replace(CFG, gait=dataclasses.replace(CFG.gait, body_height=0.25))
    with pytest.raises(ValueError, match="height_scan.nominal_height: must be 0.3"):
        policy.load_policy(out / "policy.pt", lower)


def test_the_onnx_file_holds_the_layout_too(small):
    onnx = pytest.importorskip("onnx")
    out, _ = small
    metadata = {prop.key: prop.value for prop in onnx.load(str(out / "policy.onnx")).metadata_props}
    assert json.loads(metadata[policy.LAYOUT])["groups"] == list(policy.GROUPS)


def test_a_policy_remembers_the_perception_of_its_training(small):
    onnx = pytest.importorskip("onnx")
    out, _ = small
    metadata = {prop.key: prop.value for prop in onnx.load(str(out / "policy.onnx")).metadata_props}
    stored = policy.load_policy(out / "policy.pt", CFG).perception
    assert stored == json.loads(metadata[policy.LAYOUT])["perception"] == "truth"


def _save(path, perception):
    """Write a policy of zeros, with the layout of its scans and perhaps a perception."""
    layout = policy.layout_of(CFG, perception)
    files = {policy.LAYOUT: json.dumps({name: value for name, value in layout.items() if value is not None})}
    network = torch.nn.Linear(293, 12)
    torch.nn.init.zeros_(network.weight), torch.nn.init.zeros_(network.bias)
    torch.jit.save(torch.jit.script(network), str(path), _extra_files=files)
    return path


def _play(path, *options):
    return invoke("--play", str(path), "--out", str(path.parent), *options)


@pytest.mark.slow(1)
@pytest.mark.parametrize("trained, walks", [("map", "map"), ("truth", "map"), ("blind", "blind")])
def test_a_film_shows_a_policy_with_what_it_sees(trained, walks, tmp_path):
    loaded, films = policy.load_policy(_save(tmp_path / "policy.pt", trained), CFG), []
    cfg = dataclasses.replace(CFG, episode_length=0.1)
    how = {"perception": loaded.perception, "draw": lambda task: task, "save": lambda *film: films.append(film)}
    play.play(loaded, cfg, tmp_path / "walk.webp", "stairs down", 1, **how)
    ((task, *_), path) = films[0]
    assert task.perception == walks and path == tmp_path / "walk.webp"
    assert task.cfg.terrain.kinds[int(task.kind)] == "stairs_up"


def test_a_policy_of_unknown_perception_is_not_filmed(tmp_path):
    result = _play(_save(tmp_path / "policy.pt", None))
    assert result.exit_code == 1 and "policy.pt: must hold the perception of its training, got none" in result.output


@pytest.mark.parametrize("kind", ["stairs_up", "up"])
def test_a_film_takes_the_names_of_what_a_robot_meets(kind, tmp_path):
    result = _play(_save(tmp_path / "policy.pt", "map"), "--kind", kind)
    assert result.exit_code == 1 and f"kind: must be one of flat, stairs down, got {kind}" in result.output


@pytest.mark.parametrize("name", ["policy.onnx", "checkpoint.pt", "cut.pt"])
def test_other_files_are_no_policies(small, name):
    out, _ = small
    (out / "cut.pt").write_bytes((out / "policy.pt").read_bytes()[:1000])
    result = _play(out / name)
    assert result.exit_code == 1 and isinstance(result.exception, SystemExit), result.exception
    assert f"{name}: must be a policy in TorchScript" in result.output and "give a policy.pt that" in result.output


def test_a_robot_climbs_the_stairs_that_are_called_up():
    terrain = TerrainConfig()
    grid = terrain_grid(terrain.kinds, 1)
    middle, rim = grid.field.heights[:, 100, 100], grid.field.heights[:, 100, 5]
    climb = dict(zip(terrain.labels, (rim - middle).tolist(), strict=True))
    assert climb["stairs up"] > 0.5 > -0.5 > climb["stairs down"] and climb["flat"] == 0


def test_a_checkpoint_of_another_perception_is_refused(small):
    out, _ = small
    command = ["--num-envs", "4", "--iterations", "3", "--no-compile", "--perception", "blind", "--resume"]
    result = invoke(*command, "--out", str(out))
    assert result.exit_code != 0 and "perception" in result.output


@pytest.mark.slow(2)
def test_training_resumes(small):
    out, _ = small
    command = ["--num-envs", "4", "--iterations", "3", "--episodes", "4", "--no-compile", "--perception", "truth"]
    result = invoke(*command, "--out", str(out), "--resume")
    assert result.exit_code == 0, result.output
    assert json.loads((out / "result.json").read_text())["training"]["steps"] == 3 * 24 * 4


def test_an_evaluation_counts_every_episode_once():
    cfg = dataclasses.replace(CFG, episode_length=0.2)
    result = evaluate.evaluate(evaluate.stand_in_trot, cfg, "blind", episodes=6)
    assert result["all"]["episodes"] == 6 and result["all"]["timed_out"] == 1.0
    assert sum(row["episodes"] for row in result["by_kind"].values()) == 6
    levels = [row["episodes"] for rows in result["by_level"].values() for row in rows.values()]
    assert sum(levels) == 6 and "| all |" in evaluate.table(result)


def test_the_speed_is_the_way_walked_by_the_way_asked():
    chosen = torch.tensor([True, True, True, False])
    walked, asked = torch.tensor([3.0, 1.0, -0.3, 7.0]), torch.tensor([4.0, 1.0, 0.0, 1.0])
    endings = torch.zeros(3, 4, dtype=torch.bool)
    assert evaluate._summarize(endings, walked, asked, chosen)["speed"] == pytest.approx(3.7 / 5)
    still = evaluate._summarize(endings, walked, asked, torch.tensor([False, False, True, False]))
    assert still["speed"] is None


def test_robots_that_are_asked_to_stand_have_no_speed(tmp_path):
    command = dataclasses.replace(CFG.command, standing=1.0)
    cfg = dataclasses.replace(CFG, episode_length=0.2, command=command)
    result = evaluate.evaluate(evaluate.stand_in_trot, cfg, "blind", episodes=2)
    assert result["all"]["speed"] is None and "| – |" in evaluate.table(result)


@pytest.mark.parametrize("write", [write_result, write_json])
def test_results_are_strict_json(tmp_path, write):
    write(tmp_path / "result.json", {"speed": math.nan, "rows": [{"a": math.inf}, (1.0, -math.inf)]})
    read = json.loads((tmp_path / "result.json").read_text(), parse_constant=pytest.fail)
    assert read["speed"] is None and read["rows"] == [{"a": None}, [1.0, None]]


def test_an_evaluation_reads_no_more_than_the_policy_does():
    seen = set()

    def spy(observation):
        seen.update(observation.keys())
        return evaluate.stand_in_trot(observation)

    evaluate.evaluate(spy, dataclasses.replace(CFG, episode_length=0.04), "blind", episodes=2)
    assert seen == set(policy.GROUPS)


def test_a_file_without_a_layout_is_refused(tmp_path):
    path = tmp_path / "other.pt"
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), str(path))
    with pytest.raises(ValueError, match="must hold the layout of its scans"):
        policy.load_policy(path, CFG)
