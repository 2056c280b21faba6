"""The lowest values of a window in order, by a sorting network: a fixed list of minima and maxima of whole layers.

Columns of the window are sorted once for all windows that share them; then columns are merged to pairs, pairs to fours,
and so on, by Batcher's odd-even merge (Knuth, The Art of Computer Programming 3, 5.3.4). Only what the result needs is
computed.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from torchelev.ops.storage import realize_all

# "minimum" or "maximum", the two wires it is of, the wire it makes, and those that nothing reads afterwards
Step = tuple[str, int, int, int, tuple[int, ...]]
Network = tuple[tuple[Step, ...], tuple[int, ...]]  # and the wires of the result; the first wires are the input


def run(network: Network, inputs: list[Tensor]) -> list[Tensor]:
    """Send tensors of one shape through a network."""
    steps, outputs = network
    wires = dict(enumerate(inputs))
    for operation, left, right, out, done in steps:
        wires[out] = getattr(torch, operation)(wires[left], wires[right])
        for wire in done:
            del wires[wire]
    return [wires[wire] for wire in outputs]


class _Wires:
    """Comparisons as they are drawn up: each makes two wires."""

    def __init__(self, inputs: int) -> None:
        self.count = inputs
        self.made: list[tuple[str, int, int, int]] = []

    def compare(self, a: int, b: int) -> tuple[int, int]:
        low, high = self.count, self.count + 1
        self.made += [("minimum", a, b, low), ("maximum", a, b, high)]
        self.count += 2
        return low, high

    def merge(self, a: list[int], b: list[int]) -> list[int]:
        """Merge two sorted lists: the ones of even and of odd places, then neighbours between the two results."""
        if not a or not b:
            return a + b
        if len(a) == len(b) == 1:
            return list(self.compare(a[0], b[0]))
        even, odd = self.merge(a[::2], b[::2]), self.merge(a[1::2], b[1::2])
        pairs = [self.compare(high, low) for high, low in zip(odd, even[1:], strict=False)]
        merged = [even[0], *(wire for pair in pairs for wire in pair)]
        return merged + odd[len(pairs) :] + even[1 + len(pairs) :]

    def sort(self, wires: list[int]) -> list[int]:
        half = len(wires) // 2
        return wires if half == 0 else self.merge(self.sort(wires[:half]), self.sort(wires[half:]))

    def network(self, outputs: list[int]) -> Network:
        """Keep what the outputs need, and say when each wire was read for the last time."""
        needed = set(outputs)
        steps: list[Step] = []
        for operation, left, right, out in reversed(self.made):
            if out in needed:
                done = tuple({left, right} - needed)
                needed |= {left, right}
                steps.append((operation, left, right, out, done))
        return tuple(reversed(steps)), tuple(outputs)


@functools.cache
def sorting(count: int) -> Network:
    """Return the network that sorts `count` wires."""
    wires = _Wires(count)
    return wires.network(wires.sort(list(range(count))))


@functools.cache
def merging(first: int, second: int, keep: int) -> Network:
    """Return the network that merges two sorted lists, and gives the `keep` lowest."""
    wires = _Wires(first + second)
    merged = wires.merge(list(range(first)), list(range(first, first + second)))
    return wires.network(merged[:keep])


def lowest_of_windows(rimmed: Tensor, width: int, keep: int) -> list[Tensor]:
    """Return the `keep` lowest of each square window of `width` cells, in order: a list of (B, H, W).

    `rimmed`: (B, H + width - 1, W + width - 1).
    """
    H, W = (side - width + 1 for side in rimmed.shape[1:])
    block = realize_all(*run(sorting(width), [rimmed.narrow(1, k, H) for k in range(width)])[:keep])
    result: list[Tensor] = []
    done, span = 0, 1
    while True:
        if width & span:
            piece = [wire.narrow(2, done, W) for wire in block]
            result = run(merging(len(result), len(piece), keep), result + piece) if result else piece
            done += span
        span *= 2
        if span > width:
            return result
        length = block[0].shape[2] - span // 2
        both = [wire.narrow(2, start, length) for start in (0, span // 2) for wire in block]
        block = realize_all(*run(merging(len(block), len(block), keep), both))
