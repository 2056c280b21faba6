"""Find the mesh that a URDF file names, in a format that MuJoCo reads."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

READABLE = (".stl", ".obj", ".msh")
_SUFFIXES = (".stl", ".STL", ".obj", ".OBJ")
_MAX_PARENTS = 6  # folders above the file in which packages are looked for


class MissingMeshError(Exception):
    """No such mesh was found; the message says where it was looked for."""


def find_mesh(name: str, folder: Path, mesh_folder: str = "") -> Path:
    """Return the path of a mesh.

    Args:
        name: as the URDF has it: a path, file://..., package://PACKAGE/... or $(find PACKAGE)/...
        folder: of the URDF file.
        mesh_folder: `meshdir` of MuJoCo's extension, or "".

    Raises:
        MissingMeshError: there is none, or only one in a format that MuJoCo does not read.
    """
    places = list(dict.fromkeys(_places(name.replace("\\", "/"), folder, mesh_folder)))
    for place in places:
        same = [place.with_suffix(suffix) for suffix in _SUFFIXES]
        for path in (place, *same) if place.suffix.lower() in READABLE else same:
            if path.is_file():
                return path
    found = [place for place in places if place.is_file()]
    if found:
        raise MissingMeshError(
            f"{name}: MuJoCo does not read {found[0].suffix}; convert it to {found[0].stem}.stl beside it"
        )
    shown = ", ".join(str(place) for place in places[:4])
    raise MissingMeshError(f"{name}: no such file; tried {shown}{' ...' if len(places) > 4 else ''}")


def read_mesh(path: Path) -> bytes:
    """Return a mesh as MuJoCo reads it: STL in text becomes binary."""
    content = path.read_bytes()
    if path.suffix.lower() != ".stl" or not content.lstrip().startswith(b"solid") or b"vertex" not in content:
        return content
    numbers = re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", content)
    faces = np.zeros(len(numbers) // 3, np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("attribute", "<u2")]))
    faces["v"] = np.array(numbers, dtype=np.float64)[: 3 * len(faces)].reshape(-1, 3, 3)
    return bytes(80) + np.uint32(len(faces)).tobytes() + faces.tobytes()


def _places(name: str, folder: Path, mesh_folder: str) -> Iterator[Path]:
    """Yield where a mesh may lie, likely places first."""
    folder = folder.resolve()
    parents = [folder, *folder.parents][:_MAX_PARENTS]
    match = re.match(r"(?:package://|model://|\$\(find(?:-pkg-share)? )([^/)]+)\)?/(.*)", name)
    if match:
        package, rest = match.groups()
        for parent in (*(p for p in parents if p.name == package), *(p / package for p in (*parents, *_ros_folders()))):
            yield parent / rest
    else:
        rest = name.removeprefix("file://")
    if Path(rest).is_absolute():
        yield Path(rest)
        rest = Path(rest).name
    yield from (parent / mesh_folder / rest for parent in parents[:1] if mesh_folder)
    yield from (parent / rest for parent in parents)
    yield from (parent / "meshes" / Path(rest).name for parent in parents[:3])


def _ros_folders() -> Iterator[Path]:
    """Yield the folders in which ROS finds packages."""
    yield from (Path(place) for place in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if place)
    for place in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if place:
            yield Path(place) / "share"
