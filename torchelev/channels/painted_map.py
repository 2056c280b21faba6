"""The methods of a map that read images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.channels import fuse
from torchelev.channels.camera import View
from torchelev.channels.module import Channels
from torchelev.channels.paint import Picture, fuse_view, look, require_mode, sample
from torchelev.channels.views import can_paint, paint_in_cpp
from torchelev.layers import Layer
from torchelev.ops.masks import count
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.config import ElevationMapConfig


class PaintedMap:
    """What `ElevationMap` takes from images. It is mixed into a module with these attributes."""

    cfg: ElevationMapConfig
    num_envs: int
    channels: Channels | None
    state: MapState
    device: torch.device
    _derived: dict[str, Layer]  # of filters, which may read channels

    def paint(
        self,
        image: Float[Tensor, "B *V C h w"],
        K: Float[Tensor, "*B 3 3"],
        T_map_camera: Float[Tensor, "B *V 4 4"],
        channels: str | Sequence[str],
        *,
        distortion: Sequence[float] | Float[Tensor, "*B D"] | None = None,
        mode: str = "bilinear",
        margin: float = 0.1,
    ) -> Int[Tensor, "B"]:
        """Fuse what cameras see of the ground into channels: each cell takes the pixel that shows its centre.

        A cell that the map hides takes none, nor one that is not known. Each camera counts as a point of a
        `ChannelConfig`.

        Args:
            image: (B, C, h, w), or (B, V, C, h, w) of V cameras, NaN where a pixel says nothing. Colours are from 0 to
                1, or uint8; probabilities of classes sum to 1.
            K: intrinsics [pixels], (3, 3), (B, 3, 3) or (B, V, 3, 3); (0, 0) is the centre of the first pixel. The
                principal point must lie in the middle half of the image, along both sides.
            T_map_camera: optical frame (x right, y down, z forward) to map frame, (B, 4, 4) or (B, V, 4, 4).
            channels: name of the channel, or of several in the order of the image's C components.
            distortion: k1, k2, p1, p2 and, if there are more, k3, and k4, k5, k6, as OpenCV has them; (D,), (B, D) or
                (B, V, D). None: pictures without distortion.
            mode: "bilinear" or "nearest"; use "nearest" for labels.
            margin: a cell is hidden if the line from the camera to it passes more than this below the elevation [m].

        Returns:
            How many cells a camera sees, int64. None of a known map means a wrong pose, such as axes of a sensor frame
            (x forward) in place of the optical frame.

        Raises:
            KeyError: if there is no such channel. Nothing has changed then.
            TypeError, ValueError: if an argument does not fit. Nothing has changed then.
        """
        picture, view = self._look(image, K, T_map_camera, channels, distortion, mode, margin)
        assert self.channels is not None
        self._derived.clear()
        with torch.no_grad():
            for name, part in picture.values().items():
                channel, cfg = self.channels.channel(name), self.cfg.channels[name]
                if can_paint(channel):
                    paint_in_cpp(channel, part, view, mode, cfg)
                else:
                    self.channels.write(name, fuse_view(channel, sample(part, view, mode), view, cfg))
        return count(view.seen.any(1))

    def painted(
        self,
        image: Float[Tensor, "B *V C h w"],
        K: Float[Tensor, "*B 3 3"],
        T_map_camera: Float[Tensor, "B *V 4 4"],
        channel: str,
        *,
        distortion: Sequence[float] | Float[Tensor, "*B D"] | None = None,
        mode: str = "bilinear",
        margin: float = 0.1,
    ) -> tuple[Float[Tensor, "B C H W"], Bool[Tensor, "B H W"]]:
        """Return what a channel would be after `paint`, and where it is known; differentiable in the image.

        A network that makes the image can be trained through the map. Arguments and errors are those of `paint`.
        """
        picture, view = self._look(image, K, T_map_camera, channel, distortion, mode, margin)
        assert self.channels is not None
        cfg = self.cfg.channels[channel]
        before = self.channels.channel(channel)
        before = before._replace(values=before.values.clone(), weight=before.weight.clone())
        values, known = fuse.read(fuse_view(before, sample(picture.image, view, mode), view, cfg), cfg)
        return values.movedim(-1, 1), known & self.state.validity

    def _look(
        self, image: Any, K: Any, T_map_camera: Any, channels: Any, distortion: Any, mode: str, margin: float
    ) -> tuple[Picture, View]:
        """Check the arguments of `paint`; return the images, and which pixel shows each cell."""
        require_mode(mode)
        picture = Picture(image, K, T_map_camera, channels, distortion, self.cfg.channels, self.num_envs, self.device)
        return picture, look(picture, self.state, self.cfg.grid, margin)
