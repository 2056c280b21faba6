"""The lowest values of windows in order, by a sorting network: a fixed list of minima and maxima of whole layers.

The columns of a window are sorted once for all windows that share them. Then columns are merged to pairs, pairs to
fours and so on, by Batcher's odd-even merge (Knuth, The Art of Computer Programming 3, 5.3.4). Comparisons whose
results are not needed are left out.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor


class _Step(NamedTuple):
    """One minimum or maximum. Wires hold the tensors between steps."""

    operation: str  #: "minimum" or "maximum"
    left: int  #: wire of the first operand
    right: int  #: wire of the second operand
    out: int  #: wire of the result
    unused: tuple[int, ...]  #: wires that no later step reads


class _Network(NamedTuple):
    """Steps that turn the first wires, the inputs, into some outputs."""

    steps: tuple[_Step, ...]  #: in order
    outputs: tuple[int, ...]  #: wires of the result


def run(network: _Network, inputs: list[Tensor]) -> list[Tensor]:
    """Send tensors of one shape through a network."""
    wires = dict(enumerate(inputs))
    for step in network.steps:
        wires[step.out] = getattr(torch, step.operation)(wires[step.left], wires[step.right])
        for wire in step.unused:
            del wires[wire]
    return [wires[wire] for wire in network.outputs]


class _Builder:
    """Collects comparisons; each adds two wires."""

    def __init__(self, num_inputs: int) -> None:
        self.num_wires = num_inputs
        self.comparisons: list[tuple[str, int, int, int]] = []

    def compare(self, a: int, b: int) -> tuple[int, int]:
        low, high = self.num_wires, self.num_wires + 1
        self.comparisons += [("minimum", a, b, low), ("maximum", a, b, high)]
        self.num_wires += 2
        return low, high

    def merge(self, a: list[int], b: list[int]) -> list[int]:
        """Merge two sorted lists: their even and their odd places, then neighbours between the two results."""
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

    def network(self, outputs: list[int]) -> _Network:
        """Keep the comparisons that the outputs need, and note where each wire is read last."""
        needed = set(outputs)
        steps: list[_Step] = []
        for operation, left, right, out in reversed(self.comparisons):
            if out in needed:
                unused = tuple({left, right} - needed)
                needed |= {left, right}
                steps.append(_Step(operation, left, right, out, unused))
        return _Network(tuple(reversed(steps)), tuple(outputs))


@functools.cache
def sorting(count: int) -> _Network:
    """Return the network that sorts `count` wires."""
    builder = _Builder(count)
    return builder.network(builder.sort(list(range(count))))


@functools.cache
def merging(first: int, second: int, keep: int) -> _Network:
    """Return the network that merges two sorted lists of these lengths and returns the `keep` lowest."""
    builder = _Builder(first + second)
    merged = builder.merge(list(range(first)), list(range(first, first + second)))
    return builder.network(merged[:keep])


def lowest_of_windows(rimmed: Tensor, width: int, keep: int) -> list[Tensor]:
    """Return the `keep` lowest values of each square window of `width` cells, in order: a list of (B, H, W).

    `rimmed` is (B, H + width - 1, W + width - 1).
    """
    H, W = (side - width + 1 for side in rimmed.shape[1:])
    block = run(sorting(width), [rimmed.narrow(1, k, H) for k in range(width)])[:keep]
    result: list[Tensor] = []
    start, span = 0, 1
    while True:
        if width & span:
            piece = [wire.narrow(2, start, W) for wire in block]
            result = run(merging(len(result), len(piece), keep), result + piece) if result else piece
            start += span
        span *= 2
        if span > width:
            return result
        length = block[0].shape[2] - span // 2
        both = [wire.narrow(2, shift, length) for shift in (0, span // 2) for wire in block]
        block = run(merging(len(block), len(block), keep), both)
