"""A plain U-Net that fills maps, to compare the completion network with; trained on the same walks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from tqdm import tqdm

from torchelev.completion.parameters import USUAL
from torchelev.filters import Filter
from training.completion.cells import FARTHEST, MIN_ERROR
from training.completion.maps import TrueMap

_LEVELS = 3
_SCALE = 0.1  # [m] heights count about logarithmically beyond it
_CROP = 64  # cells along each side, in training


class UNet(nn.Module):
    """Adds a correction to the nearest known height of every unknown cell, not above the upper bound.

    Args:
        channels: of the finest level; each coarser one has twice as many.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        sizes = [channels * 2**level for level in range(_LEVELS)]
        self.down = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in zip([5, *sizes], sizes, strict=False))
        self.up = nn.ModuleList(nn.Conv2d(a + b, b, 3, padding=1) for a, b in zip(sizes[1:], sizes, strict=False))
        self.last = nn.Conv2d(channels, 1, 1)

    def forward(self, maps: TrueMap) -> Tensor:
        """Return the completed elevation (B, H, W) [m]."""
        layers = maps.layers
        near, _ = Filter("inpaint_nearest")((layers.elevation, layers.validity), resolution=maps.resolution)
        return complete(self, maps, near)


def complete(net: UNet, maps: TrueMap, near: Tensor) -> Tensor:
    """Return the completed elevation, given the nearest known heights."""
    layers, known = maps.layers, maps.layers.validity
    bounded = layers.bounded & ~known
    level = torch.where(known, layers.elevation, 0.0).sum((1, 2)) / known.sum((1, 2)).clamp(min=1)
    under = torch.where(bounded, layers.upper_bound - near, 0.0)
    heights = [torch.asinh(height / _SCALE) for height in (near - level[:, None, None], under)]
    scale = torch.full_like(near, math.log(maps.resolution / USUAL))
    values = torch.stack([known.to(near.dtype), bounded.to(near.dtype), *heights, scale], 1)
    filled = near + _run(net, values)
    return torch.where(bounded, torch.minimum(filled, layers.upper_bound), filled)


def _run(net: UNet, values: Tensor) -> Tensor:
    H, W = values.shape[2:]
    step = 2 ** (_LEVELS - 1)
    values, kept = F.pad(values, (0, -W % step, 0, -H % step)), []
    for level, layer in enumerate(net.down):
        values = F.relu(layer(values if level == 0 else F.max_pool2d(values, 2)))
        kept.append(values)
    for level in reversed(range(_LEVELS - 1)):
        wide = F.interpolate(values, scale_factor=2.0, mode="nearest")
        values = F.relu(net.up[level](torch.cat([wide, kept[level]], 1)))
    return net.last(values)[:, 0, :H, :W]


def fit(maps: Sequence[TrueMap], channels: int, steps: int, seed: int = 0, learning_rate: float = 3e-3) -> UNet:
    """Fit a U-Net to unknown cells; each map counts the same, as in the training of the completion network."""
    torch.manual_seed(seed)
    net, generator = UNet(channels), torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(net.parameters(), learning_rate, weight_decay=1e-4)
    for step in tqdm(range(steps), desc=f"U-Net of {channels} channels", unit="step"):
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * 0.5 * (1 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        for _ in range(4):
            chosen = maps[int(torch.randint(len(maps), (1,), generator=generator))]
            loss = _loss(net, _crop(chosen, generator))
            (loss / 4).backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
    return net.eval()


def _loss(net: UNet, maps: TrueMap) -> Tensor:
    layers, known = maps.layers, maps.layers.validity
    near, found = Filter("inpaint_nearest")((layers.elevation, known), resolution=maps.resolution)
    counts = maps.is_inside & ~known & found & _is_near(known, maps.resolution)
    number = counts.sum((1, 2)).clamp(min=1)

    def mean(error: Tensor) -> Tensor:
        return (error.abs() * counts).sum((1, 2)) / number

    return (mean(complete(net, maps, near) - maps.truth) / (mean(near - maps.truth) + MIN_ERROR)).mean()


def _is_near(known: Tensor, resolution: float) -> Tensor:
    """Return which cells lie within FARTHEST of a known one along both axes."""
    cells = min(round(FARTHEST / resolution), max(known.shape[1:]) - 1)
    rows = F.max_pool2d(known[:, None].float(), (2 * cells + 1, 1), 1, (cells, 0))
    return F.max_pool2d(rows, (1, 2 * cells + 1), 1, (0, cells))[:, 0] > 0


def _crop(maps: TrueMap, generator: torch.Generator) -> TrueMap:
    """Return a random part of the maps, the same of all."""
    H, W = maps.truth.shape[1:]
    size = min(_CROP, H, W)
    i, j = (int(torch.randint(n - size + 1, (1,), generator=generator)) for n in (H, W))

    def cut(layer: Tensor) -> Tensor:
        return layer[:, i : i + size, j : j + size].contiguous()

    layers = type(maps.layers)(*map(cut, maps.layers))
    return maps._replace(layers=layers, truth=cut(maps.truth), is_inside=cut(maps.is_inside))
