"""`torchelev site export`: write an area of a site to a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from torchelev.app.site.options import area_option, origin_option
from torchelev.app.user_error import user_errors

_HELP = """Write an area of a site to a file in the format of its suffix.

SITE is the folder of a site map. It may be open for writing elsewhere: what is
written is its last commit. OUT ends with .tif (a cloud-optimised GeoTIFF,
needs torchelev[geo]), .png (with a world file), .ply (a mesh) or .npz.

\b
  torchelev site export hill/ hill.tif
  torchelev site export hill/ hill.tif --layer elevation --layer variance \\
      --epsg 32632 --origin 465000 5247000
"""


@click.command("export", help=_HELP, short_help="Write an area of a site as .tif, .png, .ply or .npz.")
@click.argument("site")
@click.argument("out", type=click.Path(path_type=Path))
@click.option(
    "--layer",
    "layers",
    multiple=True,
    default=("elevation",),
    show_default=True,
    metavar="NAME",
    help="Layer or channel to write; repeat it.",
)
@area_option("Part to write [m], map frame.  [default: all that is known]")
@click.option("--epsg", type=int, metavar="CODE", help="Projected coordinate system, for .tif.")
@origin_option
@click.option("--version", metavar="ID", help="Id or tag of the version to write.  [default: the newest]")
def export_command(site: str, out: Path, layers: tuple[str, ...], version: str | None, **options: Any) -> None:
    """Run `torchelev site export`; its help text is `_HELP`."""
    from torchelev.site import SiteMap

    with user_errors(), SiteMap.open(site, version, read_only=True) as opened:
        opened.export(out, layers, **options)
    click.echo(f"wrote {out}")
