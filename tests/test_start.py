"""What `import torchelev` and the first update of a process import."""

import copy
import importlib
import pickle
import subprocess
import sys
from pathlib import Path

import pytest

import torchelev

ROOT = Path(__file__).parents[1]
ROOMS = (  # that a map does not need unless its config asks for them
    "torchelev.diagnosis.causes",
    "torchelev.filters",
    "torchelev.observations",
    "torchelev.traversability.net",
)
COMPILER = ("torch._dynamo", "torch._inductor", "sympy")
CODE = f"""
import sys
import torch
import torchelev

def print_found(names):
    print([name for name in names if name in sys.modules])

print_found({ROOMS + COMPILER})
emap = torchelev.ElevationMap(num_envs=2)
points, T = torch.randn(2, 50, 3), torch.eye(4).expand(2, 4, 4).contiguous()
emap.update(points, T, T, 0.1)
emap.layer("traversability"), emap.rate(), emap.sample(torch.zeros(2, 3, 2)), emap.reset()
print_found({ROOMS + COMPILER})
filters = [torchelev.FilterConfig(layer=name, filter=name) for name in FILTERS]
cfg = torchelev.ElevationMapConfig(
    traversability=torchelev.LearnedTraversabilityConfig(), filters=filters
)
emap = torchelev.ElevationMap(cfg, 2)
emap.update(points, T, T, 0.1)
for name in emap.layers:
    emap.layer(name)
for fill in FILLS:
    torchelev.HeightScan(pattern=torch.zeros(4, 2), fill=fill)(emap, T)
emap.diagnose()
print_found({ROOMS})
print_found({COMPILER})
"""
FILTERS = ("inpaint_minimum", "inpaint_nearest", "inpaint_diffusion")
FILLS = ("ground", "base", "lowest", "upper_bound", "inpaint", "original")


@pytest.mark.slow(4)
def test_a_process_imports_what_it_needs():
    code = CODE.replace("FILTERS", repr(FILTERS)).replace("FILLS", repr(FILLS))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stdout.splitlines() == ["[]", "[]", str(list(ROOMS)), "[]"], done.stderr


def test_every_public_name_can_be_had():
    assert set(torchelev.__all__) <= set(dir(torchelev))
    assert all(getattr(torchelev, name) is not None for name in torchelev.__all__)
    assert torchelev.filters.gaussian is importlib.import_module("torchelev.filters").gaussian
    with pytest.raises(AttributeError, match="torchelev' has no attribute 'Elevation'"):
        torchelev.Elevation  # noqa: B018


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda value: pickle.loads(pickle.dumps(value))])
def test_maps_of_configs_with_filters_are_copied(copied):
    step = torchelev.FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1})
    emap = torchelev.ElevationMap(torchelev.ElevationMapConfig(filters=(step,)))
    assert copied(emap).cfg == emap.cfg and copied(emap).layers[-1] == "smooth"
    assert copied(torchelev.ElevationMap()).filters is None
