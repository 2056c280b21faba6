"""Compare walking policies that were trained with the map in the loop, with the true ground and blind.

    python -m training.quadruped.experiment

Trains every seed with each perception and deploys every policy on held-out ground, with odometry that drifts: those
that see, with the map in the loop; blind ones blind. Finished trainings are kept in RUNS: after Ctrl-C, run the command
again. Writes training/results/quadruped.json and quadruped.png.
"""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import click
import torch
from matplotlib.figure import Figure
from tqdm import tqdm

from envs.quadruped import QuadrupedConfig
from envs.quadruped.config import PERCEPTION
from torchelev.app.results import markdown_table, write_json
from torchelev.errors import require
from torchelev.sim import make_terrain
from torchelev.viz.style import make_figure, styled, write
from training import RESULTS
from training.jobs import Job, train_all
from training.options import jobs_option, runs_option
from training.quadruped.evaluate import evaluate, stand_in_trot
from training.quadruped.policy import load_policy, sight_of
from training.quadruped.train import ppo_config, task_config
from training.runs import mean, read_scalars, spread

# Fixed before the first run.
SEEDS = (0, 1)
ITERATIONS, NUM_ENVS, EPISODES, WALKS = 500, 256, 560, 128
CASES = [(perception, seed) for seed in SEEDS for perception in PERCEPTION]
NAMES = {"map": "map in the loop", "truth": "truth with noise", "blind": "blind"}
KINDS = QuadrupedConfig().terrain.labels
Evaluate = Callable[..., dict[str, Any]]
_BLOCK = 10  # iterations that a point of a learning curve averages


def _folder(runs: Path, perception: str, seed: int) -> Path:
    return runs / f"{perception}-{seed}"


def _jobs(runs: Path) -> list[Job]:
    """Return a training for each perception and seed."""
    fixed = {"--iterations": ITERATIONS, "--num-envs": NUM_ENVS}
    return [
        Job("training.quadruped", {"--perception": name, "--seed": seed, **fixed}, _folder(runs, name, seed))
        for name, seed in CASES
    ]


def walk_config() -> QuadrupedConfig:
    """Return flat and rough tiles with room for 20 s at 1.5 times the commanded 0.5 m/s."""
    cfg = task_config(held_out=True)
    terrain = dataclasses.replace(cfg.terrain, kinds=("flat", "rough"), num_levels=4, length=32.0)
    return dataclasses.replace(cfg, terrain=terrain)


def _deploy(policy: Any, perception: str, evaluate: Evaluate = evaluate) -> dict[str, Any]:
    """Deploy a policy over all kinds of terrain, and for 20 s on flat and rough ground, with what it sees.

    Raises:
        ValueError: A robot has crossed its tile on flat or rough ground: its speed there would be of a shorter walk.
    """
    crossing = evaluate(policy, task_config(held_out=True), perception, EPISODES, compiled=True)
    walk = evaluate(policy, walk_config(), perception, WALKS, compiled=True)["by_kind"]
    for kind, row in walk.items():
        actual, hint = f"{100 * row['crossed']:.3g} % crossed", "lengthen the tiles of walk_config"
        require(row["crossed"] == 0, f"walk, {kind}", "must end before the rim of the tile", actual, hint)
    return {"deployed": crossing, "walk": walk}


def _deploy_all(runs: Path, evaluate: Evaluate = evaluate) -> dict[str, Any]:
    """Deploy every policy on held-out ground, and the trot that none of them has modified."""
    cfg = task_config(held_out=True)
    rows = []
    for case in tqdm(CASES):
        folder = _folder(runs, *case)
        rows.append(
            _load_or_make(
                folder / "deployed.json", functools.partial(_row, runs, *case, evaluate), folder / "policy.pt"
            )
        )
    fixed = {
        "seeds": SEEDS, "iterations": ITERATIONS, "num_envs": NUM_ENVS, "episodes": EPISODES, "walks": WALKS,
        "levels": cfg.terrain.num_levels, "difficulty": cfg.terrain.difficulty,
    }  # fmt: skip
    trot = _load_or_make(runs / "trot.json", lambda: _deploy(stand_in_trot, "blind", evaluate))
    return {"config": fixed, "trot": trot, "rows": rows}


