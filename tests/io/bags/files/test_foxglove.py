"""Foxglove's own messages, in protobuf and JSON, are read as those of ROS."""

import base64
import json

import numpy as np
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from tests.helpers import without
from tests.io.bags.synthetic import CAMERA, SCANS, T_BASE_CAMERA, T_BASE_LIDAR, drive, write_drive
from tests.io.bags.test_recording import assert_same_map, map_bag
from torchelev.io.bags import Bag, BagRequest, open_bag
from torchelev.io.bags.scans import read_scan

FLOAT32, FLOAT64, UINT32 = 7, 8, 5  # foxglove.PackedElementField; ROS says 6 for uint32
DEPTH = "/camera/depth/image"


def stamped(time, **fields):
    seconds = int(time)
    return {"timestamp": (seconds, round((time - seconds) * 1e9)), **fields}


def vectors(T, place="translation", turn="rotation"):
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return {place: dict(zip("xyz", T[:3, 3].tolist(), strict=True)), turn: {"x": x, "y": y, "z": z, "w": w}}


def transform(time, parent, child, T):
    return stamped(time, parent_frame_id=parent, child_frame_id=child, **vectors(np.asarray(T)))


def cloud(scan, T=None):
    """A cloud whose times are nanoseconds before its stamp; its points may lie in a pose of their own."""
    kind = np.dtype([("t", "<u4"), ("x", "<f4"), ("y", "<f4"), ("z", "<f8")])
    table = np.zeros(len(scan.points), kind)
    points = scan.points if T is None else (scan.points - T[:3, 3]) @ T[:3, :3]
    table["x"], table["y"], table["z"] = points.T
    table["t"] = np.round((scan.times - scan.times.min()) * 1e9)
    types = {"t": UINT32, "x": FLOAT32, "y": FLOAT32, "z": FLOAT64}
    fields = [{"name": name, "offset": kind.fields[name][1], "type": number} for name, number in types.items()]
    pose = {} if T is None else {"pose": vectors(T, "position", "orientation")}
    start = scan.stamp + scan.times.min()
    return stamped(start, frame_id="lidar", point_stride=kind.itemsize, fields=fields, data=table.tobytes(), **pose)


def messages(T=None):
    """Topic, name of the type and fields of all messages of the drive."""
    truth = drive()
    first = truth.stamps[0]
    yield (
        first,
        "/transforms",
        "FrameTransforms",
        {"transforms": [transform(first, "base_link", "lidar", T_BASE_LIDAR)]},
    )
    yield first, "/transforms", "FrameTransform", transform(first, "base_link", "camera", T_BASE_CAMERA)
    K = CAMERA.intrinsics.double().numpy().ravel().tolist()
    info = stamped(first, frame_id="camera", width=CAMERA.width, height=CAMERA.height, K=K)
    yield first, "/camera/depth/camera_info", "CameraCalibration", info
    for stamp, base in zip(truth.stamps, truth.bases, strict=True):
        yield stamp, "/transforms", "FrameTransform", transform(stamp, "odom", "base_link", base)
        for child, mount in (("lidar", T_BASE_LIDAR), ("camera", T_BASE_CAMERA)):
            yield stamp, "/transforms", "FrameTransform", transform(stamp, "base_link", child, mount)
    for scan in truth.clouds:
        yield scan.stamp, "/lidar", "PointCloud", cloud(scan, T)
    for scan, image in truth.depths:
        raw = np.nan_to_num(image, nan=0.0).astype("<f4")
        size = {"height": image.shape[0], "width": image.shape[1], "step": 4 * image.shape[1]}
        data = stamped(scan.stamp, frame_id="camera", encoding="32FC1", data=raw.tobytes(), **size)
        yield scan.stamp, DEPTH, "RawImage", data


def to_json(name, fields):
    def plain(value):
        if isinstance(value, bytes):
            return base64.b64encode(value).decode()
        if isinstance(value, tuple):
            return {"sec": value[0], "nsec": value[1]}
        if isinstance(value, dict):
            return {key: plain(one) for key, one in value.items()}
        return [plain(one) for one in value] if isinstance(value, list) else value

    return json.dumps(plain(fields)).encode()


