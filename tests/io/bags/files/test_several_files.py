"""Recordings in several files: parts are read as one, what is missing is named, different recordings are refused."""

import shutil
import sqlite3

import numpy as np
import pytest

from tests.io.bags.synthetic import SCANS, START, Writer, drive, write_drive
from torchelev.io import RecordingError
from torchelev.io.bags import Bag, is_bag, open_bag

SUFFIX = {"ros1": "bag", "mcap": "mcap", "sqlite3": "db3"}
HALVES = (slice(0, 3), slice(3, SCANS))


def write_part(folder, kind, number, name="drive", later=0.0):
    """Write half of the drive; return its file. Only the first part holds what is static."""
    path = folder / f"part{number}"
    if kind == "ros1":
        path = folder / "part.bag"
    writer = Writer(path, kind)
    if number == 0:
        writer.transform(START - 0.3 + later, "base_link", "lidar", np.eye(4), is_static=True)
    scans = drive().clouds[HALVES[number]]
    first, last = (-np.inf, scans[-1].stamp) if number == 0 else (drive().clouds[2].stamp, np.inf)
    for stamp, T in zip(drive().stamps, drive().bases, strict=True):
        if first < stamp <= last:
            writer.transform(stamp + later, "odom", "base_link", T)
    for scan in scans:
        writer.cloud(scan._replace(stamp=scan.stamp + later), time="t")
    writer.close()
    file = path if kind == "ros1" else next(path.glob(f"*.{SUFFIX[kind]}"))
    target = folder / "bag" / f"{name}_{number}.{SUFFIX[kind]}"
    target.parent.mkdir(exist_ok=True)
    file.replace(target)
    if kind != "ros1":
        shutil.rmtree(path)
    return target


def count(path):
    with Bag(path) as bag:
        recording = open_bag(bag)
        return sum(frame is not None for frame in recording), recording.warnings


@pytest.mark.slow(1)
@pytest.mark.parametrize("kind", SUFFIX)
def test_parts_are_read_one_after_the_other(tmp_path, kind):
    files = [write_part(tmp_path, kind, number) for number in (0, 1)]
    assert is_bag(tmp_path / "bag") and count(tmp_path / "bag") == (SCANS, [])
    with Bag(tmp_path / "bag") as bag:
        stamps = [message.time for message in bag.read(["/lidar/points"])]
        assert stamps == sorted(stamps) and {topic.name: topic.num for topic in bag.topics}["/lidar/points"] == SCANS
    data = files[1].read_bytes()
    files[1].write_bytes(data[: len(data) * 2 // 3])
    num, warnings = count(tmp_path / "bag")
    assert 3 <= num <= SCANS and f"{files[1].name}: the bag was not closed" in " ".join(warnings)


@pytest.mark.slow(1)
@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
@pytest.mark.parametrize("mode", ["alone", "in a folder"])
def test_files_that_are_compressed_by_zstd_are_read(tmp_path, kind, mode):
    from rosbags.rosbag2.reader import zstd

    file = write_part(tmp_path, kind, 0)
    packed = file.with_name(f"{file.name}.zstd")
    packed.write_bytes(zstd.compress(file.read_bytes()))
    file.unlink()
    path = packed if mode == "alone" else packed.parent
    assert is_bag(path) and count(path) == (3, [])


def split(tmp_path, kind):
    """A folder of rosbag2 with metadata.yaml that names two files."""
    folder = write_drive(tmp_path, kind, depth=False)
    file = next(folder.glob(f"*.{SUFFIX[kind]}"))
    metadata = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(
        metadata.replace(f"  - {file.name}\n", f"  - {file.name}\n  - gone_1.{SUFFIX[kind]}\n")
    )
    return folder


@pytest.mark.slow(1)
@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_a_missing_part_is_named_and_the_rest_is_read(tmp_path, kind):
    num, warnings = count(split(tmp_path, kind))
    assert num == SCANS
    assert warnings == [f"1 of 2 files of the recording are missing: gone_1.{SUFFIX[kind]}"]


def test_a_metadata_file_that_was_cut_is_said(tmp_path):
    folder = write_drive(tmp_path, "mcap", depth=False)
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text[: len(text) // 3] + "\n  - [")
    num, warnings = count(folder)
    assert num == SCANS and warnings[0].startswith("metadata.yaml cannot be read: ") and len(warnings) == 1


def test_different_recordings_in_a_folder_are_refused_by_name(tmp_path):
    write_part(tmp_path, "ros1", 0, "garden")
    write_part(tmp_path, "ros1", 0, "street", later=3600.0)
    with pytest.raises(RecordingError, match="2 recordings of different times: garden_0.bag, street_0.bag; give one"):
        Bag(tmp_path / "bag")


def test_recordings_of_one_time_belong_together(tmp_path):
    write_part(tmp_path, "ros1", 0, "lidar")
    write_part(tmp_path, "ros1", 0, "camera")
    assert count(tmp_path / "bag")[0] == 6


def test_a_long_gap_between_parts_is_said(tmp_path):
    for number, later in ((0, 0.0), (1, 600.0)):
        write_part(tmp_path, "mcap", number, later=later)
    with Bag(tmp_path / "bag") as bag:
        assert "between drive_0.mcap and drive_1.mcap nothing was recorded for 600 s: a file may be" in bag.ended_early


def test_a_journal_that_was_not_merged_is_said(tmp_path):
    file = write_part(tmp_path, "sqlite3", 0)
    file.with_name(f"{file.name}-wal").write_bytes(bytes(100))
    num, warnings = count(file)
    assert num == 3 and "drive_0.db3-wal holds messages that are not read" in " ".join(warnings)


@pytest.mark.slow(1)
def test_a_database_without_definitions_or_metadata_is_whole(tmp_path):
    file = write_part(tmp_path, "sqlite3", 0)
    with sqlite3.connect(file) as database:
        database.execute("DROP TABLE message_definitions")
        database.execute("DROP TABLE schema")
        database.execute("UPDATE topics SET serialization_format = 'cdr'")
        database.execute("INSERT INTO topics VALUES (99, '/state', 'acme_msgs/msg/State', 'cdr', '', '')")
    with Bag(file) as bag:
        assert [(topic.name, topic.problem) for topic in bag.unread] == [("/state", "without a definition")]
    assert count(file) == (3, [])
