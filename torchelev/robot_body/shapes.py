"""The shapes that a robot consists of: capsules and boxes, each fixed to a link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from numbers import Real
from typing import Any

from torchelev.errors import require, require_positive


def _floats(name: str, value: Any, size: int, hint: str = "give metres") -> tuple[float, ...]:
    """Return finite numbers as a tuple of floats; ValueError for anything else."""
    values = tuple(value) if hasattr(value, "__iter__") and not isinstance(value, str) else (value,)
    numbers = all(isinstance(v, Real) and not isinstance(v, bool) and math.isfinite(v) for v in values)
    require(numbers and len(values) == size, name, f"must be {size} finite numbers", repr(value), hint)
    return tuple(float(v) for v in values)


def _require_link(name: str, link: object) -> None:
    fits = isinstance(link, str) and link != ""
    require(fits, name, "must be the name of a link", repr(link), "give the link that the shape is fixed to")


@dataclass(frozen=True, kw_only=True)
class Capsule:
    """A cylinder with half a sphere on each end. A sphere has `start` = `end`."""

    link: str  #: name of the link that the shape is fixed to
    start: tuple[float, float, float]  #: [m] one end of the axis, link frame
    end: tuple[float, float, float]  #: [m] the other end of the axis, link frame
    radius: float  #: [m]

    def __post_init__(self) -> None:
        _require_link("capsule.link", self.link)
        require_positive(**{"capsule.radius": self.radius})
        for name in ("start", "end"):
            object.__setattr__(self, name, _floats(f"capsule.{name}", getattr(self, name), 3))

    @property
    def length(self) -> float:
        """Length of the axis [m]."""
        return math.dist(self.start, self.end)


@dataclass(frozen=True, kw_only=True)
class Box:
    """A box that may be turned in its link's frame."""

    link: str  #: name of the link that the shape is fixed to
    center: tuple[float, float, float]  #: [m] centre of the box, link frame
    half_lengths: tuple[float, float, float]  #: [m] half the side lengths along the box's own x, y, z
    quat_wxyz: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  #: rotation of the box in the link frame

    def __post_init__(self) -> None:
        _require_link("box.link", self.link)
        for name in ("center", "half_lengths"):
            object.__setattr__(self, name, _floats(f"box.{name}", getattr(self, name), 3))
        quat_wxyz = _floats("box.quat_wxyz", self.quat_wxyz, 4, "give w, x, y, z")
        object.__setattr__(self, "quat_wxyz", quat_wxyz)
        hint = "give half the side lengths in metres"
        require(min(self.half_lengths) > 0, "box.half_lengths", "must be positive", self.half_lengths, hint)
        norm = math.hypot(*self.quat_wxyz)
        require(abs(norm - 1) < 1e-3, "box.quat_wxyz", "must have norm 1", f"{norm:.6g}", "divide it by its norm")


@dataclass(frozen=True, kw_only=True)
class RobotBody:
    """The robot's links as capsules and boxes: points on them are the robot's own and neither measure nor cast rays.

    A point lies on the robot if it, or a place up to `depth_tolerance` behind it on its ray, is in a shape that is
    `padding` larger on all sides. Depth noise moves points along their rays: what is measured too near has the shape
    behind it, and what is measured too far is still within the shape. The ground beside a foot stays in the map.

    Raises:
        TypeError: if the shapes are not capsules and boxes.
        ValueError: if there is no shape, or a number is out of range.
    """

    capsules: tuple[Capsule, ...] = ()  #: legs, for example, and feet as spheres
    boxes: tuple[Box, ...] = ()  #: the trunk, for example
    #: [m] margin around all shapes for errors of the mounting, joint encoders and shapes; a larger margin removes more
    #: points at the legs, and also more ground at the feet
    padding: float = 0.003
    #: [m] by which a point may be measured too near; default: three standard deviations of the default noise at 0.8 m;
    #: a larger tolerance removes more points between the sensor and a leg, but no ground
    depth_tolerance: float = 0.03

    def __post_init__(self) -> None:
        for name, kind in (("capsules", Capsule), ("boxes", Box)):
            shapes = getattr(self, name)
            fits = isinstance(shapes, tuple | list) and all(isinstance(shape, kind) for shape in shapes)
            hint = f"give ({kind.__name__}(...), ...)"
            rule = f"must be a tuple of torchelev.robot_body.{kind.__name__}"
            require(fits, f"body.{name}", rule, repr(shapes), hint, TypeError)
            object.__setattr__(self, name, tuple(shapes))
        has_shapes = bool(self.capsules or self.boxes)
        require(has_shapes, "body", "must have a capsule or a box", "none", "give shapes, or body=None for no body")
        for name in ("padding", "depth_tolerance"):
            value = getattr(self, name)
            fits = isinstance(value, Real) and not isinstance(value, bool) and 0 <= float(value) < math.inf
            require(fits, f"body.{name}", "must be finite and not negative", repr(value), "give metres, such as 0.003")

    @property
    def links(self) -> tuple[str, ...]:
        """Names of the K links, in the order of their poses `T_base_links`: that in which the shapes name them.

        Capsules come before boxes.
        """
        shapes: tuple[Capsule | Box, ...] = (*self.capsules, *self.boxes)
        return tuple(dict.fromkeys(shape.link for shape in shapes))
