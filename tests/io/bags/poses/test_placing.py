"""What a bag leaves open is found, or named with the option that gives it; each such option gives the right poses."""

from typing import NamedTuple

import numpy as np
import pytest

from tests.io.bags.synthetic import CLOUD, ODOM, START, T_BASE_LIDAR, Writer, drive
from torchelev.io import RecordingError
from torchelev.io.bags import Bag, BagRequest, open_bag
from torchelev.io.bags.poses.clocks import ClockError
from torchelev.io.bags.poses.rows import invert

MOUNT = T_BASE_LIDAR.numpy()


class Shape(NamedTuple):
    """How the drive is recorded."""

    tf: bool = True  # whether odom -> base_link is on /tf
    odometry: str | None = None  # child of the odometry, if there is one
    mount: bool = True  # whether base_link -> lidar is there
    space: str = ""  # namespace of the topics
    ahead: float = 0.0  # [s] by which the lidar's clock is ahead
    stamped: bool = True  # or stamps are 0
    registered: bool = False  # clouds are in odom
    inverted: bool = False  # base_link -> odom is on /tf
    jump: float = 0.0  # [m] to the left after 0.3 s
    again: float | None = None  # [m] to the left of a second run with the same stamps


def write(path, shape):
    """Write the drive; messages are recorded at the times of the poses' clock, the second run 10 s later."""
    writer = Writer(path, "mcap")
    if shape.mount:
        writer.transform(START - 0.3, "base_link", "lidar", MOUNT, is_static=True, space=shape.space)
    runs = [(0.0, 0.0)] if shape.again is None else [(0.0, 0.0), (10.0, shape.again)]
    for later, shift in runs:
        events = [(t, T) for t, T in zip(drive().stamps, drive().bases, strict=True)]
        events += [(scan.stamp + 0.001, scan) for scan in drive().clouds]
        for t, what in sorted(events, key=lambda event: event[0]):
            if isinstance(what, np.ndarray):
                left = shift + shape.jump * (t - START > 0.3)
                _write_pose(
                    writer, shape, t, t + later, [[1, 0, 0, 0], [0, 1, 0, left], [0, 0, 1, 0], [0, 0, 0, 1]] @ what
                )
            else:
                _write_cloud(writer, shape, t + later, what)
    writer.close()
    return path


def _write_pose(writer, shape, t, recorded, T):
    if shape.inverted:
        writer.transform(t, "base_link", "odom", invert(np.asarray(T)), space=shape.space, recorded=recorded)
    elif shape.tf:
        writer.transform(t, "odom", "base_link", T, space=shape.space, recorded=recorded)
    if shape.odometry is not None:
        writer.odometry(t, T, shape.odometry)


