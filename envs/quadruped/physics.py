"""The physics of B quadrupeds: MuJoCo steps them on all cores, on one height field that holds all tiles."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

import envs.offscreen  # noqa: F401  (before MuJoCo)
from envs.quadruped.config import RandomConfig
from envs.quadruped.kinematics import FOOT_RADIUS, JOINTS, ROBOT
from torchelev.errors import require
from torchelev.sim import TerrainGrid

try:
    import mujoco
    from mujoco import rollout
except ImportError as error:
    raise ImportError("envs.quadruped: needs MuJoCo; install it with pip install 'torchelev[rl]'") from error

_DEPTH = 1.0  # [m] of solid ground below the lowest point
_START = 1.0  # [s] time of a placed robot: after a reset by MuJoCo, whose time begins at 0, it is never reached
_MAX_SAMPLES = 2**24  # of the height field: MuJoCo's models hold one copy for each body


class Sensed(NamedTuple):
    """The values of MuJoCo's sensors, in the world's frame, at the instant of `Physics.sensed_state`."""

    foot_velocities: Tensor  #: (B, 4, 3) [m/s] of their centres
    foot_turns: Tensor  #: (B, 4, 3) [rad/s] angular velocities
    foot_forces: Tensor  #: (B, 4) [N]
    torques: Tensor  #: (B, 12) [N m]
    touches: Tensor  #: (B, 13) number of contacts of each link, feet not counted

    @property
    def sole_velocities(self) -> Tensor:
        """Velocities (B, 4, 3) [m/s] of the feet's lowest points: 0 where a foot rolls without slipping."""
        x, y, _ = self.foot_turns.unbind(-1)
        zero = torch.zeros_like(x)
        return self.foot_velocities + FOOT_RADIUS * torch.stack([-y, x, zero], -1)


_SHAPES = ((4, 3), (4, 3), (4,), (12,), (13,))


class Physics(nn.Module):
    """B robots in MuJoCo, in float64 on the CPU.

    MuJoCo evaluates its sensors before it integrates: after a step, they belong to the state one physics step (5 ms)
    before the last. `sensed_state` is that state, for what is combined with sensors. After `place`, both are the same.

    Args:
        terrain: The tiles.
        num_envs: B.
        cfg: Domain randomisation.
        seed: Seed of the bodies.
        num_threads: Threads that step the robots; None: as many as torch uses.
        robot: A model with the joints and sensors of `robot.xml`.

    Raises:
        ValueError: The model lacks a joint or a sensor, or the tiles are too many for one height field.
    """

    state: Tensor
    sensed_state: Tensor
    diverged: Tensor
    sensors: Tensor
    targets: Tensor
    body_ids: Tensor

    def __init__(
        self,
        terrain: TerrainGrid,
        num_envs: int,
        cfg: RandomConfig,
        seed: int = 0,
        num_threads: int | None = None,
        robot: Path = ROBOT,
    ) -> None:
        super().__init__()
        heights, self.tile_origins = lay_out(terrain)
        model = build_model(robot, heights, terrain.field.resolution)
        self.models = [_randomized(model, cfg, np.random.default_rng([seed, k])) for k in range(cfg.num_bodies)]
        threads = num_threads or torch.get_num_threads()
        self._rollout = rollout.Rollout(nthread=threads)
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        widths = {"state": size, "sensed_state": size, "sensors": model.nsensordata, "targets": model.nu}
        for name, width in widths.items():
            self.register_buffer(name, torch.zeros(num_envs, width, dtype=torch.float64))
        self.register_buffer("diverged", torch.zeros(num_envs, dtype=torch.bool))
        self.register_buffer("body_ids", torch.zeros(num_envs, dtype=torch.int64))

    @property
    def qpos(self) -> Tensor:
        """Position, quaternion w x y z and joint angles (B, 19), a view of the state."""
        return self.state[:, 1:20]

    @property
    def qvel(self) -> Tensor:
        """Linear velocity in the world's frame, angular velocity in the base's, joint velocities (B, 18): a view."""
        return self.state[:, 20:38]

    @property
    def sensed_qpos(self) -> Tensor:
        """The same as `qpos`, at the instant of the sensors."""
        return self.sensed_state[:, 1:20]

    @property
    def sensed_qvel(self) -> Tensor:
        """The same as `qvel`, at the instant of the sensors."""
        return self.sensed_state[:, 20:38]

    def sensed(self) -> Sensed:
        """Return the sensors' values."""
        parts = self.sensors.split([int(np.prod(shape)) for shape in _SHAPES], -1)
        return Sensed(*(part.unflatten(-1, shape) for part, shape in zip(parts, _SHAPES, strict=True)))

    def step(self, targets: Tensor, latency: Tensor, num_steps: int) -> None:
        """Step all robots, and set `diverged` (B,) where a simulation has failed.

        Where a state is NaN, infinite or huge, MuJoCo resets the robot to the model's first pose and its time to 0.

        Args:
            targets: Joint angles (B, 12) [rad] to hold.
            latency: Number of physics steps (B,) for which the targets before still hold.
            num_steps: Number of physics steps.
        """
        late = torch.arange(num_steps)[:, None] < latency[:, None, None]
        control = torch.where(late, self.targets[:, None], targets[:, None])
        models = [self.models[k] for k in self.body_ids.tolist()]
        state, sensors = self._rollout.rollout(models, self._data, self.state.numpy(), control.numpy())
        last, timestep = torch.from_numpy(state[:, -1]), self.models[0].opt.timestep
        self.diverged.copy_((last[:, 0] - self.state[:, 0] - num_steps * timestep).abs() > 0.5 * timestep)
        self.sensed_state.copy_(torch.from_numpy(state[:, -2]) if num_steps > 1 else self.state)
        self.state.copy_(last)
        self.sensors.copy_(torch.from_numpy(sensors[:, -1]))
        self.sensors[:, -13:] = torch.from_numpy(sensors[:, :, -13:].max(1))  # any touch within the step
        self.targets.copy_(targets)

    def place(self, env_ids: list[int], qpos: Tensor, qvel: Tensor, body_ids: Tensor) -> None:
        """Put robots at a state: qpos (n, 19), qvel (n, 18), and one of the bodies (n,) for each."""
        self.body_ids[env_ids] = body_ids
        start = torch.full((len(env_ids), 1), _START)
        self.state[env_ids] = torch.cat([start, qpos, qvel], -1).to(torch.float64)
        self.sensed_state[env_ids] = self.state[env_ids]
        self.diverged[env_ids] = False
        self.targets[env_ids] = qpos[:, 7:].to(torch.float64)
        data = self._data[0]
        for index, body in zip(env_ids, body_ids.tolist(), strict=True):
            mujoco.mj_setState(self.models[body], data, self.state[index].numpy(), mujoco.mjtState.mjSTATE_FULLPHYSICS)
            mujoco.mj_forward(self.models[body], data)
            self.sensors[index] = torch.from_numpy(data.sensordata)


