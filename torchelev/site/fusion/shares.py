"""What robots know of the channels of a site, and which part of it the site has taken."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.fusion.entries import rise
from torchelev.site.fusion.windows import BEFORE_ALL, Alignment, Windows

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap
    from torchelev.site.content.channels import SiteChannels


class Share(NamedTuple):
    """What the windows of B robots know of a channel. It counts where the weight is positive."""

    corner: Int[Tensor, "B 2"]  #: cell numbers of [..., 0, 0] on the lattice
    now: Float[Tensor, "B"]  #: [s] of the merge, by the site's clock
    height: Float[Tensor, "B H W"]  #: [m] of the ground that it belongs to, in the site's frame
    time: Float[Tensor, "B H W"]  #: [s] at which the values were measured, by the site's clock
    values: Float[Tensor, "B H W C"]  #: as of `torchelev.channels.state.Channel`
    weight: Float[Tensor, "B H W"]  #: the evidence
    merge: Float[Tensor, "B H W"]  #: number of the merge at which the site took it, from 1 on; 0: it did not


class Change(NamedTuple):
    """A share, that of the same robots at their last merge, and where they differ."""

    now: Share  #: at this merge; fusing notes in it which cells the site does not take
    before: Share | None  #: which it replaces, of the same windows; None: there is none
    is_new: Bool[Tensor, "B H W"]  #: cells to fuse
    number: int  #: of this merge


def read_changes(
    emap: ElevationMap,
    windows: Windows,
    alignment: Alignment,
    channels: SiteChannels,
    resolution: float,
    number: int,
) -> dict[str, Change]:
    """Return what a map knows of the channels of a site, and what of it is new since its last merge.

    What a robot knew before it was reset stays in the site. Cells that the site did not take, as it showed other
    ground, are new again.

    Args:
        emap: the map; channels that it has not are left out.
        windows: of its robots.
        alignment: how they lie in the site's frame.
        channels: of the site.
        resolution: [m].
        number: of this merge.
    """
    shares, contribution = _read_shares(emap, windows, alignment, channels, resolution), windows.contribution
    changes = {}
    for name, share in shares.items():
        before = None if contribution is None else contribution.shares.get(name)
        if contribution is None or before is None:
            new = share._replace(merge=torch.full_like(share.merge, number))
            changes[name] = Change(new, None, share.weight > 0, number)
        else:
            changes[name] = _compare(share, before, contribution.elapsed == BEFORE_ALL, number)
    return changes


def _read_shares(
    emap: ElevationMap, windows: Windows, alignment: Alignment, channels: SiteChannels, resolution: float
) -> dict[str, Share]:
    """Return copies of what a map knows of the channels of a site, of which the site has taken nothing.

    A value counts as measured when its cell was last seen, if the channel has a `max_age`; otherwise, when its ground
    was measured last.
    """
    known, shares = windows.known, {}
    if emap.channels is None or not channels:
        return {}
    place = torch.arange(known.elevation.numel(), device=known.elevation.device)
    above = rise(known, alignment, place // known.elevation[0].numel(), place, resolution)
    height = known.elevation.float() - above.view_as(known.elevation)
    for name in channels.configs.keys() & emap.cfg.channels.keys():
        values, weight, age = emap.channels.channel(name)
        time = (known.now[:, None, None] - (known.age if age is None else age.to(height))).float()
        weight = torch.where(known.is_known, weight.to(height), 0.0)
        copies = values.to(height, copy=True), weight, torch.zeros_like(weight)
        shares[name] = Share(known.corner.clone(), known.now.float(), height, time, *copies)
    return shares


def _compare(now: Share, before: Share, was_reset: Bool[Tensor, "B"], number: int) -> Change:
    """Return how a share differs from the one before, of the robots that were not reset since."""
    before = _follow(before, now.corner, was_reset)
    has_values = (before.weight > 0) & (before.values == now.values).all(-1)
    is_same = has_values & (before.weight == now.weight)
    is_new = (now.weight > 0) & ~(is_same & (before.merge > 0))
    # Evidence that only ages has not been measured again, and what was measured since is no older than the last merge.
    since = torch.where(was_reset, -torch.inf, before.now)[:, None, None]
    time = torch.where(has_values & (now.weight <= before.weight), before.time, torch.maximum(now.time, since))
    taken = torch.where(is_new, float(number), before.merge)
    return Change(now._replace(time=time, merge=taken), before, is_new, number)


def _follow(share: Share, corner: Int[Tensor, "B 2"], was_reset: Bool[Tensor, "B"]) -> Share:
    """Return a share with its windows at other corners, and nothing where they were not or robots were reset."""
    B, H, W = share.weight.shape
    robot, i, j = (torch.arange(size, device=corner.device) for size in (B, H, W))
    i, j = i + (corner - share.corner)[:, :1], j + (corner - share.corner)[:, 1:]
    inside_i, inside_j = (i >= 0) & (i < H), (j >= 0) & (j < W)
    inside = inside_i[:, :, None] & inside_j[:, None] & ~was_reset[:, None, None]
    chosen = robot[:, None, None], i.clamp(0, H - 1)[:, :, None], j.clamp(0, W - 1)[:, None]
    height, time, values, weight, merge = (layer[chosen] for layer in share[2:])
    return Share(corner, share.now, height, time, values, torch.where(inside, weight, 0.0), merge)