def to_protobuf(name, fields):
    schemas = pytest.importorskip("foxglove_schemas_protobuf")
    module = __import__(f"{schemas.__name__}.{name}_pb2", fromlist=[name])

    def fill(message, fields):
        for key, value in fields.items():
            if isinstance(value, tuple):
                message.timestamp.FromNanoseconds(value[0] * 1_000_000_000 + value[1])
            elif isinstance(value, dict):
                fill(getattr(message, key), value)
            elif isinstance(value, list) and value and isinstance(value[0], dict):
                for one in value:
                    fill(getattr(message, key).add(), one)
            elif isinstance(value, list):
                getattr(message, key).extend(value)
            else:
                setattr(message, key, value)

    message = getattr(module, name)()
    fill(message, fields)
    return message.SerializeToString()


def schema_of(name, encoding):
    if encoding == "json":
        return "jsonschema", b'{"type": "object"}'
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    module = __import__(f"foxglove_schemas_protobuf.{name}_pb2", fromlist=[name])
    files, pending = FileDescriptorSet(), [module.DESCRIPTOR]
    while pending:
        file = pending.pop()
        if file.name not in [one.name for one in files.file]:
            file.CopyToProto(files.file.add())
            pending.extend(file.dependencies)
    return "protobuf", files.SerializeToString()


def write(path, encoding, T=None):
    encode, ids = {"json": to_json, "protobuf": to_protobuf}[encoding], {}
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        for time, topic, name, fields in messages(T):
            if (topic, name) not in ids:
                schema = writer.register_schema(f"foxglove.{name}", *schema_of(name, encoding))
                ids[topic, name] = writer.register_channel(topic, encoding, schema)
            writer.add_message(ids[topic, name], round(time * 1e9), encode(name, fields), round(time * 1e9))
        writer.finish()
    return path


REQUEST = BagRequest(clouds=["/lidar"], depths=[DEPTH], map_frame="odom", base_frame="base_link")


@pytest.mark.slow(3)
@pytest.mark.parametrize("encoding", ["protobuf", "json"])
def test_the_map_is_that_of_the_same_drive_in_ros(tmp_path, encoding):
    pytest.importorskip("foxglove_schemas_protobuf")
    emap, frames, recording = map_bag(write(tmp_path / "drive.mcap", encoding), REQUEST)
    assert len(frames) == 2 * SCANS and not recording.warnings
    request = BagRequest(clouds=["/lidar/points"], depths=["/camera/depth/image_raw"])
    assert_same_map(emap, map_bag(write_drive(tmp_path), request)[0], share=0.97)


def test_points_come_out_as_they_went_in_also_from_a_pose_of_their_own(tmp_path):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", [0.1, 0.2, 2.0]).as_matrix(), [1.0, 2.0, 3.0]
    for pose in (None, T):
        with Bag(write(tmp_path / "drive.mcap", "json", pose)) as bag:
            first = next(bag.read(["/lidar"])).data
            datatypes = {field.name: field.datatype for field in first.fields}
            assert datatypes == {"t": 6, "x": 7, "y": 7, "z": 8}  # as sensor_msgs/PointField counts them
            scan = read_scan(first)
            np.testing.assert_allclose(scan.points, drive().clouds[0].points, atol=1e-5)
            times, hit = drive().clouds[0].times, np.isfinite(scan.points).all(1)
            np.testing.assert_allclose(scan.times[hit], (times - times.min())[hit], atol=1e-6)
            assert {topic.type for topic in bag.topics} == {
                "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image",
                "tf2_msgs/msg/TFMessage",
            }  # fmt: skip


def test_protobuf_without_its_library_is_named(tmp_path, monkeypatch):
    pytest.importorskip("foxglove_schemas_protobuf")
    path = write(tmp_path / "drive.mcap", "protobuf")
    without(monkeypatch, "mcap_protobuf.decoder")
    with Bag(path) as bag:
        assert bag.topics == []
        assert {topic.problem for topic in bag.unread} == {"encoded as protobuf: install mcap-protobuf-support"}
        with pytest.raises(Exception, match="there is no topic of clouds"):
            open_bag(bag)
