"""The comparison of perceptions: its trainings, its tables and its figure."""

import json

import pytest
import torch
from torch.utils.tensorboard import SummaryWriter

from envs.quadruped.config import PERCEPTION
from training.quadruped import experiment, policy
from training.quadruped.evaluate import stand_in_trot

LEVELS = 2


def summary(crossed, speed=1.0):
    return {"crossed": crossed, "fallen": 1 - crossed, "timed out": 0.0, "speed": speed, "episodes": 8}


def evaluation(crossed):
    by_level = {
        kind: {str(level): summary(crossed / (1 + level)) for level in range(LEVELS)} for kind in experiment.KINDS
    }
    return {"all": summary(crossed), "by_kind": dict.fromkeys(experiment.KINDS, summary(crossed)), "by_level": by_level}


def deployment(crossed, walking=1.0):
    return {
        "deployed": evaluation(crossed),
        "walk": {"flat": summary(walking, 0.9), "rough": summary(walking - 0.25, 0.8)},
    }


def result():
    """Crossed 0.5 and 0.7 with the map, 0.4 and 0.6 with the truth, 0.3 and 0.5 blind."""
    rows = []
    for perception, seed in experiment.CASES:
        crossed = 0.5 - 0.1 * PERCEPTION.index(perception) + 0.2 * seed
        curve = {"steps": [100, 200], "level": [0.0, 5 * crossed], "crossed": [0.0, crossed]}
        row = {"perception": perception, "seed": seed, "training": {"steps": 6000, "seconds": 120.0}, "curve": curve}
        rows.append(row | deployment(crossed) | {"own": summary(crossed)})
    config = {"seeds": [0, 1], "levels": LEVELS, "difficulty": [0.0, 0.5]}
    return {"config": config, "rows": rows, "trot": deployment(0.25)}


def test_every_perception_gets_the_same_training(tmp_path):
    jobs = experiment._jobs(tmp_path)
    assert len({job.folder for job in jobs}) == len(jobs) == len(PERCEPTION) * len(experiment.SEEDS)
    others = [{name: value for name, value in job.arguments.items() if name != "--perception"} for job in jobs]
    assert all(others.count(other) == len(PERCEPTION) for other in others)


def test_the_long_walk_has_room_for_robots_faster_than_commanded():
    cfg = experiment.walk_config()
    commanded = cfg.command.forward[1] * cfg.episode_length
    assert cfg.command.forward == (0.5, 0.5) and cfg.terrain.length / 2 - cfg.terrain.rim - 0.3 > 1.5 * commanded


def test_a_walk_that_ends_at_the_rim_is_refused():
    def fake(policy, cfg, *rest, **options):
        return {"all": summary(1.0), "by_kind": {"flat": summary(0.0), "rough": summary(0.05 if rim else 0.0)}}

    rim = False
    assert set(experiment._deploy(None, "blind", fake)["walk"]) == {"flat", "rough"}
    rim = True
    with pytest.raises(ValueError, match=r"walk, rough: must end before the rim .* got 5 % crossed; .*walk_config"):
        experiment._deploy(None, "blind", fake)


def test_a_kept_result_is_made_anew_when_its_constants_or_its_policy_change(tmp_path):
    folder, made = tmp_path / "map-0", []
    folder.mkdir()
    weights = folder / "policy.pt"
    weights.write_bytes(b"one")

    def make():
        made.append(len(made))
        return {"number": made[-1]}

    def kept(settings=None):
        return experiment._load_or_make(folder / "deployed.json", make, weights, settings)["number"]

    assert [kept(), kept()] == [0, 0]
    weights.write_bytes(b"two")
    assert [kept(), kept()] == [1, 1]
    settings = experiment._settings()
    assert kept(settings) == 1 and {"walks", "episodes", "crossing", "walk"} < set(settings)
    settings["crossing"]["max_tilt"] = 0.9
    assert [kept(settings), kept(settings)] == [2, 2]
    (folder / "deployed.json").write_text('{"number": 9}')  # of a version that kept no more
    assert kept() == 3


