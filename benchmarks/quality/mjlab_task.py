"""Run mjlab's rough velocity task with a map in place of its ideal height scan, and compare the two.

    .venv-mjlab/bin/python -m benchmarks.quality.mjlab_task

16 robots take 50 steps of small random actions; where the map is valid, its height scan is compared with mjlab's own,
which sees through everything. Then PPO learns for one iteration. Writes benchmarks/results/mjlab.json.
`make test-mjlab` makes the environment, and runs the same as a test.
"""

from __future__ import annotations

import dataclasses
import importlib.metadata
import statistics
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks import RESULTS
from torchelev import HeightScan
from torchelev.app.results import markdown_table, write_json
from torchelev.integrations.mjlab import MapObservation

PACKAGES = ("mjlab", "mujoco", "mujoco-warp", "warp-lang", "rsl-rl-lib")
STANDING_HEIGHT = 0.3  # [m] of the Go1's trunk
LEVEL = 0.02  # [m] that the ideal scan may differ between neighbours where the ground counts as level


def make_plain_config(num_envs: int) -> Any:
    """Return the config of the task as mjlab has it."""
    from mjlab.tasks.velocity.config.go1.env_cfgs import unitree_go1_rough_env_cfg

    cfg = unitree_go1_rough_env_cfg()
    cfg.scene.num_envs, cfg.seed = num_envs, 0
    return cfg


def make_config(num_envs: int) -> Any:
    """Return the config of the task for the Go1, whose actor reads a map that a depth camera in its head builds."""
    from mjlab.managers import ObservationTermCfg
    from mjlab.sensor import ObjRef, PinholeCameraPatternCfg, RayCastSensorCfg

    cfg = make_plain_config(num_envs)
    cfg.scene.spec_fn = add_camera
    camera = RayCastSensorCfg(
        name="depth_camera",
        frame=ObjRef(type="site", name="eye", entity="robot"),
        pattern=PinholeCameraPatternCfg(width=64, height=48, fovy=58.0),
        max_distance=4.0,
        include_geom_groups=(0,),
    )
    cfg.scene.sensors += (camera,)
    cfg.observations["actor"].terms["height_scan"] = ObservationTermCfg(
        func=MapObservation, params={"sensor_name": "depth_camera", "standing_height": STANDING_HEIGHT}
    )
    return cfg


def add_camera(spec: Any) -> None:
    """Add a site to the robot's head whose axes are those of a camera: it looks ahead and 40 degrees down."""
    quat = (0.6409, 0.2988, -0.2988, -0.6409)  # w x y z; x right, y up, z backward
    spec.body("robot/trunk").add_site(name="robot/eye", pos=(0.28, 0.0, 0.06), quat=quat)


def make_env(cfg: Any) -> Any:
    """Make the environment on the CPU and reset it."""
    from mjlab.envs import ManagerBasedRlEnv

    env = ManagerBasedRlEnv(cfg=cfg, device="cpu")
    env.reset()
    return env


def find_term(env: Any, group: str = "actor", name: str = "height_scan") -> MapObservation:
    """Return the term that the observation manager has built."""
    return env.observation_manager.get_term_cfg(group, name).func


def walk(env: Any, steps: int) -> dict[str, Tensor]:
    """Step the environments with small random actions.

    Returns:
        ours and ideal (T, B, 187) [m], height of the base over the ground; valid (T, B, 187); and observed
        (T, B, 187), what the policy gets.
    """
    from mjlab.envs.mdp import height_scan

    generator, scan, term = torch.Generator().manual_seed(0), HeightScan.mjlab(), find_term(env)
    size = (env.num_envs, env.action_manager.total_action_dim)
    ours, ideal, valid, observed = [], [], [], []
    for _ in range(steps):
        groups, *_ = env.step(0.3 * torch.randn(size, generator=generator))
        values, known = scan(term.emap, term.maps.source.read_base(env))
        hits = env.scene["terrain_scan"].data.distances >= 0
        ours.append(values / scan.scale)
        ideal.append(height_scan(env, "terrain_scan"))
        valid.append(known & hits)
        observed.append(groups["actor"][:, -values.shape[1] :].clone())
    return {name: torch.stack(part) for name, part in (("ours", ours), ("ideal", ideal), ("valid", valid))} | {
        "observed": torch.stack(observed)
    }


