"""The site builds without a warning, and loads nothing from other hosts."""

import re
import subprocess
import sys

import pytest

from tests.docs.markdown import DOCS

pytest.importorskip("sphinx", reason="needs pip install -e '.[docs]'")
LOADS = re.compile(r"<(?:script|img|link|iframe|source)\b[^>]*?(?:src|href)=\"((?:https?:)?//[^\"]+)")


@pytest.mark.slow(30)
def test_builds_without_warnings_and_loads_from_no_other_host(tmp_path):
    options = ["-b", "html", "-W", "--keep-going", "-q", "-d", tmp_path / "trees"]
    build = [sys.executable, "-m", "sphinx", *options, DOCS, tmp_path / "html"]
    done = subprocess.run(build, capture_output=True, text=True, cwd=DOCS.parent)
    assert done.returncode == 0, done.stderr
    pages = list((tmp_path / "html").rglob("*.html"))
    assert len(pages) > 30
    assert not {found for page in pages for found in LOADS.findall(page.read_text())}
    sheets = "".join(path.read_text() for path in (tmp_path / "html/_static").rglob("*.css"))
    assert not re.findall(r"(?:url\(|@import )[\"']?(?:https?:)?//[^)]*", sheets)
