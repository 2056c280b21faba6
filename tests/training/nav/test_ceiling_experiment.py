"""The comparison of what policies see of ceilings: its trainings, its deployment, its table and its figure."""

import dataclasses
import json

import pytest
import torch
from click.testing import CliRunner
from torch.utils.tensorboard import SummaryWriter

import training.nav.ceiling_experiment as experiment
import training.nav.train as nav
from envs.terrain_nav import CourseConfig
from tests.training.nav.runners import CFG, make_runner
from tests.training.nav.test_encoder_experiment import Answer
from torchelev.sim import CoversConfig
from training.nav.covered import covered_sight
from training.resume import CHECKPOINT

SEES = list(experiment.NAMES)


def result():
    """Success 0.5 and 0.7 without ceilings, 0.1 more with each further case; each third failure hits a box."""
    rows = []
    for sees, seed in experiment.CASES:
        success = 0.4 + 0.1 * SEES.index(sees) + 0.2 * seed
        ends = {"success": success, "fallen": 1 - success, "bumped": (1 - success) / 3, "stuck": 0.0, "truncated": 0.0}
        curve = {"steps": [100, 200], "success": [0.0, success]}
        training = {"steps": 6000, "seconds": 120.0}
        rows.append({"sees": sees, "seed": seed, "training": training, "deployed": ends, "curve": curve})
    line = {"success": 0.1, "fallen": 0.5, "bumped": 0.5, "stuck": 0.4, "truncated": 0.0}
    return {"config": {"seeds": list(experiment.SEEDS)}, "straight_line": line, "rows": rows}


def test_every_case_gets_the_same_training(tmp_path):
    jobs = experiment._jobs(tmp_path)
    assert len({job.folder for job in jobs}) == len(jobs) == len(SEES) * len(experiment.SEEDS)
    own = ("--ceilings", "--perception")
    others = [{name: value for name, value in job.arguments.items() if name not in own} for job in jobs]
    assert all(others.count(other) == len(SEES) for other in others)
    assert {(job.arguments["--perception"], job.arguments["--ceilings"]) for job in jobs} == {
        ("map", "none"), ("map", "scan"), ("map", "drop"), ("map", "voxels"), ("truth", "scan"),
    }  # fmt: skip


def test_the_table_has_the_mean_and_the_extremes():
    lines = experiment.table(result()).split("\n")
    assert lines[3] == "| ceiling scan | 60.0 % (50.0 to 70.0) | 13.3 % (10.0 to 16.7) | 0 % | 0 % | 2.0 |"
    assert lines[-1] == "| (a straight line) | 10 % | 50 % | 40 % | 0 % |  |" and len(lines) == 8


@pytest.mark.slow(1)
def test_the_figure_is_drawn(tmp_path):
    experiment.plot(result(), tmp_path / "ceilings.png")
    assert (tmp_path / "ceilings.png").stat().st_size > 5000


@pytest.mark.slow(1)
def test_each_policy_sees_what_it_was_trained_to_see(tmp_path):
    asked = []

    def evaluate(policy, cfg, perception, *rest, **options):
        asked.append((perception, cfg.sight.ceilings, cfg.course.seed, cfg.course.covers is not None))
        return {}

    for number, (sees, seed) in enumerate(experiment.CASES):
        folder = experiment._folder(tmp_path, sees, seed)
        folder.mkdir()
        torch.jit.script(Answer(number)).save(folder / "policy.pt")
        with SummaryWriter(str(folder)) as log:
            log.add_scalar("/success", 0.25, 3)
        (folder / "result.json").write_text(json.dumps({"training": {"steps": 1, "seconds": seed}}))
    assert len(experiment.deploy_all(tmp_path, evaluate)["rows"]) == len(experiment.CASES)
    *cases, line = asked
    assert cases == [(*experiment.options_of(sees), 1001, True) for sees, _ in experiment.CASES]
    assert line == ("blind", "none", 1001, True)


def small_task(held_out=False, fill="base", course="open", ceilings="none"):
    covers = CoversConfig() if course == "covered" else None
    small = CourseConfig(num_tiles=4, num_routes=16, covers=covers, distance=(3.0, 5.0))
    return dataclasses.replace(CFG, course=small, sight=covered_sight(fill, ceilings))


@pytest.mark.slow(4)
def test_trains_with_ceilings(tmp_path):
    arguments = ["--course", "covered", "--ceilings", "voxels", "--iterations", "1", "--num-envs", "4"]
    arguments += ["--episodes", "4", "--no-compile", "--out", str(tmp_path)]
    done = CliRunner().invoke(nav.main, arguments, obj=small_task, catch_exceptions=False)
    assert done.exit_code == 0 and (tmp_path / "policy.onnx").exists()
    found = json.loads((tmp_path / "result.json").read_text())["evaluation"]
    assert found["episodes"] == 4 and found["bumped"] <= found["fallen"]


@pytest.mark.slow(1)
def test_a_checkpoint_of_other_ceilings_is_refused(tmp_path):
    make_runner(tmp_path, "blind").learn(1)
    other = make_runner(None, "blind")
    other.cfg["course"] = "covered"
    with pytest.raises(ValueError, match="checkpoint: must be of course covered, got open"):
        other.resume(tmp_path / CHECKPOINT)
