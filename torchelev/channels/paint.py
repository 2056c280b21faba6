"""Images on the ground: read the pixel that shows each cell."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.channels import camera, fuse
from torchelev.channels.config import ChannelConfig
from torchelev.channels.inputs import find_channel, require_values
from torchelev.channels.state import Channel
from torchelev.channels.views import can_look, look_in_cpp
from torchelev.errors import require, require_positive
from torchelev.grid import GridConfig
from torchelev.inputs.checks import FLOATS, check_pose, check_tensor
from torchelev.ops.transforms import is_readable
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float

MODES = ("bilinear", "nearest")


def require_mode(mode: object) -> None:
    """Raise ValueError unless this is a way to read pixels."""
    require(mode in MODES, "mode", f"must be one of {', '.join(MODES)}", repr(mode), "use bilinear")


class Picture:
    """Checked images of V cameras of each of B robots, and where the cameras are.

    Args:
        image: (B, C, h, w) or (B, V, C, h, w), the components of all channels.
        K: (3, 3), (B, 3, 3) or (B, V, 3, 3) [pixels].
        T_map_camera: (B, 4, 4) or (B, V, 4, 4), optical axes.
        channels: name of a channel, or several in the order of the image's components.
        distortion: 4, 5 or 8 coefficients, or these for each robot or camera.
        configs: of the maps' channels.
        num_envs: number of maps, B.
        device: of the maps.

    Raises:
        TypeError, ValueError, KeyError: an argument does not fit.
    """

    def __init__(
        self,
        image: Any,
        K: Any,
        T_map_camera: Any,
        channels: Any,
        distortion: Any,
        configs: Mapping[str, ChannelConfig],
        num_envs: int,
        device: torch.device,
    ) -> None:
        names = (channels,) if isinstance(channels, str) else tuple(channels or ())
        is_list, hint = 0 < len(names) == len(set(names)), 'give "rgb", or several names, each once'
        require(is_list, "channels", "must name one channel or several", repr(channels), hint)
        self.channels = {name: find_channel(name, configs, "channels") for name in names}
        C = sum(cfg.size for cfg in self.channels.values())
        self.image = _check_image(image, self.channels, C, num_envs, device)
        V = self.image.shape[1]
        shape = (num_envs, 4, 4) if image.ndim == 4 else (num_envs, V, 4, 4)
        self.T = check_pose("T_map_camera", T_map_camera, shape, device, False).view(num_envs, V, 4, 4)
        self.K = _check_intrinsics(K, self.image.shape, device)
        self.distortion = None if distortion is None else _check_distortion(distortion, num_envs, V, device)

    def values(self) -> dict[str, Float[Tensor, "B V C h w"]]:
        """Return the part of the image of each channel."""
        parts = self.image.split([cfg.size for cfg in self.channels.values()], 2)
        return dict(zip(self.channels, parts, strict=True))


def _check_image(
    image: Any, channels: dict[str, ChannelConfig], C: int, B: int, device: torch.device
) -> Float[Tensor, "B V C h w"]:
    is_color = all(cfg.is_color for cfg in channels.values())
    value = check_tensor("image", image, device, (*FLOATS, torch.uint8) if is_color else FLOATS)
    fits = value.ndim in (4, 5) and value.shape[0] == B and value.shape[-3] == C and min(value.shape) > 0
    rule, hint = f"expected ({B}, {C}, h, w) or ({B}, V, {C}, h, w)", f"give the components of {', '.join(channels)}"
    require(fits, "image", rule, tuple(value.shape), hint)
    value = value.float() / 255 if value.dtype == torch.uint8 else value.float()
    value = value[:, None] if value.ndim == 4 else value
    if is_readable(value):
        parts = value.detach().split([cfg.size for cfg in channels.values()], 2)
        for (name, cfg), part in zip(channels.items(), parts, strict=True):
            require_values(f"image of {name!r}", part.movedim(2, -1), cfg)
    return value


def _check_intrinsics(K: Any, size: torch.Size, device: torch.device) -> Float[Tensor, "B V 3 3"]:
    B, V, _, h, w = size
    value = check_tensor("K", K, device, FLOATS)
    fits = tuple(value.shape) in ((3, 3), (B, 3, 3), (B, V, 3, 3))
    rule, hint = f"expected (3, 3), {(B, 3, 3)} or {(B, V, 3, 3)}", "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    require(fits, "K", rule, tuple(value.shape), hint)
    value = value[:, None] if value.ndim == 3 else value
    if is_readable(value):
        focal, center = value.detach()[..., (0, 1), (0, 1)], value.detach()[..., :2, 2]
        limit = center.new_tensor([w, h])
        # Of an image of half or twice the size, the centre would lie outside of the middle half.
        last_row = (value.detach()[..., 2, :] == value.new_tensor([0.0, 0.0, 1.0])).all(-1)
        good = last_row & (focal > 0).all(-1) & ((center > limit / 4) & (center < 3 * limit / 4)).all(-1)
        rule = f"must have positive focal lengths and its centre in the middle of the image of {w} x {h} pixels"
        if not good.all():
            first = value.reshape(-1, 3, 3)[int(good.flatten().int().argmin())].tolist()
            require(False, "K", rule, first, "scale K as the image was scaled; pad a crop")
    return value.expand(B, V, 3, 3)


def _check_distortion(D: Any, B: int, V: int, device: torch.device) -> Float[Tensor, "B V D"]:
    value = D if isinstance(D, Tensor) else torch.as_tensor(D, dtype=torch.float32)
    value = check_tensor("distortion", value.to(device), device, FLOATS).float()
    lead = tuple(value.shape[:-1])
    fits = value.ndim > 0 and value.shape[-1] in (4, 5, 8) and lead in ((), (B,), (B, V))
    hint = "give k1, k2, p1, p2[, k3[, k4, k5, k6]], as OpenCV does"
    require(fits, "distortion", "must be 4, 5 or 8 coefficients of each camera", tuple(value.shape), hint)
    return (value[:, None] if value.ndim == 2 else value).expand(B, V, -1)


def look(picture: Picture, state: MapState, grid: GridConfig, margin: float) -> camera.View:
    """Return which pixel shows each cell, and whether the map hides it. Without gradients."""
    require_positive(margin=margin)
    with torch.no_grad():
        size = (picture.image.shape[-2], picture.image.shape[-1])
        if can_look(state):
            return look_in_cpp(state, grid, picture.K, picture.T, size, picture.distortion, margin)
        view = camera.project(state, grid, picture.K, picture.T, size, picture.distortion)
        return view._replace(seen=view.seen & ~camera.hidden(state, grid, picture.T, margin))


def sample(image: Float[Tensor, "B V C h w"], view: camera.View, mode: str) -> Float[Tensor, "B V H W C"]:
    """Read the pixels of a view; arbitrary where nothing is seen. Differentiable in the image."""
    h, w = image.shape[-2:]
    place = (2 * view.uv + 1) / view.uv.new_tensor([w, h]) - 1
    place = torch.where(view.seen[..., None], place, 0.0)
    B, V, H, W = view.seen.shape
    values = F.grid_sample(
        image.flatten(0, 1), place.flatten(0, 1), mode=mode, padding_mode="border", align_corners=False
    )
    return values.view(B, V, -1, H, W).movedim(2, -1)


def fuse_view(channel: Channel, values: Float[Tensor, "B V H W C"], view: camera.View, cfg: ChannelConfig) -> Channel:
    """Return a channel with what the cameras see of each cell fused into it; each camera counts as a point."""
    counts = view.seen & values.isfinite().all(-1)
    x = torch.where(counts[..., None], values, 0.0)
    total = counts.sum(1).to(x.dtype)
    if cfg.kind == "maximum":
        added = torch.where(counts[..., None], values, -torch.inf).amax(1)
    else:
        added = x.sum(1)
    return fuse.combine(channel, added, total, cfg)
