"""The settings of an encoder: what is refused, by name."""

import pytest

from torchelev.encoders import AttentionConfig


@pytest.mark.parametrize(
    "settings, named",
    [
        ({"embed_dim": 0}, "embed_dim: must be a positive int"),
        ({"num_heads": 5}, "num_heads: must divide embed_dim = 64, got 5"),
        ({"kernel_size": 4}, "kernel_size: must be odd, got 4"),
        ({"patch": 1.5}, "patch: must be a positive int"),
        ({"hidden_channels": -1}, "hidden_channels: must be a positive int"),
        ({"resolution": 0.0}, "resolution: must be a positive number"),
        ({"validity": True}, "validity: must be a channel or a group"),
        ({"mask_unknown": True}, "mask_unknown: must be False without a validity"),
        ({"heads": 4, "width": 2}, "settings: must be some of points, .*, got heads, width"),
    ],
)
def test_refuses_by_name(settings, named):
    with pytest.raises(ValueError, match=f"^{named}"):
        AttentionConfig.from_dict(settings)


def test_takes_what_a_file_holds():
    cfg = AttentionConfig.from_dict({"points": [[0.0, 0.1]], "grid": [1, 1], "validity": "known", "mask_unknown": True})
    assert cfg.points == [[0.0, 0.1]] and cfg.validity == "known" and cfg.embed_dim == 64
