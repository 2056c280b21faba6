"""How often a sensor measures."""

from __future__ import annotations

import itertools
from collections import defaultdict

import numpy as np

from torchelev.io.bags.bag import Bag
from torchelev.io.bags.scans import stamp_of

_READ = 20  # messages of a topic


def find_period(bag: Bag, topic: str) -> float | None:
    """Return the median time between the first scans of a topic [s], by their stamps; None: there are too few.

    Several sensors may share a topic: their frames count apart.
    """
    stamps: dict[str, list[float]] = defaultdict(list)
    for message in itertools.islice(bag.read([topic]), _READ):
        stamps[message.data.header.frame_id].append(stamp_of(message.data.header))
    steps = np.concatenate([np.diff(np.sort(times)) for times in stamps.values()] or [np.zeros(0)])
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else None
