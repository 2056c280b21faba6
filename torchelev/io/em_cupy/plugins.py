"""The plugins of plugin_config.yaml: the filters that compute the same."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from torchelev.errors import require
from torchelev.filters.chain import FilterConfig
from torchelev.io.em_cupy.parameters import GONE


class Plugin(NamedTuple):
    """What becomes of a plugin."""

    filter: str | None  #: the filter that computes the same; None: there is none
    settings: tuple[str, ...] = ()  #: that it takes
    source: str = "elevation"  #: the layer that it reads by default
    note: str = ""  #: what to know about it


PLUGINS: dict[str, Plugin] = {
    "min_filter": Plugin(
        "em_cupy_min_filter",
        ("dilation_size", "iteration_n"),
        note="the paper's own, which fills each hole from its border, is inpaint_minimum",
    ),
    "max_filter": Plugin("em_cupy_max_filter", ("dilation_size", "iteration_n")),
    "smooth_filter": Plugin("em_cupy_smooth_filter", note="box and gaussian leave unknown cells out of their means"),
    "inpainting": Plugin("em_cupy_inpainting", ("method",), note="heights become 255 levels; inpaint_telea keeps them"),
    "erosion": Plugin(
        "em_cupy_erosion",
        ("kernel_size", "iterations", "reverse"),
        "traversability",
        "dilation_size and iteration_n are without effect there; values become 255 levels",
    ),
    "max_layer_filter": Plugin(None, note=f"{GONE}: write it as filters maximum, minimum or expression"),
    "robot_centric_elevation": Plugin(None, note=f"{GONE}: HeightScan reads heights below the base"),
    "semantic_filter": Plugin(None, note=f"{GONE}: read the channel's components"),
    "semantic_traversability": Plugin(None, note=f"{GONE}: write it as a filter expression of the layers"),
    "features_pca": Plugin(None, note=f"{GONE}: read the channel and project it"),
}
_WITHOUT_EFFECT = ("input_layer_name", "dilation_size", "iteration_n", "min_filter_size", "default_layer_name")


def is_plugin(value: Any) -> bool:
    """Return whether this is a plugin's group of settings."""
    return isinstance(value, Mapping) and "layer_name" in value


def read_plugins(plugins: Mapping[str, Any]) -> tuple[list[FilterConfig], list[str]]:
    """Return the filters, and the notes."""
    filters: list[FilterConfig] = []
    notes: list[str] = []
    for name, value in plugins.items():
        is_group = isinstance(value, Mapping) and isinstance(value.get("extra_params") or {}, Mapping)
        require(is_group, name, "must be a group of settings", repr(value), "give layer_name and extra_params")
        kind = str(value.get("type", name))
        require(kind in PLUGINS, name, f"must be a plugin: {', '.join(PLUGINS)}", kind, "write it as a filter")
        if not value.get("enable", True):
            continue
        plugin, layer, extra = PLUGINS[kind], str(value.get("layer_name", name)), value.get("extra_params") or {}
        if plugin.filter is not None:
            for setting in extra:
                known = (*plugin.settings, *_WITHOUT_EFFECT)
                require(
                    setting in known, f"{name}.{setting}", "is no setting of the plugin", extra[setting], "remove it"
                )
            settings = {key: extra[key] for key in plugin.settings if key in extra}
            source = str(extra.get("input_layer_name", plugin.source))
            filters.append(FilterConfig(layer=layer, filter=plugin.filter, inputs=source, settings=settings))
        if plugin.note:
            notes.append(f"plugin {name}, layer {layer}: {plugin.note}")
        if value.get("fill_nan"):
            notes.append(f"plugin {name}, layer {layer}: fill_nan {GONE}: unknown cells stay unknown")
    return filters, notes
