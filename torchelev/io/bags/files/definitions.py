"""The types of messages that bags may need and rosbags does not have."""

from __future__ import annotations

from typing import Any

GRID_MAP = "grid_map_msgs/msg/GridMap"
TF2 = "tf2_msgs/msg/TFMessage"
_INFO = """
float64 resolution
float64 length_x
float64 length_y
geometry_msgs/Pose pose
"""
_LAYERS = """
string[] layers
string[] basic_layers
std_msgs/Float32MultiArray[] data
uint16 outer_start_index
uint16 inner_start_index
"""
# In ROS 1 the header is part of the info.
_DEFINITIONS = {
    1: ("std_msgs/Header header" + _INFO, "grid_map_msgs/GridMapInfo info" + _LAYERS),
    2: (_INFO, "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info" + _LAYERS),
}


def make_typestore(ros: int) -> Any:
    """Return rosbags' types of ROS 1 or 2, with those of GridMap and, in ROS 1, of tf2."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore({1: Stores.ROS1_NOETIC, 2: Stores.ROS2_HUMBLE}[ros])
    info, grid_map = _DEFINITIONS[ros]
    store.register(get_types_from_msg(info, "grid_map_msgs/msg/GridMapInfo"))
    store.register(get_types_from_msg(grid_map, GRID_MAP))
    if TF2 not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF2))
    return store
