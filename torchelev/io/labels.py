"""Images of class labels, one number per pixel, and the probabilities that they give to a channel of classes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class LabelImage(NamedTuple):
    """Labels as a camera saw them."""

    labels: NDArray[np.integer]  #: (h, w) number of the class; values other than 0 to C - 1 are ignored
    K: NDArray[np.float64]  #: (3, 3) [pixels] of an image of this size
    T_map_camera: NDArray[np.float64]  #: (4, 4), optical axes
    distortion: tuple[float, ...] = ()  #: as `ElevationMap.paint` has them; (): none


def to_probabilities(labels: NDArray[np.integer], num_classes: int) -> NDArray[np.float32]:
    """Return the probabilities (C, h, w) of labels (h, w): 1 of the label, NaN where it is no number of a class."""
    one_hot = (labels == np.arange(num_classes)[:, None, None]).astype(np.float32)
    return np.where((labels >= 0) & (labels < num_classes), one_hot, np.float32(np.nan))
