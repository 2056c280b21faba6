"""Read URDF files as robots ship them: only links, joints and shapes reach MuJoCo, and meshes are found before."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from torchelev.errors import require
from torchelev.io.models.meshes import MissingMeshError, find_mesh, read_mesh

_INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
_MUJOCO = '<mujoco><compiler discardvisual="false" fusestatic="false" strippath="false"/></mujoco>'
_JOINT_PARTS = ("parent", "child", "origin", "axis")
_HINT = "copy the meshes beside the model, or name other links with links=(...)"


def parse_urdf(path: Path) -> ET.Element | None:
    """Return the root of a URDF file; None if it is not one.

    Raises:
        ValueError: the file is xacro.
    """
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, UnicodeDecodeError):
        return None
    if root.tag != "robot":
        return None
    is_xacro = any("xacro" in tag for node in root.iter() for tag in (node.tag if isinstance(node.tag, str) else "",))
    has_terms = any("${" in value for node in root.iter() for value in node.attrib.values())
    hint = f"expand it first: xacro {path.name} > robot.urdf"
    require(not (is_xacro or has_terms), "source", "must be a URDF file, not its xacro", str(path), hint)
    return root


def load_urdf(path: Path, root: ET.Element, links: Iterable[str] | None) -> Any:
    """Return the MjModel of a URDF file, whose base is free.

    Shapes are those of <collision>, or of <visual> for links without one. Nothing else of a link or joint is kept.

    Args:
        path: of the file, beside which meshes are looked for.
        root: what `parse_urdf` returned.
        links: names of the links whose meshes must be there; None: all.

    Raises:
        ValueError: a mesh is missing, or MuJoCo cannot read the rest.
    """
    import mujoco

    meshes = _Meshes(path, root)
    wanted = None if links is None else set(links)
    robot = ET.Element("robot", name=root.get("name", "robot"))
    robot.append(ET.fromstring(_MUJOCO))
    without = [_add_link(robot, link, meshes, wanted) for link in root.findall("link")]
    for joint in root.findall("joint"):
        _add_joint(robot, joint)
    left_out = [text for texts in without for text in texts]
    if left_out:
        warnings.warn(f"{path}: shapes of these links are left out: {'; '.join(left_out)}; {_HINT}", stacklevel=4)
    spec = mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"), assets=meshes.contents)
    spec.compiler.fusestatic = False  # or MuJoCo fuses the base into the world
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # flat meshes have no volume
    for body in spec.worldbody.bodies:
        if not body.joints:
            body.add_freejoint()
    return spec.compile()


class _Meshes:
    """The meshes of a URDF file under names of their own."""

    def __init__(self, path: Path, root: ET.Element) -> None:
        compiler = root.find("mujoco/compiler")
        self.folder, self.mesh_folder = path.parent, "" if compiler is None else compiler.get("meshdir", "")
        self.contents: dict[str, bytes] = {}
        self._names: dict[tuple[str, str], str] = {}

    def add(self, mesh: ET.Element) -> None:
        """Let an element name its mesh as MuJoCo is given it; MissingMeshError if there is none."""
        key = mesh.get("filename", ""), mesh.get("scale", "")
        if key not in self._names:
            found = find_mesh(key[0], self.folder, self.mesh_folder)
            name = f"mesh{len(self._names)}{found.suffix.lower()}"
            self.contents[name], self._names[key] = read_mesh(found), name
        mesh.set("filename", self._names[key])


def _add_link(robot: ET.Element, link: ET.Element, meshes: _Meshes, wanted: set[str] | None) -> list[str]:
    """Add a link with its shapes; return which of them are missing."""
    name, missing = link.get("name", ""), []
    added = ET.SubElement(robot, "link", name=name)
    added.append(ET.fromstring(_INERTIAL))
    collisions = [shape for shape in link.findall("collision") if shape.find("geometry") is not None]
    for shape in collisions or link.findall("visual"):
        kept = ET.Element("collision")
        kept.extend(part for part in shape if part.tag in ("origin", "geometry"))
        try:
            for mesh in kept.iter("mesh"):
                meshes.add(mesh)
            added.append(kept)
        except MissingMeshError as error:
            is_needed = bool(collisions) and (wanted is None or name in wanted)
            require(not is_needed, "source", "must have the meshes of its links", f"{name}: {error}", _HINT)
            missing.append(f"{name} ({error})")
    return missing


def _add_joint(robot: ET.Element, joint: ET.Element) -> None:
    """Add a joint without limits, dynamics and the like. One that floats against another link turns instead."""
    kind, parent = joint.get("type", "fixed"), joint.find("parent")
    if kind == "floating" and parent is not None and parent.get("link") != "world":
        kind = "continuous"
    kind = {"revolute": "continuous"}.get(kind, kind)
    added = ET.SubElement(robot, "joint", name=joint.get("name", ""), type=kind)
    added.extend(part for part in joint if part.tag in _JOINT_PARTS)
