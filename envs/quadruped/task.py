"""The quadruped task: follow velocity commands over rough ground that the robot sees only through its map.

The task offers its parts as separate calls: `advance`, `reset`, `sense`, `observe`. `envs.vector_env` and rsl-rl's
environment call them in the order of their interfaces. Physics runs on the CPU; all else is tensors on one device.
"""

from __future__ import annotations

import torch
from torch import Tensor

from envs.batched_task import BatchedTask
from envs.quadruped.config import PERCEPTION, QuadrupedConfig
from envs.quadruped.episode.commands import draw_commands, yaw_rate
from envs.quadruped.episode.outcome import ENDINGS, Outcome
from envs.quadruped.episode.rewards import Motion, reward
from envs.quadruped.episode.starts import draw_starts
from envs.quadruped.gait import foot_positions, joint_targets
from envs.quadruped.kinematics import feet_in_base, joint_angles, link_poses
from envs.quadruped.odometry import LegOdometry
from envs.quadruped.physics import Physics, Sensed
from envs.quadruped.proprioception import observe_body, to_yaw_frame
from envs.quadruped.robots import CONTACT, Robots
from envs.quadruped.sight import SIGHTS, TruthSight, View
from torchelev.errors import require, require_count
from torchelev.sim import surface_of, terrain_grid

NUM_ACTIONS = 12


