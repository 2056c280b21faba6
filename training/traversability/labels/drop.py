"""A robot that is put down in MuJoCo: a rigid box on four balls on a tile of terrain."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.labels.stances import CORNERS, corners, plane_through

if TYPE_CHECKING:
    from jaxtyping import Float

_SECONDS, _TIMESTEP = 1.5, 0.002  # [s]
_SPACING = 0.02  # [m] between the samples of the height field
_GAP = 0.0005  # [m] under a foot before the robot is released
_BODY_HEIGHT = 0.15  # [body lengths]
_MASS = 30.0  # [kg]
_MAX_MOTION = 0.07  # [body lengths] of a robot that stood
_MAX_TILT = 0.1  # [rad] of a robot that stood

_MODEL = """
<mujoco>
  <option timestep="{timestep}" cone="elliptic" impratio="10"/>
  <asset><hfield name="ground" nrow="{rows}" ncol="{columns}" size="{half_x} {half_y} {height} 0.1"/></asset>
  <worldbody>
    <geom name="ground" type="hfield" hfield="ground" pos="{x} {y} {lowest}" friction="{friction}"/>
    <body name="robot">
      <freejoint/>
      <geom name="body" type="box" size="{box}" pos="0 0 {box_middle}" mass="{mass}" friction="{friction}"/>
      {feet}
    </body>
  </worldbody>
</mujoco>
"""


class Posture(NamedTuple):
    """The pose of a robot before it is released, in the tile's frame."""

    position: Float[Tensor, 3]  #: [m] middle of the body's underside
    rotation: Float[Tensor, "3 3"]
    balls: Float[Tensor, "4 3"]  #: [m] centers of the feet


class Outcome(NamedTuple):
    """How a robot moved after its release."""

    moved: float  #: [m]
    tilted: float  #: [rad]
    touched: bool  #: the body touched the ground

    def stood(self, robot: RobotConfig) -> bool:
        """Return whether the robot stayed in place, on its feet only."""
        still = self.moved <= _MAX_MOTION * robot.length and self.tilted <= _MAX_TILT
        return still and not self.touched


def rest_heights(
    field: HeightField, tile: int, xy: Float[Tensor, "P 2"], radius: float, points: int = 10
) -> Float[Tensor, "P"]:
    """Return the heights [m] of the centers of balls that rest on the ground at places xy [m]."""
    k = torch.arange(-points, points + 1) / points
    offset = torch.cartesian_prod(k, k)
    depth = (1 - offset.square().sum(1)).clamp(min=0).sqrt()  # of the ball's underside below its center
    offset, depth = offset[depth > 0] * radius, depth[depth > 0] * radius
    z = field.height(torch.tensor([tile]), (xy[:, None] + offset).reshape(1, -1, 2)).view(len(xy), -1)
    return (z + depth).amax(1)


def on_footholds(field: HeightField, tile: int, feet: Tensor, xy: Tensor, theta: float, robot: RobotConfig) -> Posture:
    """Return the posture with the feet on their footholds `feet` (4, 3) [m], where a controller would place them."""
    z = rest_heights(field, tile, feet[:, :2], robot.foot_radius) + _GAP
    balls = torch.cat([feet[:, :2], z[:, None]], 1)
    return _posture(balls, *_plane(balls), xy, theta, robot)


def on_nominal_places(field: HeightField, tile: int, xy: Tensor, theta: float, robot: RobotConfig) -> Posture:
    """Return the posture with the feet under the body's corners, each extended towards the ground.

    The body is at most max_slope steep, and a foot is at most half a step height off the body's plane. The robot is
    lifted until no foot is in the ground.
    """
    places = corners(xy[None], torch.tensor([theta]), robot)[0]
    z = rest_heights(field, tile, places, robot.foot_radius) + _GAP
    middle, gradient = _plane(torch.cat([places, z[:, None]], 1))
    gradient = gradient * (math.tan(robot.max_slope) / gradient.norm().clamp(min=1e-6)).clamp(max=1)
    plane = middle[2] + (places - middle[:2]) @ gradient
    feet = plane + (z - plane).clamp(-robot.step_height / 2, robot.step_height / 2)
    lift = (z - feet).amax().clamp(min=0)
    middle = middle + lift * torch.tensor([0.0, 0.0, 1.0])
    return _posture(torch.cat([places, (feet + lift)[:, None]], 1), middle, gradient, xy, theta, robot)


