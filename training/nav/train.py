"""The command that trains a policy for TerrainNav: `python -m training.nav`."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import torch

from envs.terrain_nav import CourseConfig, SightConfig, TerrainNav, TerrainNavConfig
from envs.terrain_nav.config import CEILINGS, PERCEPTION
from envs.terrain_nav.rsl_rl import RslRlTerrainNav, mirror
from torchelev.observations.fill import FILLS
from training.nav.covered import COURSES, covered_course, covered_sight
from training.nav.encoders import ENCODERS, encoder_config
from training.nav.evaluate import evaluate, picture
from training.nav.export import export, record
from training.options import compile_option, smoke_option
from training.resume import checkpoint_path, write_result
from training.runner import ResumableRunner

TaskConfig = Callable[..., TerrainNavConfig]
_POSITIVE = click.IntRange(1)
_TRAIN_SEED, _HELD_OUT_SEED = 1, 1001  # of the courses


def ppo_config(num_steps: int = 24, save_interval: int = 10, encoder: str = "cnn") -> dict[str, Any]:
    """Return rsl-rl's configuration: PPO, with a small network for the actor and one for the critic."""
    model = {"hidden_dims": [128, 64], "activation": "elu", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.7}
    return {
        "num_steps_per_env": num_steps,
        "save_interval": save_interval,
        "encoder": encoder,
        "obs_groups": {"actor": ["policy", "map"], "critic": ["policy", "truth"]},
        "algorithm": {
            "class_name": "PPO",
            "num_learning_epochs": 4,
            "num_mini_batches": 4,
            "learning_rate": 1e-3,
            "schedule": "adaptive",
            "desired_kl": 0.01,
            "gamma": 0.98,
            "lam": 0.95,
            "entropy_coef": 0.003,
            "symmetry_cfg": {"data_augmentation_func": mirror, "use_data_augmentation": True},
        },
        "actor": model | encoder_config(encoder, "map") | {"distribution_cfg": gaussian},
        "critic": model | encoder_config(encoder, "truth"),
    }


def task_config(
    held_out: bool = False, fill: str = "base", course: str = "open", ceilings: str = "none"
) -> TerrainNavConfig:
    """Return the task on the training course, or on the held-out one, with fill and ceilings of `SightConfig`."""
    seed = _HELD_OUT_SEED if held_out else _TRAIN_SEED
    if course == "open":
        return TerrainNavConfig(course=CourseConfig(seed=seed), sight=SightConfig(fill=fill, ceilings=ceilings))
    return TerrainNavConfig(course=covered_course(seed), sight=covered_sight(fill, ceilings))


def make_runner(
    num_envs: int,
    perception: str,
    seed: int,
    device: str,
    log_dir: Path | None,
    compiled: bool = True,
    encoder: str = "cnn",
    fill: str = "base",
    config: TaskConfig = task_config,
    **options: str,
) -> ResumableRunner:
    """Return a runner with its environments, all seeded; `options` are further ones of `config`."""
    rank = int(os.environ.get("RANK", "0"))
    torch.manual_seed(seed + 1000 * rank)
    task = TerrainNav(config(fill=fill, **options), num_envs, device, perception, seed + 1000 * rank, compiled)
    settings = ppo_config(encoder=encoder) | {"fill": fill} | options
    return ResumableRunner(RslRlTerrainNav(task), settings, str(log_dir) if log_dir else None, device)


@click.command()
@click.option("--num-envs", type=_POSITIVE, default=256, show_default=True, help="Number of parallel robots.")
@click.option(
    "--iterations",
    type=_POSITIVE,
    default=140,
    show_default=True,
    help="Iterations in total, including those before --resume.",
)
@click.option(
    "--perception",
    type=click.Choice(PERCEPTION),
    default="map",
    show_default=True,
    help="What the policy sees: the map, the true ground with white noise, or nothing.",
)
@click.option(
    "--encoder",
    type=click.Choice(ENCODERS),
    default="cnn",
    show_default=True,
    help="How the policy reads the map's image.",
)
@click.option(
    "--fill",
    type=click.Choice(FILLS),
    default="base",
    show_default=True,
    help="What the image's elevation reads where the map is unknown.",
)
@click.option(
    "--course",
    type=click.Choice(COURSES),
    default="open",
    show_default=True,
    help="Open ground with blocks and pits, or covered: walls with gates, tables and beams.",
)
@click.option(
    "--ceilings",
    type=click.Choice(CEILINGS),
    default="none",
    show_default=True,
    help="What the image shows of ceilings.",
)
@click.option("--seed", default=0, show_default=True, help="Seed of weights, starts, goals and noise.")
@click.option("--device", default=None, help="Default: a GPU if there is one, else the CPU.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("runs/nav"), show_default=True, help="Output folder."
)
@click.option("--resume", is_flag=True, help="Continue from OUT/checkpoint.pt.")
@compile_option
@smoke_option(num_envs=8, iterations=2, episodes=4, compiled=False)
@click.option("--episodes", type=_POSITIVE, default=256, show_default=True, help="Episodes of the evaluation.")
@click.pass_obj
def main(
    config: TaskConfig | None,
    num_envs: int,
    iterations: int,
    perception: str,
    encoder: str,
    fill: str,
    course: str,
    ceilings: str,
    seed: int,
    device: str | None,
    out: Path,
    resume: bool,
    compiled: bool,
    episodes: int,
) -> None:
    """Train a policy for TerrainNav with rsl-rl's PPO.

    Then evaluate it on held-out ground with the map in the loop, draw an episode and export the policy.

    Writes TensorBoard logs, checkpoints, result.json, episode.png, policy.pt and policy.onnx to OUT. policy.pt
    (TorchScript) takes the observation "policy" (B, 12) and a list of "map" (B, 4, 16, 16); policy.onnx takes "obs"
    (1, 12) and "map" (1, 4, 16, 16). Both return actions (B, 2).
    """
    config = config or task_config
    options = {} if (course, ceilings) == ("open", "none") else {"course": course, "ceilings": ceilings}
    device = device or (f"cuda:{os.environ.get('LOCAL_RANK', '0')}" if torch.cuda.is_available() else "cpu")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise click.UsageError(f"--device: there is no GPU for {device}; leave --device out")
    checkpoint = checkpoint_path(out, resume)
    runner = make_runner(num_envs, perception, seed, device, out, compiled, encoder, fill, config, **options)
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
        _finish(runner, out, episodes, compiled, config(held_out=True, fill=fill, **options))


def _finish(runner: ResumableRunner, out: Path, episodes: int, compiled: bool, cfg: TerrainNavConfig) -> None:
    """Evaluate on held-out ground with the map in the loop, draw an episode and export the policy."""
    policy = runner.get_inference_policy(device=runner.device)
    result = evaluate(policy, cfg, "map", episodes, runner.device, compiled)
    click.echo(" ".join(f"{name} {value:.3f}" for name, value in result.items() if value is not None))
    picture(policy, cfg, out / "episode.png", runner.device)
    export(runner, out)
    is_recorded = record(runner.get_inference_policy(device="cpu"), cfg, out)
    training = {"steps": runner.logger.tot_timesteps, "seconds": runner.logger.tot_time}
    write_result(out / "result.json", {"training": training, "evaluation": result})
    click.echo(f"Wrote result.json, episode.png, policy.pt and policy.onnx to {out}.")
    if is_recorded:
        click.echo(f"For a robot: torchelev export {out} --out bundle")
