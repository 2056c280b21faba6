"""A sensor on a robot: a pattern of rays, where it is mounted, and the points that it sees in many environments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import torch
from torch import Tensor

from torchelev.checks import check_pose
from torchelev.errors import require
from torchelev.sim.sensors.casting import Boxes, cast
from torchelev.sim.terrains.heightfield import HeightField

if TYPE_CHECKING:
    from jaxtyping import Float, Int


class Pattern(Protocol):
    """Rays in the sensor frame, as of DepthCamera, Lidar and NonRepetitiveLidar."""

    @property
    def max_range(self) -> float:
        """Range beyond which nothing is hit [m]."""

    @property
    def directions(self) -> Tensor | Callable[[Tensor], Tensor]:
        """Unit vectors (M, 3), or a function that returns those of a step."""


class MountedSensor:
    """A sensor mounted on the base of the robot of every environment.

    Args:
        pattern: the rays.
        T_base_sensor: (4, 4) the mounting; `torchelev.sim.mount` makes one.
        min_range: nearer hits are not returned, but block the ray [m].
        max_range: nothing is hit beyond [m]; None: the pattern's.

    Raises ValueError for a mounting that is no rigid transform and for ranges that are not 0 <= min < max.
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
        rule, hint = "must be 0 <= min < max, finite", "give metres"
        require(0 <= min_range < max_range < math.inf, "min_range, max_range", rule, (min_range, max_range), hint)
        self.pattern, self.T_base_sensor, self.min_range, self.max_range = pattern, T_base_sensor, min_range, max_range
        self._fixed: dict[torch.device, tuple[Tensor, Tensor | None]] = {}

    def _on(self, device: torch.device) -> tuple[Tensor, Tensor | None]:
        """Return mounting and directions, None if those change with the step; copied to a device once."""
        if device not in self._fixed:
            rays = self.pattern.directions
            fixed = rays.to(device, torch.float32) if isinstance(rays, Tensor) else None
            self._fixed[device] = self.T_base_sensor.to(device), fixed
        return self._fixed[device]

    def T_map_sensor(
        self, T_map_base: Float[Tensor, "B 4 4"], T_base_sensor: Float[Tensor, "B 4 4"] | None = None
    ) -> Float[Tensor, "B 4 4"]:
        """Return the sensors' poses. `T_base_sensor` takes the place of the mounting, for each environment its own."""
        mounting = self._on(T_map_base.device)[0] if T_base_sensor is None else T_base_sensor
        return T_map_base @ mounting.to(T_map_base.dtype)

    def directions(self, device: torch.device, step: int | Int[Tensor, "*B"] = 0) -> Float[Tensor, "*B M 3"]:
        """Return the rays' directions, sensor frame. One step or a fixed pattern gives (M, 3)."""
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
    ) -> Float[Tensor, "B M 3"]:
        """Return the points seen [m], sensor frame, float32, NaN where nothing was hit or nearer than `min_range`.

        Args:
            field: the terrain.
            tile_ids: the tile on which each environment stands.
            T_map_base: the robots; the map frame is that of the tile.
            boxes: people and other robots, in the map frame.
            legs: the robot's own, in the base frame: `T_map_box` is then T_base_box.
            step: which step of a pattern that changes, one for all or one per environment.
            T_base_sensor: the true mountings, where they differ from the one that everybody believes in.

        Raises ValueError or TypeError for shapes that do not fit and, on a CPU, for poses that are not rigid.
        """
        shape = (len(tile_ids), 4, 4)
        check_pose("T_map_base", T_map_base, shape, field.device, False)
        if T_base_sensor is not None:
            check_pose("T_base_sensor", T_base_sensor, shape, field.device, False)
        T = self.T_map_sensor(T_map_base, T_base_sensor).float()
        rays = self.directions(T.device, step).expand(len(T), -1, 3)
        if legs is not None:
            boxes = legs.moved(T_map_base) if boxes is None else boxes.joined(legs.moved(T_map_base))
        distance = cast(field, tile_ids, T[:, :3, 3], rays @ T[:, :3, :3].mT, self.max_range, boxes)
        returned = (distance >= self.min_range) & (distance < math.inf)
        return rays * distance.masked_fill(~returned, math.nan)[..., None]

    def depth(self, points: Float[Tensor, "B M 3"]) -> Float[Tensor, "B h w"]:
        """Return a camera's points as images of their depth along its viewing direction [m], NaN where there is none.

        Raises TypeError for a pattern that is no image.
        """
        h, w = getattr(self.pattern, "height", None), getattr(self.pattern, "width", None)
        image = isinstance(h, int) and isinstance(w, int)
        require(image, "pattern", "must be an image", type(self.pattern).__name__, "mount a DepthCamera", TypeError)
        return points[..., 0].unflatten(-1, (h, w))
