"""CUDA kernels are used where they run, and tensors elsewhere. What the kernels compute: beside the stages' tests."""

import contextlib
import warnings
from types import SimpleNamespace
from unittest.mock import patch

import pytest
import torch

from torchelev.native import kernels


@pytest.fixture
def gpu(monkeypatch):
    """A GPU as far as `can_launch` asks; what it knows of GPUs is forgotten."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device", lambda device: contextlib.nullcontext())
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: False)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(kernels, "_CAN_LAUNCH", {})
    monkeypatch.delenv("TORCHELEV_NATIVE", raising=False)
    return monkeypatch


def test_without_a_gpu():
    with patch.object(torch.cuda, "is_available", lambda: False):
        assert not kernels.can_launch(0)


def test_each_gpu_is_tried_once(gpu):
    tried = []
    gpu.setattr(kernels, "_try", lambda device: not tried.append(device))
    assert kernels.can_launch(0) and kernels.can_launch(1) and kernels.can_launch(0)
    assert tried == [0, 1]


def test_nothing_is_tried_while_a_graph_is_captured(gpu):
    gpu.setattr(kernels, "_try", lambda device: True)
    with patch.object(torch.cuda, "is_current_stream_capturing", lambda: True):
        assert not kernels.can_launch(0)
    assert kernels.can_launch(0)


def test_they_can_be_switched_off(gpu):
    gpu.setattr(kernels, "_try", lambda device: True)
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


@pytest.mark.parametrize(
    "blocks, memory, suits", [(66, 1000, True), (65, 1000, False), (500, 200_000, True), (500, 240_000, False)]
)
def test_blocks_suit_a_gpu_with_enough_memory_whose_half_they_keep_busy(monkeypatch, blocks, memory, suits):
    properties = SimpleNamespace(multi_processor_count=132, shared_memory_per_block_optin=232_448)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: properties)
    assert kernels.suits_blocks(0, blocks, memory) == suits
    del properties.shared_memory_per_block_optin
    assert kernels.suits_blocks(0, blocks, memory) == (suits and memory <= 48 * 1024)


@pytest.mark.parametrize("memory, works", [(48 * 1024, True), (48 * 1024 + 1, False)])
def test_kernels_work_where_their_blocks_have_enough_memory(gpu, memory, works):
    gpu.setattr(kernels, "_try", lambda device: True)
    gpu.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace())
    layer = SimpleNamespace(is_cuda=True, get_device=lambda: 0)
    assert kernels.work_on(layer, memory) == works
    gpu.setattr(torch.cuda, "get_device_properties", lambda _: SimpleNamespace(shared_memory_per_block_optin=65536))
    assert kernels.work_on(layer, memory)
    assert not kernels.work_on(SimpleNamespace(is_cuda=False), memory)


def test_compiled_code_asks():
    compiled = torch.compile(lambda x: x + kernels.can_launch(max(0, x.get_device())), fullgraph=True, backend="eager")
    assert compiled(torch.zeros(1)) == kernels.can_launch(0)


def test_all_kernels_are_loaded(gpu):
    loaded = []
    gpu.setattr(kernels, "_function", lambda source, kernel, _: loaded.append(f"{source} {kernel}"))
    gpu.setattr(kernels, "_launch", lambda *_: None)
    gpu.setattr(torch, "ones", lambda *_, **__: torch.tensor(2.0))
    assert kernels._try(0)
    sources = [path.read_text(encoding="utf-8") for path in kernels._SOURCES.rglob("*.cu")]
    assert len(set(loaded)) == sum(text.count('extern "C" __global__') for text in sources) > 8
    assert "surface/surface.cu rate_surface" in loaded and "tables/tables.cu widen" in loaded
