"""The observation groups of a policy, in its order: what the robot gives itself, height scans and images of the map."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

from torchelev.errors import require
from torchelev.files import config_files
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.map_image import MapImage
from torchelev.observations.scan_layout import scan_layout

#: of a group: the names of its entries if the robot gives them itself, else what reads the map
Group = HeightScan | MapImage | Sequence[str]

_REFUSED = ("channels", "channel_fill")  # settings of what `require_heights` refuses
_IMAGE_SETTINGS = [field.name for field in dataclasses.fields(MapImage) if field.init and field.name not in _REFUSED]


def shape_of(group: Group) -> tuple[int, ...]:
    """Return the shape of a group's values in one environment."""
    if isinstance(group, HeightScan):
        return (group.num_points,)
    return group.shape if isinstance(group, MapImage) else (len(group),)


def to_json(groups: Mapping[str, Group]) -> list[dict[str, Any]]:
    """Return groups as values that JSON can hold."""
    return [{"name": name, **_describe(group)} for name, group in groups.items()]


def _describe(group: Group) -> dict[str, Any]:
    if isinstance(group, HeightScan):
        return {"kind": "height_scan", "layout": scan_settings(group)}
    if isinstance(group, MapImage):
        return {"kind": "map_image", "image": image_settings(group)}
    return {"kind": "given", "entries": list(group)}


def scan_settings(scan: HeightScan) -> dict[str, Any]:
    """Return the settings of a height scan by name, as the C library takes them."""
    return scan_layout(scan) | {"reach": scan.reach}


def image_settings(image: MapImage) -> dict[str, Any]:
    """Return the settings of an image by name, as the C library takes them."""
    settings = {name: getattr(image, name) for name in _IMAGE_SETTINGS}
    if "clearance" not in image.layers:  # libraries without levels do not know it
        del settings["max_clearance"]
    return settings


def require_heights(groups: Mapping[str, Group]) -> None:
    """Refuse groups that read channels, or scans of ceilings, which neither recordings nor the C library hold."""
    for name, group in groups.items():
        channels = group.channels if isinstance(group, HeightScan | MapImage) else ()
        rule, hint = "must read no channels, which bundles do not hold", "leave channels out"
        require(not channels, f"groups.{name}.channels", rule, channels, hint)
        reads_ceiling = isinstance(group, HeightScan) and group.surface == "ceiling"
        rule, hint = "must scan no ceilings, which bundles do not hold", "read the clearance of a MapImage"
        require(not reads_ceiling, f"groups.{name}", rule, "a scan of ceilings", hint)


def from_json(where: str, rows: Any) -> dict[str, Group]:
    """Return the groups that `to_json` described; errors call them `where`.

    Raises:
        ValueError: a row is of another kind, or its settings do not fit.
    """
    is_list = isinstance(rows, list) and all(isinstance(row, dict) and "name" in row for row in rows) and len(rows) > 0
    require(is_list, where, "must be a list of groups with names", type(rows).__name__, "export the run again")
    groups = {row["name"]: _group(f"{where}, {row['name']}", row) for row in rows}
    require_heights(groups)
    return groups


def _group(where: str, row: dict[str, Any]) -> Group:
    kind, hint = row.get("kind"), "export the run again"
    rule = "must be of kind given, height_scan or map_image"
    require(kind in ("given", "height_scan", "map_image"), where, rule, repr(kind), hint)
    try:
        if kind == "given":
            return tuple(row["entries"])
        if kind == "map_image":
            settings: dict[str, Any] = {
                name: tuple(v) if isinstance(v, list) else v for name, v in row["image"].items()
            }
            return MapImage(**settings)
        return HeightScan(**{name: config_files.from_json(value) for name, value in row["layout"].items()})
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{where}: {error}; {hint}") from error
