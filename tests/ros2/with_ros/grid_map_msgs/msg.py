"""The messages of grid_map_msgs in Humble, Jazzy and later."""

from geometry_msgs.msg import Pose
from std_msgs.msg import Float32MultiArray, Header

from grid_map_msgs.support import FLOAT64, STRINGS, UINT16, Many, One, make_message

GridMapInfo = make_message(
    "grid_map_msgs/msg/GridMapInfo", resolution=FLOAT64, length_x=FLOAT64, length_y=FLOAT64, pose=One(Pose)
)
GridMap = make_message(
    "grid_map_msgs/msg/GridMap",
    header=One(Header),
    info=One(GridMapInfo),
    layers=STRINGS,
    basic_layers=STRINGS,
    data=Many(Float32MultiArray),
    outer_start_index=UINT16,
    inner_start_index=UINT16,
)
