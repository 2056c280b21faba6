"""The heads to compare a learned head with: the analytic head in several variants, and the paper's filter."""

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
from torchelev.pipeline import rate
from torchelev.state import blank_state
from torchelev.traversability.paper_filter import RIM, PaperFilter
from training.traversability.maps.data import MappedTerrain
from training.traversability.maps.mapping import map_config

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_PAPER_RESOLUTION = 0.04  # [m] of the maps that the paper's weights are for

Score = Callable[[MappedTerrain], Tensor]  # (B, H, W), 0 to 1


def analytic(maps: MappedTerrain, layer: Layer, of_robot: bool) -> Float[Tensor, "B H W"]:
    """Rate a layer by the analytic head, with its default or the robot's critical slope and step; 0 where unknown."""
    values, known = layer
    cfg = TraversabilityConfig()
    if of_robot:
        robot = maps.robot
        cfg = dataclasses.replace(cfg, critical_slope=robot.max_slope, critical_step=robot.step_height)
    map_cfg = dataclasses.replace(map_config(maps.resolution, values.shape[1] * maps.resolution), traversability=cfg)
    state = blank_state(map_cfg.grid, len(values), values.device, values.dtype)
    return rate(state._replace(elevation=torch.where(known, values, 0.0), validity=known), map_cfg).traversability


def as_mapped(maps: MappedTerrain) -> Layer:
    """Return the elevation and validity of the maps."""
    return maps.elevation, maps.validity


def _fill_and_smooth(maps: MappedTerrain) -> Layer:
    """Fill each hole of the elevation with the lowest height of its border, and smooth with a sigma of 5 cm."""
    return gaussian(inpaint_minimum(as_mapped(maps)), resolution=maps.resolution, sigma=0.05)


def paper(maps: MappedTerrain, net: PaperFilter, resampled: bool) -> Float[Tensor, "B H W"]:
    """Rate by the paper's filter, with holes filled by Telea's method; 0 in maps without known cells.

    Args:
        maps: the maps.
        net: the paper's filter.
        resampled: apply it to heights resampled to the 4 cm that its weights are for, instead of to the map's cells.
    """
    values, known = inpaint_telea(as_mapped(maps), resolution=maps.resolution)
    values, shape = torch.where(known, values, 0.0), values.shape[1:]
    if resampled:
        cells = [max(1, round(n * maps.resolution / _PAPER_RESOLUTION)) for n in shape]
        values = resize(values, cells)
    rim = F.pad(values[:, None], [RIM] * 4, mode="replicate")[
        :, 0
    ]  # it does not rate cells whose windows leave the map
    rated = net(rim)[:, RIM:-RIM, RIM:-RIM]
    return resize(rated, shape).clamp(0, 1) * known


def resize(values: Float[Tensor, "B H W"], shape: tuple[int, ...] | list[int]) -> Float[Tensor, "B h w"]:
    """Resample to another number of cells, linearly, and with antialiasing where they become fewer."""
    if tuple(values.shape[1:]) == tuple(shape):
        return values
    return F.interpolate(values[:, None], tuple(shape), mode="bilinear", antialias=True)[:, 0]


def lowest_under_body(
    score: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], maps: MappedTerrain
) -> Float[Tensor, "B H W"]:
    """Return the lowest known score within the robot's half width of each known cell; 0 where unknown."""
    radius = int(maps.robot.width / 2 / maps.resolution)
    worst = torch.where(known, 1 - score, 0.0)
    found = torch.zeros_like(score)
    for row in range(-radius, radius + 1):
        reach = int((radius**2 - row**2) ** 0.5)
        widest = F.max_pool2d(worst[:, None], (1, 2 * reach + 1), 1, (0, reach))[:, 0]
        found = torch.maximum(found, F.pad(widest, (0, 0, radius, radius)).narrow(1, radius + row, score.shape[1]))
    return (1 - found) * known


def baselines(paper_weights: Path | None = None) -> dict[str, Score]:
    """Return the heads to compare with, by "family (variant)".

    These heads do not know the robot's body, so each has a variant that takes the lowest score in the footprint.

    Args:
        paper_weights: file of the paper's filter, see `PaperFilter.from_npz`; None: it is left out.
    """
    heads: dict[str, Score] = {}
    for of_robot, critical in ((False, "defaults"), (True, "robot's")):
        _add(heads, "analytic", critical, _analytic(as_mapped, of_robot), filled=False)
        _add(heads, "analytic on filled", critical, _analytic(_fill_and_smooth, of_robot), filled=True)
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
