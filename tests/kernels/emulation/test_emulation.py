"""The emulated GPU: what threads share, and what it says of kernels that are wrong."""

import ctypes
from pathlib import Path

import pytest
import torch

from tests.kernels.emulation.launcher import emulated, needs_emulation

pytestmark = needs_emulation
UNWRITTEN = 0x5A5A5A5A


class Pair(ctypes.Structure):
    _fields_ = (("scale", ctypes.c_float), ("offset", ctypes.c_int64))


@pytest.fixture(params=["forward", "backward"])
def samples(request):
    launcher = emulated(Path(__file__).with_name("samples.cu"))
    launcher.is_backward = request.param == "backward"
    return launcher


def zeros(*shape):
    return torch.zeros(*shape, dtype=torch.int32)


def test_each_thread_of_each_block_runs_once(samples):
    out = zeros(2 * 3 * 2, 4 * 5 * 3)
    samples("places", (2, 3, 2), (4, 5, 3), 0, out)
    assert torch.equal(out, (1000 * torch.arange(12)[:, None] + torch.arange(60)).int())


def test_arguments_are_passed_as_on_a_gpu(samples):
    values, out = torch.arange(300.0), torch.zeros(300)
    samples.launch("scale", 1, 299, values, out, Pair(2.0, 7), 299)
    assert torch.equal(out[:299], 2 * values[:299] + 7) and out[299] == 0


@pytest.mark.parametrize("number", [2.0, 2], ids=["a struct of another size", "one argument more"])
def test_other_arguments_are_refused(samples, number):
    wrong = (ctypes.c_float(number), 299) if isinstance(number, float) else (Pair(2.0, 7), 299, 1)
    with pytest.raises(AssertionError, match=r"scale: arguments have \[8, 8, .* its parameters \[8, 8, 16, 8\]"):
        samples.launch("scale", 1, 299, torch.zeros(300), torch.zeros(300), *wrong)


def test_warps_reduce_and_blocks_share_memory(samples):
    values = torch.randint(100, (3, 512)).float()
    sums, reversed_ = torch.zeros(3), torch.zeros(3, 512, dtype=torch.float64)
    samples.launch_blocks("sum_and_reverse", 3, 8 * 512, values, sums, reversed_)
    assert torch.equal(sums, values.sum(1)) and torch.equal(reversed_, values.flip(1).double())


def test_lanes_of_a_warp_read_each_other(samples):
    out = zeros(64, 8)
    samples("lanes", 1, 64, 0, out)
    own = torch.arange(64)
    warp, lane, eighth = own // 32 * 32, own % 32, own // 8 * 8
    expected = [warp + 5, own ^ 3, torch.where(own + 2 < eighth + 8, own + 2, own), torch.where(lane > 0, own - 1, own)]
    assert torch.equal(out[:, :4], torch.stack(expected, 1).int())
    votes = [sum(1 << k for k in range(32) if (first + k) % 3 == 0) for first in (0, 32)]
    assert (out[:, 4].long() % 2**32).tolist() == [votes[0]] * 32 + [votes[1]] * 32
    assert torch.equal(out[:, 5], (own >= 32).int()) and torch.equal(out[:, 6], (own < 32).int())
    assert out[:8, 7].tolist() == [10] * 4 + [60] * 4 and out[32:40, 7].tolist() == [330] * 4 + [380] * 4
    assert not out[lane >= 8, 7].any()


def test_atomic_operations_return_what_was_before(samples):
    values, ints, total, wide = torch.randperm(256).int() - 100, zeros(4), torch.zeros(1), torch.tensor([0, 155, 0])
    samples("atomics", 2, 128, 0, values, ints, total, wide)
    assert ints.tolist() == [256, 255 * 128, -100, 155] and total == 128
    assert wide[:2].tolist() == [256 * 2**40, 0] and wide[2] == -1  # -100 is large without a sign


def test_a_missing_barrier_shows(samples):
    out = zeros(64)
    samples("reads_before_writing", 1, 64, 0, out)
    assert not torch.equal(out, torch.arange(64).flip(0).int())


def test_shared_memory_is_filled_with_what_no_kernel_means(samples):
    out = zeros(128)
    samples("reads_what_none_wrote", 2, 64, 256, out)
    assert (out == UNWRITTEN).all()


def test_writing_beyond_the_shared_memory_is_an_error(samples):
    samples("writes_beyond", 1, 64, 256)
    with pytest.raises(AssertionError, match="writes_beyond: takes more shared memory than the 252 bytes"):
        samples("writes_beyond", 1, 64, 252)


@pytest.mark.parametrize(
    "kernel, message",
    [
        ("parts_before_a_barrier", r"waits in __shfl_xor_sync \(mask 0xffffffff\).*16 threads wait in __syncthreads"),
        ("leaves_a_lane_out", "lane (16|31) is not in its own mask 0xffff"),
        ("reads_a_lane_that_returned", "lane 0 reads lane 16, which does not take part"),
    ],
)
def test_lanes_that_wait_in_vain_are_named(samples, kernel, message):
    with pytest.raises(AssertionError, match=f"{kernel}: .*{message}"):
        samples(kernel, 1, 32, 0, zeros(32))
    test_each_thread_of_each_block_runs_once(samples)  # nothing is left of the failure


def test_a_block_that_no_gpu_has_is_refused(samples):
    with pytest.raises(AssertionError, match="at most 1024 threads, not 1025"):
        samples("places", 1, 1025, 0, zeros(1025))
    with pytest.raises(AssertionError, match="shares at most 233472 bytes"):
        samples("places", 1, 32, 2**18, zeros(32))


@pytest.mark.slow(2)
@pytest.mark.parametrize("call", ["atomicAdd(x, 1LL)", "atomicMin((float*)x, 1.0f)"])
def test_what_cuda_lacks_does_not_compile(tmp_path, call):
    path = tmp_path / "wrong.cu"
    path.write_text(f'extern "C" __global__ void wrong(long long* x) {{ {call}; }}')
    with pytest.raises(RuntimeError, match="CUDA has no atomic"):
        emulated(path)


@pytest.mark.slow(1)
def test_undefined_behaviour_is_an_error_with_its_line(tmp_path):
    path = tmp_path / "sums.cu"
    path.write_text('extern "C" __global__ void sum(int* x) {\nx[0] += x[1]; }')
    sums = emulated(path)
    sums("sum", 1, 1, 0, torch.tensor([2**30, 2**30 - 1], dtype=torch.int32))
    for _ in range(2):
        with pytest.raises(AssertionError, match=r"sum: .*sums.cu:2: Signed integer overflow"):
            sums("sum", 1, 1, 0, torch.tensor([2**30, 2**30], dtype=torch.int32))
