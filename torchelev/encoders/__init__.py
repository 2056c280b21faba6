"""Map encoders of policies: attention over the points of a height scan or the pixels of a map image.

Environments and observations are not here, see `gym` and `observations`. `MapAttention` needs torch alone.
`torchelev.encoders.rsl_rl`, the model that rsl-rl loads, also needs rsl-rl; import it by that name.
"""

from torchelev.encoders.attention import MapAttention
from torchelev.encoders.encoder_config import AttentionConfig
from torchelev.encoders.layout import MapLayout

__all__ = ["AttentionConfig", "MapAttention", "MapLayout"]
