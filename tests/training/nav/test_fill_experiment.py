"""The comparison of fills: its trainings, its deployment, its table and its figure."""

import dataclasses
import json
import shutil

import pytest
from click.testing import CliRunner

import training.nav.fill_experiment as experiment
import training.nav.train as nav
from envs.terrain_nav import SightConfig
from tests.training.nav.runners import CFG, make_runner
from training.nav.fill_experiment import FILLS
from training.resume import CHECKPOINT


def small_task(held_out=False, fill="base"):
    return dataclasses.replace(CFG, sight=SightConfig(fill=fill))


def result():
    """Success 0.5 to 0.9 with the nominal ground, 0.6 to 1.0 inpainted."""
    rows = []
    for fill, seed in experiment.cases(3):
        success = 0.5 + 0.1 * FILLS.index(fill) + 0.2 * seed
        deployed = {"success": success, "fallen": 1 - success, "stuck": 0.0, "truncated": 0.0}
        curve = {"steps": [100, 200], "success": [0.0, success]}
        training = {"steps": 6000, "seconds": 120.0}
        rows.append({"fill": fill, "seed": seed, "training": training, "deployed": deployed, "curve": curve})
    errors = {"base": 0.1, "inpaint": 0.08}
    return {"config": {"seeds": list(experiment.SEEDS)}, "unknown_error_m": errors, "rows": rows}


def test_every_fill_gets_the_same_training(tmp_path):
    jobs = experiment._jobs(tmp_path, 3)
    assert len({job.folder for job in jobs}) == len(jobs) == len(FILLS) * len(experiment.SEEDS)
    others = [{name: value for name, value in job.arguments.items() if name != "--fill"} for job in jobs]
    assert all(others.count(other) == len(FILLS) for other in others)


def test_the_table_has_the_mean_and_the_extremes():
    lines = experiment.table(result()).split("\n")
    expected = "| inpainted | 8.0 cm | 3 | 80.0 % (60.0 to 100.0) | 20.0 % | 0.0 % | 0.0 % | 2 |"
    assert lines[3] == expected and len(lines) == 4


@pytest.mark.slow(1)
def test_the_figure_is_drawn(tmp_path):
    experiment.plot(result(), tmp_path / "fill.png")
    assert (tmp_path / "fill.png").stat().st_size > 5000


@pytest.mark.slow(9)
def test_trains_two_iterations_and_deploys_with_each_fill(tmp_path):
    *others, job = experiment._jobs(tmp_path, 1)
    options = {**job.arguments, "--iterations": 2, "--num-envs": 4, "--episodes": 4, "--out": job.folder}
    arguments = [str(part) for option in options.items() for part in option]
    done = CliRunner().invoke(nav.main, [*arguments, "--no-compile"], obj=small_task, catch_exceptions=False)
    assert done.exit_code == 0 and job.folder.name == "inpaint-0"
    for other in others:  # their networks have the same inputs
        shutil.copytree(job.folder, other.folder)
    found = experiment.deploy_all(tmp_path, 1, small_task, num_envs=4, episodes=4, compiled=False)
    assert [row["fill"] for row in found["rows"]] == list(FILLS) and len(experiment.table(found).split("\n")) == 4
    assert all(row["training"]["steps"] == 2 * 24 * 4 and len(row["curve"]["steps"]) == 2 for row in found["rows"])
    assert len({round(error, 6) for error in found["unknown_error_m"].values()}) == len(FILLS)
    assert json.loads((tmp_path / "inpaint-0" / "result.json").read_text())["evaluation"]["episodes"] == 4


@pytest.mark.slow(1)
def test_a_checkpoint_of_another_fill_is_refused(tmp_path):
    make_runner(tmp_path, "blind").learn(1)
    other = make_runner(None, "blind")
    other.cfg["fill"] = "inpaint"
    with pytest.raises(ValueError, match="checkpoint: must be of fill inpaint, got base"):
        other.resume(tmp_path / CHECKPOINT)


@pytest.mark.slow(1)
def test_the_error_is_that_of_unknown_pixels():
    error = experiment.unknown_error(small_task(), num_envs=4)
    assert 0.01 < error < 0.5
