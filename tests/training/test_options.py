"""Options of several commands: each experiment keeps its trainings in a folder of its own."""

from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from training.options import jobs_option, paper_weights_option, runs_option


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
