"""The windows of B robots at a merge: their present values, and their earlier contributions to the site."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.layers import absolute_variance
from torchelev.ops.indexing import read
from torchelev.ops.moving import HOST_ENVIRONMENTS, move_layers, sources
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap
    from torchelev.site.fusion.shares import Share
    from torchelev.site.fusion.stacks import Stack

_NANOSECONDS = 1e-9
BEFORE_ALL = -(10**18)  # [ns] earlier than anything on a map's clock


class Alignment(NamedTuple):
    """How B windows lie in the site's frame: site = elevation - offset - tilt . (xy - center of the window)."""

    offset: Float[Tensor, "B"]  #: [m]
    tilt: Float[Tensor, "B 2"]  #: rise over run along x and y
    is_isolated: Bool[Tensor, "B"]  #: overlaps no other window and not the site; its offset is its last one, or 0

    def of_moved(self, away: Float[Tensor, "B 2"]) -> Alignment:
        """Return the same alignment of windows whose centres, about which tilts turn, lie farther away [m]."""
        return self._replace(offset=self.offset + (self.tilt * away).sum(1))


def no_alignment(num_windows: int, device: torch.device) -> Alignment:
    """Return the alignment of windows that lie in the site's frame."""
    zero = torch.zeros(num_windows, 3, dtype=torch.float64, device=device)
    return Alignment(zero[:, 0], zero[:, 1:], torch.zeros(num_windows, dtype=torch.bool, device=device))


class Known(NamedTuple):
    """The values of B windows in the robots' frames, valid where `is_known`."""

    corner: Int[Tensor, "B 2"]  #: cell numbers of [..., 0, 0] on the lattice
    elevation: Float[Tensor, "B H W"]  #: [m]
    variance: Float[Tensor, "B H W"]  #: [m^2] now
    age: Float[Tensor, "B H W"]  #: [s] since the last measurement
    is_known: Bool[Tensor, "B H W"]  #: the other layers count here
    now: Float[Tensor, "B"]  #: [s] the site's time at which they know it
    rate: Float[Tensor, "B"]  #: [m^2/s] at which the variance has grown since the last measurement


class Windows(NamedTuple):
    """The windows of B robots at a merge."""

    known: Known  #: now
    gradient_x: Float[Tensor, "B H W"]  #: dz/dx
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    has_normal: Bool[Tensor, "B H W"]  #: elsewhere the gradient is unknown
    upper_bound: Float[Tensor, "B H W"]  #: [m]
    is_bounded: Bool[Tensor, "B H W"]  #: unknown cells that have an upper bound
    is_new: Bool[Tensor, "B H W"]  #: measured since the last merge
    contribution: Contribution | None  #: of the same robots at earlier merges; None: none
    before: Known | None = None  #: its values, moved to the present windows


class Contribution(NamedTuple):
    """What a map contributed to a site: what it knew at its last merge, and how that was aligned."""

    known: Known  #: then
    alignment: Alignment  #: by which it was fused
    elapsed: Int[Tensor, "B"]  #: [ns] of the maps' clocks
    num_resets: Int[Tensor, "B"]  #: of the maps until then
    keyframe: Int[Tensor, "B"]  #: id of that merge's keyframe; -1: none was kept
    shares: Mapping[str, Share] = MappingProxyType({})  #: of the site's channels, by name
    stack: Stack | None = None  #: of a site with levels: all surfaces that they knew; None: the ground alone
    number: int = 0  #: of the site's commit, from 1 on; 0: none yet


def no_contribution(known: Known, num_resets: Int[Tensor, "B"]) -> Contribution:
    """Return the empty contribution of B maps that know this and were reset so often; shares no memory with them."""
    blank = Known(*(value.clone() for value in known))._replace(is_known=torch.zeros_like(known.is_known))
    never = torch.full_like(num_resets, BEFORE_ALL)
    alignment = no_alignment(len(never), never.device)
    return Contribution(blank, alignment, never, num_resets.clone(), torch.full_like(never, -1))


def read_known(emap: ElevationMap, state: MapState, now: float) -> Known:
    """Return the values of a map's windows, which share memory with it; arguments as of `read_windows`.

    Cells whose variance has grown to the map's maximum hold no information, nor do those that feet initialised.
    """
    variance = sideways_variance(state)
    is_known = state.validity & (variance < emap.cfg.fusion.max_variance)
    per_robot = torch.ones(emap.num_envs, dtype=torch.float64, device=state.corner.device)
    rate = emap.cfg.aging.variance_rate
    return Known(state.corner, state.elevation, variance, state.time, is_known, now * per_robot, rate * per_robot)


