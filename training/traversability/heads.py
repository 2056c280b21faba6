"""What a learned head is compared with: heads that look at slopes, steps and roughness, and the paper's filter."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev import TraversabilityConfig
from torchelev.filters.inpainting.inpaint import inpaint_minimum, inpaint_telea
from torchelev.filters.smoothing import gaussian
from torchelev.layers import Layer
from torchelev.pipeline import rate_surface
from torchelev.state import blank_state
from torchelev.traversability.paper_filter import RIM, PaperFilter
from training.traversability.maps.data import MappedTerrain
from training.traversability.maps.mapping import map_config

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

PAPER_RESOLUTION = 0.04  # [m] that the paper's weights are for

Score = Callable[[MappedTerrain], Tensor]  # (B, H, W), 0 to 1


def analytic(maps: MappedTerrain, layer: Layer, of_robot: bool) -> Float[Tensor, "B H W"]:
    """Rate heights by slope, step and roughness, by the defaults or at the robot's own slope and step; 0 if unknown."""
    values, known = layer
    cfg = TraversabilityConfig()
    if of_robot:
        robot = maps.robot
        cfg = dataclasses.replace(cfg, critical_slope=robot.max_slope, critical_step=robot.step_height)
    whole = dataclasses.replace(map_config(maps.resolution, values.shape[1] * maps.resolution), traversability=cfg)
    state = blank_state(whole.grid, len(values), values.device, values.dtype)
    return rate_surface(state._replace(elevation=torch.where(known, values, 0.0), validity=known), whole).traversability


def as_mapped(maps: MappedTerrain) -> Layer:
    """Return the elevation as the map holds it."""
    return maps.elevation, maps.validity


def filled_and_smoothed(maps: MappedTerrain) -> Layer:
    """Return the elevation with the lowest height of its border in each hole, smoothed by 5 cm."""
    return gaussian(inpaint_minimum(as_mapped(maps)), resolution=maps.resolution, sigma=0.05)


def paper(maps: MappedTerrain, net: PaperFilter, resampled: bool) -> Float[Tensor, "B H W"]:
    """Rate by the paper's filter, holes filled by Telea's method; 0 where nothing is known.

    As it is, or on heights resampled to the 4 cm that its weights are for.
    """
    values, known = inpaint_telea(as_mapped(maps), resolution=maps.resolution)
    values, shape = torch.where(known, values, 0.0), values.shape[1:]
    if resampled:
        cells = [max(1, round(n * maps.resolution / PAPER_RESOLUTION)) for n in shape]
        values = resize(values, cells)
    rim = F.pad(values[:, None], [RIM] * 4, mode="replicate")[:, 0]  # it rates no cells whose windows leave the map
    rated = net(rim)[:, RIM:-RIM, RIM:-RIM]
    return resize(rated, shape).clamp(0, 1) * known


def resize(values: Float[Tensor, "B H W"], shape: tuple[int, ...] | list[int]) -> Float[Tensor, "B h w"]:
    """Resample to another number of cells, linearly, by their mean where they become fewer."""
    if tuple(values.shape[1:]) == tuple(shape):
        return values
    return F.interpolate(values[:, None], tuple(shape), mode="bilinear", antialias=True)[:, 0]


def lowest_under_body(
    score: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], maps: MappedTerrain
) -> Float[Tensor, "B H W"]:
    """Return the lowest score of the known cells in the circle of the robot's half width around each known cell."""
    radius = int(maps.robot.width / 2 / maps.resolution)
    worst = torch.where(known, 1 - score, 0.0)
    found = torch.zeros_like(score)
    for row in range(-radius, radius + 1):
        reach = int((radius**2 - row**2) ** 0.5)
        widest = F.max_pool2d(worst[:, None], (1, 2 * reach + 1), 1, (0, reach))[:, 0]
        found = torch.maximum(found, F.pad(widest, (0, 0, radius, radius)).narrow(1, radius + row, score.shape[1]))
    return (1 - found) * known


def baselines(paper_weights: Path | None = None) -> dict[str, Score]:
    """Return the heads to compare with, as "family (variant)": also with the robot's footprint, as they know no body.

    The paper's filter takes part if a file of its weights is given; see `PaperFilter.from_npz` for errors.
    """
    heads: dict[str, Score] = {}
    for of_robot, critical in ((False, "defaults"), (True, "robot's")):
        _add(heads, "analytic", critical, _analytic(as_mapped, of_robot), filled=False)
        _add(heads, "analytic on filled", critical, _analytic(filled_and_smoothed, of_robot), filled=True)
    if paper_weights is not None:
        net = PaperFilter.from_npz(paper_weights).requires_grad_(False)
        _add(heads, "paper", "as is", lambda maps: paper(maps, net, False), filled=True)
        _add(heads, "paper", "at 4 cm", lambda maps: paper(maps, net, True), filled=True)
    return heads


def family(name: str) -> str:
    """Return a head's name without its variant."""
    return name.split(" (")[0]


def _add(heads: dict[str, Score], name: str, variant: str, score: Score, filled: bool) -> None:
    def lowest(maps: MappedTerrain) -> Tensor:
        known = torch.ones_like(maps.validity) if filled else maps.validity
        return lowest_under_body(score(maps), known, maps)

    heads[f"{name} ({variant})"] = score
    heads[f"{name} ({variant}, footprint)"] = lowest


def _analytic(layer: Callable[[MappedTerrain], Layer], of_robot: bool) -> Score:
    return lambda maps: analytic(maps, layer(maps), of_robot)
