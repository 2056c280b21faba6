"""Train a quadruped to walk over rough ground with rsl-rl's PPO, evaluate and export the policy."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch

from envs.quadruped import Quadruped, QuadrupedConfig
from envs.quadruped.config import PERCEPTION
from envs.quadruped.rsl_rl import RslRlQuadruped
from torchelev.errors import require
from training.options import compile_option, smoke_option
from training.quadruped.evaluate import evaluate, table
from training.quadruped.play import play
from training.quadruped.policy import GROUPS, LoadedPolicy, export, load_policy, record, sight_of
from training.resume import checkpoint_path, write_result
from training.runner import ResumableRunner

TaskConfig = Callable[..., QuadrupedConfig]
_POSITIVE = click.IntRange(min=1)
_HELD_OUT_SEED = 1001  # of the terrain
CRITIC = ("policy", "privileged", "true_height_scan", "true_feet")


def ppo_config(save_interval: int = 25) -> dict[str, Any]:
    """Return rsl-rl's configuration: PPO with an actor that sees its map and a critic that sees the truth."""
    model = {"class_name": "MLPModel", "hidden_dims": [256, 128, 64], "activation": "elu", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.35}
    return {
        "num_steps_per_env": 24,
        "save_interval": save_interval,
        "obs_groups": {"actor": list(GROUPS), "critic": list(CRITIC)},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "learning_rate": 1e-3,
            "schedule": "adaptive",
            "desired_kl": 0.01,
            "gamma": 0.99,
            "lam": 0.95,
            "entropy_coef": 0.002,
        },
        "actor": model | {"distribution_cfg": gaussian},
        "critic": dict(model),
    }


def task_config(held_out: bool = False) -> QuadrupedConfig:
    """Return the task on the training ground, with a curriculum, or on held-out ground at levels drawn evenly."""
    cfg = QuadrupedConfig()
    if not held_out:
        return cfg
    terrain = dataclasses.replace(cfg.terrain, seed=_HELD_OUT_SEED, curriculum=False)
    command = dataclasses.replace(cfg.command, forward=(0.5, 0.5), left=(0.0, 0.0), standing=0.0)
    return dataclasses.replace(cfg, terrain=terrain, command=command)


def make_runner(
    num_envs: int,
    perception: str,
    seed: int,
    device: str,
    log_dir: Path | None,
    compiled: bool = True,
    config: TaskConfig = task_config,
) -> ResumableRunner:
    """Return a runner with its environments, all seeded."""
    rank = int(os.environ.get("RANK", "0"))
    torch.manual_seed(seed + 1000 * rank)
    task = Quadruped(config(), num_envs, device, perception, seed + 1000 * rank, compiled)
    return ResumableRunner(RslRlQuadruped(task), ppo_config(), str(log_dir) if log_dir else None, device)


