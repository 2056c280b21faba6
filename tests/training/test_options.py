"""Options of several commands: each experiment keeps its trainings in a folder of its own."""

import importlib
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from training.options import jobs_option, paper_weights_option, runs_option, smoke_option


@click.command()
@runs_option("runs/mine")
@jobs_option
@paper_weights_option
def command(runs, jobs, paper_weights):
    click.echo(repr((runs, jobs, paper_weights)))


def test_defaults_and_types(tmp_path):
    assert CliRunner().invoke(command).output.strip() == repr((Path("runs/mine"), 2, None))
    given = ["--runs", tmp_path, "--jobs", 3, "--paper-weights", tmp_path]
    assert CliRunner().invoke(command, list(map(str, given))).output.strip() == repr((tmp_path, 3, tmp_path))


def test_weights_that_do_not_exist_are_refused(tmp_path):
    result = CliRunner().invoke(command, ["--paper-weights", str(tmp_path / "none.npz")])
    assert result.exit_code == 2 and "does not exist" in result.output


def test_experiments_keep_their_trainings_apart():
    pytest.importorskip("rsl_rl")
    from training.nav import experiment as nav
    from training.traversability import experiment as traversability

    params = [*nav.main.params, *traversability.main.params]
    folders = [param.default for param in params if param.name == "runs"]
    assert folders == [Path("runs/nav_experiment"), Path("runs/traversability_experiment")]


@click.command()
@click.option("--steps", default=1000)
@smoke_option(steps=2, compiled=False)
@click.option("--compile/--no-compile", "compiled", default=True)
def training(steps, compiled):
    click.echo(f"{steps} {compiled}")


@pytest.mark.parametrize(
    "arguments, expected",
    [
        ([], "1000 True"),
        (["--smoke"], "2 False"),
        (["--steps", "5", "--smoke"], "5 False"),
        (["--smoke", "--compile"], "2 True"),
    ],
)
def test_a_smoke_run_takes_small_values_where_none_is_given(arguments, expected):
    assert CliRunner().invoke(training, arguments).output.strip() == expected


@pytest.mark.parametrize("name", ["nav", "quadruped", "traversability"])
def test_every_training_has_small_values_of_its_own_options(name):
    pytest.importorskip("rsl_rl")
    command = importlib.import_module(f"training.{name}.train").main
    defaults = command.make_context(name, []).params
    smoke = command.make_context(name, ["--smoke"])
    assert set(smoke.default_map) <= set(defaults)
    assert all(smoke.params[key] == value < defaults[key] for key, value in smoke.default_map.items())
