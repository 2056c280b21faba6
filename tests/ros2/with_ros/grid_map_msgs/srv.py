"""The service of grid_map_msgs by which one asks for a part of a map."""

from grid_map_msgs.msg import GridMap
from grid_map_msgs.support import FLOAT64, STRING, STRINGS, One, make_message, make_service

GetGridMap = make_service(
    "grid_map_msgs/srv/GetGridMap",
    make_message(
        "grid_map_msgs/srv/GetGridMap_Request",
        frame_id=STRING,
        position_x=FLOAT64,
        position_y=FLOAT64,
        length_x=FLOAT64,
        length_y=FLOAT64,
        layers=STRINGS,
    ),
    make_message("grid_map_msgs/srv/GetGridMap_Response", map=One(GridMap)),
)
