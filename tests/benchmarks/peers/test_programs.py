"""Peers that are programs: what they are given, what their answers become, and what errors say."""

import sys

import numpy as np
import pytest
from click.testing import CliRunner

import benchmarks.peers.__main__ as command
from benchmarks.peers import program
from benchmarks.peers.maps import mean
from benchmarks.peers.peer import Frame, Setup
from benchmarks.peers.process import About

SETUP = Setup(0.5, (-1.0, -2.0), (4, 6), 5.0, 0.8, None)
ABOUT = "printf 'title\\n1\\nsettings\\n'\n"
TAKES_SETUP = ABOUT + "head -c 88 > /dev/null\n"


def written(folder, text, interpreter="/bin/sh"):
    """Return a program made of a script."""
    path = folder / "script"
    path.write_text(f"#!{interpreter}\n{text}")
    path.chmod(0o755)
    return path


def started(path, setup=SETUP):
    return program.Program(About("script", "title", "settings", "", "points", "1", str(path)), setup)


def frame(seed):
    """Return a scan from a tilted sensor beside the base, with points outside and missing pixels."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3.0, 3.0, (500, 3)).astype(np.float32)
    points[::7] = np.nan
    c, s = np.cos(0.5 + seed), np.sin(0.5 + seed)
    T_map_sensor = np.array([[c, 0, s, 0.3], [0, 1, 0, -0.2], [-s, 0, c, 1.0], [0, 0, 0, 1]])
    return Frame(points, T_map_sensor, np.eye(4), 0.1)


def test_cell_means_of_a_program_equal_those_of_the_peer(cell_means):
    about = program.about_program(cell_means)
    assert about[:5] == ("cell_means", "means of a program", "all points weigh the same", "", "points")
    assert about.version == "1.2"
    asked, expected = program.Program(about, SETUP), mean.Map(SETUP)
    for seed in range(2):
        seconds, cpu = asked.update(frame(seed))
        assert 0 < seconds < 1 and 0 <= cpu < 1
        expected.update(frame(seed))
        height, std, _ = asked.ground()
        np.testing.assert_allclose(height, expected.ground()[0], atol=1e-6)
        assert std is None and height.dtype == np.float64
    asked.close()


def test_the_setup_names_the_camera_and_deviations_are_read(tmp_path):
    """A program that answers the ground with what it was given."""
    text = """
import struct, sys
print("title\\n\\nsettings", flush=True)
setup = sys.stdin.buffer.read(88)
sys.stdin.buffer.read(8)
found = struct.unpack("<3d2i2d2i4d", setup)
sys.stdout.buffer.write(struct.pack("<13f", *found) + b"\\1" + struct.pack("<13f", *found[::-1]))
"""
    setup = Setup(0.5, (-1.0, 2.0), (13, 1), 5.0, 0.75, (160, 120, 115.5, 116.5, 79.5, 59.5))
    asked = started(written(tmp_path, text, sys.executable), setup)
    height, std, _ = asked.ground()
    asked.close()
    assert height.tolist() == [[value] for value in (0.5, -1, 2, 13, 1, 5, 0.75, 160, 120, 115.5, 116.5, 79.5, 59.5)]
    assert std.tolist() == height[::-1].tolist()


def test_memory_is_the_growth_of_the_program(tmp_path):
    text = """
import sys
held = [b"a" * 30_000_000]
print("title\\n1\\nsettings", flush=True)
sys.stdin.buffer.read(88)
held.append(b"b" * 50_000_000)
sys.stdin.buffer.read(8)
sys.stdout.buffer.write(bytes(4 * 24 + 1))
sys.stdout.flush()
sys.stdin.buffer.read()
"""
    asked = started(written(tmp_path, text, sys.executable))
    height, std, memory = asked.ground()
    asked.close()
    assert not height.any() and std is None and 49e6 < memory < 60e6


def test_a_program_that_ends_early_says_why(tmp_path):
    asked = started(written(tmp_path, TAKES_SETUP + "echo no memory >&2; exit 3"))
    with pytest.raises(RuntimeError, match="^title .*no memory$"):
        asked.update(frame(0))


def test_answers_of_the_wrong_size_are_refused(tmp_path, monkeypatch):
    short = started(written(tmp_path, TAKES_SETUP + "head -c 8 > /dev/null; printf 12345; exec sleep 60"))
    monkeypatch.setattr(program, "PATIENCE", 0.2)
    with pytest.raises(RuntimeError, match="title sent 5 of 96 bytes of the heights, then nothing for 0.2 s: it"):
        short.ground()
    cut = started(written(tmp_path, TAKES_SETUP + "head -c 8 > /dev/null; head -c 97 /dev/zero; printf 1; exit"))
    cut.ground()
    with pytest.raises(RuntimeError, match="title sent 1 bytes too many"):
        cut.close()
    ends = started(written(tmp_path, TAKES_SETUP + "head -c 8 > /dev/null; head -c 95 /dev/zero; exit"))
    with pytest.raises(RuntimeError, match="title sent 95 of 96 bytes of the heights, then ended"):
        ends.ground()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("echo title", "script: expected three lines: title, version, settings, got 1;"),
        ("echo no library >&2; exit 1", "got 0 no library; see benchmarks/peers/program.py"),
    ],
)
def test_a_program_that_does_not_say_what_it_is_is_refused(tmp_path, text, message):
    done = CliRunner().invoke(command.main, ["--program", str(written(tmp_path, text))])
    assert done.exit_code == 2 and message in " ".join(done.output.split())


def test_a_program_that_cannot_start_is_refused(tmp_path):
    for path, message in (
        (tmp_path / "nothing", "does not exist"),
        (written(tmp_path, "", "/nowhere/python"), "No such file or directory"),
    ):
        done = CliRunner().invoke(command.main, ["--program", str(path)])
        assert done.exit_code == 2 and "'--program'" in done.output and message in done.output


def test_names_of_programs_are_their_own(tmp_path):
    path = written(tmp_path, ABOUT).rename(tmp_path / "mean.sh")
    done = CliRunner().invoke(command.main, ["--program", str(path), "--only", "mean"])
    assert done.exit_code == 2 and "another peer has this name; rename the file" in done.output


def test_programs_are_left_out_unless_given(tmp_path, capsys):
    chosen = command._chosen((), ["/bin/false"], [])
    assert not chosen and "give each by --program PATH" in capsys.readouterr().out
    about = program.about_program(written(tmp_path, ABOUT))
    assert command._chosen((), ["/bin/false"], [about]) == {"script": (about, "")}
    assert "--program" not in capsys.readouterr().out
