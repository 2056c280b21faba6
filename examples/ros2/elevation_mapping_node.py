"""A ROS 2 node: PointCloud2 and transforms in, GridMap out. Written for Humble and later, Python 3.10.

    python elevation_mapping_node.py --ros-args -p points:=/lidar/points -p map_frame:=odom -p base_frame:=base_link

Run against stand-ins of the ROS packages (tests/examples/test_ros2_node.py); not tried with ROS itself.
"""

from array import array

import rclpy
import torch
from grid_map_msgs.msg import GridMap, GridMapInfo
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout
from tf2_ros import Buffer, TransformException, TransformListener

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.frames import transform_xyzw
from torchelev.io.bags.point_cloud import CloudError, read_points
from torchelev.io.bags.scans import clean, stamp_of
from torchelev.io.grid_map import to_grid_map

DEFAULTS = {
    "points": "/points",
    "map_frame": "odom",
    "base_frame": "base_link",
    "resolution": 0.1,  # [m]
    "length": 10.0,  # [m] side of the map
    "rate": 5.0,  # [Hz] of the GridMap
    "layers": ["elevation", "variance", "traversability", "upper_bound"],
    "compile": True,  # the first update then takes a minute
}
WAIT = Duration(seconds=0.1)  # for a transform


class ElevationMapping(Node):
    """Fuses clouds into a map around the robot and publishes it.

    One thread runs all callbacks, so that no one reads the map while it is updated.
    """

    def __init__(self):
        super().__init__("elevation_mapping")
        self.settings = {name: self.declare_parameter(name, value).value for name, value in DEFAULTS.items()}
        grid = GridConfig(
            resolution=self.settings["resolution"], length_x=self.settings["length"], length_y=self.settings["length"]
        )
        self.emap, self.stamp = ElevationMap(ElevationMapConfig(grid=grid)), None
        if self.settings["compile"]:
            self.get_logger().info("compiling for one to three minutes")
            self.emap.compile()
            self.emap.warm_up(num_points=20_000)
        self.buffer = Buffer()
        self.listener = TransformListener(self.buffer, self)
        self.publisher = self.create_publisher(GridMap, "elevation_map", 1)
        self.create_subscription(PointCloud2, self.settings["points"], self.on_cloud, qos_profile_sensor_data)
        self.create_timer(1 / self.settings["rate"], self.publish)

    def on_cloud(self, cloud):
        """Fuse a cloud with the poses at its stamp."""
        stamp = stamp_of(cloud.header)
        try:
            T_map_sensor = self.look_up(clean(cloud.header.frame_id), cloud.header.stamp)
            T_map_base = self.look_up(self.settings["base_frame"], cloud.header.stamp)
            points = torch.from_numpy(read_points(cloud, stamp).points)[None]
        except (TransformException, CloudError) as error:
            self.get_logger().warning(f"left out a cloud: {error}")
            return
        dt = 0.0 if self.stamp is None else max(0.0, stamp - self.stamp)
        self.emap.update(points, T_map_sensor, T_map_base, dt=dt)
        self.stamp = stamp
        for line in self.emap.diagnose():
            self.get_logger().warning(line, once=True)

    def look_up(self, frame, stamp):
        """Return the pose of a frame in the map's frame, (1, 4, 4)."""
        found = self.buffer.lookup_transform(self.settings["map_frame"], frame, Time.from_msg(stamp), WAIT).transform
        p, q = found.translation, found.rotation
        return transform_xyzw([[p.x, p.y, p.z]], [[q.x, q.y, q.z, q.w]])

    def publish(self):
        """Publish the map, once there is one."""
        if self.stamp is not None:
            header = Header(frame_id=self.settings["map_frame"])
            header.stamp.sec, header.stamp.nanosec = int(self.stamp), int(self.stamp % 1 * 1e9)
            self.publisher.publish(to_message(to_grid_map(self.emap, layers=self.settings["layers"]), header))


def to_message(grid_map, header):
    """Turn torchelev's GridMap into the message."""
    info = GridMapInfo(
        resolution=grid_map.info.resolution, length_x=grid_map.info.length_x, length_y=grid_map.info.length_y
    )
    info.pose.position.x, info.pose.position.y, info.pose.orientation.w = *grid_map.info.pose.position[:2], 1.0
    data = []
    for layer in grid_map.data:
        dim = [MultiArrayDimension(**one._asdict()) for one in layer.layout.dim]
        data.append(Float32MultiArray(layout=MultiArrayLayout(dim=dim), data=array("f", layer.data.tobytes())))
    return GridMap(header=header, info=info, layers=grid_map.layers, basic_layers=["elevation"], data=data)


def main():
    rclpy.init()
    try:
        rclpy.spin(ElevationMapping())
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
