"""Raw packets of lidars, which only the lidar's driver can decode."""

from __future__ import annotations

_PACKETS = {
    "VelodyneScan": "velodyne_pointcloud",
    "PacketMsg": "ouster-ros",
    "UdpFrame": "hesai_ros_driver",
    "UdpPacket": "hesai_ros_driver",
    "PandarScan": "hesai_ros_driver",
    "RslidarPacket": "rslidar_sdk",
    "RslidarScan": "rslidar_sdk",
    "NebulaPackets": "nebula_ros",
    "LivoxPacket": "livox_ros_driver2",
}


def converter_of(type_: str) -> str:
    """Return the package whose driver makes clouds of messages of a type; "": they are not packets of a lidar."""
    return _PACKETS.get(type_.rsplit("/", 1)[-1], "")
