"""A sensor mounted on a robot: its ray pattern, its mounting, and the points it sees in many environments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, Protocol

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.inputs.checks import check_pose
from torchelev.robot_body.shapes import RobotBody
from torchelev.sim.boxes import Boxes
from torchelev.sim.sensors.body_casting import cast_at_body
from torchelev.sim.sensors.casting import cast, see, to_points
from torchelev.sim.terrains.heightfield import HeightField

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class Pattern(Protocol):
    """A ray pattern: DepthCamera, Lidar, NonRepetitiveLidar, or your own class with these two members."""

    @property
    def max_range(self) -> float:
        """Range beyond which nothing is hit [m]."""

    @property
    def directions(self) -> Tensor | Callable[[Tensor], Tensor]:
        """Unit vectors (M, 3) in the sensor frame, or a function that returns those of a step."""


class View(NamedTuple):
    """The points that a sensor sees."""

    points: Float[Tensor, "B M 3"]  #: [m] sensor frame, float32; NaN where nothing is hit, or nearer than `min_range`
    on_body: Bool[Tensor, "B M"]  #: the robot's own `body` was hit; also where that was nearer than `min_range`


class MountedSensor:
    """A sensor that is mounted on the robot of every environment.

    Args:
        pattern: The rays.
        T_base_sensor: The mounting (4, 4); see `torchelev.sim.mount`.
        min_range: Hits nearer than this are not returned, but block the ray [m].
        max_range: Range beyond which nothing is hit [m]. None: that of the pattern.

    Raises:
        ValueError: The mounting is not a rigid transform, or the ranges are not 0 <= min_range < max_range.
    """

    def __init__(
        self,
        pattern: Pattern,
        T_base_sensor: Float[Tensor, "4 4"],
        min_range: float = 0.0,
        max_range: float | None = None,
    ) -> None:
        check_pose("T_base_sensor", T_base_sensor, (4, 4), T_base_sensor.device, True)
        max_range = pattern.max_range if max_range is None else max_range
        fits, actual = 0 <= min_range < max_range < math.inf, (min_range, max_range)
        require(fits, "min_range, max_range", "must be finite, with 0 <= min < max", actual, "give metres")
        self.pattern, self.T_base_sensor, self.min_range, self.max_range = pattern, T_base_sensor, min_range, max_range
        self._fixed: dict[torch.device, tuple[Tensor, Tensor | None]] = {}

    def _on(self, device: torch.device) -> tuple[Tensor, Tensor | None]:
        """Return mounting and directions on a device, copied there once; None for directions that change by step."""
        if device not in self._fixed:
            rays = self.pattern.directions
            fixed = rays.to(device, torch.float32) if isinstance(rays, Tensor) else None
            self._fixed[device] = self.T_base_sensor.to(device), fixed
        return self._fixed[device]

    def T_map_sensor(
        self, T_map_base: Float[Tensor, "B 4 4"], T_base_sensor: Float[Tensor, "B 4 4"] | None = None
    ) -> Float[Tensor, "B 4 4"]:
        """Return the poses of the sensors; `T_base_sensor` replaces the mounting, with one for each environment."""
        mounting = self._on(T_map_base.device)[0] if T_base_sensor is None else T_base_sensor
        return T_map_base @ mounting.to(T_map_base.dtype)

    def directions(self, device: torch.device, step: int | Int[Tensor, "*B"] = 0) -> Float[Tensor, "*B M 3"]:
        """Return the unit vectors of the rays in the sensor frame, (M, 3) for a single step or a fixed pattern."""
        rays = self._on(device)[1]
        if rays is None:
            make = self.pattern.directions
            assert callable(make)
            step = step if isinstance(step, Tensor) else torch.full((), step, device=device)
            rays = make(step).float()
        return rays

    def __call__(
        self,
        field: HeightField,
        tile_ids: Int[Tensor, "B"],
        T_map_base: Float[Tensor, "B 4 4"],
        boxes: Boxes | None = None,
        *,
        legs: Boxes | None = None,
        step: int | Int[Tensor, "B"] = 0,
        T_base_sensor: Float[Tensor, "B 4 4"] | None = None,
        body: RobotBody | None = None,
        T_base_links: Float[Tensor, "B K 4 4"] | None = None,
    ) -> Float[Tensor, "B M 3"]:
        """Return the points seen [m], sensor frame, float32; NaN where nothing is hit, or nearer than `min_range`.

        Arguments and errors are those of `view`, which also returns the points on the robot's own body.
        """
        return self.view(
            field,
            tile_ids,
            T_map_base,
            boxes,
            legs=legs,
            step=step,
            T_base_sensor=T_base_sensor,
            body=body,
            T_base_links=T_base_links,
        ).points

    def view(
        self,
        field: HeightField,
        tile_ids: Int[Tensor, "B"],
        T_map_base: Float[Tensor, "B 4 4"],
        boxes: Boxes | None = None,
        *,
        legs: Boxes | None = None,
        step: int | Int[Tensor, "B"] = 0,
        T_base_sensor: Float[Tensor, "B 4 4"] | None = None,
        body: RobotBody | None = None,
        T_base_links: Float[Tensor, "B K 4 4"] | None = None,
    ) -> View:
        """Return the points seen, and which of them lie on the robot's own body.

        Args:
            field: Terrain tiles.
            tile_ids: The tile of each environment, int64.
            T_map_base: Poses of the robots; the map frame is that of the tile.
            boxes: Obstacles such as people and other robots, in the map frame.
            legs: Boxes of the robot itself, in the base frame: here `T_map_box` holds T_base_box.
            step: Step of a pattern that changes, one for all or one for each environment.
            T_base_sensor: True mountings, where they differ from the nominal one.
            body: Shapes of the robot itself, which hide what is behind them. They are not padded, and a shape that
                holds the sensor hides nothing from it, as cameras are built into housings.
            T_base_links: Poses of the body's links in the base frame, in the order of `body.links`.

        Raises:
            TypeError: An argument has the wrong dtype.
            ValueError: A shape does not fit, or, on a CPU, a pose is not rigid.
        """
        hint = "give both, or neither"
        require(
            body is not None or T_base_links is None, "T_base_links", "must be left out without body", "poses", hint
        )
        shape = (len(tile_ids), 4, 4)
        check_pose("T_map_base", T_map_base, shape, field.device, False)
        if T_base_sensor is not None:
            check_pose("T_base_sensor", T_base_sensor, shape, field.device, False)
        T = self.T_map_sensor(T_map_base, T_base_sensor).float()
        rays = self.directions(T.device, step)
        if legs is not None:
            boxes = legs.moved(T_map_base) if boxes is None else boxes.joined(legs.moved(T_map_base))
        if body is None and boxes is None:
            points = see(field, tile_ids, T, rays, self.min_range, self.max_range)
            return View(points, torch.zeros_like(points[..., 0], dtype=torch.bool))
        rays = rays.expand(len(T), -1, 3)
        distance = cast(field, tile_ids, T[:, :3, 3], rays @ T[:, :3, :3].mT, self.max_range, boxes)
        on_body = torch.zeros_like(distance, dtype=torch.bool)
        if body is not None:
            to_body = self._distance_to(body, T_base_links, rays, T_base_sensor)
            on_body = (to_body < distance) & (to_body <= self.max_range)
            distance = torch.where(on_body, to_body, distance)
        return View(to_points(rays, distance, self.min_range), on_body)

    def _distance_to(
        self, body: RobotBody, T_base_links: Tensor | None, rays: Tensor, T_base_sensor: Tensor | None
    ) -> Float[Tensor, "B M"]:
        """Return the distance [m] to the robot's body; inf where a ray does not hit it."""
        B, K, device = len(rays), len(body.links), rays.device
        rule = f"expected ({B}, {K}, 4, 4), the poses in the base frame of {', '.join(body.links)}"
        require(T_base_links is not None, "T_base_links", rule, "None", "compute them from the joint angles")
        T_base_links = check_pose("T_base_links", T_base_links, (B, K, 4, 4), device, False)
        T = self._on(device)[0].expand(B, 4, 4) if T_base_sensor is None else T_base_sensor
        return cast_at_body(body, T, T_base_links, rays)

    def depth(self, points: Float[Tensor, "B M 3"]) -> Float[Tensor, "B h w"]:
        """Return the points of a camera as depth images, along its viewing direction [m], NaN where there is no return.

        Raises:
            TypeError: The pattern is not an image.
        """
        h, w = getattr(self.pattern, "height", None), getattr(self.pattern, "width", None)
        is_image = isinstance(h, int) and isinstance(w, int)
        require(is_image, "pattern", "must be an image", type(self.pattern).__name__, "mount a DepthCamera", TypeError)
        return points[..., 0].unflatten(-1, (h, w))
