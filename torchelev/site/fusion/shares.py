"""What robots know of the channels of a site, and how it is fused into the site's cells."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.channels.config import ChannelConfig
from torchelev.site.fusion.entries import rise
from torchelev.site.fusion.windows import BEFORE_ALL, Alignment, Contribution, Windows

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap
    from torchelev.site.channels import SiteChannels

_NOTHING = 1e-5  # share of a cell's weight that is rounding


class Share(NamedTuple):
    """What the windows of B robots know of a channel. It counts where the weight is positive."""

    corner: Int[Tensor, "B 2"]  #: cell numbers of [..., 0, 0] on the lattice
    height: Float[Tensor, "B H W"]  #: [m] of the ground that it belongs to, in the site's frame
    time: Float[Tensor, "B H W"]  #: [s] at which that was measured, by the site's clock
    values: Float[Tensor, "B H W C"]  #: as of `torchelev.channels.state.Channel`
    weight: Float[Tensor, "B H W"]  #: the evidence


class Change(NamedTuple):
    """A share, that of the same robots at their last merge, and where they differ."""

    now: Share  #: at this merge
    before: Share | None  #: which it replaces; None: there is none
    is_new: Bool[Tensor, "B H W"]  #: cells to fuse


def read_shares(
    emap: ElevationMap, windows: Windows, alignment: Alignment, channels: SiteChannels, resolution: float
) -> dict[str, Share]:
    """Return copies of what a map knows of the channels of a site.

    Args:
        emap: the map; channels that it has not are left out.
        windows: of its robots.
        alignment: how they lie in the site's frame.
        channels: of the site.
        resolution: [m].
    """
    known, shares = windows.known, {}
    if emap.channels is None or not channels:
        return {}
    place = torch.arange(known.elevation.numel(), device=known.elevation.device)
    above = rise(known, alignment, place // known.elevation[0].numel(), place, resolution)
    height = known.elevation.float() - above.view_as(known.elevation)
    time = (known.now[:, None, None] - known.age).float()
    for name in channels.configs.keys() & emap.cfg.channels.keys():
        values, weight = (part.to(height.device).float() for part in emap.channels.channel(name)[:2])
        weight = torch.where(known.is_known, weight, 0.0)
        shares[name] = Share(known.corner.clone(), height, time, values.clone(), weight)
    return shares


def find_changes(shares: Mapping[str, Share], contribution: Contribution | None) -> dict[str, Change]:
    """Return what shares have changed since a contribution; what a robot knew before it was reset stays in the site."""
    changes = {}
    for name, now in shares.items():
        before = None if contribution is None else contribution.shares.get(name)
        is_new = now.weight > 0
        if before is not None and contribution is not None:
            was_reset = (contribution.elapsed == BEFORE_ALL)[:, None, None]
            before = before._replace(weight=torch.where(was_reset, 0.0, before.weight))
            place, inside = _places(now.corner, before, torch.arange(is_new.numel(), device=is_new.device))
            old = before.values.flatten(0, 2)[place].view_as(now.values), before.weight.flatten()[place].view_as(is_new)
            is_same = inside.view_as(is_new) & (old[1] == now.weight) & (old[0] == now.values).all(-1)
            is_new = is_new & ~is_same
        changes[name] = Change(now, before, is_new)
    return changes


def _places(
    corner: Int[Tensor, "B 2"], before: Share, place: Int[Tensor, "K"]
) -> tuple[Int[Tensor, "K"], Bool[Tensor, "K"]]:
    """Return where cells of the flat windows at `corner` lie in an earlier share, and whether they do."""
    H, W = before.weight.shape[1:]
    robot = place // (H * W)
    shift = (corner - before.corner).index_select(0, robot)
    i, j = place // W % H + shift[:, 0], place % W + shift[:, 1]
    inside = (i >= 0) & (i < H) & (j >= 0) & (j < W)
    return (robot * H + i.clamp(0, H - 1)) * W + j.clamp(0, W - 1), inside


def forget_changed(
    stored: Float[Tensor, "C1 cells"], before: Float[Tensor, "cells"], after: Float[Tensor, "cells"], tolerance: float
) -> None:
    """Forget the channel of cells whose elevation [m] has changed by more than a tolerance [m], in place."""
    stored.copy_(torch.where((after - before).abs() <= tolerance, stored, torch.nan))  # NaN is not


def fuse_change(
    stored: Float[Tensor, "C1 cells"],
    before: Float[Tensor, "cells"],
    after: Float[Tensor, "cells"],
    change: Change,
    cell: Int[Tensor, "K"],
    place: Int[Tensor, "K"],
    cfg: ChannelConfig,
) -> None:
    """Fuse what robots know of a channel into cells of a site, in place, after `forget_changed`.

    Like a map's, a site's channel is that of the ground which it shows: a share counts if its ground lies within
    `tolerance` of the site's elevation.

    - Means, and counts of classes: the sum of the evidence of all robots. What a robot knew at its last merge is taken
      out, so that it counts once.
    - "maximum": the largest of all.
    - "exponential", "class_average": of the share whose ground was measured last.

    Args:
        stored: components and weight of the cells, NaN where unknown.
        before: elevation [m] of the cells before the merge, NaN where unknown.
        after: the same after it.
        change: of the channel.
        cell: (K,) numbers of the cells that robots know.
        place: (K,) of these in the flat windows.
        cfg: settings of the channel.
    """
    weight = stored[-1].nan_to_num(nan=0.0)
    known = Cells(stored[:-1].nan_to_num(nan=0.0).T, weight)
    new = _at(change.now, place, after.index_select(0, cell), cfg.tolerance)
    if cfg.is_weighted or cfg.kind == "class":
        old = _withdrawn(change, known.weight, before, cell, place, cfg.tolerance)
        fused = _sum(known, cell, new, old, cfg.kind == "class")
    elif cfg.kind == "maximum":
        fused = _largest(known, cell, new)
    else:
        fused = _newest(known, cell, new, change.now.time.flatten()[place])
    is_known = fused.weight > 0
    stored[:-1] = torch.where(is_known, fused.values.T, torch.nan)
    stored[-1] = torch.where(is_known, fused.weight, torch.nan)


class Cells(NamedTuple):
    """What cells, or robots, know of a channel; it counts where the weight is positive, and the values are finite."""

    values: Float[Tensor, "K C"]  #: as stored
    weight: Float[Tensor, "K"]  #: the evidence


def _at(share: Share, place: Tensor, elevation: Tensor, tolerance: float) -> Cells:
    """Return what a share knows at places of its flat windows, as far as its ground is that of an elevation [m]."""
    is_same = (share.height.flatten()[place] - elevation).abs() <= tolerance
    return Cells(share.values.flatten(0, 2)[place], torch.where(is_same, share.weight.flatten()[place], 0.0))


def _withdrawn(
    change: Change, weight: Tensor, before: Tensor, cell: Tensor, place: Tensor, tolerance: float
) -> Cells | None:
    """Return what the same robots gave to the cells at their last merge; None: nothing."""
    if change.before is None:
        return None
    there, inside = _places(change.now.corner, change.before, place)
    old = _at(change.before, there, before.index_select(0, cell), tolerance)
    is_kept = inside & (weight.index_select(0, cell) > 0)  # the site may have forgotten it
    return old._replace(weight=torch.where(is_kept, old.weight, 0.0))


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


def _newest(known: Cells, cell: Tensor, new: Cells, time: Float[Tensor, "K"]) -> Cells:
    """Return cells with what was measured last of what is new; of several that are as new, the mean."""
    time = torch.where(new.weight > 0, time, -torch.inf)
    newest = torch.full_like(known.weight, -torch.inf).scatter_reduce(0, cell, time, "amax")
    counts = ((new.weight > 0) & (time == newest.index_select(0, cell))).float()
    number = torch.zeros_like(known.weight).scatter_add(0, cell, counts)
    mean = torch.zeros_like(known.values).index_add(0, cell, new.values * counts[:, None])
    mean = mean / number.clamp(min=1.0)[:, None]
    weight = torch.zeros_like(known.weight).scatter_reduce(0, cell, new.weight * counts, "amax")
    is_new = number > 0
    return Cells(torch.where(is_new[:, None], mean, known.values), torch.where(is_new, weight, known.weight))
