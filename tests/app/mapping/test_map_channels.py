"""`torchelev map --colour` and `--semantic`: a ground that is red on the left, and labels that a camera sees."""

import numpy as np
import plyfile
import pytest
import torch
from PIL import Image

from tests.app.drives import sensor_poses, value_at, world_points, write_poses
from tests.io.bags.synthetic import CAMERA, START, T_BASE_CAMERA, Scan, Writer
from torchelev.channels.views import build_libraries
from torchelev.io.export import load_npz
from torchelev.sim.poses import pose

LABELS = "/camera/semantic/image"


@pytest.fixture(autouse=True, scope="module")
def built():
    """The C++ of channels is there: the first use on a machine says on stderr that it is built."""
    build_libraries()


def base_at(seconds):
    """The robot drives ahead at 2 m/s."""
    return pose(torch.tensor([2.0 * seconds, 0.0, 0.5], dtype=torch.float64), 0.0).numpy()


def ground(seed):
    """Points of flat ground in the map frame, and their colours: red where y > 0, green where not."""
    xy = np.random.default_rng(seed).uniform(-4, 4, (20000, 2))
    is_left = xy[:, 1] > 0
    colors = np.where(is_left[:, None], [255, 0, 0], [0, 255, 0]).astype(np.uint32)
    return np.column_stack([xy, np.zeros(len(xy))]), colors


def label_image(T_map_camera, width=CAMERA.width, height=CAMERA.height):
    """The labels that the camera sees: 1 where y > 0, 0 where not, and 255 in the sky."""
    K = CAMERA.intrinsics.double().numpy()
    scale = width / CAMERA.width
    v, u = np.mgrid[:height, :width]
    pixels = np.stack([(u + 0.5) / scale - 0.5, (v + 0.5) / scale - 0.5, np.ones(u.shape)])
    rays = np.einsum("ij,jk,khw->ihw", T_map_camera[:3, :3], np.linalg.inv(K), pixels)
    is_down = rays[2] < -1e-3
    y = T_map_camera[1, 3] + rays[1] * T_map_camera[2, 3] / np.where(is_down, -rays[2], 1.0)
    return np.where(is_down, y > 0, 255).astype(np.uint8)