def read_windows(emap: ElevationMap, state: MapState, now: float, contribution: Contribution | None) -> Windows:
    """Read a map's windows, which share memory with it.

    Args:
        emap: the map.
        state: its state, or the same state with the windows moved.
        now: the site's time [s].
        contribution: of the map at its last merge.
    """
    known = read_known(emap, state, now)
    surface = state.gradient_x, state.gradient_y, state.has_normal
    bound = state.upper_bound, state.bounded & ~state.validity
    before = None if contribution is None else move_known(contribution.known, state.corner)
    return Windows(known, *surface, *bound, _find_new(state, known, contribution, before), contribution, before)


def sideways_variance(state: MapState) -> Float[Tensor, "B H W"]:
    """Return the variance [m^2] of the elevations, including horizontal pose errors on slopes.

    The vertical error is shared by the window; the offset takes it out.
    """
    if not state.pose_covariance.any():
        return state.variance
    covariance = state.pose_covariance.clone()
    covariance[:, 2] = covariance[:, :, 2] = 0.0
    return absolute_variance(state._replace(pose_covariance=covariance))


def drop_reset(contribution: Contribution, num_resets: Int[Tensor, "B"], elapsed: Int[Tensor, "B"]) -> Contribution:
    """Drop contributions of environments that were reset or loaded an earlier state: all that they know is new."""
    was_reset = (contribution.num_resets != num_resets) | (elapsed < contribution.elapsed)
    if not was_reset.any():
        return contribution
    known = contribution.known._replace(is_known=contribution.known.is_known & ~was_reset[:, None, None])
    offset, tilt, is_isolated = contribution.alignment
    offset, tilt = torch.where(was_reset, 0.0, offset), torch.where(was_reset[:, None], 0.0, tilt)
    elapsed = torch.where(was_reset, BEFORE_ALL, contribution.elapsed)
    alignment = Alignment(offset, tilt, is_isolated)
    keyframe = torch.where(was_reset, -1, contribution.keyframe)
    stack = contribution.stack
    if stack is not None:
        stack = stack._replace(is_known=stack.is_known & ~was_reset[:, None, None, None])
    return contribution._replace(
        known=known, alignment=alignment, elapsed=elapsed, num_resets=num_resets.clone(), keyframe=keyframe, stack=stack
    )


def _find_new(
    state: MapState, known: Known, contribution: Contribution | None, before: Known | None
) -> Bool[Tensor, "B H W"]:
    """Return which known cells are new: measured since the contribution, whose values these are, or not part of it.

    What `initialize_from` gave may be younger than the last merge, but nobody has measured it: no bit of it changes.
    """
    if contribution is None or before is None:
        return known.is_known
    has_changed = (known.elevation != before.elevation) | (known.variance < before.variance)
    passed = state.elapsed - contribution.elapsed
    return find_new(known.is_known, before.is_known, has_changed, state.time, passed)


def find_new(is_known: Tensor, was_known: Tensor, has_changed: Tensor, age: Tensor, passed: Int[Tensor, "B"]) -> Tensor:
    """Return which known cells are new, (B, ...): `passed` [ns] since the contribution, which `was_known`."""
    since = (passed.double() * _NANOSECONDS).view(-1, *(1 for _ in age.shape[1:]))
    # Ages are sums in float32, whose rounding must not make an old measurement new.
    is_younger = age < since * (1 - 1e-4) - 1e-6
    return is_known & (~was_known | (is_younger & has_changed))


def move_known(known: Known, corner: Int[Tensor, "B 2"]) -> Known:
    """Return the values of windows, moved to other corners."""
    H, W = known.elevation.shape[1:]
    shift = (corner - known.corner).clamp(-max(H, W), max(H, W))
    if not shift.any():
        return known
    layers = {name: getattr(known, name) for name in ("elevation", "variance", "age", "is_known")}
    if len(corner) > HOST_ENVIRONMENTS:  # gather; what enters is not known, and its values do not count
        index, is_entering = sources(shift, H, W)
        layers = {name: read(layer, index) for name, layer in layers.items()}
        layers["is_known"] &= ~is_entering
    else:
        layers = move_layers(layers, shift, {})
    return known._replace(corner=corner.clone(), **layers)


def snapshot(
    emap: ElevationMap,
    windows: Windows,
    alignment: Alignment,
    elapsed: Int[Tensor, "B"],
    keyframe: Int[Tensor, "B"],
    shares: Mapping[str, Share] = MappingProxyType({}),
    stack: Stack | None = None,
) -> Contribution:
    """Return a map's contribution at a merge, as copies, with its keyframes, the maps' clocks, and what it is given."""
    known = Known(*(value.clone() for value in windows.known))
    num_resets = emap.num_resets.to(elapsed.device, copy=True)
    return Contribution(known, alignment, elapsed.clone(), num_resets, keyframe, shares, stack)
