"""Isaac Lab's rough velocity task for the quadruped of envs/quadruped, whose policy reads a map."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path
from typing import Any

import torch
from isaaclab.actuators import ImplicitActuatorCfg
from isaaclab.assets import ArticulationCfg
from isaaclab.managers import ObservationGroupCfg, ObservationTermCfg, SceneEntityCfg
from isaaclab.sensors import CameraCfg, RayCasterCameraCfg, RayCasterCfg, patterns
from isaaclab.sim import PinholeCameraCfg, UsdFileCfg
from isaaclab.utils import configclass, replace
from isaaclab_newton.renderers import NewtonWarpRendererCfg
from isaaclab_newton.sim.schemas import NewtonArticulationCfg
from isaaclab_tasks.core.velocity import mdp
from isaaclab_tasks.core.velocity.velocity_env_cfg import LocomotionVelocityRoughEnvCfg, RoughPhysicsCfg
from torch import Tensor

from benchmarks.quality.isaac_lab.robot import write_usd
from torchelev import HeightScan
from torchelev.integrations.isaac_lab import MapObservation

STANDING_HEIGHT = 0.3  # [m] of the base
GROUND = ["/World/ground"]
#: ahead of the base, looking 40 degrees down; x y z w
CAMERA = RayCasterCameraCfg(
    prim_path="{ENV_REGEX_NS}/Robot/base",
    offset=RayCasterCameraCfg.OffsetCfg(pos=(0.22, 0.0, 0.08), rot=(0.0, 0.3420, 0.0, 0.9397), convention="world"),
    data_types=["distance_to_image_plane"],
    pattern_cfg=patterns.PinholeCameraPatternCfg(width=64, height=48),
    mesh_prim_paths=GROUND,
    max_distance=4.0,
    depth_clipping_behavior="zero",
)
#: on top of the base; it sees the ground and not the robot
LIDAR = RayCasterCfg(
    prim_path="{ENV_REGEX_NS}/Robot/base",
    offset=RayCasterCfg.OffsetCfg(pos=(0.0, 0.0, 0.15)),
    pattern_cfg=patterns.LidarPatternCfg(
        channels=24, vertical_fov_range=(-60.0, 15.0), horizontal_fov_range=(-180.0, 180.0), horizontal_res=4.0
    ),
    mesh_prim_paths=GROUND,
    max_distance=6.0,
    global_world_only=True,
)
#: the camera, rendered: it sees the robot's feet too
RENDERED = CameraCfg(
    prim_path="{ENV_REGEX_NS}/Robot/base/eye",
    offset=CameraCfg.OffsetCfg(pos=(0.22, 0.0, 0.08), rot=(0.0, 0.3420, 0.0, 0.9397), convention="world"),
    data_types=["distance_to_image_plane"],
    width=64,
    height=48,
    spawn=PinholeCameraCfg(clipping_range=(0.05, 4.0)),
    update_latest_camera_pose=True,
    renderer_cfg=NewtonWarpRendererCfg(),
)
LEGS = ImplicitActuatorCfg(joint_names_expr=[".*"], stiffness=60.0, damping=2.0, armature=0.01, joint_effort_limit=28.0)


@functools.cache
def find_robot() -> str:
    """Return the path of the robot's USD file, written once per process."""
    return str(write_usd(Path(tempfile.mkdtemp()) / "quadruped.usda"))


def make_robot() -> ArticulationCfg:
    """Return the articulation: it stands on bent legs."""
    stance = {".*_abduction_joint": 0.0, ".*_thigh_joint": 0.8, ".*_knee_joint": -1.6}
    return ArticulationCfg(
        prim_path="{ENV_REGEX_NS}/Robot",
        spawn=UsdFileCfg(
            usd_path=find_robot(),
            activate_contact_sensors=True,
            articulation_props=[NewtonArticulationCfg(self_collision_enabled=False)],
        ),
        init_state=ArticulationCfg.InitialStateCfg(pos=(0.0, 0.0, 0.34), joint_pos=stance),
        actuators={"legs": LEGS},
        soft_joint_pos_limit_factor=0.9,
    )


def map_term(*sensors: str, func: type = MapObservation, **params: Any) -> ObservationTermCfg:
    """Return the term that reads a map of these sensors."""
    names = [SceneEntityCfg(name) for name in sensors]
    given = {"sensor_cfg": names if len(names) > 1 else names[0], "standing_height": STANDING_HEIGHT}
    return ObservationTermCfg(func=func, params=given | params)