def _write_cloud(writer, shape, recorded, scan):
    scan = scan._replace(stamp=scan.stamp + shape.ahead if shape.stamped else 0.0, times=None)
    if shape.registered:
        T = scan.T_map_sensor
        scan = scan._replace(points=(scan.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
    frame = "odom" if shape.registered else "lidar"
    writer.cloud(scan, f"{shape.space}{CLOUD}", frame, recorded)


def read(path, **request):
    with Bag(path) as bag:
        recording = open_bag(bag, BagRequest(**request))
        return recording, [frame for frame in recording if frame is not None]


def assert_poses(frames, scans=None, sensor="T_map_sensor", atol=1e-6):
    scans = drive().clouds if scans is None else scans
    assert len(frames) == len(scans)
    for frame, scan in zip(frames, scans, strict=True):
        np.testing.assert_allclose(frame.T_map_sensor, getattr(scan, sensor), atol=atol)
        np.testing.assert_allclose(frame.T_map_base, scan.T_map_base, atol=atol)


CURED = {
    "mounting": (Shape(odometry="base_link", tf=False, mount=False), dict(poses=ODOM, T_base_sensor=MOUNT)),
    "mounting beside /tf": (Shape(mount=False), dict(T_base_sensor=MOUNT)),
    "mounting in place of that in the bag": (Shape(), dict(T_base_sensor=MOUNT)),
    "namespace": (Shape(space="/robot1"), {}),
    "named topics": (Shape(space="/robot1"), dict(transforms=["/robot1/tf", "/robot1/tf_static"])),
    "odometry without child": (Shape(tf=False, odometry=""), dict(poses=ODOM, base_frame="base_link")),
    "clock ahead": (Shape(ahead=37.0), dict(clock_offsets={CLOUD: -37.0})),
    "clock of all topics": (Shape(ahead=37.0), dict(clock_offsets={"": -37.0})),
}


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", CURED)
def test_the_poses_are_right(tmp_path, name):
    shape, request = CURED[name]
    recording, frames = read(write(tmp_path / "drive", shape), **request)
    assert (recording.map_frame, recording.base_frame) == ("odom", "base_link")
    assert recording.warnings == []
    assert_poses(frames)


NAMED = {
    "mounting": (Shape(odometry="base_link", tf=False, mount=False), {}, "give --poses /odom, and --extrinsics with"),
    "mounting with --poses": (
        Shape(odometry="base_link", tf=False, mount=False), dict(poses=ODOM),
        "frames are base_link, odom; give --extrinsics with the pose of lidar on base_link",
    ),
    "odometry without child": (Shape(tf=False, odometry=""), dict(poses=ODOM), "whose pose it is; give --base-frame"),
    "no such transforms": (Shape(), dict(transforms=["/x"]), "--tf /x holds no transforms; topics of"),
    "unread transforms": (
        Shape(space="/robot1"), dict(transforms=["/robot1/tf_static"], map_frame="odom"), "--tf /robot1/tf",
    ),
    "empty time": (Shape(), dict(start=2.0, end=1.0), "--start 2.0 is not before --end 1.0"),
}  # fmt: skip


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", NAMED)
def test_the_option_is_named(tmp_path, name):
    shape, request, words = NAMED[name]
    with pytest.raises(RecordingError) as error:
        read(write(tmp_path / "drive", shape), **request)
    assert words in str(error.value)


@pytest.mark.slow(1)
@pytest.mark.parametrize("ahead", [37.0, 812.25 - START])
def test_clocks_that_differ_are_named_with_both_ranges_and_the_offset(tmp_path, ahead):
    path = write(tmp_path / "drive", Shape(ahead=ahead))
    with pytest.raises(ClockError) as error:
        read(path)
    assert f"stamps of {CLOUD} are {START + ahead:,.3f} .." in str(error.value)
    assert f"those of base_link {START - 0.3:,.3f} .. {START + 0.9:,.3f}" in str(error.value)
    assert f"--clock-offset {CLOUD}=" in str(error.value) and "or --stamps recorded" in str(error.value)
    offset = -37.0 if ahead == 37.0 else 0.001 - ahead  # messages are recorded 1 ms later
    assert error.value.offsets == {CLOUD: pytest.approx(offset, abs=1e-5)}
    assert_poses(read(path, clock_offsets=error.value.offsets)[1], atol=2e-3)
    assert_poses(read(path, stamps="recorded")[1], atol=2e-3)


def test_a_clock_that_is_ahead_by_less_than_the_bag_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("torchelev.io.bags.poses.clocks._DIFFERENCE", 0.2)
    recording, _ = read(write(tmp_path / "drive", Shape(ahead=0.3)))
    (note,) = recording.pose_notes
    assert "the poses arrive 0.299 s late, which does no harm, or the clocks differ" in note
    assert f"give --clock-offset {CLOUD}=-0.299 if they differ" in note


def test_stamps_that_were_never_filled_in_are_named(tmp_path):
    path = write(tmp_path / "drive", Shape(stamped=False))
    with pytest.raises(ClockError, match=f"those of {CLOUD} were never filled in; give --stamps recorded"):
        read(path)
    assert_poses(read(path, stamps="recorded")[1], atol=2e-3)


def test_registered_clouds_are_seen_from_the_robot(tmp_path):
    path = write(tmp_path / "drive", Shape(registered=True))
    recording, frames = read(path)
    assert (recording.map_frame, recording.base_frame, recording.rays_from) == ("odom", "base_link", "base_link")
    assert recording.warnings == [] and recording.has_base
    assert_poses(frames, sensor="T_map_base")
    recording, from_lidar = read(path, rays_from="lidar")
    assert_poses(from_lidar)
    for frame, scan in zip(from_lidar, drive().clouds, strict=True):
        np.testing.assert_allclose(frame.points, scan.points, atol=1e-5)


def test_a_jump_is_named_and_both_cures_map_a_part_without_it(tmp_path):
    path = write(tmp_path / "drive", Shape(jump=3.0))
    (note,) = read(path)[0].pose_notes
    assert note.startswith("base_link jumps by 3.0 m in odom within 0.02 s, 0.6 s after its first pose")
    words = note.split()
    end, start = float(words[words.index("--end") + 1]), float(words[words.index("--start") + 1])
    before, after = read(path, end=end), read(path, start=start)
    assert before[0].pose_notes == after[0].pose_notes == []
    assert_poses(before[1], drive().clouds[:4])
    assert [frame.T_map_base[1, 3] > 2.9 for frame in after[1]] == [True] * 2


def test_a_clock_that_restarts_is_named_and_runs_are_not_mixed(tmp_path):
    path = write(tmp_path / "drive", Shape(again=2.0))
    recording, frames = read(path, end=11.2)
    (note,) = recording.pose_notes
    assert note.startswith("the clock goes back by 1.2 s: stamps of base_link ") and "are followed by" in note
    assert_poses(frames)
    words = note.split()
    second, frames = read(path, start=float(words[words.index("--start", words.index("as")) + 1]))
    assert second.pose_notes == [] and len(frames) == 6 and all(frame.T_map_base[1, 3] > 1.9 for frame in frames)


def test_transforms_of_several_robots_must_be_chosen(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for space in ("/a", "/b"):
        writer.transform(START, "odom", "base_link", MOUNT, space=space)
    writer.cloud(drive().clouds[0])
    writer.close()
    with pytest.raises(RecordingError, match="transforms are on /a/tf, /b/tf; choose them with --tf TOPIC"):
        read(tmp_path / "drive")


def test_the_mounting_is_kept_through_a_quaternion():
    from torchelev.io.bags.poses.rows import from_matrix, to_matrices

    for T in (MOUNT, invert(drive().bases[-1]), np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])):
        np.testing.assert_allclose(to_matrices(np.array([[0.0, *from_matrix(T), 0.0]]))[0], T, atol=1e-12)


def test_a_mounting_below_a_sensor_with_poses_gives_the_base(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for t, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(t, "map", "lidar", T @ MOUNT)
    for scan in drive().clouds:
        writer.cloud(scan._replace(times=None))
    writer.close()
    recording, frames = read(tmp_path / "drive", T_base_sensor=MOUNT)
    assert (recording.map_frame, recording.base_frame, recording.has_base) == ("map", "base_link", True)
    assert_poses(frames)


def test_a_lidar_whose_clock_is_set_while_recording_loses_these_scans_only(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    stamps = np.arange(-0.3, 9.0, 0.1)
    for t in stamps:
        writer.transform(START + t, "odom", "lidar", np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * max(0.0, t))
    for t in np.arange(0.0, 8.0, 0.5):
        scan = drive().clouds[0]._replace(stamp=START + t - (3.0 if t >= 6.0 else 0.0), times=None)
        writer.cloud(scan, recorded=START + t)
    writer.close()
    recording, frames = read(tmp_path / "drive")
    assert len(frames) == 12 and recording.pose_notes == []
    (warning,) = recording.warnings
    assert warning.startswith(f"4 of 16 scans were left out: the clock of {CLOUD} was set during the recording")
    assert len(read(tmp_path / "drive", stamps="recorded")[1]) == 16


@pytest.mark.slow(1)
@pytest.mark.parametrize("pose_start", [0.3, -6.0])
def test_poses_that_arrive_late_are_used(tmp_path, pose_start):
    """A mapper that lags by 3 s at first, then by 6 s, before or while the scans begin."""
    writer = Writer(tmp_path / "drive", "mcap")
    for t in np.arange(pose_start, 9.0, 0.1):
        T = np.eye(4) + np.eye(4, k=3) * max(0.0, t)
        writer.transform(START + t, "odom", "lidar", T, recorded=START + t + 3 + 0.3 * max(0.0, t))
    for t in np.arange(0.0, 8.0, 0.5):
        writer.cloud(drive().clouds[0]._replace(stamp=START + t, times=None), recorded=START + t)
    writer.close()
    recording, frames = read(tmp_path / "drive")
    assert len(frames) == 16 and recording.clock_offsets == {}
    np.testing.assert_allclose([frame.T_map_sensor[0, 3] for frame in frames], np.arange(0.0, 8.0, 0.5), atol=1e-6)
    (warning,) = recording.warnings
    assert "arrive" in warning and "late, which does no harm" in warning and f"--clock-offset {CLOUD}=-" in warning


def test_poses_of_two_clocks_are_named(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for t, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(t, "odom", "base_link", T)
        writer.transform(
            t - 5.0, "base_link", "lidar", np.diag([1.0, 1, 1, 1]) + np.eye(4, k=3) * (t % 0.1), recorded=t
        )
    writer.cloud(drive().clouds[0]._replace(times=None))
    writer.close()
    with pytest.raises(ClockError, match="5.000 s behind the other poses: their clocks differ; give --stamps recorded"):
        read(tmp_path / "drive")
    assert len(read(tmp_path / "drive", stamps="recorded")[1]) == 1


def test_poses_without_stamps_are_named(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for t, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(0.0, "odom", "lidar", T, recorded=t)
    for scan in drive().clouds:
        writer.cloud(scan._replace(times=None))
    writer.close()
    with pytest.raises(ClockError, match="those of the poses were never filled in; give --stamps recorded"):
        read(tmp_path / "drive")
    _, frames = read(tmp_path / "drive", stamps="recorded")
    for frame, scan in zip(frames, drive().clouds, strict=True):
        np.testing.assert_allclose(frame.T_map_sensor, scan.T_map_base, atol=1e-6)


def write_slowly(path, mounted, posed=lambda t: True, moves=True):
    """Write the drive with the mounting on /tf, at the times for which `mounted` holds."""
    writer = Writer(path, "mcap")
    for t, T in zip(drive().stamps, drive().bases, strict=True):
        if posed(t - START):
            writer.transform(t, "odom", "base_link", T if moves else drive().bases[0])
        if mounted(t - START):
            writer.transform(t + 0.1, "base_link", "lidar", MOUNT, recorded=t)
    for scan in drive().clouds:
        writer.cloud(scan._replace(times=None))
    writer.close()
    return path


def test_a_mounting_on_tf_holds_at_all_times(tmp_path):
    recording, frames = read(write_slowly(tmp_path / "drive", lambda t: t < -0.1))
    assert recording.warnings == []
    assert_poses(frames)


def test_poses_of_a_still_robot_hold_only_while_they_are_sent(tmp_path):
    path = write_slowly(tmp_path / "drive", lambda t: True, lambda t: t < 0.05, moves=False)
    recording, frames = read(path, map_frame="odom", base_frame="base_link")
    assert (
        len(frames) == 3
    )  # one of them a period of the scans later, and not those for which nothing says where the robot was
    assert recording.warnings == ["3 of 6 scans were left out: no pose of lidar in odom at that time"]


def test_poses_that_move_take_the_place_of_a_static_one(tmp_path):
    writer = Writer(tmp_path / "drive", "mcap")
    for t, T in zip(drive().stamps, drive().bases, strict=True):
        writer.transform(t, "odom", "base_link", T)
        writer.transform(t, "odom", "base_link", np.eye(4), is_static=True)
    writer.transform(START, "base_link", "lidar", MOUNT, is_static=True)
    for scan in drive().clouds:
        writer.cloud(scan._replace(times=None))
    writer.close()
    assert_poses(read(tmp_path / "drive")[1])


def test_a_slash_before_a_frame_that_was_asked_for_is_dropped(tmp_path):
    recording, frames = read(write(tmp_path / "drive", Shape()), map_frame="/odom", base_frame="/base_link")
    assert (recording.map_frame, recording.base_frame) == ("odom", "base_link")
    assert_poses(frames)
