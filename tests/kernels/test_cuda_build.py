"""CUDA kernels are used where they run, and tensors elsewhere. What the kernels compute: beside the stages' tests."""

import contextlib
import warnings
from unittest.mock import patch

import pytest
import torch

from torchelev import ElevationMapConfig, pipeline
from torchelev.kernels import cuda_build as kernels


@pytest.fixture
def gpu(monkeypatch):
    """A GPU as far as `can_launch` asks, which knows of none yet."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device", lambda device: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(kernels, "_CAN_LAUNCH", {})
    monkeypatch.delenv("TORCHELEV_NATIVE", raising=False)
    return monkeypatch


@pytest.fixture
def tried(gpu):
    """The GPUs that were tried; kernels run on all of them."""
    devices = []
    gpu.setattr(kernels, "_try", lambda device: not devices.append(device))
    return devices


def test_without_a_gpu():
    with patch.object(torch.cuda, "is_available", lambda: False):
        assert not kernels.can_launch(0)


def test_each_gpu_is_tried_once(tried):
    assert kernels.can_launch(0) and kernels.can_launch(1) and kernels.can_launch(0)
    assert tried == [0, 1]


def test_nothing_is_tried_while_a_graph_is_captured(tried):
    with patch.object(torch.cuda, "is_current_stream_capturing", lambda: True):
        assert not kernels.can_launch(0)
    assert not tried and kernels.can_launch(0)


def test_they_can_be_switched_off(gpu, tried):
    gpu.setenv("TORCHELEV_NATIVE", "0")
    assert not kernels.can_launch(0)


def test_a_gpu_for_which_nothing_compiles_is_told(gpu):
    def fail(*_):
        raise RuntimeError("no such architecture")

    gpu.setattr(kernels, "_module", fail)
    kernels._function.cache_clear()
    with pytest.warns(RuntimeWarning, match="do not work here.*no such architecture.*TORCHELEV_NATIVE=0"):
        assert not kernels.can_launch(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not kernels.can_launch(0)


def test_compiled_code_asks():
    compiled = torch.compile(lambda x: x + kernels.can_launch(max(0, x.get_device())), fullgraph=True, backend="eager")
    assert compiled(torch.zeros(1)) == kernels.can_launch(0)


def test_every_source_compiles():
    """By NVRTC, where it is found; else `tests.kernels.emulation` compiles them."""
    cuda = pipeline.cuda_stages(ElevationMapConfig())
    sources = {source for launches in cuda._launches.values() for source, _ in launches}
    assert {source.path for source in sources} == {kernel.cuda_source for kernel in pipeline.KERNELS if kernel.cuda}
    try:
        kernels._nvrtc()
    except OSError:
        pytest.skip("needs a torch with CUDA")
    for source in sources | {kernels.Source("kernels/cuda/trial.cu")}:
        assert kernels.compile_source(source, "sm_90")