@configclass
class MapEnvCfg(LocomotionVelocityRoughEnvCfg):
    """The task with a camera and a lidar; the policy's height scan is read from the camera's map."""

    def __post_init__(self) -> None:
        """Set the robot, the sensors and the term."""
        super().__post_init__()
        self.scene.num_envs, self.seed, self.sim.device = 4, 0, "cpu"
        self.sim.physics = RoughPhysicsCfg().newton_mjwarp
        self.scene.robot = make_robot()
        self.scene.camera, self.scene.lidar = CAMERA, LIDAR
        # What comes from a server, and what is only seen.
        self.scene.terrain.visual_material, self.scene.sky_light = None, None
        self.commands.base_velocity.debug_vis = False
        generator = self.scene.terrain.terrain_generator
        generator.num_rows, generator.num_cols, generator.border_width, generator.seed = 2, 4, 2.0, 0
        self.scene.terrain.max_init_terrain_level = 1
        self.rewards.feet_air_time.params["sensor_cfg"].body_names = ".*_calf"
        self.rewards.undesired_contacts.params["sensor_cfg"].body_names = ".*_thigh"
        self.observations.policy.height_scan = map_term("camera")


@configclass
class MapsCfg(ObservationGroupCfg):
    """A term for each way to measure."""

    lidar: ObservationTermCfg = map_term("lidar")
    both: ObservationTermCfg = map_term("camera", "lidar")
    slow: ObservationTermCfg = map_term("slow", update_every=2)
    rendered: ObservationTermCfg = map_term("rendered")

    def __post_init__(self) -> None:
        """Keep the terms apart."""
        self.concatenate_terms = False


@configclass
class AllSensorsCfg(MapEnvCfg):
    """The task with all kinds of sensors, and a group of observations with a term for each."""

    def __post_init__(self) -> None:
        """Add the sensors and the terms."""
        super().__post_init__()
        self.observations.maps = MapsCfg()
        self.scene.slow = replace(CAMERA, update_period=0.04)  # two control steps
        self.scene.rendered = RENDERED
        # Isaac Lab's defaults: rays start at the base, inside its shape, and see it.
        self.scene.inside = replace(LIDAR, offset=RayCasterCfg.OffsetCfg(), global_world_only=False)


def make_env(cfg: Any) -> Any:
    """Make the environment and reset it."""
    from isaaclab.envs import ManagerBasedRLEnv

    env = ManagerBasedRLEnv(cfg=cfg)
    env.reset()
    return env


def find_term(env: Any, group: str, name: str) -> ObservationTermCfg:
    """Return the config that the observation manager keeps, whose `func` is the term that it has built."""
    manager = env.observation_manager
    return manager._group_obs_term_cfgs[group][manager.active_terms[group].index(name)]


def find_terms(env: Any) -> dict[str, MapObservation]:
    """Return the terms of `AllSensorsCfg` by what they measure with."""
    maps = {name: find_term(env, "maps", name).func for name in ("lidar", "both", "slow", "rendered")}
    return {"camera": find_term(env, "policy", "height_scan").func} | maps


def random_actions(env: Any, generator: torch.Generator) -> Tensor:
    """Return actions that make robots step, stumble and fall."""
    return torch.randn(env.num_envs, env.action_manager.total_action_dim, generator=generator)


def walk(env: Any, terms: dict[str, MapObservation], steps: int) -> dict[str, dict[str, Tensor]]:
    """Step the environments with random actions; they begin anew where a robot falls on its base.

    Returns:
        for each term ours and ideal (T, B, 187) [m], height of the base over the ground minus 0.5 m; and valid
        (T, B, 187), where the map is known and the ideal ray hits.
    """
    generator, scan = torch.Generator().manual_seed(0), HeightScan.isaac_lab(standing_height=STANDING_HEIGHT)
    found: dict[str, dict[str, list[Tensor]]] = {name: {"ours": [], "ideal": [], "valid": []} for name in terms}
    for _ in range(steps):
        env.step(random_actions(env, generator))
        ideal = mdp.height_scan(env, SceneEntityCfg("height_scanner"))
        for name, term in terms.items():
            ours, known = scan(term.emap, term.maps.source.read_base(env))
            values = {"ours": ours, "ideal": ideal.clamp(-1, 1), "valid": known & ideal.isfinite()}
            for part, value in values.items():
                found[name][part].append(value)
    return {name: {part: torch.stack(values) for part, values in parts.items()} for name, parts in found.items()}
