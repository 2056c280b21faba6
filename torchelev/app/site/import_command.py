"""`torchelev site import`: fuse a raster into a site as prior ground."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from torchelev.app.site.options import area_option, origin_option
from torchelev.app.user_error import user_errors

_HELP = """Fuse a raster, such as a terrain model, into a site as prior ground.

SITE is the folder of a site map; --resolution makes one where there is none.
RASTER is a GeoTIFF, an .npz of torchelev, or a bag with a GridMap. Heights
that robots measure override those of a raster of the default variance.

\b
  torchelev site import hill/ terrain.tif --origin 465000 5247000 --height 412
  torchelev site import hill/ terrain.tif --resolution 0.1 --variance 0.0025

All of it is stored or nothing. The same heights are taken once.
"""


@click.command("import", help=_HELP, short_help="Fuse a GeoTIFF, GridMap or .npz into a site as prior ground.")
@click.argument("site")
@click.argument("raster", type=click.Path(path_type=Path))
@click.option("--band", type=int, default=1, show_default=True, metavar="N", help="Number of the band.")
@click.option("--layer", metavar="NAME", help="Name of the band or layer, in place of --band.")
@click.option("--variance", type=float, metavar="M2", help="Variance of the heights [m^2].  [default: 0.09, of 0.3 m]")
@click.option("--epsg", type=int, metavar="CODE", help="Coordinate system that the file must have.")
@origin_option
@click.option(
    "--height",
    type=float,
    default=0.0,
    show_default=True,
    metavar="M",
    help="Height of the map frame's origin in the raster [m].",
)
@area_option("Part to take [m], map frame.  [default: all of it]")
@click.option(
    "--time",
    type=float,
    metavar="S",
    help="When it was surveyed, on the clock of the merges [s].  [default: the oldest time of the site]",
)
@click.option("--resolution", type=float, metavar="M", help="Cell size of a new site [m].")
def import_command(
    site: str,
    raster: Path,
    resolution: float | None,
    area: tuple[float, ...] | None,
    time: float | None,
    **options: Any,
) -> None:
    """Run `torchelev site import`; its help text is `_HELP`."""
    from torchelev.io.rasters import Raster
    from torchelev.site import SiteMap

    given = {name: value for name, value in options.items() if value is not None}
    with user_errors():
        source = Raster.open(raster, **given)  # before a site is made
        with SiteMap.open(site) if resolution is None else SiteMap(resolution, site) as opened:
            report = opened.import_raster(source, area=area, time=time)
    click.echo(f"{report.cells} cells of {raster}, of which {report.contradictions} contradict what was there")
