"""Draw the pictures of the reference: all layers of one scene, and a thumbnail of each filter.

python -m docs.reference_pictures
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, NamedTuple

import torch
from PIL import Image

from torchelev import ElevationMap, ElevationMapConfig, FilterConfig, GridConfig
from torchelev.filters import FILTERS
from torchelev.sim import DepthCamera, Scene, noisy, turn_on_the_spot
from torchelev.sim.exact.scenes import block, mixed, rough, steps
from torchelev.viz.palette import ERRORS
from torchelev.viz.picture import save_image
from torchelev.viz.plot import Panel, save_layers

PICTURES = Path(__file__).parent / "pictures"
LENGTH = 4.0  # [m] of the layers' window
SMALL_LENGTH = 2.8  # [m] of the thumbnails' window
HEIGHTS = dict(cmap="viridis", vmin=-0.08, vmax=0.42)  # [m]
COLORS = 64  # of a thumbnail


class Shown(NamedTuple):
    """How a filter is shown."""

    inputs: tuple[str, ...] | str = "elevation"
    colors: dict[str, Any] = HEIGHTS
    settings: dict[str, Any] = {}


def signed(limit: float) -> dict[str, Any]:
    """Return the colours of values around zero."""
    return dict(cmap=ERRORS, vmin=-limit, vmax=limit)


def positive(limit: float) -> dict[str, Any]:
    """Return the colours of values from zero on."""
    return dict(cmap="cividis", vmin=0.0, vmax=limit)


GEOMETRY = ("slope", "step_height", "roughness")
FILLED = "inpaint_diffusion"
# In an order in which each reads layers that stand before it.
SHOWN = {
    **{name: Shown() for name in FILTERS if name.startswith("inpaint")},
    **{f"em_cupy_{name}": Shown() for name in ("min_filter", "max_filter", "smooth_filter", "inpainting")},
    "em_cupy_erosion": Shown(FILLED),
    "fill_from": Shown(("elevation", "upper_bound")),
    **{name: Shown(FILLED) for name in ("gaussian", "box", "median", "dilation", "erosion", "opening", "closing")},
    "maximum": Shown(("inpaint_minimum", "inpaint_nearest")),
    "minimum": Shown(("inpaint_minimum", "inpaint_nearest")),
    **{name: Shown(FILLED) for name in ("smooth_ground", "virtual_floor")},
    "slope": Shown(colors=positive(1.2)),
    "normal_x": Shown(colors=signed(1.0)),
    "normal_y": Shown(colors=signed(1.0)),
    "normal_z": Shown(colors=positive(1.0)),
    "step_height": Shown(colors=positive(0.4)),
    "roughness": Shown(colors=positive(0.08)),
    "standard_deviation": Shown(colors=positive(0.15)),
    "curvature": Shown(colors=signed(10.0)),
    "traversability_three_part": Shown(GEOMETRY, positive(1.0)),
    "signed_distance": Shown(colors=signed(0.5), settings=dict(step=0.08, max_distance=0.5)),
    "foothold_score": Shown(("slope", "standard_deviation", "signed_distance"), positive(1.0)),
    "expression": Shown((), positive(1.0), dict(formula="where(foothold_score > 0.5, foothold_score, 0)")),
}
UNITS = {"elevation": "m", "variance": "m²", "time": "s", "upper_bound": "m"}


def playground() -> Scene:
    """Return rough ground with stairs, a block, a post, a thin wall and a gap: something for every filter."""
    climb = steps(0.523, -0.717, 0.683, count=4, rise=0.1, run=0.22)
    crate = block(-1.117, -0.643, 0.317, 0.883, 0.25)
    post = block(-0.563, -0.437, -0.783, -0.657, 0.3)
    wall = block(-0.257, 0.283, 0.917, 0.983, 0.35)
    gap = [block(-0.157, 0.077, -1.183, -0.857, 0.12), block(0.163, 0.397, -1.183, -0.857, 0.12)]
    ground = rough()
    boxes = (*climb, crate, post, wall, *gap)
    return Scene(name="playground", terrain=ground.terrain, steepness=ground.steepness, boxes=boxes)


def filter_chain() -> tuple[FilterConfig, ...]:
    """Return a layer of each filter, named after it; the map has layers of the normals' names already."""
    return tuple(
        FilterConfig(layer=name, filter=name, inputs=shown.inputs, settings=shown.settings)
        for name, shown in SHOWN.items()
        if not name.startswith("normal")
    )


def map_scene(scene: Scene, length: float, filters: tuple[FilterConfig, ...] = ()) -> ElevationMap:
    """Map a scene with a noisy depth camera that turns on the spot."""
    grid = GridConfig(resolution=0.04, length_x=length, length_y=length)
    emap = ElevationMap(ElevationMapConfig(grid=grid, filters=filters))
    camera, generator = DepthCamera(), torch.Generator().manual_seed(0)
    path = turn_on_the_spot(scene=scene)
    for T_map_sensor, T_map_base in zip(path.T_map_sensor, path.T_map_base, strict=True):
        points = noisy(camera.cast(scene, T_map_sensor), generator)
        emap.update(points[None], T_map_sensor[None], T_map_base[None], dt=0.1)
    return emap


def draw_layers(emap: ElevationMap, path: Path) -> None:
    """Draw the map's own layers."""
    colors = {name: signed(1.0) for name in ("normal_x", "normal_y")}
    panels = [
        Panel(title=name, values=emap.layer(name)[0].numpy(), unit=UNITS.get(name, ""), **colors.get(name, {}))
        for name in emap.layers
    ]
    half = LENGTH / 2
    save_layers(path, panels, extent=(-half, half, -half, half))


def draw_thumbnail(emap: ElevationMap, name: str, path: Path) -> None:
    """Draw the thumbnail of a layer."""
    picture = io.BytesIO()
    colors = SHOWN.get(name, Shown()).colors
    save_image(path, emap.layer(name)[0].numpy(), emap.cfg.grid.resolution, scale_bar=False, scale=3, **colors)
    with Image.open(path) as image:
        image.quantize(COLORS).save(picture, format="png", optimize=True)
    path.write_bytes(picture.getvalue())


def main() -> None:
    """Draw all pictures."""
    (PICTURES / "filters").mkdir(parents=True, exist_ok=True)
    draw_layers(map_scene(mixed(), LENGTH), PICTURES / "layers.png")
    emap = map_scene(playground(), SMALL_LENGTH, filter_chain())
    for name in ("elevation", *FILTERS):
        draw_thumbnail(emap, name, PICTURES / "filters" / f"{name}.png")


if __name__ == "__main__":
    main()
