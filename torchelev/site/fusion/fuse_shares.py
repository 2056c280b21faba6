"""Fusing what robots know of channels into the cells of a site."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.site.content.tiles import Tiles
from torchelev.site.fusion.pieces import Pieces
from torchelev.site.fusion.shares import Change, Share

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_NOTHING = 1e-5  # share of a cell's weight that is rounding


def fuse_channels(
    layers: Float[Tensor, "L cells"],
    before: Float[Tensor, "cells"],
    after: Float[Tensor, "cells"],
    tiles: Tiles,
    pieces: Pieces,
    changes: Mapping[str, Change],
) -> None:
    """Fuse what robots know of channels into the layers of tiles, in place.

    Args:
        layers: of the tiles.
        before: their elevation [m] before the merge, NaN where unknown.
        after: the same after it.
        tiles: of the site.
        pieces: of the robots' windows.
        changes: of the channels that the robots know.
    """
    for name, cfg in tiles.channels.configs.items():
        first, row = tiles.layers.index(tiles.channels.sources(name)[0]), tiles.channels.since(name)
        stored = layers[first : first + cfg.size + 1]
        since = layers[tiles.layers.index(row)] if row in tiles.layers else torch.full_like(before, torch.nan)
        forget_changed(stored, before, after, cfg.tolerance)
        if name in changes:
            _, cell, place = pieces.select(changes[name].is_new)
            fuse_change(stored, since, after, changes[name], cell, place, cfg)
        since.copy_(torch.where(stored[-1].isnan(), torch.nan, since))


def forget_changed(
    stored: Float[Tensor, "C1 cells"], before: Float[Tensor, "cells"], after: Float[Tensor, "cells"], tolerance: float
) -> None:
    """Forget the channel of cells whose elevation [m] has changed by more than a tolerance [m], in place."""
    stored.copy_(torch.where((after - before).abs() <= tolerance, stored, torch.nan))  # NaN is not


def fuse_change(
    stored: Float[Tensor, "C1 cells"],
    since: Float[Tensor, "cells"],
    elevation: Float[Tensor, "cells"],
    change: Change,
    cell: Int[Tensor, "K"],
    place: Int[Tensor, "K"],
    cfg: ChannelConfig,
) -> None:
    """Fuse what robots know of a channel into cells of a site, in place, after `forget_changed`.

    Like a map's, a site's channel is that of the ground which it shows: a share counts if its ground lies within
    `tolerance` of the site's elevation. What does not is noted in the share, and tried again at the next merge.

    - Means, and counts of classes: the sum of the evidence of all robots. What a robot gave before is taken out, so
      that it counts once, unless the cell has forgotten it, as its evidence began at a later merge.
    - "maximum": the largest of all.
    - "exponential", "class_average": the value that was measured last, the site's own included.

    Args:
        stored: components and weight of the cells, NaN where unknown.
        since: of the cells, as of `SiteChannels.since`; NaN where unknown: nothing was forgotten, and all new values
            were measured later.
        elevation: of the cells after the merge [m], NaN where unknown.
        change: of the channel.
        cell: (K,) numbers of the cells that robots know.
        place: (K,) of these in the flat windows.
        cfg: settings of the channel.
    """
    known = Cells(stored[:-1].nan_to_num(nan=0.0).T, stored[-1].nan_to_num(nan=0.0))
    new = _take(change.now, place, elevation.index_select(0, cell), cfg.tolerance)
    if cfg.is_newest:
        fused, newest = _newest(known, since, cell, new, change.now.time.flatten()[place])
        since.copy_(newest)
    elif cfg.kind == "maximum":
        fused = _largest(known, cell, new)
    else:
        fused = _sum(known, cell, new, _withdrawn(change.before, known, since, cell, place), cfg.kind == "class")
        since.copy_(torch.where(known.weight > 0, since, float(change.number)))
    is_known = fused.weight > 0
    stored[:-1] = torch.where(is_known, fused.values.T, torch.nan)
    stored[-1] = torch.where(is_known, fused.weight, torch.nan)


class Cells(NamedTuple):
    """What cells, or robots, know of a channel; it counts where the weight is positive, and the values are finite."""

    values: Float[Tensor, "K C"]  #: as stored
    weight: Float[Tensor, "K"]  #: the evidence


def _take(share: Share, place: Tensor, elevation: Tensor, tolerance: float) -> Cells:
    """Return what the site takes of a share at places of its flat windows, and note there what it does not take."""
    is_same = (share.height.flatten()[place] - elevation).abs() <= tolerance
    merge = share.merge.view(-1)
    merge[place] = torch.where(is_same, merge[place], 0.0)
    return Cells(share.values.flatten(0, 2)[place], torch.where(is_same, share.weight.flatten()[place], 0.0))


def _withdrawn(before: Share | None, known: Cells, since: Tensor, cell: Tensor, place: Tensor) -> Cells | None:
    """Return what cells still hold of what the same robots gave before; None: nothing."""
    if before is None:
        return None
    began = torch.where(known.weight > 0, since.nan_to_num(nan=1.0), torch.inf).index_select(0, cell)
    weight = torch.where(before.merge.flatten()[place] >= began, before.weight.flatten()[place], 0.0)
    return Cells(before.values.flatten(0, 2)[place], weight)


def _sum(known: Cells, cell: Tensor, new: Cells, old: Cells | None, are_counts: bool) -> Cells:
    """Return cells with new evidence added and old evidence taken out, of means or of counts of classes."""
    total = known.weight.scatter_add(0, cell, new.weight)
    weight = total if old is None else total.scatter_add(0, cell, -old.weight)
    weight = torch.where(weight > _NOTHING * total, weight, 0.0)
    values = known.values
    for part, sign in ((new, 1.0), *(() if old is None else ((old, -1.0),))):
        if are_counts:
            moment = sign * part.values * (part.weight > 0)[:, None]
        else:  # about the mean before, which keeps the precision of float32
            about = known.values.index_select(0, cell)
            share = part.weight / weight.clamp(min=1e-30).index_select(0, cell)
            moment = sign * (part.values - about) * share[:, None]
        values = values.index_add(0, cell, moment)
    return Cells(values.clamp(min=0.0) if are_counts else values, weight)


def _largest(known: Cells, cell: Tensor, new: Cells) -> Cells:
    """Return cells with the larger one of what they know and what is new."""
    own = torch.where((known.weight > 0)[:, None], known.values, -torch.inf)
    given = torch.where((new.weight > 0)[:, None], new.values, -torch.inf)
    values = own.scatter_reduce(0, cell[:, None].expand_as(given), given, "amax")
    return Cells(values, known.weight.scatter_reduce(0, cell, new.weight, "amax"))


def _newest(
    known: Cells, since: Tensor, cell: Tensor, new: Cells, time: Float[Tensor, "K"]
) -> tuple[Cells, Float[Tensor, "cells"]]:
    """Return cells with what was measured last, and when [s]; of several new values that are as new, the mean."""
    time = torch.where(new.weight > 0, time, -torch.inf)
    held = torch.where((known.weight > 0) & ~since.isnan(), since, -torch.inf)
    newest = held.scatter_reduce(0, cell, time, "amax")
    counts = ((new.weight > 0) & (time == newest.index_select(0, cell))).float()
    number = torch.zeros_like(known.weight).scatter_add(0, cell, counts)
    mean = torch.zeros_like(known.values).index_add(0, cell, new.values * counts[:, None])
    mean = mean / number.clamp(min=1.0)[:, None]
    weight = torch.zeros_like(known.weight).scatter_reduce(0, cell, new.weight * counts, "amax")
    is_new = number > 0
    fused = Cells(torch.where(is_new[:, None], mean, known.values), torch.where(is_new, weight, known.weight))
    return fused, torch.where(is_new, newest, since)
