"""The pictures of docs/gallery.md, on a transparent ground for light and dark pages.

    python -m docs.figures.gallery                     # all, about three minutes on two cores
    python -m docs.figures.gallery stairs fleet
    python -m docs.figures.gallery real_scan --recording FOLDER

Writes docs/pictures/gallery_NAME.webp. Needs pyvista (``pip install pyvista``). The real scan is not part of this
repository: without a recording, a folder of scans/, poses.txt and driven_path.txt, `real_scan` is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from docs.figures import gallery_drives as drives
from docs.figures import gallery_scenes as scenes
from docs.figures.view import View
from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.sight import MapSight
from training import RESULTS
from training.quadruped.play import play
from training.quadruped.policy import load_policy

PICTURES = Path(__file__).parents[1] / "pictures"
Shape = tuple[pv.DataSet, NDArray]  # a mesh and its colour


def draw_quadruped(out: Path) -> None:
    """Draw the quadruped that learned to walk with its map, after some steps up stairs."""
    cfg = QuadrupedConfig()
    policy = load_policy(RESULTS / "quadruped_policy.pt", cfg)
    play(policy, cfg, out, "stairs up", level=2, seconds=4.0, draw=take_snapshot, save=_draw_last)


def take_snapshot(task: Quadruped) -> tuple[NDArray, NDArray, list[Shape]]:
    """Return the cells' centres (H, W, 2) [m] and heights (H, W) [m] of the first robot's map, and its body."""
    assert isinstance(task.sight, MapSight)
    xy, heights = scenes.read(task.sight.emap)
    return xy.copy(), heights.copy(), read_body(task)


def read_body(task: Quadruped) -> list[Shape]:
    """Return the shapes of the first robot in the frame of its tile."""
    import mujoco  # after envs.offscreen, which chooses how it draws

    model = task.physics.models[0]
    data = mujoco.MjData(model)
    data.qpos[:] = task.physics.qpos[0].numpy()
    data.qpos[:2] -= task.physics.tile_origins[task.tile_ids[0].cpu()].numpy()
    mujoco.mj_forward(model, data)
    shapes = []
    for k in range(model.ngeom):
        kind = mujoco.mjtGeom(model.geom_type[k]).name
        if (mesh := _shape(kind, model.geom_size[k])) is None:
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = data.geom_xmat[k].reshape(3, 3), data.geom_xpos[k]
        shapes.append((mesh.transform(T, inplace=False), model.geom_rgba[k, :3].copy()))
    return shapes


def _shape(kind: str, size: NDArray) -> pv.PolyData | None:
    """Return a primitive of MuJoCo around the origin; None for the ground."""
    if kind == "mjGEOM_BOX":
        return pv.Cube(x_length=2 * size[0], y_length=2 * size[1], z_length=2 * size[2])
    if kind == "mjGEOM_CAPSULE":
        return pv.Capsule(radius=size[0], cylinder_length=2 * size[1], direction=(0, 0, 1))
    return pv.Sphere(radius=size[0]) if kind == "mjGEOM_SPHERE" else None


def _draw_last(snapshots: list[tuple[NDArray, NDArray, list[Shape]]], out: Path) -> None:
    """Draw the last one of some snapshots."""
    xy, heights, shapes = snapshots[-1]
    x, y, z = (float(v) for v in shapes[0][0].center)
    view = View((x + 0.9, y - 3.1, z + 1.6), (x + 0.1, y, z - 0.1))
    view.add_map(xy, heights)
    for mesh, color in shapes:
        view.add_solid(mesh, color)
    view.save(out)


SCENES: dict[str, Callable[[Path], None]] = {
    "stairs": scenes.draw_stairs,
    "quadruped": draw_quadruped,
    "batch": scenes.draw_batch,
    "fleet": drives.draw_fleet,
    "ceilings": scenes.draw_ceilings,
    "classes": scenes.draw_classes,
    "bag": drives.draw_bag,
}


@click.command(help=__doc__)
@click.argument("names", nargs=-1, type=click.Choice([*SCENES, "real_scan"]))
@click.option("--recording", type=click.Path(path_type=Path, exists=True), help="Of `real_scan`.")
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES, help="Output folder.")
def main(names: tuple[str, ...], recording: Path | None, out: Path) -> None:
    """Draw some pictures, or all."""
    for name in names or (*SCENES, "real_scan"):
        path = out / f"gallery_{name}.webp"
        if name != "real_scan":
            SCENES[name](path)
        elif recording is not None:
            drives.draw_real_scan(recording, path)
        else:
            click.echo("real_scan is left out: give --recording FOLDER")


if __name__ == "__main__":
    main()
