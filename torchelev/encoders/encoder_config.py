"""The settings of an attention encoder, as plain numbers of a policy's configuration."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torchelev.errors import require, require_count, require_positive


@dataclass(frozen=True, kw_only=True)
class AttentionConfig:
    """How an encoder reads one observation group, and the size of its network.

    A group is a height scan (B, P) or (B, C, P), or a map image (B, C, H, W). A scan needs `points`; an image needs
    `points` or `resolution`. The defaults are those of He et al., "Attention-Based Map Encoding for Learning
    Generalized Legged Locomotion" (2025, arXiv 2506.09588), except for `kernel_size`, which is 5 there: as a
    convolution needs a grid, the default looks at each point by itself.

    Raises:
        ValueError: for a setting out of range.
    """

    #: where the values lie, in their order: "isaac_lab", "mjlab" or "legged_gym"; a `HeightScan`; or rows (P, F) of
    #: plain numbers, x and y [m] and, if you like, further constants of a point, such as the foot that it belongs to
    points: Any = None
    resolution: float | None = None  #: [m] side of a pixel of an image, as of the `MapImage` that fills the group
    offset: tuple[float, float] = (0.0, 0.0)  #: [m] centre of an image (x, y), as of its `MapImage`
    #: rows and columns of a scan whose points form a grid, needed for `kernel_size` > 1: (11, 17) for Isaac Lab and
    #: mjlab, (17, 11) for legged_gym and `HeightScan.grid`
    grid: tuple[int, int] | None = None
    #: where the group's validity is, 1 if known: the index of one of its channels, or the name of another group (B, P)
    validity: int | str | None = None
    #: False: validity is a feature of a point; True: also, the encoder pays no attention to unknown points
    mask_unknown: bool = False
    embed_dim: int = 64  #: size of a point's features, of the query, and of the result
    num_heads: int = 16  #: heads; must divide `embed_dim`
    hidden_channels: int = 16  #: channels of the first of the two layers that compute a point's features
    kernel_size: int = 1  #: odd; of both layers. 1: a perceptron for each point; more: a convolution over the grid
    #: [pixels] side of the square that becomes one point; 2 takes about a quarter of the time of 1
    patch: int = 1

    def __post_init__(self) -> None:
        for name in ("embed_dim", "num_heads", "hidden_channels", "kernel_size", "patch"):
            require_count(name, getattr(self, name), "leave it out for its default")
        hint = "change one of them"
        is_divided, rule = self.embed_dim % self.num_heads == 0, f"must divide embed_dim = {self.embed_dim}"
        require(is_divided, "num_heads", rule, self.num_heads, hint)
        require(self.kernel_size % 2 == 1, "kernel_size", "must be odd", self.kernel_size, "use 1, 3 or 5")
        if self.resolution is not None:
            require_positive(resolution=self.resolution)
        is_kind = self.validity is None or type(self.validity) in (int, str)
        require(is_kind, "validity", "must be a channel or a group", repr(self.validity), "give its index or name")
        has_mask = not self.mask_unknown or self.validity is not None
        require(has_mask, "mask_unknown", "must be False without a validity", self.mask_unknown, "give validity")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> AttentionConfig:
        """Build the settings from a dict, as read from a file.

        Raises:
            ValueError: for a name that is not a setting, or a value out of range.
        """
        names = [field.name for field in dataclasses.fields(cls)]
        unknown = [name for name in values if name not in names]
        require(not unknown, "settings", f"must be some of {', '.join(names)}", ", ".join(unknown), "correct them")
        return cls(**values)
