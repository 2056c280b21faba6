"""A robot put down in MuJoCo: one rigid body, a box on four balls, on a tile of terrain."""

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

SECONDS, TIMESTEP = 1.5, 0.002
SAMPLES = 0.02  # [m] between the height field's samples
GAP = 0.0005  # [m] under a foot before it is let go
BOX = 0.15  # [body lengths] height of the body
MASS = 30.0  # [kg]
MOST_MOVED = 0.07  # [body lengths]
MOST_TILTED = 0.1  # [rad]

MODEL = """
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
    """A robot before it is let go, in the tile's frame."""

    position: Float[Tensor, 3]  # [m] the middle of the body's belly
    rotation: Float[Tensor, "3 3"]
    balls: Float[Tensor, "4 3"]  # [m] the feet's middles


class Outcome(NamedTuple):
    """What became of a robot."""

    moved: float  # [m]
    tilted: float  # [rad]
    touched: bool  # the body did

    def stood(self, robot: RobotConfig) -> bool:
        """Tell whether it hardly moved, on nothing but its feet."""
        still = self.moved <= MOST_MOVED * robot.length and self.tilted <= MOST_TILTED
        return still and not self.touched


def rest_heights(
    field: HeightField, tile: int, xy: Float[Tensor, "P 2"], radius: float, points: int = 10
) -> Float[Tensor, P]:
    """Return the heights [m] of the middles of balls that touch the ground from above at places xy [m]."""
    k = torch.arange(-points, points + 1) / points
    around = torch.cartesian_prod(k, k)
    under = (1 - around.square().sum(1)).clamp(min=0).sqrt()
    around, under = around[under > 0] * radius, under[under > 0] * radius
    z = field.height(torch.tensor([tile]), (xy[:, None] + around).reshape(1, -1, 2)).view(len(xy), -1)
    return (z + under).amax(1)


def on_footholds(field: HeightField, tile: int, feet: Tensor, xy: Tensor, theta: float, robot: RobotConfig) -> Posture:
    """Return the posture with feet (4, 3) on their footholds, as a controller would set them."""
    z = rest_heights(field, tile, feet[:, :2], robot.foot_radius) + GAP
    balls = torch.cat([feet[:, :2], z[:, None]], 1)
    return _posture(balls, *_plane(balls), xy, theta, robot)


def on_nominal_places(field: HeightField, tile: int, xy: Tensor, theta: float, robot: RobotConfig) -> Posture:
    """Return the posture with feet under the body's corners, each stretched towards the ground there.

    The body is no steeper than max_slope, and no foot is more than half a step height off its plane; all is lifted
    until no foot is in the ground.
    """
    places = corners(xy[None], torch.tensor([theta]), robot)[0]
    z = rest_heights(field, tile, places, robot.foot_radius) + GAP
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
    """Return the posture whose body is parallel to a plane through the balls' middles."""
    ahead = torch.tensor([math.cos(theta), math.sin(theta)])
    normal = torch.cat([-gradient, torch.ones(1)]) / (1 + gradient.square().sum()).sqrt()
    x = torch.cat([ahead, (gradient @ ahead)[None]])
    x = x / x.norm()
    ground = middle[2] + gradient @ (xy - middle[:2]) - robot.foot_radius / normal[2]
    position = torch.cat([xy, (ground + robot.clearance)[None]])
    return Posture(position, torch.stack([x, torch.linalg.cross(normal, x), normal], 1), balls)


def legs_clear(field: HeightField, tile: int, posture: Posture, robot: RobotConfig) -> bool:
    """Tell whether straight legs from the body's corners to the feet keep out of the ground."""
    half = torch.tensor([robot.length / 2, robot.width / 2])
    hips = posture.position + torch.cat([torch.tensor(CORNERS) * half, torch.zeros(4, 1)], 1) @ posture.rotation.t()
    share = torch.linspace(0, 1, 12)[:, None, None]
    legs = (hips + share * (posture.balls - hips)).view(1, -1, 3)
    return bool((field.height(torch.tensor([tile]), legs[..., :2]) <= legs[..., 2]).all())


def drop(field: HeightField, tile: int, posture: Posture, robot: RobotConfig, friction: float) -> Outcome:
    """Let a robot go and simulate it."""
    import mujoco

    model = _model(field, tile, posture, robot, friction)
    data = mujoco.MjData(model)
    data.qpos[:3] = posture.position.numpy()
    mujoco.mju_mat2Quat(data.qpos[3:], posture.rotation.double().numpy().ravel())
    body = model.geom("body").id
    for _ in range(round(SECONDS / TIMESTEP)):
        mujoco.mj_step(model, data)
        if (data.contact.geom == body).any():
            return Outcome(math.inf, math.inf, True)
    rotation = torch.from_numpy(data.body("robot").xmat.reshape(3, 3)).float()
    turned = ((rotation.t() @ posture.rotation).trace() - 1) / 2
    moved = np.linalg.norm(data.qpos[:3] - posture.position.numpy())
    return Outcome(float(moved), math.acos(max(-1.0, min(1.0, float(turned)))), False)


def _model(field: HeightField, tile: int, posture: Posture, robot: RobotConfig, friction: float) -> Any:
    """Build the MuJoCo model: the ground within reach and the robot, its feet where the posture has them."""
    import mujoco

    half = math.ceil((math.hypot(robot.length, robot.width) / 2 + robot.foot_reach + 0.3) / SAMPLES)
    i, j = (posture.position[:2] / SAMPLES).round()
    k = torch.arange(-half, half + 1)
    places = torch.stack(torch.meshgrid(i + k, j + k, indexing="ij"), -1) * SAMPLES
    z = field.height(torch.tensor([tile]), places.view(1, -1, 2)).view(len(k), len(k))
    lowest, height = float(z.min()), max(float(z.max() - z.min()), 1e-3)
    balls = ((posture.balls - posture.position) @ posture.rotation).tolist()
    foot = '<geom type="sphere" size="{0}" pos="{1} {2} {3}" mass="0.2" friction="{4}"/>'
    box = BOX * robot.length
    text = MODEL.format(
        timestep=TIMESTEP, friction=friction, mass=MASS, rows=len(k), columns=len(k), half_x=half * SAMPLES,
        half_y=half * SAMPLES, height=height, x=float(i) * SAMPLES, y=float(j) * SAMPLES, lowest=lowest,
        box=f"{robot.length / 2} {robot.width / 2} {box / 2}", box_middle=box / 2,
        feet="".join(foot.format(robot.foot_radius, *ball, friction) for ball in balls),
    )  # fmt: skip
    model = mujoco.MjModel.from_xml_string(text)
    model.hfield_data[:] = ((z - lowest) / height).t().flatten().numpy()  # rows along y, columns along x
    return model
