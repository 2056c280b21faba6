"""A node's parameters: what ROS was given, and their declarations. Imports ROS."""

from __future__ import annotations

import dataclasses
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from torchelev.ros2.settings import NodeSettings, is_of_ros, make_settings, nest, split


def merged_parameters(node: Node, settings: NodeSettings, cfg: dict[str, Any]) -> tuple[NodeSettings, dict[str, Any]]:
    """Return the settings of node and map, of which those that ROS was given come first, and declare them all.

    Raises:
        ValueError: a value does not fit, or there is no such parameter.
    """
    given = {name: one.value for name, one in node.get_parameters_by_prefix("").items() if not is_of_ros(name)}
    own, of_map = split(nest(given))
    settings = make_settings({**dataclasses.asdict(settings), **own})
    for each in dataclasses.fields(settings):
        if each.name in own:
            node.undeclare_parameter(each.name)
        _declare(node, each, getattr(settings, each.name))
    return settings, _merged(cfg, of_map)


def _declare(node: Node, each: dataclasses.Field[Any], value: Any) -> None:
    describe = ParameterDescriptor(
        name=each.name,
        description=each.metadata["meaning"],
        read_only=not each.metadata["changeable"],
        dynamic_typing=True,  # a whole number may be given for a float; `NodeSettings` checks types
    )
    plain = list(value) if isinstance(value, tuple) else value
    node.declare_parameter(each.name, plain, describe, ignore_override=True)


def _merged(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Return the first settings updated by the second, group by group."""
    both = dict(a)
    for name, value in b.items():
        old = both.get(name)
        both[name] = _merged(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return both
