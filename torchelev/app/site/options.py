"""Options that several commands of `torchelev site` have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

origin_option = click.option(
    "--origin",
    type=float,
    nargs=2,
    default=(0.0, 0.0),
    show_default=True,
    metavar="E N",
    help="Easting and northing of the map frame's origin [m].",
)


def area_option(text: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Return the option of an area with this help."""
    return click.option("--area", type=float, nargs=4, metavar="X_MIN X_MAX Y_MIN Y_MAX", help=text)