def write_bag(path, colors="rgb", labels="mono8", info="/camera/semantic/camera_info", size=1, value=1):
    """Write four clouds and images."""
    writer = Writer(path, "mcap")
    T_camera = T_BASE_CAMERA.numpy()
    writer.transform(START, "base_link", "camera", T_camera, is_static=True)
    writer.transform(START, "base_link", "lidar", np.eye(4), is_static=True)
    for k in range(4):
        stamp = START + 0.1 * k
        for late in (0.0, 0.05):
            writer.transform(stamp + late, "odom", "base_link", base_at(0.1 * k + late))
        points, rgb = ground(k)
        packed = (rgb[:, 0] << 16 | rgb[:, 1] << 8 | rgb[:, 2]).astype(np.uint32)
        layout = {"colors": {colors: packed.view(np.float32)}} if colors else {}
        base = base_at(0.1 * k)
        writer.cloud(Scan(stamp, (points - base[:3, 3]).astype(np.float32), None, base, base), **layout)
        if labels:
            writer.camera_info(stamp, info)
            image = label_image(base_at(0.1 * k + 0.02) @ T_camera, CAMERA.width // size, CAMERA.height // size)
            image = np.where(image == 1, value, image).astype(np.uint8)
            write_labels(writer, stamp + 0.02, image, labels)
    writer.close()
    return path


def write_labels(writer, stamp, image, encoding):
    pixels = image if encoding == "mono8" else np.where(image == 255, 65535, image.astype(np.int64)).astype("<u2")
    data = np.frombuffer(pixels.tobytes(), np.uint8)
    shape = dict(height=image.shape[0], width=image.shape[1], step=pixels.itemsize * image.shape[1], is_bigendian=0)
    name, header = "sensor_msgs/msg/Image", writer.header(stamp, "camera")
    writer.write(LABELS, name, stamp, writer.make(name, header=header, encoding=encoding, data=data, **shape))


@pytest.mark.slow(2)
def test_colours_of_a_bag(run, tmp_path):
    code, out, err = run("map", write_bag(tmp_path / "bag"), "--colour", "--size", 6)
    assert (code, err) == (0, "")
    saved = load_npz(tmp_path / "map.npz")
    for y, red in ((1.5, 1.0), (-1.5, 0.0)):
        assert value_at(saved, 1.0, y, "rgb.red") == pytest.approx(red, abs=1e-4)
        assert value_at(saved, 1.0, y, "rgb.green") == pytest.approx(1 - red, abs=1e-4)
    picture = np.array(Image.open(tmp_path / "map.png").convert("RGB")).reshape(-1, 3).astype(int)
    for color in ([255, 0, 0], [0, 255, 0]):
        assert (abs(picture - color).max(1) < 10).mean() > 0.01, "the picture shows the colours"


@pytest.mark.slow(2)
@pytest.mark.parametrize("size", [1, 2], ids=["camera's size", "half the size"])
def test_labels_of_a_bag(run, tmp_path, size):
    path = write_bag(tmp_path / "bag", colors="", size=size)
    code, _, err = run("map", path, "--semantic", LABELS, "--classes", "grass,stone", "--size", 6)
    assert (code, err) == (0, "")
    saved = load_npz(tmp_path / "map.npz")
    for x, y in ((1.5, 0.4), (2.0, 0.5), (2.5, 0.8)):
        assert value_at(saved, x, y, "semantic.stone") == pytest.approx(0.9, abs=1e-4)  # (4 + 1/2) / (4 + 1)
        assert value_at(saved, x, -y, "semantic.grass") == pytest.approx(0.9, abs=1e-4)
    assert np.isnan(value_at(saved, -1.0, 0.5, "semantic.grass")), "behind the camera"
    border = np.array([value_at(saved, 2.0, y, "semantic.stone") for y in np.arange(-0.45, 0.5, 0.1)])
    counts = 5 * border - 0.5  # of four whole labels: none is blended at the border
    np.testing.assert_allclose(counts, counts.round(), atol=1e-3)
    known = np.isfinite(saved.layers["semantic.stone"])
    assert 100 < known.sum() < 0.4 * known.size


@pytest.mark.slow(1)
def test_as_many_classes_as_there_are(run, tmp_path):
    path = write_bag(tmp_path / "bag", colors="", labels="16UC1", value=3)
    assert run("map", path, "--semantic", LABELS, "--size", 4)[0] == 0
    saved = load_npz(tmp_path / "map.npz")
    names = [name for name in saved.layers if name.startswith("semantic.")]
    assert names == [f"semantic.{k}" for k in range(4)]
    assert value_at(saved, 1.5, 0.5, "semantic.3") > 0.8 > 0.1 > value_at(saved, 1.5, 0.5, "semantic.1")


@pytest.mark.slow(1)
def test_labels_without_a_name_are_said(run, tmp_path):
    path = write_bag(tmp_path / "bag", colors="", value=2)
    code, _, err = run("map", path, "--semantic", LABELS, "--classes", "grass,stone", "--size", 4)
    assert code == 0 and f"warning: {LABELS}: labels from 2 have no name in --classes, and are left out" in err


@pytest.mark.slow(3)
def test_what_is_not_there_names_the_option(run, tmp_path):
    path = write_bag(tmp_path / "bag", colors="", info="/calibration")
    for options, words in (
        (["--colour"], "--colour: no points with colours: /lidar/points has x, y, z; give --points with a topic whose"),
        (["--semantic", "/labels"], f"--semantic /labels is not in the bag; topics of images are {LABELS}"),
        (["--semantic", "/tf"], "--semantic /tf is tf2_msgs/msg/TFMessage; topics of images are"),
        (
            ["--semantic", LABELS],
            "no camera_info beside it; name one with --semantic-info; topics of CameraInfo are /cal",
        ),
        (
            ["--semantic", LABELS, "--semantic-info", "/tf"],
            "--semantic-info /tf is tf2_msgs/msg/TFMessage; such topics",
        ),
        (["--classes", "a,b"], "--classes: only with --semantic; give --semantic TOPIC"),
        (["--semantic", LABELS, "--classes", "a"], "--classes a: must name two classes or more; give grass,stone"),
    ):
        code, _, err = run("map", path, *options)
        assert code == 2 and words in " ".join(err.split()), err
    (tmp_path / "map.yaml").write_text("channels: {semantic: {kind: mean}}")
    options = ("--semantic", LABELS, "--semantic-info", "/calibration", "--config", tmp_path / "map.yaml")
    code, _, err = run("map", path, *options)
    assert code == 2 and "config.channels.semantic: must be of kind class and have 2 components, as --semantic" in err


@pytest.mark.slow(1)
def test_what_a_bag_brings_is_proposed(run, tmp_path):
    _, out, _ = run("bag", write_bag(tmp_path / "bag"))
    assert "the points have colours, which --colour maps" in out
    assert f"class labels are mapped with --semantic {LABELS}" in out
    _, out, _ = run("bag", write_bag(tmp_path / "plain", colors="", labels=""))
    assert "to map it" in out and "colour" not in out and "--semantic" not in out


@pytest.mark.slow(2)
def test_colours_of_a_folder(run, recording, tmp_path):
    code, _, err = run("map", recording, "--colour")
    assert code == 2 and "--colour: must find colours of the points, got none in 000000.bin; save fields red" in err
    folder = tmp_path / "coloured"
    folder.mkdir()
    write_poses(folder / "poses.txt", sensor_poses())
    for k, T in enumerate(sensor_poses()):
        world = world_points(k)
        rows = np.zeros(len(world), [(axis, "f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
        for axis, values in zip("xyz", ((world - T[:3, 3]) @ T[:3, :3]).T, strict=True):
            rows[axis] = values
        rows["red"], rows["blue"] = 255 * (world[:, 2] > 0.2), 255 * (world[:, 2] < 0.2)
        plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(folder / f"{k}.ply")
    assert run("map", folder, "--color", "--size", 8)[0] == 0
    saved = load_npz(tmp_path / "map.npz")
    assert value_at(saved, 2.5, 1.5, "rgb.red") > 0.99 and value_at(saved, -2.0, 1.5, "rgb.blue") > 0.99
