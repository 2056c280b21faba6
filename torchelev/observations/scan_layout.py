"""The layout of the height scan that a policy was trained with, as plain data to store beside its weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from torchelev.errors import require
from torchelev.files.config_files import to_json
from torchelev.observations.scan.settings import ScanSettings

# Noise belongs to training, reach to the map's window; the placement follows from the pattern.
_LEFT_OUT = ("noise", "noise_after_clip", "reach", "placement")
# Layouts of policies that read the heights of the ground alone do not name these.
_CHANNELS, _CEILING = ("channels", "channel_fill"), ("surface", "no_ceiling")
_DIGITS = 6  # of a pattern's coordinates [m]


def scan_layout(scan: ScanSettings) -> dict[str, Any]:
    """Describe a scan by its points in their order, offset, clip, scale, fill and channels, as values of JSON.

    Store it with a policy, and check it with `require_layout` where the policy is deployed.
    """
    left_out = (*_LEFT_OUT, *(() if scan.channels else _CHANNELS), *(_CEILING if scan.surface == "ground" else ()))
    names = [field.name for field in dataclasses.fields(scan) if field.name not in left_out]
    pattern = [[round(x, _DIGITS), round(y, _DIGITS)] for x, y in scan.pattern]
    return {name: pattern if name == "pattern" else to_json(getattr(scan, name)) for name in names}


def require_layout(scan: ScanSettings, layout: Mapping[str, Any], name: str = "height_scan") -> None:
    """Refuse a scan that a policy of another layout would misread.

    Args:
        scan: The scan that the policy is to read.
        layout: What `scan_layout` returned for the scan that it was trained with.
        name: What errors call the scan.

    Raises:
        ValueError: The two differ; the error names the first setting that does, both values, and the fix.
    """
    actual = scan_layout(scan)
    for key in sorted(actual.keys() | layout.keys(), key=lambda key: (key != "pattern", key)):
        found, wanted = actual.get(key), layout.get(key)
        if key == "pattern":
            _require_pattern(found, wanted, name)
        hint = f"build the scan with {key}={wanted!r}, or train with {found!r}"
        require(found == wanted, f"{name}.{key}", f"must be {wanted!r}, with which the policy was trained", found, hint)


def _require_pattern(found: Any, wanted: Any, name: str) -> None:
    """Refuse other points, or the same in another order."""
    if found == wanted:
        return
    is_reordered = isinstance(wanted, list) and sorted(found) == sorted(wanted)
    rule = "must have the points with which the policy was trained"
    hint = "use the same preset: isaac_lab and mjlab have x fastest, legged_gym and grid y fastest"
    if is_reordered:
        require(False, f"{name}.pattern", f"{rule}, in their order", "the same points in another order", hint)
    actual = f"{_summarize(found)} instead of {_summarize(wanted)}"
    require(False, f"{name}.pattern", rule, actual, "use the lengths and the resolution of the training")


def _summarize(points: Any) -> str:
    """Name the number of points and their extent."""
    if not isinstance(points, list) or not points:
        return "none"
    (x0, y0), (x1, y1) = ([f(axis) for axis in zip(*points, strict=True)] for f in (min, max))
    return f"{len(points)} points over x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m"
