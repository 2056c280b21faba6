"""The site builds without a warning, loads nothing from other hosts, and its search finds settings."""

import json
import re
import subprocess
import sys

import pytest

from tests.docs.markdown import DOCS

pytest.importorskip("sphinx", reason="needs pip install -e '.[docs]'")
LOADS = re.compile(r"<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)=\"((?:https?:)?//[^\"]+)")


@pytest.mark.slow(30)
def test_builds_without_warnings_loads_from_no_other_host_and_finds_settings(tmp_path):
    options = ["-b", "html", "-W", "--keep-going", "-q", "-d", tmp_path / "trees"]
    build = [sys.executable, "-m", "sphinx", *options, DOCS, tmp_path / "html"]
    done = subprocess.run(build, capture_output=True, text=True, cwd=DOCS.parent)
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "html").rglob("*.html"))
    assert len(pages) > 30
    assert not {found for page in pages for found in LOADS.findall(page.read_text())}
    sheets = "".join(path.read_text() for path in (tmp_path / "html/_static").rglob("*.css"))
    assert not re.findall(r"(?:url\(|@import )[\"']?(?:https?:)?//[^)]*", sheets)
    index = (tmp_path / "html/searchindex.js").read_text()
    found = json.loads(index.removeprefix("Search.setIndex(").removesuffix(")"))["objects"]
    assert {
        ("FusionConfig", "max_variance"),
        ("RaycastConfig", "min_incidence"),
        ("Statistics", "rejected_outlier"),
    } <= {(owner, entry[-1]) for owner, entries in found.items() for entry in entries}
