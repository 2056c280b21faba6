"""MCAP files that are not of ROS 2 throughout: what can be read is read, the rest is named and counted."""

import json
import re

import numpy as np
import pytest
import torch
from mcap.writer import CompressionType

from tests.io.bags.files.rewriting import rewrite
from tests.io.bags.synthetic import SCANS, Writer, drive, write_drive
from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.io import RecordingError, read_grid_map, write_grid_map
from torchelev.io.bags import Bag, BagRequest, open_bag

JSON = ("/markers", "foxglove.SceneUpdate", "jsonschema", b"{}", "json", [json.dumps({"a": 1}).encode()] * 3)
PROTOBUF = ("/state", "acme.State", "protobuf", b"\x00", "protobuf", [b"\x08\x01"])


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return next(write_drive(tmp_path_factory.mktemp("source"), depth=False).glob("*.mcap"))


def scans_of(path):
    with Bag(path) as bag:
        recording = open_bag(bag)
        frames = [frame for frame in recording if frame is not None]
        return [frame.points for frame in frames], recording.warnings, bag.unread


@pytest.mark.slow(3)
@pytest.mark.parametrize("profile", ["ros2", "", "ros1", "px4"])
@pytest.mark.parametrize("extra", [(), (JSON,), (JSON, PROTOBUF)])
def test_clouds_are_read_whatever_lies_beside_them(tmp_path, source, profile, extra):
    expected, *_ = scans_of(source)
    points, warnings, unread = scans_of(rewrite(source, tmp_path / "mixed.mcap", profile, extra))
    np.testing.assert_array_equal(points, expected)
    assert warnings == []
    described = [(topic.name, topic.type, topic.num, topic.problem) for topic in unread]
    assert described == [
        ("/markers", "foxglove.SceneUpdate", 3, "encoded as json"), ("/state", "acme.State", 1, "encoded as protobuf")
    ][: len(extra)]  # fmt: skip


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    "options", [{"use_chunking": False}, {"use_statistics": False}, {"compression": CompressionType.LZ4}]
)
def test_a_closed_file_is_whole_with_and_without_an_index(tmp_path, source, options):
    path = rewrite(source, tmp_path / "mixed.mcap", "", (JSON,), **options)
    points, warnings, unread = scans_of(path)
    assert (len(points), warnings, len(unread)) == (SCANS, [], 1)
    path.write_bytes(path.read_bytes()[:-100])
    points, warnings, _ = scans_of(path)
    assert len(points) <= SCANS and "the bag was not closed: read up to" in " ".join(warnings)


def test_a_damaged_chunk_is_said(tmp_path, source):
    path = rewrite(source, tmp_path / "mixed.mcap", "", (JSON,), compression=CompressionType.NONE, chunk_size=100_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 255
    path.write_bytes(data)
    points, warnings, _ = scans_of(path)
    assert len(points) < SCANS and "the bag is damaged, and was read up to" in " ".join(warnings)


def to_idl(schema):
    """The definition of a cloud as `ros2 bag` stores it where it has only IDL: parts that include each other."""
    if schema.name != "sensor_msgs/msg/PointCloud2":
        return schema.encoding, schema.data
    parts = {
        "builtin_interfaces/msg/Time": "struct Time { int32 sec; uint32 nanosec; };",
        "std_msgs/msg/Header": "struct Header { builtin_interfaces::msg::Time stamp; string frame_id; };",
        "sensor_msgs/msg/PointField": "struct PointField { string name; uint32 offset; uint8 datatype; "
        "uint32 count; };",
        "sensor_msgs/msg/PointCloud2": "struct PointCloud2 { std_msgs::msg::Header header; uint32 height; "
        "uint32 width; "
        "sequence<sensor_msgs::msg::PointField> fields; boolean is_bigendian; uint32 point_step; uint32 row_step; "
        "sequence<uint8> data; boolean is_dense; };",
    }
    text = ""
    for name, struct in reversed(parts.items()):
        used = re.findall(r"(\w+)::msg::(\w+)", struct)
        includes = "".join(f'#include "{package}/msg/{kind}.idl"\n' for package, kind in used)
        package = name.split("/")[0]
        text += f"{'=' * 80}\nIDL: {name}\n// made from a .msg\n{includes}\n"
        text += f"module {package} {{ module msg {{ {struct} }}; }};\n\n"
    return "ros2idl", text.encode()


def test_definitions_in_idl_that_include_others_are_read(tmp_path, source):
    expected, *_ = scans_of(source)
    points, warnings, unread = scans_of(rewrite(source, tmp_path / "idl.mcap", schema_of=to_idl))
    np.testing.assert_array_equal(points, expected)
    assert (warnings, unread) == ([], [])


def test_a_definition_that_nobody_can_read_is_named_and_ros_own_types_are_read_without_one(tmp_path, source):
    broken = ("/state", "acme_msgs/msg/State", "ros2msg", b"no definition !", "cdr", [bytes(8)])
    spoil = lambda schema: (schema.encoding, b"no definition !")  # noqa: E731
    points, warnings, unread = scans_of(rewrite(source, tmp_path / "a.mcap", "ros2", (broken,), spoil))
    assert (len(points), warnings) == (SCANS, [])
    assert [(topic.name, topic.problem) for topic in unread] == [("/state", "its definition cannot be read")]


def test_messages_of_another_type_than_they_say_are_counted(tmp_path, source):
    schema = ("std_msgs/msg/String", "ros2msg", b"string data\n")
    odd = ("/odd", *schema, "cdr", [b"\x00\x01\x00\x00\xff\xff\xff\x7f"] * 2)
    with Bag(rewrite(source, tmp_path / "odd.mcap", "", (odd,))) as bag:
        assert list(bag.read(["/odd"])) == []
        assert bag.ended_early.startswith("2 messages could not be decoded: /odd, ")
        assert len(list(bag.read(["/lidar/points"]))) == SCANS and bag.ended_early == ""


def test_a_grid_map_beside_json_is_read(tmp_path):
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.5, length_x=3.0, length_y=3.0)))
    emap.initialize(torch.tensor([[[0.0, 0.0, 0.2], [1.0, 0.0, 0.2], [0.0, 1.0, 0.2]]]))
    write_grid_map(tmp_path / "map.mcap", emap)
    path = rewrite(tmp_path / "map.mcap", tmp_path / "mixed.mcap", "", (JSON,))
    expected, read = read_grid_map(tmp_path / "map.mcap"), read_grid_map(path)
    np.testing.assert_array_equal(read.layers["elevation"], expected.layers["elevation"])


def test_a_bag_without_clouds_names_what_is_not_read(tmp_path):
    writer = Writer(tmp_path / "tf", "mcap")
    writer.transform(drive().stamps[0], "odom", "base_link", np.eye(4))
    writer.close()
    cloud = ("/points", "acme.Cloud", "jsonschema", b"{}", "json", [b"{}"] * 4)
    path = rewrite(next((tmp_path / "tf").glob("*.mcap")), tmp_path / "a.mcap", "", (cloud,))
    with Bag(path) as bag:
        with pytest.raises(RecordingError, match=r"not read: /points \(4 of acme.Cloud: encoded as json\)"):
            open_bag(bag)
        with pytest.raises(RecordingError, match="--points /points is acme.Cloud, not read: encoded as json"):
            open_bag(bag, BagRequest(clouds=["/points"]))
