"""`torchelev site log`, `tag`, `rollback`, `compact` and `convert`."""

import re

import pytest
import torch
from click.testing import CliRunner

pytest.importorskip("icechunk", reason="needs Python 3.11")

from tests.site.helpers import fill, known_cells, robots
from torchelev.app.cli import main
from torchelev.site import SiteMap
from torchelev.site.storage import convert as convert_module


def run(*arguments, code=0):
    result = CliRunner().invoke(main, ["site", *map(str, arguments)])
    assert result.exit_code == code, result.output
    return result.output


@pytest.fixture
def site(tmp_path):
    """A site of three merges, the third of which contradicts the first two."""
    path, emap = tmp_path / "site", robots([(0, 0)])
    with SiteMap(0.1, path) as opened:
        for step in range(3):
            fill(emap, [(10 * step, 0)])
            emap.state.elapsed.add_(10**9)
            opened.merge(emap, align=False)
    return path


def test_log_lists_versions(site):
    lines = run("log", site).splitlines()
    assert len(lines) == 4 and all(
        re.match(r"[0-9A-Z]{20}  \d{4}-\d\d-\d\d \d\d:\d\d:\d\d UTC  ", line) for line in lines
    )
    assert lines[0].endswith("1 robot, 360 new cells") and lines[3].endswith("new site")
    assert run("log", site, "-n", 2).splitlines() == lines[:2]


def test_tag_rollback_and_compact(site):
    first = run("log", site).splitlines()[2].split()[0]
    assert run("tag", site, "good", "--version", first) == f"good is {first}\n"
    now = SiteMap.open(site, read_only=True).version
    assert run("tag", site, "last") == f"last is {now}\n"
    assert re.fullmatch(
        r"now \w{20}; what was the newest version is before-rollback-1\n", run("rollback", site, "good")
    )
    assert run("log", site).splitlines()[-1].endswith("[before-rollback-1]  [last]")
    assert len(known_cells(SiteMap.open(site, read_only=True))) == 40 * 36
    assert run("compact", site, "--keep", 1).startswith("3 versions are left; 0.0 MB")
    assert run("rollback", site, SiteMap.open(site).version).endswith("is the newest version\n")


def test_errors_take_one_line(site, tmp_path):
    for arguments, text in (
        (("log", tmp_path / "none"), "must be a folder, got a path where nothing is"),
        (("rollback", site, "none"), "Error: version: must be the id or tag of a version, got 'none'"),
        (("tag", site, "a b"), "Error: name: must be made of letters"),
        (("convert", site, site), "Error: target: must be new, got"),
        (("convert", tmp_path / "none", tmp_path / "new"), "must be a folder, got a path where nothing is"),
    ):
        output = run(*arguments, code=2)
        assert text in output and len(output.splitlines()) == 1
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("engine", ["files", "icechunk"])
def test_convert_copies_a_version_with_its_keyframes(tmp_path, engine):
    emap, T = robots([(0, 0)]), torch.eye(4, dtype=torch.float64)[None]
    source, other = tmp_path / "source", {"files": "icechunk", "icechunk": "files"}[engine]
    with SiteMap(0.1, source, keyframes=True, engine=other) as site:
        site.merge(emap, T_map_base=T)
        before, version = known_cells(site), site.version
        if other == "icechunk":
            fill(emap, [(40, 0)])
            emap.state.elapsed.add_(10**9)
            site.merge(emap, T_map_base=T)
    output = run("convert", source, tmp_path / "copy", "--engine", engine, "--version", version)
    assert output.endswith(f"copied 1 tiles to {tmp_path / 'copy'}\n")
    with SiteMap.open(tmp_path / "copy") as copy:
        assert known_cells(copy) == before and len(copy.keyframes.ids) == 1
        if other == "files":
            assert not copy.merge(emap, T_map_base=T).new_cells.any()  # it counts once
            assert copy.versions()[1].message == f"converted from {source}"


def test_a_conversion_that_fails_leaves_nothing(site, tmp_path, monkeypatch):
    def fail(*args):
        raise KeyboardInterrupt

    (tmp_path / "empty").mkdir()
    before = sorted(file for file in site.rglob("*") if file.is_file())
    for name in ("new", "empty"):
        with pytest.raises(KeyboardInterrupt):
            convert_module.convert(site, tmp_path / name, show=fail)
    assert not (tmp_path / "new").exists() and not list((tmp_path / "empty").iterdir())
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("mine")
    with pytest.raises(ValueError, match="target: must be a new or empty folder"):
        convert_module.convert(site, tmp_path / "full")
    assert (tmp_path / "full" / "mine").read_text() == "mine"
    assert sorted(file for file in site.rglob("*") if file.is_file()) == before
