"""Attention of a query over the points of a map, after He et al. 2025 (AME-1, arXiv 2506.09588)."""

# Annotations are not postponed: TorchScript reads those of buffers as types.

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from torchelev.encoders.encoder_config import AttentionConfig
from torchelev.encoders.layout import MapLayout
from torchelev.errors import require


class MapAttention(nn.Module):
    """Encode a map for a robot's state: the robot's query pays attention to the features of the map's points.

    The features of point p are f_p = [coordinates_p, values_p, g_p], where g is two convolutions of the values, or for
    `kernel_size` 1 a perceptron at each point. With the query q = W_q s + b_q of the state s, split into h heads of c
    entries each, head k computes

        weights_kp = softmax_p(q_k . (W_K f_p)_k / sqrt(c)),    out_k = sum_p weights_kp (W_V f_p)_k

    and the result is W_O [out_1, ..., out_h] + b_O. W_K and W_V are applied to the query and to the mean of the
    features instead of to each point, which is the same and costs a fraction. Keys have no bias, since the softmax
    removes it, and values none, since b_O has the same effect. With `patch` > 1, a point is a square of pixels: its
    coordinates and values are their means, and the first convolution strides over the squares.

    The coordinates are part of `state_dict()`. Loading those of other points is refused.

    Args:
        layout: the points, from `MapLayout.find`.
        cfg: the settings.
        state_dim: number of entries of the robot's state.
        activation: between the two convolutions.

    Raises:
        ValueError: `embed_dim` has no room for the coordinates and values.
    """

    coordinates: Tensor

    def __init__(
        self, layout: MapLayout, cfg: AttentionConfig, state_dim: int, activation: nn.Module | None = None
    ) -> None:
        super().__init__()
        self.embed_dim, self.num_heads, self.patch = cfg.embed_dim, cfg.num_heads, cfg.patch
        self.rows, self.columns = layout.coordinates.shape[1:]
        self.validity = -1 if layout.validity is None else layout.validity
        self.mask_unknown = cfg.mask_unknown
        plain = len(layout.coordinates) + layout.channels
        rule = f"must exceed the {plain} coordinates and values of a point"
        require(cfg.embed_dim > plain, "embed_dim", rule, cfg.embed_dim, "raise it")
        coordinates = F.avg_pool2d(layout.coordinates[None], cfg.patch)
        self.grid = (coordinates.shape[2], coordinates.shape[3])  # rows and columns of points
        self.register_buffer("coordinates", coordinates.flatten(2))
        padding = cfg.kernel_size // 2
        self.features = nn.Sequential(
            # The square with its padding, so that each output is centred on its square.
            nn.Conv2d(layout.channels, cfg.hidden_channels, cfg.kernel_size + cfg.patch - 1, cfg.patch, padding),
            nn.ELU() if activation is None else activation,
            nn.Conv2d(cfg.hidden_channels, cfg.embed_dim - plain, cfg.kernel_size, 1, padding),
        )
        self.query = nn.Linear(state_dim, cfg.embed_dim)
        self.key = nn.Linear(cfg.embed_dim, cfg.embed_dim, bias=False)
        self.value = nn.Linear(cfg.embed_dim, cfg.embed_dim, bias=False)
        self.output = nn.Linear(cfg.embed_dim, cfg.embed_dim)

    def forward(self, state: Tensor, inputs: list[Tensor]) -> Tensor:
        """Encode the maps.

        Args:
            state: (B, S) of the robots.
            inputs: the observation groups of the layout, each (B, P), (B, C, P) or (B, C, H, W).

        Returns:
            The encoding (B, embed_dim).
        """
        features, known = self._describe(inputs)
        weights = self._weigh(state, features, known)
        mean = torch.matmul(weights, features.transpose(1, 2))  # (B, h, embed_dim)
        out = torch.einsum("bhd,hcd->bhc", mean, self._split(self.value.weight))
        return self.output(out.flatten(1))

    def attention(self, state: Tensor, inputs: list[Tensor]) -> Tensor:
        """Return the weights (B, num_heads, P) of the points; those of a head sum to 1. Arguments as of a call."""
        features, known = self._describe(inputs)
        return self._weigh(state, features, known)

    def _describe(self, inputs: list[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the features (B, embed_dim, P) of the points, and whether they are known (B, P)."""
        images = [group.reshape(group.shape[0], -1, self.rows, self.columns) for group in inputs]
        values = torch.cat(images, 1).to(self.coordinates.dtype)
        means = F.avg_pool2d(values, self.patch) if self.patch > 1 else values
        coordinates = self.coordinates.expand(values.shape[0], -1, -1)
        features = torch.cat([coordinates, means.flatten(2), self.features(values).flatten(2)], 1)
        return features, means[:, self.validity].flatten(1) > 0

    def _weigh(self, state: Tensor, features: Tensor, known: Tensor) -> Tensor:
        """Return the weights (B, num_heads, P)."""
        query = self.query(state).unflatten(1, (self.num_heads, -1))
        projected = torch.einsum("bhc,hcd->bhd", query, self._split(self.key.weight))
        scores = torch.matmul(projected, features) / math.sqrt(self.embed_dim // self.num_heads)
        if self.mask_unknown:
            # Finite, also in float16: where all points are unknown, attention is uniform and not NaN.
            scores = scores.masked_fill(~known.unsqueeze(1), -1e4)
        return torch.softmax(scores, -1)

    def _split(self, weight: Tensor) -> Tensor:
        """Split a weight (embed_dim, embed_dim) into those of the heads (h, c, embed_dim)."""
        return weight.view(self.num_heads, -1, self.embed_dim)

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *args: Any) -> None:
        found, errors = state_dict.get(f"{prefix}coordinates"), args[-1]
        if found is not None and found.shape == self.coordinates.shape:
            if not torch.allclose(found.to(self.coordinates), self.coordinates, atol=1e-4):
                hint = "read the scan or image that it was trained with"
                errors.append(f"{prefix}coordinates: must be those of this model, got others; {hint}")
        super()._load_from_state_dict(state_dict, prefix, *args)
