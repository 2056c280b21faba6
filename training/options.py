"""Options that several commands of the trainings take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

Command = TypeVar("Command", bound=Callable[..., Any])

jobs_option = click.option(
    "--jobs", default=2, show_default=True, help="Number of parallel processes, each on one core."
)
paper_weights_option = click.option(
    "--paper-weights",
    type=click.Path(path_type=Path, exists=True),
    default=None,
    help="The paper's filter (npz) to compare with.",
)


def runs_option(default: str) -> Callable[[Command], Command]:
    """Return the option --runs, the folder in which the trainings of an experiment are kept."""
    return click.option(
        "--runs",
        type=click.Path(path_type=Path),
        default=Path(default),
        show_default=True,
        help="Folder of the trainings.",
    )
