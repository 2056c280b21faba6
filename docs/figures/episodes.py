"""One TerrainNav episode, walked by a policy trained on the true ground and by one trained with the map.

    python -m training.nav --perception truth --seed 1 --out runs/truth     # then --perception map --out runs/map
    python -m docs.figures.episodes runs/truth/policy.pt runs/map/policy.pt

Both policies walk the same held-out episodes with the map in the loop: same ground, start, goal and sensor errors.
Draws the first episode that the first policy fails and the second one masters, and prints how often each succeeds.
Writes docs/pictures/truth_and_map.png.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import click
import numpy as np
import torch
from numpy.typing import NDArray

from envs.terrain_nav import TerrainNav
from envs.terrain_nav.outcome import ENDINGS
from envs.terrain_nav.render import Snapshot, draw_column, snapshot, window_around
from torchelev.viz.palette import ROBOT_COLOR
from torchelev.viz.style import make_figure, styled, write
from training.nav.evaluate import Policy
from training.nav.train import task_config

PICTURES = Path(__file__).parents[1] / "pictures"
_NAMES = ("trained on the true ground", "trained with the map")
_SAYS = {"success": "arrives", "fallen": "falls", "stuck": "is stuck", "truncated": "runs out of time"}


class Outcomes(NamedTuple):
    """How a policy's episodes ended."""

    ending: list[str]  #: of each episode
    seconds: list[float]  #: [s] until its end
    trails: NDArray  #: (T, B, 2) [m] positions
    shots: dict[int, Snapshot]  #: by episode, at its end


def load_policy(path: Path) -> Policy:
    """Read an exported policy."""
    scripted = torch.jit.load(str(path))
    return lambda observation: scripted(observation["policy"], [observation["map"]])


@torch.inference_mode()
def run(policy: Policy, episodes: int, seed: int, max_steps: int | None = None) -> Outcomes:
    """Run one episode in each environment, on held-out ground with the map in the loop."""
    cfg = task_config(held_out=True)
    task = TerrainNav(cfg, episodes, "cpu", "map", seed)
    ending, seconds, shots = ["truncated"] * episodes, [cfg.episode_length] * episodes, {}
    trails = [task.xy.numpy().copy()]
    for step in range(max_steps or cfg.max_episode_length):
        outcome = task.advance(policy(task.observe()))
        trails.append(task.xy.numpy().copy())
        for env in outcome.done.nonzero()[:, 0].tolist():
            if env not in shots:
                ending[env] = next(name for name in ENDINGS if bool(getattr(outcome, name)[env]))
                seconds[env], shots[env] = (step + 1) * cfg.dt, snapshot(task, env)
        if len(shots) == episodes:
            break
        task.reset(outcome.done)
        task.sense()
    return Outcomes(ending, seconds, np.array(trails), shots)


def first_difference(results: tuple[Outcomes, Outcomes]) -> int | None:
    """Return the first episode that the first policy fails and the second one masters."""
    pairs = zip(results[0].ending, results[1].ending, strict=True)
    return next((k for k, (a, b) in enumerate(pairs) if a != "success" and b == "success"), None)


@styled()
def draw(results: tuple[Outcomes, Outcomes], env: int, out: Path) -> None:
    """Draw an episode of both policies: the ground with the paths above, the maps at the end below."""
    figure = make_figure(8, 7.4)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    places = [*(_trail(result, env) for result in results), results[0].shots[env].goal]
    window = window_around(np.vstack(places), margin=1.0)
    for column, name, result in zip(axes.T, _NAMES, results, strict=True):
        trail = _trail(result, env)
        image = draw_column(column, result.shots[env], trail, window)
        for ax in column:
            ax.plot(*trail[0], "o", color=ROBOT_COLOR, markeredgecolor="white")
        column[0].set_title(f"{name}: {_SAYS[result.ending[env]]}\nafter {result.seconds[env]:.1f} s")
        column[1].set_xlabel("x [m]")
    axes[0, 0].set_ylabel("ground\ny [m]")
    axes[1, 0].set_ylabel("the robot's map at the end\ny [m]")
    figure.colorbar(image, ax=axes, pad=0.01, extend="both").set_label("height above the level ground [m]")
    write(figure, out)


def _trail(result: Outcomes, env: int) -> NDArray:
    """Return the positions (T, 2) [m] of an episode."""
    return result.trails[: round(result.seconds[env] / task_config().dt) + 1, env]


@click.command(help=__doc__)
@click.argument("truth", type=click.Path(path_type=Path, exists=True))
@click.argument("trained_map", type=click.Path(path_type=Path, exists=True))
@click.option("--episodes", default=128, show_default=True, help="Held-out episodes to choose the first one from.")
@click.option("--seed", default=7, show_default=True, help="Seed of starts, goals and errors.")
@click.option("--out", type=click.Path(path_type=Path), default=PICTURES / "truth_and_map.png")
def main(truth: Path, trained_map: Path, episodes: int, seed: int, out: Path) -> None:
    """Run both policies and draw the pair."""
    first, second = (run(load_policy(path), episodes, seed) for path in (truth, trained_map))
    for name, result in zip(_NAMES, (first, second), strict=True):
        click.echo(f"{name}: {100 * result.ending.count('success') / episodes:.0f} % of {episodes} episodes succeed")
    env = first_difference((first, second))
    if env is None:
        raise click.ClickException("no episode separates the two policies; raise --episodes")
    click.echo(f"episode {env}")
    draw((first, second), env, out)


if __name__ == "__main__":
    main()
