"""Bags that are cut or overwritten: what can be read is read, and the rest is said."""

import random

import pytest

from tests.io.bags.synthetic import FORMATS, SCANS, write_drive
from torchelev.io import RecordingError
from torchelev.io.bags import Bag, open_bag


def file_of(path):
    """The file that holds the messages."""
    return path if path.is_file() else next(path.glob("drive*.[dm]*"))


def read_all(path):
    """Return the number of scans, and what is said about the end."""
    with Bag(path) as bag:
        recording = open_bag(bag)
        return sum(frame is not None for frame in recording), recording.warnings


@pytest.mark.slow(3)
@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_a_bag_that_was_not_closed_is_read_to_its_end(tmp_path, kind):
    path = write_drive(tmp_path, kind, depth=False)
    file = file_of(path)
    whole = file.read_bytes()
    found = []
    for part in range(1, 40):
        file.write_bytes(whole[: len(whole) * part // 40])
        try:
            num, warnings = read_all(path)
        except RecordingError:  # before the first scan
            num, warnings = 0, ["refused"]
        found.append(num)
        assert num == SCANS or warnings, part
        if 0 < num < SCANS:
            assert "the bag was not closed: read up to" in " ".join(warnings)
    assert found == sorted(found) and set(range(1, SCANS - 1)) <= set(found)


@pytest.mark.slow(3)
def test_a_database_that_was_cut_is_read_as_far_as_it_goes_or_refused_with_a_cure(tmp_path):
    path = write_drive(tmp_path, "sqlite3", depth=False)
    file = file_of(path)
    whole, found = file.read_bytes(), []
    for part in range(1, 40):
        file.write_bytes(whole[: len(whole) * part // 40])
        try:
            num, warnings = read_all(path)
        except RecordingError as error:
            assert "repaired by `sqlite3 BAG.db3 .recover" in str(error) or "no topic of clouds" in str(error), error
            continue
        assert "the bag was not closed" in " ".join(warnings)
        found.append(num)
    assert len(set(found)) > 3


def test_an_index_that_misses_messages_is_said(tmp_path, monkeypatch):
    path = write_drive(tmp_path, depth=False)
    with Bag(path) as bag:
        messages = bag._reader.messages
        monkeypatch.setattr(bag._reader, "messages", lambda connections: list(messages(connections))[:-2].__iter__())
        assert len(list(bag.read(["/lidar/points"]))) == SCANS - 2
        assert bag.ended_early == f"the bag is damaged: 2 of {SCANS} messages are missing"


@pytest.mark.slow(6)
@pytest.mark.parametrize("kind", FORMATS)
def test_an_overwritten_bag_is_read_or_refused_and_never_raises_otherwise(tmp_path, kind):
    path = write_drive(tmp_path, kind, depth=False)
    file, rng = file_of(path), random.Random(0)
    whole = file.read_bytes()
    for _ in range(20):
        damaged = bytearray(whole)
        start = rng.randrange(len(whole))
        damaged[start : start + 200] = rng.randbytes(len(damaged[start : start + 200]))
        file.write_bytes(damaged)
        try:
            read_all(path)
        except RecordingError as error:
            assert str(path) in str(error)


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
@pytest.mark.parametrize("content", [b"", b"no bag at all" * 100])
def test_what_is_no_bag_is_refused_by_name(tmp_path, name, content):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=f"{name}: cannot be read as a bag"):
        Bag(tmp_path / name)