class Quadruped(BatchedTask):
    """B quadrupeds that walk across their tiles.

    The action (B, 12) moves the feet of a trot, leg by leg along x, y and z of the base; `gait.py` turns feet into
    joint angles, which PD controllers hold. `episode.rewards` gives the reward.

    An episode terminates when the robot falls: its base touches the ground or tilts by more than `max_tilt`, or its
    simulation diverges. It is truncated when the robot has crossed its tile, or after `episode_length`.

    Args:
        cfg: The settings; None for the defaults.
        num_envs: B.
        device: Where everything but the physics is computed.
        perception: What "height_scan" and "feet" of `observe()` contain: "map", the elevation map built from simulated
            sensors; "truth", the true ground with the noise of Miki et al. 2022; "blind", zeros.
        seed: Seed of bodies, starts, commands and all noise. The terrain has its own, `cfg.terrain.seed`.
        compiled: Build what the map's updates run on at once; else the first one does.

    Raises:
        ValueError: `perception` is none of the three, or `num_envs` is not positive.
    """

    num_actions, ending_names = NUM_ACTIONS, ENDINGS
    level: Tensor
    kind: Tensor
    phase: Tensor
    command: Tensor
    heading: Tensor
    latency: Tensor
    action: Tensor
    joint_velocities: Tensor
    episode_length: Tensor
    since_sight: Tensor
    commanded: Tensor
    steps: Tensor
    noise: Tensor

    def __init__(
        self,
        cfg: QuadrupedConfig | None = None,
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
        self.cfg, self.num_envs, self.perception = cfg or QuadrupedConfig(), num_envs, perception
        self.max_action = self.cfg.gait.max_action
        terrain = self.cfg.terrain
        self.terrain = terrain_grid(
            terrain.kinds, terrain.num_levels, difficulty=terrain.difficulty, length=terrain.length,
            resolution=terrain.resolution, seed=terrain.seed, device=device,
        ).with_surface(**surface_of("mujoco"))  # fmt: skip
        self.physics = Physics(self.terrain, num_envs, self.cfg.random, seed)
        self.robots = Robots(self.physics, device)
        self.generator = torch.Generator(device)
        self.odometry = LegOdometry(self.cfg.odometry, num_envs, device)
        self.sight = SIGHTS[perception](self.cfg, self.terrain.field, num_envs, compiled)
        self.truth = TruthSight(self.cfg, self.terrain.field, num_envs, noisy=False)
        self.origins = self.physics.tile_origins.to(device, torch.float32)
        shapes = {
            "phase": (), "command": (3,), "heading": (), "action": (12,), "joint_velocities": (12,),
            "since_sight": (), "commanded": (), "noise": (30,),
        }  # fmt: skip
        for name, shape in shapes.items():
            self.register_buffer(name, torch.zeros(num_envs, *shape, device=device))
        for name in ("level", "latency", "episode_length"):
            self.register_buffer(name, torch.zeros(num_envs, dtype=torch.int64, device=device))
        self.register_buffer("kind", torch.arange(num_envs, device=device) % len(terrain.kinds))
        self.register_buffer("endings", torch.zeros(len(ENDINGS), num_envs, device=device))
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))
        self.reward_terms: dict[str, Tensor] = {}
        self._is_fresh = True
        self.seed(seed)
        self.reset()
        self.sense()

    # State --------------------------------------------------------------------------------------------------------

    @property
    def device(self) -> torch.device:
        """Where all tensors but the physics are stored."""
        return self.phase.device

    @property
    def tile_ids(self) -> Tensor:
        """The tile of each robot (B,)."""
        return self.level * len(self.terrain.kinds) + self.kind

    @property
    def T_map_base(self) -> Tensor:
        """True poses of the robots (B, 4, 4) in the frame of their tile."""
        return self.robots.pose_from(self.origins[self.tile_ids])

    @property
    def max_episode_length(self) -> int:
        """Number of steps after which an episode is truncated."""
        return self.cfg.max_episode_length

    def info(self, outcome: Outcome | None) -> dict[str, Tensor]:
        """Return the level of the terrain, and after a step how the episode ended, each (B,)."""
        endings = {} if outcome is None else {name: getattr(outcome, name) for name in ENDINGS}
        return {"level": self.level.clone(), **endings}

    @property
    def log(self) -> dict[str, Tensor]:
        """Figures that a training shows: endings, the mean level, and each term of the reward per second."""
        terms = {f"reward/{name}": value.mean() / self.cfg.dt for name, value in self.reward_terms.items()}
        return {**self.ending_fractions, "level": self.level.float().mean(), **terms}

    # Steps --------------------------------------------------------------------------------------------------------

    def reset(self, mask: Tensor | None = None) -> None:
        """Begin new episodes in the environments of `mask` (B,) bool, or in all; the curriculum gives the levels."""
        if mask is None:
            mask = torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
            self.steps.zero_()
        if bool(mask.any()):
            self._choose_levels(mask)
            self._begin(mask)

    def _begin(self, mask: Tensor) -> None:
        """Begin new episodes on the tiles of the current levels."""
        self._place(mask)
        for name in ("action", "joint_velocities", "episode_length", "since_sight", "commanded"):
            getattr(self, name).masked_fill_(mask.view(-1, *[1] * (getattr(self, name).ndim - 1)), 0)
        self._store("latency", (self._uniform() * (self.cfg.random.max_latency + 1)).long(), mask)
        self._draw_commands(mask)
        self.odometry.reset(mask)
        self.sight.reset(mask)
        self._draw_noise()

    def place_at(self, levels: Tensor) -> None:
        """Begin new episodes in all environments, each at a given level (B,) of its kind of terrain."""
        self.level.copy_(levels)
        self.steps.zero_()
        self._begin(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))
        self.sense()

    @property
    def forward_speed(self) -> Tensor:
        """Speed of the robots ahead (B,) [m/s]."""
        return to_yaw_frame(self.robots.qvel[:, :3], self.T_map_base)[:, 0]

    def _choose_levels(self, mask: Tensor) -> None:
        """Move robots up that crossed their tile, and down that walked less than half the commanded distance.

        Fallen robots never move up: one that has diverged is anywhere.
        After seeding, levels are drawn from the first `start_level`; without a curriculum always, and from all.
        """
        terrain = self.cfg.terrain
        if self._is_fresh or not terrain.curriculum:
            top = min(terrain.start_level, terrain.num_levels) if terrain.curriculum else terrain.num_levels
            self._store("level", (self._uniform() * top).long().clamp(max=top - 1), mask)
            self._is_fresh = False
        else:
            distance = torch.linalg.vector_norm(self.T_map_base[:, :2, 3], dim=-1)
            crossed = self._has_crossed() & ~self.robots.have_fallen(self.robots.sensed(), self.cfg.max_tilt)
            failed = distance < 0.5 * self.commanded
            self._store("level", self.terrain.promote(self.level, crossed, failed, self.generator), mask)

    def _place(self, mask: Tensor) -> None:
        """Put robots at the middle of their tile, standing, at any heading."""
        env_ids = mask.cpu().nonzero()[:, 0].tolist()
        if not env_ids:
            return
        origins = self.physics.tile_origins[self.tile_ids[env_ids].cpu()]
        phase, yaw, qpos, bodies = draw_starts(self._uniform(5, self.num_envs)[:, env_ids].cpu(), origins, self.cfg)
        self.physics.place(env_ids, qpos, torch.zeros(len(env_ids), 18, dtype=torch.float64), bodies)
        self.phase[env_ids], self.heading[env_ids] = phase.to(self.device), yaw.to(self.device)

    def advance(self, action: Tensor) -> Outcome:
        """Move the robots by one step of `cfg.dt`.

        Args:
            action: Displacements of the feet (B, 12) in units of `gait.action_scale`; NaN counts as 0.

        Raises:
            ValueError: The action has another shape.
        """
        expected = (self.num_envs, NUM_ACTIONS)
        actual, hint = tuple(action.shape), "give one per robot"
        require(actual == expected, "action", f"expected {expected}", actual, hint)
        cfg, limit = self.cfg, self.cfg.gait.max_action
        action = action.to(self.device, torch.float32).nan_to_num(0.0).clamp(-limit, limit)
        self.command[:, 2] = yaw_rate(self.command, self.heading, self.T_map_base, cfg.command)
        self._store("phase", (self.phase + cfg.gait.frequency * cfg.dt).remainder(1.0))
        targets = joint_targets(action, self.phase, self.command, cfg.gait)
        self.physics.step(targets.cpu().double(), self.latency.cpu(), cfg.substeps)
        sensed = self.robots.sensed()
        self._store("episode_length", self.episode_length + 1)
        self._store("commanded", self.commanded + torch.linalg.vector_norm(self.command[:, :2], dim=-1) * cfg.dt)
        self._store("since_sight", self.since_sight + cfg.dt)
        self.odometry.step(self.robots.sensed_velocity, sensed.sole_velocities, sensed.foot_forces, cfg.dt)
        outcome = self._evaluate(action, sensed)
        self._store("joint_velocities", self.robots.qvel[:, 6:])
        self._store("action", action)
        self._note_endings(outcome)
        self._push()
        self._draw_commands(self._happens(cfg.command.interval))
        self._draw_noise()
        return outcome

    def _evaluate(self, action: Tensor, sensed: Sensed) -> Outcome:
        """Return reward and endings of a step. No term combines sensors with the state, which is 5 ms later."""
        cfg, T_map_base = self.cfg, self.T_map_base
        qvel = self.robots.qvel
        fallen = self.robots.have_fallen(sensed, cfg.max_tilt)
        motion = Motion(
            velocity=to_yaw_frame(qvel[:, :3], T_map_base),
            angular_velocity=qvel[:, 3:6],
            gravity=-T_map_base[:, 2, :3],
            command=self.command,
            torques=sensed.torques,
            joint_acceleration=(qvel[:, 6:] - self.joint_velocities) / cfg.dt,
            action=action,
            last_action=self.action,
            touches=(sensed.touches > 0).float(),
            foot_speed=torch.linalg.vector_norm(sensed.sole_velocities[..., :2], dim=-1),
            stands=sensed.foot_forces > CONTACT,
            fallen=fallen,
        )
        value, self.reward_terms = reward(motion, cfg.reward, cfg.dt)
        crossed = self._has_crossed() & ~fallen
        timed_out = (self.episode_length >= cfg.max_episode_length) & ~fallen & ~crossed
        return Outcome(value.nan_to_num(0.0).clamp(-10.0, 10.0), crossed, fallen, timed_out)

    def _has_crossed(self) -> Tensor:
        """Return which robots are at the rim of their tile (B,)."""
        terrain = self.cfg.terrain
        return self.T_map_base[:, :2, 3].abs().amax(-1) > terrain.length / 2 - terrain.rim

    def _draw_commands(self, mask: Tensor) -> None:
        """Draw new commands in the environments of `mask` (B,) bool."""
        command, heading = draw_commands(self._uniform(4, self.num_envs), self.heading, self.cfg.command)
        self._store("command", command, mask)
        self._store("heading", heading, mask)

    def _push(self) -> None:
        """Change the velocity of some robots at random."""
        cfg = self.cfg.random
        change = cfg.push * (2 * self._uniform(2, self.num_envs) - 1) * self._happens(cfg.push_interval)
        self.physics.qvel[:, :2] += change.t().cpu()

    def _happens(self, interval: float) -> Tensor:
        """Return for which robots an event happens that has this mean time [s] between two (B,) bool."""
        return self._uniform() < self.cfg.dt / interval

    # Observations -------------------------------------------------------------------------------------------------

    def sense(self, mask: Tensor | None = None) -> None:
        """Update the maps of all robots, at every `map_every`-th call; `mask` is accepted for the common interface."""
        if int(self.steps) % self.cfg.sight.map_every == 0:
            self.sight.sense(self.view(), self.since_sight)
            self._store("since_sight", torch.zeros_like(self.since_sight))
        self.steps.add_(1)

    def view(self) -> View:
        """Return the poses from which the robots see now."""
        T_map_base, joints = self.T_map_base, self._joints()
        return View(
            T_map_base=T_map_base,
            T_estimated=self.odometry.estimate(T_map_base),
            T_base_links=link_poses(self.robots.qpos[:, 7:]),
            T_base_links_measured=link_poses(joints),
            feet=feet_in_base(joints),
            tile_ids=self.tile_ids,
        )

    def _joints(self) -> Tensor:
        """Return what the joint encoders read (B, 12) [rad]."""
        return self.robots.qpos[:, 7:] + self.cfg.random.joint_noise * self.noise[:, 18:]

    def observe(self, critic: bool = True) -> dict[str, Tensor]:
        """Return new tensors with the current observations.

        Args:
            critic: Whether to include what only a critic may see.

        Returns:
            "policy" (B, 50), see `observe_body`. "height_scan" (B, 187) and "feet" (B, 56) as `perception` says. For
            the critic "privileged" (B, 20), "true_height_scan" and "true_feet", the scans of the true ground.
        """
        cfg, rotation = self.cfg, self.robots.rotation
        random, noise, view = cfg.random, self.noise, self.view()
        standing = joint_angles(foot_positions(torch.zeros_like(self.phase), torch.zeros_like(self.command), cfg.gait))
        qvel = self.robots.qvel
        policy = observe_body(
            (rotation.mT @ self.odometry.velocity[..., None])[..., 0],
            qvel[:, 3:6] + random.gyro_noise * noise[:, :3],
            -rotation[:, 2] + random.gravity_noise * noise[:, 3:6],
            self.command,
            self._joints() - standing,
            qvel[:, 6:] + random.joint_velocity_noise * noise[:, 6:18],
            self.action,
            self.phase,
        )
        seen = {"policy": policy, **self.sight.read(view)}
        if critic:
            seen["privileged"] = self.robots.observe_privileged(self.latency)
            seen |= {f"true_{name}": value for name, value in self.truth.read(view).items()}
        return seen

    def _draw_noise(self) -> None:
        self.noise.copy_(2 * self._uniform(*self.noise.shape) - 1)

    # Storage ------------------------------------------------------------------------------------------------------

    def _uniform(self, *shape: int) -> Tensor:
        """Draw numbers from 0 to 1, by default one for each robot."""
        return torch.rand(shape or (self.num_envs,), generator=self.generator, device=self.device)

    def seed(self, seed: int) -> None:
        """Seed all random number generators; the next `reset` draws levels as at the start, without the curriculum."""
        super().seed(seed)
        self._is_fresh = True
