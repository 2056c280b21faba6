"""The robot's own body as capsules and boxes fixed to its links, and the points that lie on it.

Read a body from MJCF or URDF with `torchelev.io.read_body`. The single box in the base frame, `torchelev.BodyConfig`,
is in `torchelev.stages.measure`. Obstacles and other robots are not here: see `torchelev.sim.Boxes`.
"""

from torchelev.robot_body.shapes import Box, Capsule, RobotBody

__all__ = ["Box", "Capsule", "RobotBody"]
