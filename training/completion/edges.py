"""Measure where the completion and in-painting filters put the edges of stairs that were seen in part.

    python -m training.completion.edges

A robot stands before stairs that go up or down. Along lines across them, an edge is where the completed height first
passes the middle between the two treads. The edges behind the first one count whose next tread was seen in part: some
of its middle third is known, and not all of it.
Writes training/results/completion_edges.json and prints the table.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import torch
from torch import Tensor
from tqdm import tqdm

from torchelev.app.results import markdown_table, write_json
from torchelev.completion.net import CompletionNet
from torchelev.sim import HeightField
from training import RESULTS
from training.completion.evaluate import COMPLETED, FILLS, Answer, fill, learned
from training.completion.stairs import NUM_EDGES, WINDOW, SeenStairs, Stairs, look_at

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

SEEDS = 10  # robots for each of the stairs
NAME = "completion_edges"  # of the result
TRUE_CELLS = "true cells"  # the true heights at the cells' centers: what the resolution leaves
CLOSE = 0.02  # [m]
_LINES = torch.linspace(-0.5, 0.5, 9)  # [m] y of the lines
_SHARES = torch.linspace(-0.5, 0.5, 301)  # of the run, places around an edge


class Sizes(NamedTuple):
    """The stairs, and the cells of the maps [m]."""

    rises: tuple[float, ...] = (0.12, 0.16, 0.2)
    runs: tuple[float, ...] = (0.25, 0.3, 0.36)
    resolutions: tuple[float, ...] = (0.02, 0.04, 0.08)


USUAL = Sizes()


class Edge(NamedTuple):
    """An edge of B stairs, on L lines and at S places around it on each."""

    xy: Float[Tensor, "B L S 2"]  #: [m] in the frame of the map's center
    counts: Bool[Tensor, "B L"]  #: the next tread was seen in part


def find_edges(seen: SeenStairs) -> Iterator[tuple[int, Edge]]:
    """Yield the edges behind the first one."""
    maps = seen.maps
    known = maps.layers.validity.float()
    for k in range(1, NUM_EDGES):
        tread = _lines(seen, k + 0.5 + _SHARES)
        middle = _lines(seen, k + 0.5 + _SHARES / 3)  # without the risers' cells
        is_known, is_known_in_middle = (_read(known, xy, maps.resolution) > 0.5 for xy in (tread, middle))
        is_inside = tread.abs().amax((-2, -1)) < WINDOW / 2 - maps.resolution
        yield k, Edge(_lines(seen, k + _SHARES), is_inside & is_known_in_middle.any(-1) & ~is_known.all(-1))


def _lines(seen: SeenStairs, runs: Float[Tensor, "S"]) -> Float[Tensor, "B L S 2"]:
    """Return the places at x = runs * run on each line."""
    x = runs * torch.tensor([each.run for each in seen.stairs])[:, None]
    x, y = torch.broadcast_tensors(x[:, None], _LINES[:, None])
    T = seen.T_center_stairs.float()
    return torch.einsum("bkl,bnsl->bnsk", T[:, :2, :2], torch.stack([x, y], -1)) + T[:, None, None, :2, 3]


def _read(layer: Float[Tensor, "B H W"], xy: Float[Tensor, "B L S 2"], resolution: float) -> Float[Tensor, "B L S"]:
    """Interpolate a layer between the cells' centers."""
    return HeightField(layer, resolution).height(torch.arange(len(xy)), xy.flatten(1, 2)).view(xy.shape[:3])


def errors_of(heights: Float[Tensor, "B L S"], k: int, stairs: tuple[Stairs, ...]) -> Float[Tensor, "B L"]:
    """Return the errors [m] of the places where heights first pass the middle between the treads of edge k.

    Heights that pass it nowhere within half a run of the edge err by half a run.
    """
    rise, run = torch.tensor([(each.rise, each.run) for each in stairs]).T[:, :, None]
    is_beyond = (heights - ((k + 0.5) * rise)[..., None]) * rise[..., None] > 0
    first = torch.where(is_beyond.any(-1), is_beyond.int().argmax(-1), len(_SHARES) - 1)
    return _SHARES[first] * run


@torch.no_grad()
def all_errors(answers: dict[str, Answer], seen: SeenStairs) -> dict[str, Tensor]:
    """Return the errors [m] of each answer, on all lines that count."""
    edges, maps = list(find_edges(seen)), seen.maps
    found = {}
    for name, answer in answers.items():
        mean = answer(maps)[0]
        errors = [errors_of(_read(mean, edge.xy, maps.resolution), k, seen.stairs)[edge.counts] for k, edge in edges]
        found[name] = torch.cat(errors)
    return found


def measure(errors: Float[Tensor, "n"]) -> dict[str, float | int]:
    """Return the metrics [m] of signed errors."""
    size = errors.abs()
    if not len(size):
        return {"edges": 0}
    values = {"median": size.median(), "p90": size.quantile(0.9), "within_2_cm": (size <= CLOSE).float().mean()}
    values["bias"] = errors.median()  # positive: beyond the edge, seen from the robot
    return {"edges": len(size)} | {name: round(float(value), 5) for name, value in values.items()}


def evaluate(answers: dict[str, Answer], seeds: int, sizes: Sizes = USUAL) -> dict[str, Any]:
    """Measure answers, and the fills, as `result[direction][resolution][answer][metric]`."""
    answers = answers | {name: fill(name) for name in FILLS} | {TRUE_CELLS: lambda maps: (maps.truth, None)}
    result: dict[str, Any] = {}
    for direction, sign in (("up", 1), ("down", -1)):
        stairs = [Stairs(rise=sign * rise, run=run) for rise, run in itertools.product(sizes.rises, sizes.runs)]
        for resolution in sizes.resolutions:
            bar = tqdm(range(seeds), desc=f"{direction} at {100 * resolution:g} cm", unit="robot")
            parts = [all_errors(answers, look_at(stairs, resolution, seed)) for seed in bar]
            measured = {name: measure(torch.cat([part[name] for part in parts])) for name in answers}
            result.setdefault(direction, {})[f"{resolution:g}"] = measured
    return result


def table(result: dict[str, Any]) -> str:
    """Tabulate the median and the 90th percentile [cm], and the share within 2 cm [%]."""
    lines: list[list[str]] = []
    names: list[str] = []
    for direction in ("up", "down"):
        for resolution, of_answers in result[direction].items():
            names = list(of_answers)
            cells = [of_answers[name] for name in names]
            if not cells[0]["edges"]:
                continue
            texts = [f"{100 * c['median']:.1f} / {100 * c['p90']:.1f} / {100 * c['within_2_cm']:.0f}" for c in cells]
            lines.append([direction, f"{100 * float(resolution):g} cm", str(cells[0]["edges"]), *texts])
    return markdown_table(["stairs", "cells", "edges", *names], lines)


@click.command(help=__doc__)
@click.option("--weights", type=click.Path(path_type=Path, exists=True), default=None, help="Weights to evaluate.")
@click.option("--seeds", type=click.IntRange(1), default=SEEDS, show_default=True, help="Robots per stairs.")
@click.option(
    "--out", type=click.Path(path_type=Path), default=RESULTS / "completion_edges.json", help="File to write."
)
@click.pass_obj
def main(sizes: Sizes | None, weights: Path | None, seeds: int, out: Path) -> None:
    """Measure, write JSON and print the table."""
    answers = {COMPLETED: learned(CompletionNet.from_pretrained(weights))}
    result = evaluate(answers, seeds, sizes or USUAL)
    write_json(out, result | {"seeds": seeds})
    click.echo(table(result))


if __name__ == "__main__":
    main()
