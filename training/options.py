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


compile_option = click.option(
    "--compile/--no-compile", "compiled", default=True, show_default=True, help="Build updates ahead."
)


def smoke_option(**values: object) -> Callable[[Command], Command]:
    """Return the option --smoke, which gives other options small values in place of their defaults.

    Options that stand on the command line keep what they are given.

    Args:
        values: The small values, by the names of the command's parameters.
    """

    def use_small_values(context: click.Context, _: click.Parameter, is_smoke: bool) -> None:
        if is_smoke:
            context.default_map = {**(context.default_map or {}), **values}

    return click.option(
        "--smoke",
        is_flag=True,
        is_eager=True,  # before other options take their defaults
        expose_value=False,
        callback=use_small_values,
        help="Try the whole command in a minute or two: small values where an option is left out. No useful result.",
    )
