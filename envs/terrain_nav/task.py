"""TerrainNav: reach a goal over rough ground that the robot sees only through its map.

The task offers its parts as separate calls: `advance`, `reset`, `sense`, `observe`. `gym.py` and `rsl_rl.py` call them
in the order of their interfaces. All state is tensors on one device.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.batched_task import BatchedTask
from envs.terrain_nav.config import PERCEPTION, TerrainNavConfig
from envs.terrain_nav.course import make_rated_course
from envs.terrain_nav.outcome import ENDINGS, Outcome
from envs.terrain_nav.proprioception import observe_body
from envs.terrain_nav.robot import Ground, RobotState, advance, base_pose
from envs.terrain_nav.sight import SIGHTS, TruthSight
from torchelev.errors import require, require_count

NUM_ACTIONS = 2  # forward speed and yaw rate


class TerrainNav(BatchedTask):
    """B robots that walk to their goals.

    With the distance d to the goal [m], the action a, and [x] = 1 if x holds and 0 otherwise, the reward of a step is
    `progress (d_before - d) + success [d < goal_radius] + fall [fallen] + stuck [blocked for stuck_after]
    + blocked [blocked] + time + action_rate |a - a_before|^2`, with the weights of `RewardConfig`.

    An episode terminates when the robot reaches the goal, falls or is stuck, and is truncated after `episode_length`.
    On a course with `covers` a robot falls, too, when its body meets a box; `Outcome.bumped` tells these falls apart.

    Args:
        cfg: The settings; None for the defaults.
        num_envs: B.
        device: Where all tensors are stored.
        perception: What `observe()["map"]` contains: "map", the elevation map built from simulated depth cameras;
            "truth", the true ground with white noise; "blind", nothing. The shapes are the same.
        seed: Seed of starts, goals and all noise. The course has its own seed, `cfg.course.seed`.
        compiled: Build what the map's updates run on at once; else the first one does.

    Raises:
        ValueError: `perception` is none of the three, `num_envs` is not positive, or the truth should show voxels.
    """

    num_actions, ending_names = NUM_ACTIONS, ENDINGS
    max_action = 1.0
    xy: Tensor
    yaw: Tensor
    velocity: Tensor
    blocked: Tensor
    fallen: Tensor
    bumped: Tensor
    goal: Tensor
    tile_ids: Tensor
    episode_length: Tensor
    blocked_time: Tensor
    last_action: Tensor

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
        require(perception in PERCEPTION, "perception", f"must be one of {names}", repr(perception), "use 'map'")
        num_envs = require_count("num_envs", num_envs, "give the number of robots")
        self.cfg, self.num_envs, self.perception = cfg or TerrainNavConfig(), num_envs, perception
        self.course = make_rated_course(self.cfg.course, device)
        self.ground = Ground(self.course.field, self.cfg.robot.reach, self.course.structures)
        self.generator = torch.Generator(device)
        self.sight = SIGHTS[perception](self.cfg, self.course, num_envs, compiled)
        shown = "none" if self.course.ceilings is None else "scan"
        self.truth = TruthSight(self.cfg, self.course, num_envs, noise=0.0, ceilings=shown)
        for name in ("xy", "velocity", "goal", "last_action"):
            self.register_buffer(name, torch.zeros(num_envs, 2, device=device))
        dtypes = {"yaw": torch.float32, "blocked_time": torch.float32, "blocked": torch.bool, "fallen": torch.bool}
        for name, dtype in {**dtypes, "tile_ids": torch.int64, "episode_length": torch.int64}.items():
            self.register_buffer(name, torch.zeros(num_envs, dtype=dtype, device=device))
        # Each step that bumps ends its episode: nothing to save.
        self.register_buffer("bumped", torch.zeros(num_envs, dtype=torch.bool, device=device), persistent=False)
        self.register_buffer("endings", torch.zeros(len(ENDINGS), num_envs, device=device))
        self.seed(seed)
        self.reset()
        self.sense()

    @property
    def device(self) -> torch.device:
        """Where all tensors are stored."""
        return self.xy.device

    @property
    def T_map_base(self) -> Tensor:
        """Poses of the robots (B, 4, 4) in the frame of their tile."""
        return base_pose(self.xy, self.yaw, self.tile_ids, self.course.field, self.cfg.robot)

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.cfg.max_episode_length

    def info(self, outcome: Outcome | None) -> dict[str, Tensor]:
        """Return the distance to the goal [m], and after a step how the episode ended, each (B,)."""
        endings = {} if outcome is None else {name: getattr(outcome, name) for name in ENDINGS[:3]}
        if outcome is not None and self.course.structures is not None:
            endings["bumped"] = outcome.bumped
        return {"distance": self.distance, **endings}

    @property
    def log(self) -> dict[str, Tensor]:
        """Figures that a training shows: the fraction of the last finished episodes by ending."""
        return self.ending_fractions

    @property
    def distance(self) -> Tensor:
        """Distance of each robot to its goal (B,) [m]."""
        return torch.linalg.vector_norm(self.goal - self.xy, dim=-1)

    def reset(self, mask: Tensor | None = None) -> None:
        """Begin new episodes in the environments of `mask` (B,) bool, or in all."""
        B, course = self.num_envs, self.course
        mask = torch.ones(B, dtype=torch.bool, device=self.device) if mask is None else mask
        u = torch.rand(3, B, generator=self.generator, device=self.device)
        tile = (u[0] * course.field.num_tiles).long().clamp(max=course.field.num_tiles - 1)
        route = (u[1] * course.starts.shape[1]).long().clamp(max=course.starts.shape[1] - 1)
        start, goal = course.starts[tile, route], course.goals[tile, route]
        offset = goal - start
        yaw = torch.atan2(offset[:, 1], offset[:, 0]) + (u[2] - 0.5) * torch.pi
        for name, value in {"xy": start, "goal": goal, "yaw": yaw, "tile_ids": tile}.items():
            self._store(name, value, mask)
        for name in ("velocity", "blocked", "fallen", "bumped", "episode_length", "blocked_time", "last_action"):
            self._store(name, torch.zeros_like(getattr(self, name)), mask)
        self.sight.reset(mask)

    def advance(self, action: Tensor) -> Outcome:
        """Move the robots by one step of `cfg.dt`.

        Args:
            action: Forward speed and yaw rate (B, 2), clipped to [-1, 1]; NaN counts as 0.

        Raises:
            ValueError: The action has another shape.
        """
        expected = (self.num_envs, NUM_ACTIONS)
        require(
            tuple(action.shape) == expected, "action", f"expected {expected}", tuple(action.shape), "give one per robot"
        )
        cfg, old_distance = self.cfg, self.distance
        action = action.to(self.xy.dtype).nan_to_num(0.0).clamp(-1.0, 1.0)
        robot = RobotState(self.xy, self.yaw, self.velocity, self.blocked, self.fallen, self.bumped)
        dt = cfg.dt / cfg.substeps
        robot = advance(robot, action, self.tile_ids, self.ground, cfg.robot, dt, cfg.substeps)
        for name, value in robot._asdict().items():
            self._store(name, value)
        self.blocked_time.add_(cfg.dt).mul_(robot.blocked)
        self.episode_length.add_(1)
        outcome = self._evaluate(old_distance, action)
        self._store("last_action", action)
        self._note_endings(outcome)
        return outcome

    def _evaluate(self, old_distance: Tensor, action: Tensor) -> Outcome:
        """Return reward and endings of a step that began at `old_distance` (B,) [m] from the goal."""
        cfg, weight, distance = self.cfg, self.cfg.reward, self.distance
        success = (distance < cfg.goal_radius) & ~self.fallen
        stuck = (self.blocked_time >= cfg.stuck_after - 1e-6) & ~success & ~self.fallen
        truncated = (self.episode_length >= cfg.max_episode_length) & ~(success | stuck | self.fallen)
        change = (action - self.last_action).square().sum(-1)
        reward = weight.progress * (old_distance - distance) + weight.time + weight.action_rate * change
        reward = reward + weight.success * success + weight.fall * self.fallen + weight.stuck * stuck
        reward = reward + weight.blocked * self.blocked
        return Outcome(reward, success, self.fallen.clone(), stuck, truncated, self.bumped.clone())

    def sense(self, mask: Tensor | None = None) -> None:
        """Let the robots of `mask` (B,) bool, or all of them, sense the ground once from their current poses."""
        mask = torch.ones_like(self.blocked) if mask is None else mask
        self.sight.sense(self.T_map_base, self.tile_ids, mask)

    def observe(self, critic: bool = True) -> dict[str, Tensor]:
        """Return new tensors with the current observations.

        Args:
            critic: Whether to include "truth".

        Returns:
            "policy" (B, 12), see `observe_body`. "map" (B, 4, n, n): elevation and upper bound relative to the ground
            under the base [m], validity, traversability; further channels with `SightConfig.ceilings`. "truth"
            (B, 4, n, n): the same of the true ground, with a scan of the ceiling on a course with `covers`.
        """
        T_map_base = self.T_map_base
        policy = observe_body(T_map_base, self.goal, self.velocity, self.last_action, self.blocked_time)
        seen = {"policy": policy, "map": self.sight.image(T_map_base, self.tile_ids)}
        return seen | ({"truth": self.truth.image(T_map_base, self.tile_ids)} if critic else {})
