"""Choose the files of a bag, and a reader of each."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack, suppress
from pathlib import Path, PurePosixPath

from torchelev.io.bags.files.joined import JoinedReader, are_parts, describe_gap
from torchelev.io.bags.files.mcap_reader import McapReader, is_closed
from torchelev.io.bags.files.reader import Reader
from torchelev.io.bags.files.rosbags_reader import RosbagsReader
from torchelev.io.bags.files.unfinished import UnfinishedReader
from torchelev.io.errors import RecordingError

SUFFIXES = (".bag", ".mcap", ".db3")
_COMPRESSED = (".zstd", ".zst")  # of files that rosbag2 or a user compressed
_HEAD_BYTES = 4096  # of a metadata.yaml, which begin with its key


def is_bag_file(path: Path) -> bool:
    """Return whether a file has the suffix of a bag, compressed or not."""
    return path.suffix in SUFFIXES or (path.suffix in _COMPRESSED and Path(path.stem).suffix in SUFFIXES)


def has_metadata(folder: Path) -> bool:
    """Return whether a folder has the metadata.yaml of rosbag2; data sets have files of this name, too."""
    file = folder / "metadata.yaml"
    if not file.is_file():
        return False
    with file.open("rb") as opened:
        return b"rosbag2_bagfile_information" in opened.read(_HEAD_BYTES)


def bag_files(folder: Path) -> list[Path]:
    """Return the files of messages in a folder; of one that lies there compressed and plain, the plain one."""
    files = sorted(path for path in folder.iterdir() if is_bag_file(path) and path.is_file())
    return [file for file in files if file.suffix in SUFFIXES or file.with_suffix("") not in files]


def open_reader(path: Path, stack: ExitStack) -> Reader:
    """Return a reader of a file, or of a folder with one or several files.

    Args:
        path: of the file or folder.
        stack: closes what is opened.

    Raises:
        RecordingError: the folder holds no bag, or several recordings.
        Exception: whatever rosbags lets through of a file that cannot be read.
    """
    if not path.is_dir():
        return _open_file(path, stack)
    note = ""
    if has_metadata(path):
        try:
            return _opened(RosbagsReader(path), stack)
        except ModuleNotFoundError:
            raise
        except Exception:  # rosbags passes on exceptions of its file formats: each file is tried by itself
            note = _describe_missing(path)
    files = bag_files(path)
    if not files:
        raise RecordingError(path, note or "holds no .bag, .mcap or .db3 file", "give a bag")
    return _join(path, [(file, _open_file(file, stack)) for file in files], note, has_metadata(path))


def _join(path: Path, readers: list[tuple[Path, Reader]], note: str, has_metadata: bool) -> Reader:
    if len(readers) == 1 and not note:
        return readers[0][1]
    if not (has_metadata or are_parts(readers)):
        names = ", ".join(file.name for file, _ in readers)
        raise RecordingError(path, f"holds {len(readers)} recordings of different times: {names}", "give one of them")
    return JoinedReader(readers, note or describe_gap(readers))


def _open_file(path: Path, stack: ExitStack) -> Reader:
    """Return the most capable reader of a file: rosbags', else mcap's, else one that reads up to the damage."""
    if path.suffix in _COMPRESSED:
        path = _decompress(path, stack)
    journal = path.with_name(f"{path.name}-wal")
    reader = _open_plain(path, stack)
    if not (journal.is_file() and journal.stat().st_size):
        return reader
    note = f"{journal.name} holds messages that are not read: `sqlite3 {path.name} 'PRAGMA wal_checkpoint'` adds them"
    return JoinedReader([(path, reader)], note)


def _open_plain(path: Path, stack: ExitStack) -> Reader:
    try:
        return _opened(RosbagsReader(path), stack)
    except ModuleNotFoundError:
        raise
    except Exception:  # rosbags lets through what its file formats raise
        if path.suffix not in SUFFIXES:
            raise
        if path.suffix == ".mcap" and is_closed(path):
            with suppress(Exception):
                return _opened(McapReader(path), stack)
        with suppress(ValueError):
            return UnfinishedReader(path)
        raise


def _opened(reader: Reader, stack: ExitStack) -> Reader:
    stack.callback(reader.close)
    return reader


def _decompress(path: Path, stack: ExitStack) -> Path:
    """Return a plain copy of a file that is compressed by zstd, in a temporary folder."""
    from rosbags.rosbag2.reader import zstd

    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix="torchelev-"))
    plain = Path(folder) / path.stem
    with path.open("rb") as file, zstd.open(file, "rb") as packed, plain.open("wb") as out:
        shutil.copyfileobj(packed, out)
    return plain


def _describe_missing(folder: Path) -> str:
    """Return a sentence if files are missing that metadata.yaml names, or if it cannot be read; else ""."""
    import yaml

    try:
        metadata = yaml.safe_load((folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        names = [PurePosixPath(name).name for name in metadata["relative_file_paths"]]
    except Exception as error:  # of any damage
        return f"metadata.yaml cannot be read: {' '.join(str(error).split())[:100]}"
    missing = [name for name in names if not (folder / name).exists()]
    if not missing:
        return ""
    return f"{len(missing)} of {len(names)} files of the recording are missing: {', '.join(missing)}"