def test_the_tables_have_the_mean_and_the_extremes():
    lines = experiment.table(result()).split("\n")
    assert lines[2].startswith("| map in the loop | 60.0 % (50.0 to 70.0) | 60 % | 60 % |")
    assert lines[5].startswith("| (the trot alone) | 25 % | 25 % |") and lines[5].endswith("| 75 % |  |")
    stairs = experiment.stairs_table(result()).split("\n")
    assert stairs[0] == "| crossed [%], by seed | 5.0 cm | 14.0 cm |" and len(stairs) == 2 + 2 * len(PERCEPTION)
    assert stairs[2] == "| stairs up: map in the loop | 50, 70 | 25, 35 |"
    assert stairs[-1] == "| stairs down: blind | 30, 50 | 15, 25 |"
    walked = experiment.walk_table(result()).split("\n")
    assert walked[4] == "| blind | 0.90 | 0.0 % | 0.80 | 25.0 % |" and len(walked) == 5


@pytest.mark.slow(2)
def test_the_figure_is_drawn_over_the_heights_of_stairs(tmp_path):
    figure = experiment.plot(result(), tmp_path / "quadruped.png")
    assert (tmp_path / "quadruped.png").stat().st_size > 5000
    panels = {axes.get_title(): axes for axes in figure.axes}
    for kind in ("stairs up", "stairs down"):
        assert panels[kind].get_xlabel() == "height of a stair [cm]"
        assert [label.get_text() for label in panels[kind].get_xticklabels()] == ["5", "14"]
    assert panels["boxes"].get_xlabel() == "level" and panels["rough"].get_ylabel() == "crossed, of 16"


def save_policy(path, number, perception):
    """Write a policy that answers a number."""
    layout = policy.layout_of(experiment.task_config(held_out=True), perception)
    network = torch.nn.Linear(1, 1)
    torch.nn.init.zeros_(network.weight), torch.nn.init.constant_(network.bias, number)
    torch.jit.save(torch.jit.script(network), str(path), _extra_files={policy.LAYOUT: json.dumps(layout)})


def write_log(folder, values):
    with SummaryWriter(str(folder)) as log:
        for step, value in enumerate(values):
            for name in ("level", "crossed"):
                log.add_scalar(f"/{name}", value, step)


def test_reads_every_policy_from_its_folder(tmp_path):
    deployed = []
    for number, (perception, seed) in enumerate(experiment.CASES):
        folder = experiment._folder(tmp_path, perception, seed)
        folder.mkdir()
        save_policy(folder / "policy.pt", number, perception)
        write_log(folder, [seed])
        (folder / "result.json").write_text(json.dumps({"training": {"steps": 1, "seconds": seed}}))

    def fake(policy, cfg, perception, *rest, **options):
        deployed.append((policy, perception))
        number = None if policy is stand_in_trot else round(policy.network(torch.zeros(1)).item())
        return {"all": [number, perception], "by_kind": {}}

    rows = experiment._deploy_all(tmp_path, fake)["rows"]
    sights = {"map": "map", "truth": "map", "blind": "blind"}
    for number, ((perception, seed), row) in enumerate(zip(experiment.CASES, rows, strict=True)):
        assert row["deployed"]["all"] == [number, sights[perception]] and row["own"] == [number, perception]
        assert row["curve"]["level"] == [seed] and row["training"]["seconds"] == seed
    assert len(deployed) == 2 * len(rows) + 2 + len(experiment.SEEDS), "twice each; those with the truth also with it"
    again = len(deployed)
    assert experiment._deploy_all(tmp_path, fake)["rows"] == rows and len(deployed) == again, "what is finished is kept"


def test_a_curve_averages_blocks_of_iterations(tmp_path):
    write_log(tmp_path, range(25))
    curve = experiment.read_curve(tmp_path)
    assert curve["level"] == [4.5, 14.5, 22.0]
    assert curve["steps"] == [n * 24 * experiment.NUM_ENVS for n in (10, 20, 25)]
