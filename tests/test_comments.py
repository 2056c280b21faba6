"""Files and names that comments and docstrings of torchelev mention exist."""

import ast
import builtins
import functools
import io
import keyword
import re
import tokenize
from collections import defaultdict
from pathlib import Path

import numpy
import pytest
import torch

ROOT = Path(__file__).parents[1]
#: Files and folders of torchelev that are not checked yet.
SKIPPED: tuple[str, ...] = ()
#: Names of other programs and libraries that the code itself does not use.
FOREIGN = {
    "__wrapped__",
    *("CameraSensor", "RayCastSensor", "TerrainHeightSensor"),  # mjlab
    *("channel_info", "ros2_py", "max_filter", "smooth_filter", "inpainting"),  # elevation_mapping_cupy
    *("LidarPatternCfg", "RayCaster", "RayCasterCamera", "TiledCamera", "quat_w_opengl", "quat_w_world"),  # Isaac Lab
    *("mdp.height_scan", "measured_points_x", "measured_points_y"),  # Isaac Lab, legged_gym
    *("cam_quat", "mj_kinematics"),  # MuJoCo
    *("env.call", "spec.max_episode_steps"),  # gymnasium
    *("camera_link", "tensorstore.TensorStore", "compression_common.h", "malloc.h", "libtorchelev"),
}
CODE = "torchelev", "envs", "training", "benchmarks", "docs", "examples", "tests"
SOURCES = ".py", ".h", ".cpp", ".cu"
LIBRARIES = builtins, torch, torch.Tensor, torch.nn.functional, torch.func, torch.library, numpy

FILE = re.compile(r"(?<![\w/.*-])((?:[\w-]+/)*[\w-]+\.(?:py|h|cpp|cu))\b(?!\.)")
QUOTED = re.compile(r"(?<!`)(`{1,2})(?!`)([^`]+)\1")
WORD = r"[A-Za-z_]\w*"
NAME = re.compile(rf"({WORD}(?:\.{WORD})*)(?:\(.*\)|=.*|\[.*\])?")
DATA = "json", "txt", "npz", "png", "yaml", "csv", *(suffix[1:] for suffix in SOURCES)
C_COMMENT = re.compile(r"//[^\n]*|/\*.*?\*/", re.DOTALL)


@functools.cache
def sources(*folders):
    """Files with code."""
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*")) if path.suffix in SOURCES]


@functools.cache
def parsed(path):
    return ast.parse(path.read_text())


@functools.cache
def prose_of(path):
    """Comments and docstrings of a file."""
    if path.suffix != ".py":
        return C_COMMENT.findall(path.read_text())
    documented = ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef
    nodes = [node for node in ast.walk(parsed(path)) if isinstance(node, documented)]
    tokens = tokenize.generate_tokens(io.StringIO(path.read_text()).readline)
    comments = [token.string for token in tokens if token.type == tokenize.COMMENT]
    return comments + [text for node in nodes if (text := ast.get_docstring(node, clean=False))]


def words_of(tree):
    """Names in Python code, and those in strings that are no sentences, such as names of layers."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and not re.search(r"\s", node.value):
            yield from re.findall(WORD, node.value)
        for field in ("id", "attr", "arg", "name", "asname", "module"):
            if isinstance(value := getattr(node, field, None), str):
                yield from value.split(".")
        if isinstance(node, ast.Attribute):
            yield f"{getattr(node.value, 'id', getattr(node.value, 'attr', None))}.{node.attr}"


@functools.cache
def classes():
    """Names of all classes: the words of each, and of the names of its bases."""
    found = defaultdict(set)
    for path in sources(*CODE[:-1]):
        for node in ast.walk(parsed(path)) if path.suffix == ".py" else ():
            if isinstance(node, ast.ClassDef):
                found[node.name] |= {*words_of(node)}
    return found


def is_member(owner, name, depth=6):
    """Whether a class has a member, of its own or of a base."""
    words = classes().get(owner, ())
    return depth > 0 and (name in words or any(is_member(base, name, depth - 1) for base in words if base in classes()))


@functools.cache
def known():
    """Words of all code, those of each file behind its name, and pairs of neighbours in paths and attributes."""
    words = set()
    for path in sources(*CODE[:-1]):
        parts = path.relative_to(ROOT).with_suffix("").parts
        words |= {*parts, *map(".".join, zip(parts, parts[1:], strict=False))}
        code = path.read_text()
        own = {*words_of(parsed(path))} if path.suffix == ".py" else {*re.findall(WORD, C_COMMENT.sub(" ", code))}
        words |= own | {f"{parts[-2] if path.stem == '__init__' else path.stem}.{word}" for word in own}
    return words


def is_of_library(name):
    """Whether a builtin, torch or NumPy has a name."""
    parts = name.removeprefix("torch.").split(".")
    for value in LIBRARIES:
        for k, part in enumerate(parts, 1):
            if not hasattr(value, part):
                break
            if k == len(parts):
                return True
            value = getattr(value, part)
    return keyword.iskeyword(name)


def exists(name):
    """Whether code defines or uses a name, and of a dotted one each part as a member of the part before."""
    parts = name.split(".")
    pairs = list(zip(parts, parts[1:], strict=False))
    if all(part in known() for part in parts) and all(
        f"{owner}.{member}" in known() or is_member(owner, member) for owner, member in pairs
    ):
        return True
    return is_of_library(name) or name in FOREIGN


@functools.cache
def is_file(name):
    """Whether a file of the repository has this name, or this path below some folder."""
    return any(f"/{path}".endswith(f"/{name}") for path in sources(*CODE))


def missing_files(text):
    """Files that a text mentions and that are not in the repository."""
    return sorted(name for name in {*FILE.findall(text)} - FOREIGN if not is_file(name))


def missing_names(text):
    """Names in backticks that nothing in the repository or in a library has."""
    found = (NAME.fullmatch(quoted.strip()) for _, quoted in QUOTED.findall(text))
    names = {match[1] for match in found if match}
    return sorted(name for name in names if name.rpartition(".")[2] not in DATA and not exists(name))


def checked():
    """Files of torchelev whose comments are checked."""
    root = ROOT / "torchelev"
    return [path for path in sources("torchelev") if not str(path.relative_to(root)).startswith(SKIPPED)]


@pytest.mark.slow(4)
@pytest.mark.parametrize("missing", [missing_files, missing_names])
def test_what_comments_mention_exists(missing):
    stale = {(str(path), name) for path in checked() for text in prose_of(path) for name in missing(text)}
    assert not stale, "rename what moved, or add a name of another program to FOREIGN"


def test_files_that_pages_mention_exist():
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    stale = {(str(page), name) for page in pages for name in missing_files(page.read_text())}
    assert not {(page, name) for page, name in stale if name not in ("my_robot.py", "examples/NAME.py")}


@pytest.mark.slow(4)
def test_stale_files_and_names_are_found():
    text = "# see `unheard`, `ElevationMap.unheard()`, `sensor.measure`, `torch.unheard`, lost.py and `io/lost.h`"
    assert missing_files(text) == ["io/lost.h", "lost.py"]
    assert missing_names(text) == ["ElevationMap.unheard", "sensor.measure", "torch.unheard", "unheard"]


def test_names_of_all_kinds_are_known():
    text = "`ElevationMap.layer`, `T_map_base`, `fill='inpaint'`, `with`, `torch.func.vjp`, ``io.clouds``, `amax`"
    assert missing_names(text) == [] and missing_files("grid.py, site/content/tiles.py and `/absent`") == []
