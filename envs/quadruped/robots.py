"""The robots in the physics, as float32 tensors on the device of the task."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from envs.quadruped.physics import Physics, Sensed
from envs.quadruped.proprioception import observe_privileged, rotation_matrix
from torchelev.frames.arrays import assemble

CONTACT = 1.0  # [N] of a foot that stands


class Robots:
    """B robots as the physics has them now.

    Args:
        physics: in which they are.
        device: where tensors are returned.
    """

    def __init__(self, physics: Physics, device: torch.device | str) -> None:
        self._physics, self._device = physics, torch.device(device)

    def _floats(self, values: Tensor) -> Tensor:
        return values.to(self._device, torch.float32)

    @property
    def qpos(self) -> Tensor:
        """Positions [m], orientations and joint angles [rad] (B, 19), in the frame of the physics."""
        return self._floats(self._physics.qpos)

    @property
    def qvel(self) -> Tensor:
        """Velocities [m/s], in the base's frame angular ones [rad/s], and of the joints [rad/s] (B, 18)."""
        return self._floats(self._physics.qvel)

    @property
    def sensed_velocity(self) -> Tensor:
        """Velocities of the bases (B, 3) [m/s] at the sensors' instant."""
        return self._floats(self._physics.sensed_qvel[:, :3])

    @property
    def rotation(self) -> Tensor:
        """Orientations of the bases (B, 3, 3)."""
        return rotation_matrix(self.qpos[:, 3:7])

    def pose_from(self, origins: Tensor) -> Tensor:
        """Return the poses of the bases (B, 4, 4) in frames with these origins (B, 2) [m]."""
        return assemble(self.qpos[:, :3] - torch.nn.functional.pad(origins, (0, 1)), self.rotation)

    def sensed(self) -> Sensed:
        """Return what the sensors measured."""
        return Sensed(*(self._floats(value) for value in self._physics.sensed()))

    def have_fallen(self, sensed: Sensed, max_tilt: float) -> Tensor:
        """Return which robots lie on their base, tilt by more than `max_tilt` [rad], or have diverged (B,)."""
        tilts = self.rotation[:, 2, 2] < math.cos(max_tilt)
        return (sensed.touches[:, 0] > 0) | tilts | self._physics.diverged.to(self._device)

    def observe_privileged(self, latency: Tensor) -> Tensor:
        """Return what only a critic may see of the bodies (B, 20), given the latencies (B,)."""
        sensed = self.sensed()
        velocity = (self.rotation.mT @ self.qvel[:, :3, None])[..., 0]
        sensed_rotation = rotation_matrix(self._floats(self._physics.sensed_qpos[:, 3:7]))
        feet = sensed.foot_velocities @ sensed_rotation  # rows: v^T R = (R^T v)^T
        return observe_privileged(velocity, sensed.foot_forces > CONTACT, feet, latency)
