"""The encoders of the map that `python -m training.nav` offers, as configurations of rsl-rl's models."""

from __future__ import annotations

from typing import Any

from envs.terrain_nav.config import SightConfig
from envs.terrain_nav.sight import LAYERS

ENCODERS = ("mlp", "cnn", "attention")


def encoder_config(encoder: str, group: str) -> dict[str, Any]:
    """Return the entries of a model's configuration that choose its encoder.

    "mlp" is a convolution whose kernel is the whole image: a fully connected layer, in a model that takes images.

    Args:
        encoder: one of ENCODERS.
        group: the observation group of the images.
    """
    sight = SightConfig()
    if encoder == "attention":
        place = {"resolution": sight.crop_resolution, "offset": (sight.crop_ahead, 0.0)}
        size = {"embed_dim": 32, "num_heads": 4, "hidden_channels": 8, "kernel_size": 3, "patch": 2}
        cfg = place | size | {"validity": LAYERS.index("validity")}
        return {"class_name": "torchelev.encoders.rsl_rl:AttentionModel", "attention_cfg": {group: cfg}}
    if encoder == "mlp":
        pixels = round(sight.crop_length / sight.crop_resolution)
        cnn = {"output_channels": [128], "kernel_size": pixels, "padding": "none", "activation": "elu"}
    else:
        cnn = {"output_channels": [8, 16], "kernel_size": 3, "stride": 2, "padding": "zeros", "activation": "elu"}
    return {"class_name": "CNNModel", "cnn_cfg": cnn}