@click.command()
@click.option("--num-envs", type=_POSITIVE, default=256, show_default=True, help="Number of parallel robots.")
@click.option(
    "--iterations",
    type=_POSITIVE,
    default=1000,
    show_default=True,
    help="Iterations in total, including those before --resume.",
)
@click.option(
    "--perception",
    type=click.Choice(PERCEPTION),
    default="map",
    show_default=True,
    help="What the policy sees: the map, the true ground with noise, or nothing.",
)
@click.option("--seed", default=0, show_default=True, help="Seed of weights, starts, commands and noise.")
@click.option("--device", default=None, help="Of policy and map. Default: a GPU if there is one, else the CPU.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("runs/quadruped"), show_default=True, help="Output folder."
)
@click.option("--resume", is_flag=True, help="Continue from OUT/checkpoint.pt.")
@compile_option
@click.option("--episodes", type=_POSITIVE, default=280, show_default=True, help="Episodes of the evaluation.")
@smoke_option(num_envs=7, iterations=2, episodes=7, compiled=False)
@click.option(
    "--play",
    "played",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Do not train: walk with this policy.pt and write OUT/walk.webp.",
)
@click.option(
    "--kind", default="stairs up", show_default=True, help="What the robot meets in --play, such as 'stairs down'."
)
@click.option("--level", default=3, show_default=True, help="Difficulty for --play, from 0 to 7.")
@click.pass_obj
def main(
    config: TaskConfig | None,
    num_envs: int,
    iterations: int,
    perception: str,
    seed: int,
    device: str | None,
    out: Path,
    resume: bool,
    compiled: bool,
    episodes: int,
    played: Path | None,
    kind: str,
    level: int,
) -> None:
    """Train a quadruped to walk over rough ground with rsl-rl's PPO.

    Then evaluate it on held-out ground, with odometry that drifts and the map in the loop (a blind policy: blind), and
    export the policy.

    Writes TensorBoard logs, checkpoints, result.json, policy.pt and policy.onnx to OUT. Both policies hold the layout
    of the scans that they read, and loading policy.pt with another one is refused.
    """
    config = config or task_config
    if played is not None:
        return _play(played, out, kind, level, seed, config)
    device = device or (f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise click.UsageError(f"--device: there is no GPU for {device}; leave --device out")
    checkpoint = checkpoint_path(out, resume)
    runner = make_runner(num_envs, perception, seed, device, out, compiled, config)
    if resume:
        try:
            runner.resume(checkpoint)
        except ValueError as error:
            raise click.UsageError(str(error)) from None
    remaining = iterations - runner.current_learning_iteration
    if remaining <= 0:
        click.echo(f"{checkpoint} has {runner.current_learning_iteration} iterations already: only evaluating it.")
    else:
        try:
            runner.learn(remaining, init_at_random_ep_len=not resume)
        except KeyboardInterrupt:
            raise click.ClickException(f"stopped; {checkpoint} is saved, continue with --resume") from None
    runner.close()
    if int(os.environ.get("RANK", "0")) == 0:
        _finish(runner, out, episodes, compiled, config)


def _play(policy: Path, out: Path, kind: str, level: int, seed: int, config: TaskConfig) -> None:
    """Walk with an exported policy and write a moving picture."""
    out.mkdir(parents=True, exist_ok=True)
    cfg = config(held_out=True)
    try:
        loaded = load_policy(policy, cfg)
        perception = _trained_with(loaded, policy)
        play(loaded, cfg, out / "walk.webp", kind, level, seed=seed, perception=perception)
    except (ValueError, RuntimeError) as error:
        raise click.ClickException(str(error)) from None
    click.echo(f"Wrote {out / 'walk.webp'}, {'blind' if perception == 'blind' else 'with the map in the loop'}.")


def _trained_with(policy: LoadedPolicy, path: Path) -> str:
    """Return the perception of a policy's training.

    Raises:
        ValueError: The file does not say.
    """
    hint = "export it again: python -m training.quadruped --resume --out with its folder"
    require(policy.perception is not None, str(path), "must hold the perception of its training", "none", hint)
    return str(policy.perception)


def _finish(runner: ResumableRunner, out: Path, episodes: int, compiled: bool, config: TaskConfig) -> None:
    """Evaluate with the map in the loop, or blind, write the result and export the policy."""
    policy = runner.get_inference_policy(device=runner.device)
    sight = sight_of(runner.env.task.perception)
    result = evaluate(policy, config(held_out=True), sight, episodes, runner.device, compiled)
    click.echo(table(result))
    training = {"steps": runner.logger.tot_timesteps, "seconds": runner.logger.tot_time}
    write_result(out / "result.json", {"training": training, "evaluation": result})
    export(runner, config(), out)
    click.echo(f"Wrote result.json, policy.pt and policy.onnx to {out}.")
    if sight == "map":
        record(runner.get_inference_policy(device="cpu"), config(held_out=True), out)
        click.echo(f"For a robot: torchelev export {out} --out bundle")