def lay_out(terrain: TerrainGrid) -> tuple[np.ndarray, Tensor]:
    """Lay tiles side by side: levels along x, kinds along y.

    Returns:
        The heights (rows along x, columns along y) [m], and the tiles' origins (K, 2) [m] in the world's frame, whose
        origin is the centre of all.

    Raises:
        ValueError: The tiles have more samples than the height field may have.
    """
    tiles, kinds = terrain.field.heights, len(terrain.kinds)
    n = tiles.shape[1] - 1  # neighbours share their rim
    actual, hint = len(tiles) * n * n, "take fewer kinds or levels, shorter tiles or a coarser resolution"
    require(actual <= _MAX_SAMPLES, "terrain", f"must fit a height field of {_MAX_SAMPLES} samples", actual, hint)
    tiles = tiles.cpu()
    grid = tiles[:, :n, :n].unflatten(0, (-1, kinds)).permute(0, 2, 1, 3).flatten(2).flatten(0, 1)
    index = torch.arange(len(tiles))
    middle = torch.stack([index // kinds, index % kinds], -1) * n + n / 2
    size = torch.tensor(grid.shape)
    return grid.numpy().astype(np.float64), ((middle - (size - 1) / 2) * terrain.field.resolution).double()


def build_model(robot: Path, heights: np.ndarray, resolution: float) -> Any:
    """Return the robot's model on a height field (rows along x, columns along y) [m]."""
    spec = mujoco.MjSpec.from_file(str(robot))
    low, high = float(heights.min()), float(heights.max())
    extent = [resolution * (n - 1) / 2 for n in heights.shape]
    relief = max(high - low, 1e-3)
    rows = ((heights - low) / relief).T  # MuJoCo's rows run along y
    size = [*extent, relief, _DEPTH]
    spec.add_hfield(name="ground", nrow=rows.shape[0], ncol=rows.shape[1], size=size, userdata=rows.flatten().tolist())
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[0, 0, low],
        contype=1, conaffinity=0, condim=3, friction=[0.5, 0.005, 0.0001], rgba=[0.72, 0.68, 0.6, 1],
    )  # fmt: skip
    spec.worldbody.add_light(pos=[0, 0, high + 6], dir=[0.4, 0.3, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    model = spec.compile()
    _require_parts(model)
    return model


def _require_parts(model: Any) -> None:
    """Refuse a model whose joints, actuators or sensors are not those of `robot.xml`."""
    joints = [model.joint(k).name for k in range(model.njnt)][1:]
    hint = f"name them {', '.join(JOINTS)}"
    require(tuple(joints) == JOINTS, "robot", "must have the 12 joints of robot.xml", joints, hint)
    expected = sum(int(np.prod(shape)) for shape in _SHAPES)
    fits = model.nsensordata == expected and model.nu == len(JOINTS)
    actual = f"{model.nsensordata} and {model.nu}"
    require(fits, "robot", f"must have {expected} sensor values and 12 actuators", actual, "take those of robot.xml")


def _randomized(model: Any, cfg: RandomConfig, rng: np.random.Generator) -> Any:
    """Return a copy of the model with another friction, mass, centre of mass and strength."""
    model = copy.copy(model)
    base = model.body("base").id
    mass = model.body_mass[base]
    scale = (mass + rng.uniform(*cfg.payload)) / mass
    model.body_mass[base] *= scale
    model.body_inertia[base] *= scale
    model.body_ipos[base] += rng.uniform(-cfg.center_of_mass, cfg.center_of_mass, 3)
    model.geom_friction[:, 0] = rng.uniform(*cfg.friction)
    strength = rng.uniform(*cfg.strength)
    model.actuator_gainprm[:, 0] *= strength
    model.actuator_biasprm[:, 1:3] *= strength
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model
