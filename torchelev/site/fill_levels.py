"""Fill maps with the levels that a site knows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.levels.state import SURFACE, Levels
from torchelev.site.content.levels import SPACE
from torchelev.site.content.tiles import Tiles, locate
from torchelev.site.fusion.entries import rise
from torchelev.site.fusion.stacks import Stack, read_stack
from torchelev.site.fusion.windows import Contribution, read_known
from torchelev.site.initialize_from_site import SUPPORT

if TYPE_CHECKING:
    from jaxtyping import Bool

    from torchelev.elevation_map import ElevationMap
    from torchelev.site.content.reading import Clock
    from torchelev.state import MapState


def fill_levels(
    emap: ElevationMap,
    before: MapState,
    after: MapState,
    tiles: Tiles,
    contribution: Contribution,
    chosen: Bool[Tensor, "B"],
    clock: Clock,
    resolution: float,
) -> Contribution:
    """Write a site's other surfaces into the unknown cells of a map's levels, if it has them.

    Args:
        emap: the map.
        before: its state, with the windows where they will be.
        after: the same with the ground filled.
        tiles: of the site.
        contribution: of the map, of these windows.
        chosen: environments to fill.
        clock: of the site.
        resolution: [m].

    Returns:
        The contribution with what was filled.
    """
    filled = after.validity & ~before.validity
    if emap.levels is not None:
        own = Levels(*(value.to(tiles.device) for value in emap.levels.in_windows(_on(emap, after))))
        is_free = chosen[:, None, None] & ~before.validity & ~(own.support > 0).any(1)
        known = _read(tiles, contribution, own, clock, resolution)
        has_surfaces = is_free & (known.support > 0).any(1)
        levels = Levels(*(_choose(is_free, new, old) for new, old in zip(known, own, strict=True)))
        emap.levels.put(Levels(*(value.to(emap.device) for value in levels)), _on(emap, after))
        filled = filled | has_surfaces
    now = read_stack(emap, after, read_known(emap, after, clock.time))
    old = contribution.stack
    if old is None:
        old = now._replace(is_known=torch.zeros_like(now.is_known))
    stack = Stack(now.corner.clone(), *(_choose(filled, new, past) for new, past in zip(now[1:], old[1:], strict=True)))
    return contribution._replace(stack=stack)


def _on(emap: ElevationMap, state: MapState) -> MapState:
    """Return a state whose windows are known on the map's device."""
    return state._replace(corner=state.corner.to(emap.device))


def _choose(mask: Bool[Tensor, "B H W"], new: Tensor, old: Tensor) -> Tensor:
    return torch.where(mask if new.ndim == 3 else mask[:, None], new.to(old.dtype), old)


def _read(tiles: Tiles, contribution: Contribution, like: Levels, clock: Clock, resolution: float) -> Levels:
    """Return what a site knows of windows, as levels of the map: of too many surfaces, those of most points."""
    B, L, H, W = like.lower.shape
    corner, device = contribution.known.corner, tiles.device
    x, y = ((corner[:, axis, None] + torch.arange((H, W)[axis], device=device)) for axis in (0, 1))
    x, y = (value.expand(B, H, W).flatten() for value in (x[:, :, None], y[:, None]))
    raw = dict(zip(tiles.levels.stored, tiles.look_up(locate(x, y), tiles.levels.stored), strict=True))
    place = torch.arange(B * H * W, device=device)
    above = rise(contribution.known, contribution.alignment, place // (H * W), place, resolution)
    found = {n: torch.stack([raw[f"surface{k}/{n}"] for k in range(tiles.levels.others)]) for n in SURFACE}
    age = clock.time - found["time"]
    found["support"] = found["support"].clamp(min=SUPPORT)
    found |= {"time": age, "variance": found["variance"] + clock.rate * age}
    found |= {name: found[name] + above for name in ("lower", "upper")}
    order = found["support"].nan_to_num(nan=0.0).argsort(dim=0, descending=True, stable=True)[:L]
    kept = {name: value.gather(0, order).nan_to_num(nan=0.0) for name, value in found.items()}
    surfaces = {name: _places(value, L).unflatten(1, (B, H, W)).movedim(0, 1) for name, value in kept.items()}
    top = (raw[SPACE[0]] + above).nan_to_num(nan=-torch.inf).view(B, H, W)
    return Levels(**surfaces, free_top=top, is_open=(raw[SPACE[1]] == 1).view(B, H, W))


def _places(values: Tensor, number: int) -> Tensor:
    """Return values of L places, of which those that are missing are 0."""
    return torch.nn.functional.pad(values, (0, 0, 0, number - len(values)))