def is_level(ideal: Tensor) -> Tensor:
    """Return where the ideal scan (..., 187) differs by at most LEVEL from all eight neighbours: no edge is near."""
    grid = ideal.unflatten(-1, (11, 17)).flatten(0, -3)[:, None]
    highest = torch.nn.functional.max_pool2d(grid, 3, 1, 1)
    lowest = -torch.nn.functional.max_pool2d(-grid, 3, 1, 1)
    return (highest - lowest <= LEVEL).view(ideal.shape)


def compare(walked: dict[str, Tensor]) -> dict[str, Any]:
    """Return the differences between the two scans [m] where the map is valid: everywhere, and on level ground."""
    error = (walked["ours"] - walked["ideal"]).abs()
    level = walked["valid"] & is_level(walked["ideal"])
    return {
        "valid": float(walked["valid"].float().mean()),
        "all": _summary(error[walked["valid"]]),
        "level": _summary(error[level]),
    }


def _summary(error: Tensor) -> dict[str, float]:
    quantiles = torch.quantile(error[:: max(1, len(error) // 10**6)], torch.tensor([0.5, 0.9, 0.99]))
    return {"points": len(error), **{f"p{q}": float(v) for q, v in zip((50, 90, 99), quantiles, strict=True)}}


def train_once(env: Any) -> dict[str, float]:
    """Learn for one iteration of PPO with the task's own settings; return its losses."""
    from mjlab.rl import MjlabOnPolicyRunner, RslRlVecEnvWrapper
    from mjlab.tasks.velocity.config.go1.rl_cfg import unitree_go1_ppo_runner_cfg

    settings = dataclasses.asdict(unitree_go1_ppo_runner_cfg())
    runner = MjlabOnPolicyRunner(RslRlVecEnvWrapper(env), settings, log_dir=None, device="cpu")
    losses: dict[str, float] = {}
    update = runner.alg.update
    runner.alg.update = lambda: losses.update(update()) or losses
    runner.learn(1)
    return {name: float(value) for name, value in losses.items()}


def time_steps(envs: dict[str, Any], steps: int = 10, rounds: int = 5) -> dict[str, float]:
    """Return the time of a control step [ms] of each environment, the median of rounds that alternate."""
    times: dict[str, list[float]] = {name: [] for name in envs}
    for env in envs.values():
        env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))  # compiles what is left
    for _ in range(rounds):
        for name, env in envs.items():
            start = time.perf_counter()
            for _ in range(steps):
                env.step(torch.zeros(env.num_envs, env.action_manager.total_action_dim))
            times[name].append(1e3 * (time.perf_counter() - start) / steps)
    return {name: statistics.median(values) for name, values in times.items()}


def table(results: dict[str, Any]) -> str:
    """Tabulate the differences [mm] and the times of a step [ms], with the versions."""
    rows = []
    for name, where in (("all", "where the map is valid"), ("level", "of these, on level ground")):
        error = results["error"][name]
        rows.append([where, *(f"{1e3 * error[q]:.2f}" for q in ("p50", "p90", "p99")), f"{error['points']:,}"])
    head = ["difference from mjlab's scan", "median mm", "p90 mm", "p99 mm", "points"]
    times, versions = results["milliseconds_per_step"], results["versions"]
    valid = f"The map is valid at {results['error']['valid']:.0%} of the points"
    steps = f"a control step of {results['num_envs']} robots takes {times['map']:.0f} ms with the map"
    with_ideal = f"{times['ideal scan']:.0f} ms with the ideal scan alone"
    run_with = ", ".join(f"{name} {version}" for name, version in versions.items())
    return f"{markdown_table(head, rows)}\n\n{valid}; {steps} and {with_ideal}. {run_with}."


def main(path: Path = RESULTS / "mjlab.json", num_envs: int = 16, steps: int = 50) -> None:
    """Run, print and write the results."""
    plain, env = make_env(make_plain_config(num_envs)), make_env(make_config(num_envs))
    results = {
        "versions": {name: importlib.metadata.version(name) for name in PACKAGES},
        "task": "Mjlab-Velocity-Rough-Unitree-Go1",
        "num_envs": num_envs,
        "steps": steps,
        "milliseconds_per_step": time_steps({"ideal scan": plain, "map": env}),
        "error": compare(walk(env, steps)),
        "losses": train_once(env),
    }
    write_json(path, results)
    print(table(results))


if __name__ == "__main__":
    main()