def _load_or_make(
    path: Path,
    make: Callable[[], dict[str, Any]],
    policy: Path | None = None,
    settings: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the result in a file; make and write it first if the file is missing or of other settings or weights."""
    source = json.loads(
        json.dumps((settings or _settings()) | {"policy": policy and sha256(policy.read_bytes()).hexdigest()})
    )
    kept = json.loads(path.read_text()) if path.exists() else {}
    if kept.get("source") != source:
        kept = {"source": source, "result": make()}
        path.write_text(json.dumps(kept))
    return json.loads(json.dumps(kept["result"]))


def _settings() -> dict[str, Any]:
    """Return the settings that determine the result of a deployment, besides the policy."""
    tasks = {"crossing": task_config(held_out=True), "walk": walk_config()}
    constants = {"iterations": ITERATIONS, "num_envs": NUM_ENVS, "episodes": EPISODES, "walks": WALKS}
    return constants | {name: dataclasses.asdict(cfg) for name, cfg in tasks.items()}


def _row(runs: Path, perception: str, seed: int, evaluate: Evaluate) -> dict[str, Any]:
    """Deploy one policy; also as it was trained, if that is something else."""
    cfg, folder = task_config(held_out=True), _folder(runs, perception, seed)
    policy = load_policy(folder / "policy.pt", cfg)
    training = json.loads((folder / "result.json").read_text())["training"]
    row = {"perception": perception, "seed": seed, "training": training} | _deploy(
        policy, sight_of(perception), evaluate
    )
    is_own = perception != "truth"
    own = row["deployed"]["all"] if is_own else evaluate(policy, cfg, perception, EPISODES)["all"]
    return row | {"own": own, "curve": read_curve(folder)}


def read_curve(folder: Path) -> dict[str, list[float]]:
    """Return the mean level and the share of crossed tiles over environment steps, each averaged over iterations."""
    per_iteration = ppo_config()["num_steps_per_env"] * NUM_ENVS
    level, crossed = (list(read_scalars(folder, f"/{name}").values()) for name in ("level", "crossed"))
    starts = range(0, len(level), _BLOCK)
    return {
        "steps": [(start + len(level[start : start + _BLOCK])) * per_iteration for start in starts],
        "level": [round(mean(level[start : start + _BLOCK]), 3) for start in starts],
        "crossed": [round(mean(crossed[start : start + _BLOCK]), 4) for start in starts],
    }


def table(result: dict[str, Any]) -> str:
    """Tabulate the crossed tiles by kind of terrain: the mean over the seeds, and the lowest and highest of all."""
    head = ["trained with", "crossed", *KINDS, "fallen", "as trained"]
    lines = []
    for perception in PERCEPTION:
        rows = _rows(result, perception)
        kinds = [mean([row["deployed"]["by_kind"][kind]["crossed"] for row in rows]) for kind in KINDS]
        crossed, own = (spread([row[name]["crossed"] for row in rows]) for name in ("all", "own"))
        fallen = mean([row["all"]["fallen"] for row in rows])
        lines.append([NAMES[perception], crossed, *map(_percent, kinds), _percent(fallen), own])
    trot = result["trot"]["deployed"]
    alone = [_percent(trot["by_kind"][kind]["crossed"]) for kind in KINDS]
    ends = [_percent(trot["all"][name]) for name in ("crossed", "fallen")]
    return markdown_table(head, [*lines, ["(the trot alone)", ends[0], *alone, ends[1], ""]])


def stairs_table(result: dict[str, Any]) -> str:
    """Tabulate the stairs that each policy crossed, by their height: a percentage for each seed."""
    head = ["crossed [%], by seed", *(f"{height:.1f} cm" for height in stair_heights(result["config"]))]
    lines = []
    for kind in ("stairs up", "stairs down"):
        for perception in PERCEPTION:
            by_level = [row["deployed"]["by_level"][kind].values() for row in _rows(result, perception)]
            cells = [", ".join(f"{100 * of['crossed']:.0f}" for of in level) for level in zip(*by_level, strict=True)]
            lines.append([f"{kind}: {NAMES[perception]}", *cells])
    return markdown_table(head, lines)


def walk_table(result: dict[str, Any]) -> str:
    """Tabulate the speed by the commanded 0.5 m/s, and the falls, in 20 s on flat and rough ground."""
    head = ["trained with", "flat: speed by command", "fallen", "rough: speed by command", "fallen"]
    lines = []
    for perception in PERCEPTION:
        rows, cells = _rows(result, perception), []
        for kind in ("flat", "rough"):
            speed, fallen = (mean([row["walk"][kind][name] for row in rows]) for name in ("speed", "fallen"))
            cells += [f"{speed:.2f}", f"{100 * fallen:.1f} %"]
        lines.append([NAMES[perception], *cells])
    return markdown_table(head, lines)


def _rows(result: dict[str, Any], perception: str) -> list[dict[str, Any]]:
    """Return the results of a perception, one for each seed."""
    return [row | {"all": row["deployed"]["all"]} for row in result["rows"] if row["perception"] == perception]


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.0f} %"


@styled()
def plot(result: dict[str, Any], path: Path) -> Figure:
    """Draw the level during training, and the crossed tiles by kind and level when deployed."""
    figure = make_figure(11, 5.2)
    grid = figure.add_gridspec(2, 5)
    curves = figure.add_subplot(grid[:, :2])
    colors = dict(zip(PERCEPTION, ("C0", "C1", "0.5"), strict=True))
    for row in result["rows"]:
        label = NAMES[row["perception"]] if row["seed"] == result["config"]["seeds"][0] else None
        curve = row["curve"]
        curves.plot(curve["steps"], curve["level"], color=colors[row["perception"]], linewidth=1.2, label=label)
    curves.set(xlabel="environment steps", ylabel="mean level", title="while training, as trained")
    curves.xaxis.set_major_formatter(lambda steps, _: f"{steps / 1e6:g}M")
    curves.legend(loc="lower right")
    levels = range(result["config"]["levels"])
    shown = [kind for kind in KINDS if kind != "flat"]
    for place, kind in enumerate(shown):
        axes = figure.add_subplot(grid[place // 3, 2 + place % 3])
        for perception in PERCEPTION:
            rows = [row["deployed"]["by_level"][kind] for row in _rows(result, perception)]
            crossed = [mean([row[str(level)]["crossed"] for row in rows]) for level in levels]
            axes.plot(levels, crossed, "o-", color=colors[perception], linewidth=1.2, markersize=3)
        axes.set(title=kind, ylim=(-0.04, 1.04), xticks=levels, xlabel="level")
        if kind.startswith("stairs"):
            axes.set_xticks(levels, [f"{height:.0f}" for height in stair_heights(result["config"])])
            axes.set_xlabel("height of a stair [cm]")
        axes.set_ylabel(f"crossed, of {_per_point(result)}" if place % 3 == 0 else "")
    write(figure, path)
    return figure


def stair_heights(config: dict[str, Any]) -> list[float]:
    """Return the height of a stair [cm] at each level."""
    first, last = config["difficulty"]
    difficulty = torch.linspace(first, last, config["levels"])
    tiles = make_terrain("stairs_down", difficulty, resolution=0.1).field.heights  # 0 in the middle
    return [100 * float(heights[heights > 0].min()) for heights in tiles]


def _per_point(result: dict[str, Any]) -> int:
    """Return the number of episodes, over the seeds, of a kind and level."""
    rows = _rows(result, PERCEPTION[0])
    return sum(row["deployed"]["by_level"][KINDS[0]]["0"]["episodes"] for row in rows)


@click.command(help=__doc__)
@runs_option("runs/quadruped_experiment")
@jobs_option
def main(runs: Path, jobs: int) -> None:
    """Train, deploy, write JSON and figure and print the tables."""
    train_all(_jobs(runs), jobs)
    result = _deploy_all(runs)
    write_json(RESULTS / "quadruped.json", result)
    plot(result, RESULTS / "quadruped.png")
    click.echo("\n\n".join(make(result) for make in (table, stairs_table, walk_table)))


if __name__ == "__main__":
    main()
