"""TerrainNav: reach a goal over rough ground that the robot sees only through its map.

All environments are tensors on one device. The pieces are called by what steps them: `advance`, `reset`, `sense`,
`observe`; `rsl_rl.py` and `gym.py` put them in the order that their users expect.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from envs.terrain_nav.config import PERCEPTION, TerrainNavConfig
from envs.terrain_nav.course import make_rated_course
from envs.terrain_nav.robot import Ground, RobotState, advance, base_pose
from envs.terrain_nav.sight import SIGHTS, Truth
from torchelev.errors import require

NUM_ACTIONS = 2  # forward speed and yaw rate
ASIDE = (1, 4, 6, 8, 10)  # entries of the observation "policy" that a mirror turns round
ENDINGS = ("success", "fallen", "stuck", "truncated")


class Outcome(NamedTuple):
    """What a step brought, each (B,)."""

    reward: Tensor
    success: Tensor
    fallen: Tensor
    stuck: Tensor
    truncated: Tensor

    @property
    def terminated(self) -> Tensor:
        """Where the episode ended by itself."""
        return self.success | self.fallen | self.stuck

    @property
    def done(self) -> Tensor:
        """Where the episode ended."""
        return self.terminated | self.truncated


class TerrainNav(nn.Module):
    """B robots on their way to goals.

    Reward of a step, with d the distance to the goal [m] and a the action:
    `progress (d_before - d) + success [d < goal_radius] + fall [fallen] + stuck [blocked for stuck_after]
    + blocked [blocked] + time + action_rate |a - a_before|^2`, weights in `RewardConfig`.

    An episode terminates with success, a fall, or being stuck, and is truncated after `episode_length`.

    Args:
        cfg: the task.
        num_envs: B.
        device: where everything lives.
        perception: what `observe()["map"]` shows: "map", the elevation map fed by simulated depth cameras; "truth",
            the ground itself with white noise; "blind", nothing. Shapes are the same.
        seed: of starts, goals and all noise. The course has its own, `cfg.course.seed`.
        compiled: run the map's update compiled.
    """

    xy: Tensor
    yaw: Tensor
    velocity: Tensor
    blocked: Tensor
    fallen: Tensor
    goal: Tensor
    tile_ids: Tensor
    episode_length: Tensor
    blocked_time: Tensor
    last_action: Tensor
    endings: Tensor

    def __init__(
        self,
        cfg: TerrainNavConfig | None = None,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        perception: str = "map",
        seed: int = 0,
        compiled: bool = False,
    ) -> None:
        super().__init__()
        names = ", ".join(PERCEPTION)
        require(perception in PERCEPTION, "perception", f"must be one of {names}", repr(perception), "use map")
        self.cfg, self.num_envs, self.perception = cfg or TerrainNavConfig(), num_envs, perception
        self.course = make_rated_course(self.cfg.course, device)
        self.ground = Ground(self.course.field, self.cfg.robot.reach)
        self.generator = torch.Generator(device)
        self.sight = SIGHTS[perception](self.cfg, self.course, num_envs, compiled)
        self.truth = Truth(self.cfg, self.course, num_envs, noise=0.0)
        for name in ("xy", "velocity", "goal", "last_action"):
            self.register_buffer(name, torch.zeros(num_envs, 2, device=device))
        dtypes = {"yaw": torch.float32, "blocked_time": torch.float32, "blocked": torch.bool, "fallen": torch.bool}
        for name, dtype in {**dtypes, "tile_ids": torch.int64, "episode_length": torch.int64}.items():
            self.register_buffer(name, torch.zeros(num_envs, dtype=dtype, device=device))
        self.register_buffer("endings", torch.zeros(len(ENDINGS), num_envs, device=device))
        self.seed(seed)
        self.reset()
        self.sense()

    @property
    def device(self) -> torch.device:
        """The device of all tensors."""
        return self.xy.device

    @property
    def T_map_base(self) -> Tensor:
        """Where the robots are, (B, 4, 4), in the frame of their tile."""
        return base_pose(self.xy, self.yaw, self.tile_ids, self.course.field, self.cfg.robot)

    @property
    def shares(self) -> dict[str, Tensor]:
        """How the robots' last finished episodes ended: shares that sum to 1, or zeros before any has."""
        finished = self.endings.sum().clamp(min=1.0)
        return {name: ended.sum() / finished for name, ended in zip(ENDINGS, self.endings, strict=True)}

    @property
    def distance(self) -> Tensor:
        """Distance to the goal (B,) [m]."""
        return torch.linalg.vector_norm(self.goal - self.xy, dim=-1)

    def reset(self, mask: Tensor | None = None) -> None:
        """Begin new episodes, in the environments of `mask` (B,) bool, or in all."""
        B, course = self.num_envs, self.course
        mask = torch.ones(B, dtype=torch.bool, device=self.device) if mask is None else mask
        u = torch.rand(3, B, generator=self.generator, device=self.device)
        tile = (u[0] * course.field.num_tiles).long().clamp(max=course.field.num_tiles - 1)
        route = (u[1] * course.starts.shape[1]).long().clamp(max=course.starts.shape[1] - 1)
        start, goal = course.starts[tile, route], course.goals[tile, route]
        ahead = goal - start
        yaw = torch.atan2(ahead[:, 1], ahead[:, 0]) + (u[2] - 0.5) * torch.pi
        for name, value in {"xy": start, "goal": goal, "yaw": yaw, "tile_ids": tile}.items():
            self._put(name, value, mask)
        for name in ("velocity", "blocked", "fallen", "episode_length", "blocked_time", "last_action"):
            self._put(name, torch.zeros_like(getattr(self, name)), mask)
        self.sight.reset(mask)

    def advance(self, action: Tensor) -> Outcome:
        """Move by one step of `cfg.dt`; `action` (B, 2), clipped to [-1, 1], NaN is 0: forward speed and yaw rate.

        Raises ValueError for another shape.
        """
        expected = (self.num_envs, NUM_ACTIONS)
        require(tuple(action.shape) == expected, "action", f"expected {expected}", tuple(action.shape), "one per robot")
        cfg, before = self.cfg, self.distance
        action = action.to(self.xy.dtype).nan_to_num(0.0).clamp(-1.0, 1.0)
        robot = RobotState(self.xy, self.yaw, self.velocity, self.blocked, self.fallen)
        hit = torch.zeros_like(self.blocked)
        for _ in range(cfg.substeps):
            robot = advance(robot, action, self.tile_ids, self.ground, cfg.robot, cfg.dt / cfg.substeps)
            hit = hit | robot.blocked
        for name, value in robot._asdict().items():
            self._put(name, value)
        self._put("blocked", hit)
        self._put("blocked_time", torch.where(hit, self.blocked_time + cfg.dt, 0.0))
        self._put("episode_length", self.episode_length + 1)
        outcome = self._judge(before, action)
        self._put("last_action", action)
        endings = torch.stack([getattr(outcome, name) for name in ENDINGS])
        self._put("endings", torch.where(outcome.done, endings.to(self.endings.dtype), self.endings))
        return outcome

    def _judge(self, before: Tensor, action: Tensor) -> Outcome:
        cfg, weight, distance = self.cfg, self.cfg.reward, self.distance
        success = (distance < cfg.goal_radius) & ~self.fallen
        stuck = (self.blocked_time >= cfg.stuck_after - 1e-6) & ~success & ~self.fallen
        truncated = (self.episode_length >= cfg.max_episode_length) & ~(success | stuck | self.fallen)
        change = (action - self.last_action).square().sum(-1)
        reward = weight.progress * (before - distance) + weight.time + weight.action_rate * change
        reward = reward + weight.success * success + weight.fall * self.fallen + weight.stuck * stuck
        reward = reward + weight.blocked * self.blocked
        return Outcome(reward, success, self.fallen.clone(), stuck, truncated)

    def sense(self, mask: Tensor | None = None) -> None:
        """Let the robots look once from where they are: those of `mask` (B,) bool, or all."""
        mask = torch.ones_like(self.blocked) if mask is None else mask
        self.sight.sense(self.T_map_base, self.tile_ids, mask)

    def observe(self, critic: bool = True) -> dict[str, Tensor]:
        """Return fresh observations.

        policy (B, 12): see `_proprioception`; map (B, 4, n, n): elevation and upper bound over the ground under the
        base [m], validity, traversability; with `critic` truth (B, 4, n, n): the same of the ground itself.
        """
        T_map_base = self.T_map_base
        seen = {"policy": self._proprioception(T_map_base), "map": self.sight.image(T_map_base, self.tile_ids)}
        return seen | ({"truth": self.truth.image(T_map_base, self.tile_ids)} if critic else {})

    def _proprioception(self, T_map_base: Tensor) -> Tensor:
        """Return (B, 12).

        Goal ahead and aside [m], within 3 m, its distance / 5 m, direction's cos and sin, forward velocity [m/s], yaw
        rate [rad/s], slopes ahead and aside, last action, blocked time [s]. Where the goal is comes from somewhere
        else, a localisation that does not drift; odometry alone places the map.
        """
        away = self.goal - T_map_base[:, :2, 3]
        distance = torch.linalg.vector_norm(away, dim=-1, keepdim=True)
        ahead = torch.nn.functional.normalize(T_map_base[:, :2, 0], dim=-1)
        cos = (away * ahead).sum(-1, keepdim=True)
        sin = ahead[:, :1] * away[:, 1:] - ahead[:, 1:] * away[:, :1]
        near = torch.cat([cos, sin], -1)
        direction = near / distance.clamp(min=1e-3)
        parts = [near.clamp(-3.0, 3.0), distance / 5.0, direction, self.velocity, T_map_base[:, 2, :2]]
        return torch.cat([*parts, self.last_action, self.blocked_time[:, None]], -1)

    def _put(self, name: str, value: Tensor, mask: Tensor | None = None) -> None:
        """Write into a buffer, in place: see CONTRIBUTING.md on inference mode."""
        buffer = getattr(self, name)
        if mask is not None:
            value = torch.where(mask.view(-1, *[1] * (buffer.ndim - 1)), value, buffer)
        buffer.copy_(value)

    # Random numbers -------------------------------------------------------------------------------------------------

    def _generators(self) -> list[torch.Generator]:
        """List the generators of the task and of all that the robots see with."""
        return [module.generator for module in self.modules() if hasattr(module, "generator")]  # type: ignore[misc]

    def seed(self, seed: int) -> None:
        """Seed all random numbers; `reset` then begins the same episodes each time."""
        for number, generator in enumerate(self._generators()):
            generator.manual_seed(1000 * seed + number)  # no two alike, of this seed or its neighbours

    def get_extra_state(self) -> dict[str, Any]:
        """Return the state of the random numbers, so that a resumed training goes on as if never stopped."""
        return {"generator": self.generator.get_state()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Set the state of the random numbers."""
        self.generator.set_state(state["generator"].cpu())
