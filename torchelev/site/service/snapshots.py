"""What a robot's windows know at one time, and the cells that have left them since."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.moving import move_layers
from torchelev.site.fusion.windows import Contribution, Known, Windows, find_new, move_known, read_windows

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.elevation_map import ElevationMap


_SURFACE = "gradient_x", "gradient_y", "has_normal", "upper_bound", "is_bounded"


class Snapshot(NamedTuple):
    """Copies of what B windows know, float32 on the CPU. Values are 0 where nothing is known."""

    known: Known  #: `now` is the time of the snapshot [s], on the clock that all robots share
    gradient_x: Float[Tensor, "B H W"]  #: dz/dx
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    has_normal: Bool[Tensor, "B H W"]  #: elsewhere the gradient is unknown
    upper_bound: Float[Tensor, "B H W"]  #: [m]
    is_bounded: Bool[Tensor, "B H W"]  #: unknown cells that have an upper bound
    map_age: Float[Tensor, "B H W"]  #: [s] since the last measurement, on the maps' own clocks
    elapsed: Int[Tensor, "B"]  #: [ns] of these clocks
    num_resets: Int[Tensor, "B"]  #: of the maps until then

    @property
    def counts(self) -> Bool[Tensor, "B H W"]:
        """The cells of which anything is known."""
        return self.known.is_known | self.is_bounded

    @property
    def num_bytes(self) -> int:
        """Bytes in memory."""
        tensors = (value for value in (*self.known, *self[1:]) if isinstance(value, Tensor))
        return sum(value.nbytes for value in tensors)


def read_snapshot(emap: ElevationMap, envs: Int[Tensor, "E"], time: float) -> Snapshot:
    """Return what some of a map's environments know at a time [s]."""

    def copy(value: Tensor) -> Tensor:
        chosen = value.index_select(0, envs.to(value.device)).cpu()
        return chosen.float() if chosen.dtype in (torch.float16, torch.bfloat16) else chosen

    windows = read_windows(emap, emap.state, time, None)
    known = Known(*map(copy, windows.known))
    layers = {name: getattr(known, name).float() for name in ("elevation", "variance", "age")}
    surface = {name: copy(getattr(windows, name)) for name in _SURFACE}
    own = {"elapsed": copy(emap.state.elapsed), "num_resets": copy(emap.num_resets)}
    whole = Snapshot(known=known._replace(**layers), map_age=layers["age"].clone(), **surface, **own)
    return limit(whole, known.is_known, whole.is_bounded)


def limit(snapshot: Snapshot, is_known: Bool[Tensor, "B H W"], is_bounded: Bool[Tensor, "B H W"]) -> Snapshot:
    """Return a snapshot that knows these cells alone, with zeros elsewhere, which need next to no bytes to send."""

    def choose(value: Tensor, mask: Tensor) -> Tensor:
        return torch.where(mask, value, torch.zeros((), dtype=value.dtype))

    known, has_normal = snapshot.known, snapshot.has_normal & is_known
    layers = {name: choose(getattr(known, name), is_known) for name in ("elevation", "variance", "age")}
    return snapshot._replace(
        known=known._replace(is_known=is_known, **layers),
        gradient_x=choose(snapshot.gradient_x, has_normal).float(),
        gradient_y=choose(snapshot.gradient_y, has_normal).float(),
        has_normal=has_normal,
        upper_bound=choose(snapshot.upper_bound, is_bounded).float(),
        is_bounded=is_bounded,
        map_age=choose(snapshot.map_age, is_known),
    )


def find_left(before: Snapshot, after: Snapshot) -> Snapshot:
    """Return the part of a snapshot that a later one of the same windows no longer knows.

    These are the cells that have left the windows, that were cleared, and all of those that were reset since.
    """
    was_reset = (before.num_resets != after.num_resets) | (after.elapsed < before.elapsed)
    everywhere = after.known._replace(is_known=torch.ones_like(after.known.is_known))
    is_inside = move_known(everywhere, before.known.corner).is_known & ~was_reset[:, None, None]
    is_known_still = move_known(after.known, before.known.corner).is_known & is_inside
    return limit(before, before.known.is_known & ~is_known_still, before.is_bounded & ~is_inside)


def join(first: Snapshot, second: Snapshot) -> Snapshot | None:
    """Return two parts that left one after the other as one of the time of the second; None if they do not fit.

    They fit if the windows of the first hold all cells, if no cell left twice, and if no map was reset between.
    """
    moved = move(second, first.known.corner)
    same = torch.equal(first.num_resets, second.num_resets) and bool((second.elapsed >= first.elapsed).all())
    if not same or (moved.counts & first.counts).any() or int(moved.counts.sum()) < int(second.counts.sum()):
        return None
    aged, chosen = _age(first, second), moved.counts

    def choose(new: Tensor, old: Tensor) -> Tensor:
        return torch.where(chosen, new, old) if new.ndim == 3 else old

    known = Known(*(choose(new, old) for new, old in zip(moved.known, aged.known, strict=True)))
    rest = (choose(new, old) for new, old in zip(moved[1:], aged[1:], strict=True))
    return Snapshot(known, *rest)  # type: ignore[arg-type]


def move(snapshot: Snapshot, corner: Int[Tensor, "B 2"]) -> Snapshot:
    """Return a snapshot with the windows at other corners."""
    H, W = snapshot.map_age.shape[1:]
    shift = (corner - snapshot.known.corner).clamp(-max(H, W), max(H, W))
    layers = move_layers({name: getattr(snapshot, name) for name in (*_SURFACE, "map_age")}, shift, {})
    return snapshot._replace(known=move_known(snapshot.known, corner), **layers)


def _age(snapshot: Snapshot, later: Snapshot) -> Snapshot:
    """Return a snapshot as of the time of a later one."""
    known = snapshot.known
    passed = (later.known.now - known.now)[:, None, None]
    own = (1e-9 * (later.elapsed - snapshot.elapsed).double())[:, None, None]
    age, variance = known.age + passed, known.variance + known.rate[:, None, None] * passed
    known = known._replace(age=age.float(), variance=variance.float(), now=later.known.now)
    return snapshot._replace(known=known, map_age=(snapshot.map_age + own).float(), elapsed=later.elapsed)


def make_windows(snapshot: Snapshot, contribution: Contribution | None) -> Windows:
    """Return the windows of a merge: a snapshot, and what of it is new since the robot's contribution."""
    known = snapshot.known
    is_new = known.is_known
    if contribution is not None:
        before = move_known(contribution.known, known.corner)
        has_changed = (known.elevation != before.elevation) | (known.variance < before.variance)
        passed = snapshot.elapsed - contribution.elapsed
        is_new = find_new(known.is_known, before.is_known, has_changed, snapshot.map_age, passed)
    return Windows(known, *snapshot[1:6], is_new, contribution)