def _plane(points: Tensor) -> tuple[Tensor, Tensor]:
    plane = plane_through(points[None])
    return plane.middle[:, 0], plane.gradient[:, 0]


def _posture(balls: Tensor, middle: Tensor, gradient: Tensor, xy: Tensor, theta: float, robot: RobotConfig) -> Posture:
    """Return the posture whose body is parallel to a plane through the centers of the balls."""
    ahead = torch.tensor([math.cos(theta), math.sin(theta)])
    normal = torch.cat([-gradient, torch.ones(1)]) / (1 + gradient.square().sum()).sqrt()
    x = torch.cat([ahead, (gradient @ ahead)[None]])
    x = x / x.norm()
    ground = middle[2] + gradient @ (xy - middle[:2]) - robot.foot_radius / normal[2]
    position = torch.cat([xy, (ground + robot.clearance)[None]])
    return Posture(position, torch.stack([x, torch.linalg.cross(normal, x), normal], 1), balls)


def has_clear_legs(field: HeightField, tile: int, posture: Posture, robot: RobotConfig) -> bool:
    """Return whether straight legs from the body's corners to the feet stay above the ground."""
    half = torch.tensor([robot.length / 2, robot.width / 2])
    hips = posture.position + torch.cat([torch.tensor(CORNERS) * half, torch.zeros(4, 1)], 1) @ posture.rotation.t()
    fraction = torch.linspace(0, 1, 12)[:, None, None]
    legs = (hips + fraction * (posture.balls - hips)).view(1, -1, 3)
    return bool((field.height(torch.tensor([tile]), legs[..., :2]) <= legs[..., 2]).all())


def drop(field: HeightField, tile: int, posture: Posture, robot: RobotConfig, friction: float) -> Outcome:
    """Release a robot and simulate it for 1.5 s."""
    import mujoco

    model = _model(field, tile, posture, robot, friction)
    data = mujoco.MjData(model)
    data.qpos[:3] = posture.position.numpy()
    mujoco.mju_mat2Quat(data.qpos[3:], posture.rotation.double().numpy().ravel())
    body = model.geom("body").id
    for _ in range(round(_SECONDS / _TIMESTEP)):
        mujoco.mj_step(model, data)
        if (data.contact.geom == body).any():
            return Outcome(math.inf, math.inf, True)
    rotation = torch.from_numpy(data.body("robot").xmat.reshape(3, 3)).float()
    cos_tilt = ((rotation.t() @ posture.rotation).trace() - 1) / 2
    moved = np.linalg.norm(data.qpos[:3] - posture.position.numpy())
    return Outcome(float(moved), math.acos(max(-1.0, min(1.0, float(cos_tilt)))), False)


def _model(field: HeightField, tile: int, posture: Posture, robot: RobotConfig, friction: float) -> Any:
    """Build the MuJoCo model of the ground within reach and the robot in its posture."""
    import mujoco

    half = math.ceil((math.hypot(robot.length, robot.width) / 2 + robot.foot_reach + 0.3) / _SPACING)
    i, j = (posture.position[:2] / _SPACING).round()
    k = torch.arange(-half, half + 1)
    places = torch.stack(torch.meshgrid(i + k, j + k, indexing="ij"), -1) * _SPACING
    z = field.height(torch.tensor([tile]), places.view(1, -1, 2)).view(len(k), len(k))
    lowest, height = float(z.min()), max(float(z.max() - z.min()), 1e-3)
    balls = ((posture.balls - posture.position) @ posture.rotation).tolist()
    foot = '<geom type="sphere" size="{0}" pos="{1} {2} {3}" mass="0.2" friction="{4}"/>'
    box = _BODY_HEIGHT * robot.length
    text = _MODEL.format(
        timestep=_TIMESTEP, friction=friction, mass=_MASS, rows=len(k), columns=len(k), half_x=half * _SPACING,
        half_y=half * _SPACING, height=height, x=float(i) * _SPACING, y=float(j) * _SPACING, lowest=lowest,
        box=f"{robot.length / 2} {robot.width / 2} {box / 2}", box_middle=box / 2,
        feet="".join(foot.format(robot.foot_radius, *ball, friction) for ball in balls),
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(text)
    model.hfield_data[:] = ((z - lowest) / height).t().flatten().numpy()  # rows along y, columns along x
    return model
