"""Layers come at the rate asked for, never half copied, and stay as they were."""

import contextlib

import numpy as np
import pytest
import torch

from tests.helpers import mapped, scan
from torchelev.io import publish
from torchelev.io.publish import Publisher


def fuse(emap, seed):
    cloud, T = scan(seed, emap.num_envs)
    emap.update(cloud, T, T, 0.1)


def as_seen(emap, name="elevation"):
    return emap.layer(name).numpy()


# Any device -----------------------------------------------------------------------------------------------------------


def test_publishes_the_layers_with_where_they_lie():
    emap = mapped(num_envs=3)
    publisher = Publisher(emap, ("elevation", "traversability"))
    assert publisher.take() is None
    assert publisher.offer(now=12.5)
    published = publisher.take()
    assert list(published.layers) == ["elevation", "traversability"]
    for name, values in published.layers.items():
        np.testing.assert_array_equal(values, as_seen(emap, name))
    assert np.isnan(published.layers["elevation"]).any()
    np.testing.assert_array_equal(published.center, emap.center.numpy())
    assert published.center.dtype == np.float64 and published.layers["elevation"].dtype == np.float32
    assert published.resolution == 0.1 and published.stamp == 12.5
    assert publisher.take() is None, "nothing was finished since"


@pytest.mark.slow(1)
@pytest.mark.parametrize("updates, rate, expected", [(10, 5, 2), (30, 20, 2), (10, 10, 1), (10, 3, 4), (2, 5, 1)])
def test_never_more_often_than_asked(updates, rate, expected):
    """Offered at each of so many updates a second for 100 s: every so many offers start a copy."""
    publisher = Publisher(mapped(num_envs=1), rate=rate)
    stamps = [k / updates for k in range(100 * updates) if publisher.offer(now=k / updates)]
    assert np.diff(stamps).min() >= 1 / rate - 1e-6
    assert len(stamps) == -(-100 * updates // expected)


def test_the_clock_of_a_robot_counts_as_well_as_a_small_one():
    start = 1.8e9
    publisher = Publisher(mapped(num_envs=1), rate=5)
    assert sum(publisher.offer(now=start + k * 0.1) for k in range(100)) == 50


def test_a_clock_that_was_set_back_starts_anew():
    publisher = Publisher(mapped(num_envs=1), rate=1)
    assert publisher.offer(now=100.0) and publisher.offer(now=0.0) and not publisher.offer(now=0.5)


def test_nothing_is_read_where_nothing_is_due():
    emap, reads = mapped(num_envs=1), []
    publisher = Publisher(emap, rate=1)
    read = emap.layer
    emap.layer = lambda name: (reads.append(name), read(name))[1]
    assert [publisher.offer(now=now) for now in (0.0, 0.4, 0.8)] == [True, False, False]
    assert reads == ["elevation"]


def test_by_default_the_clock_is_the_processes_own(monkeypatch):
    publisher = Publisher(mapped(num_envs=1), rate=2)
    for now, due in ((50.0, True), (50.4, False), (50.5, True)):
        monkeypatch.setattr(publish.time, "monotonic", lambda now=now: now)
        assert publisher.offer() == due
    assert publisher.take().stamp == 50.5


def test_groups_of_layers_have_rates_of_their_own():
    emap = mapped(num_envs=1)
    fast, slow = Publisher(emap, ("elevation",), rate=10), Publisher(emap, ("variance", "time"), rate=1)
    counts = [sum(p.offer(now=k / 10) for k in range(100)) for p in (fast, slow)]
    assert counts == [100, 10]


def test_an_infinite_rate_copies_at_every_offer():
    publisher = Publisher(mapped(num_envs=1), rate=float("inf"))
    assert all(publisher.offer(now=0.0) for _ in range(3))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
def test_other_precisions(dtype):
    emap = mapped().to(dtype)
    publisher = Publisher(emap)
    assert publisher.offer(now=0.0)
    values = publisher.take().layers["elevation"]
    np.testing.assert_array_equal(values, emap.layer("elevation").double().numpy())
    assert values.dtype == {torch.bfloat16: np.float32, torch.float16: np.float16}.get(dtype, np.float64)


def test_refuses_what_cannot_be_published():
    emap = mapped(num_envs=1)
    with pytest.raises(KeyError, match="height"):
        Publisher(emap, ("elevation", "height"))
    for layers in ("elevation", ()):
        with pytest.raises(ValueError, match="layers: must be a sequence of names"):
            Publisher(emap, layers)
    for rate in (0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="rate: must be positive"):
            Publisher(emap, rate=rate)


# CUDA, by a stand-in whose copies happen when the test says so --------------------------------------------------------


class Device:
    """What is queued on the stand-in for a GPU, and what was asked of it."""

    def __init__(self):
        self.queue, self.kept, self.calls, self.pinned = [], [], [], 0

    def finish(self):
        for task in self.queue:
            task()
        self.queue.clear()


@pytest.fixture
def device(monkeypatch):
    """Let CPU tensors go the way of CUDA tensors."""
    device = Device()

    class OnDevice(torch.Tensor):
        is_cuda = True

        @classmethod
        def __torch_function__(cls, function, types, args=(), kwargs=None):
            if function is torch.Tensor.copy_:
                assert kwargs == {"non_blocking": True}, "the host would wait"
                device.queue.append(lambda: args[0].copy_(args[1].as_subclass(torch.Tensor)))
                return args[0]
            return super().__torch_function__(function, types, args, kwargs or {})

        def record_stream(self, stream):
            device.kept.append(self)

    class Event:
        def record(self):
            self.done = False
            device.queue.append(lambda: setattr(self, "done", True))

        def query(self):
            return self.done

    class Stream:
        def __init__(self, device):
            pass

        def wait_stream(self, other):
            device.calls.append(f"wait for {other}")

    def allocate_pinned(value):
        device.pinned += 1
        return torch.full(value.shape, -7.0, dtype=value.dtype)

    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "Event", Event)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: "the updates")
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: contextlib.nullcontext())
    monkeypatch.setattr(publish, "allocate_pinned", allocate_pinned)
    device.tensor = OnDevice
    return device


class MapOnDevice:
    """A map whose layers and centre are on the stand-in."""

    def __init__(self, emap, tensor):
        self.emap, self.tensor, self.cfg = emap, tensor, emap.cfg

    def layer(self, name):
        return self.emap.layer(name).as_subclass(self.tensor)

    @property
    def center(self):
        return self.emap.center.as_subclass(self.tensor)


@pytest.fixture
def on_device(device):
    return MapOnDevice(mapped(), device.tensor)


def test_a_copy_under_way_is_neither_taken_nor_overwritten(on_device, device):
    publisher = Publisher(on_device, rate=10)
    before, center = as_seen(on_device.emap), on_device.emap.center.numpy()
    assert publisher.offer(now=0.0) and device.calls == ["wait for the updates"]
    assert publisher.take() is None
    fuse(on_device.emap, 5)
    assert not publisher.offer(now=1.0), "the first one is under way"
    device.finish()
    published = publisher.take()
    assert published.stamp == 0.0
    np.testing.assert_array_equal(published.layers["elevation"], before)
    np.testing.assert_array_equal(published.center, center)
    assert publisher.offer(now=1.0), "a copy that was due in the meantime starts as soon as it can"


def test_what_was_taken_is_never_written_again(on_device, device):
    publisher = Publisher(on_device, rate=10)
    taken, expected = [], []
    for k in range(5):
        expected.append(as_seen(on_device.emap))
        assert publisher.offer(now=float(k))
        device.finish()
        taken.append(publisher.take())
        fuse(on_device.emap, k)
    for published, values in zip(taken, expected, strict=True):
        np.testing.assert_array_equal(published.layers["elevation"], values)
    assert not np.array_equal(expected[0], expected[-1], equal_nan=True)
    assert device.pinned == 2 * 2, "two sets of the layer and the centre serve all copies"


def test_the_newest_finished_copy_outlives_the_one_under_way(on_device, device):
    publisher = Publisher(on_device, rate=10)
    publisher.offer(now=0.0)
    device.finish()
    fuse(on_device.emap, 5)
    newer = as_seen(on_device.emap)
    publisher.offer(now=1.0)
    device.finish()
    fuse(on_device.emap, 6)
    assert publisher.offer(now=2.0)
    published = publisher.take()
    assert published.stamp == 1.0, "the third is under way, the first is older"
    np.testing.assert_array_equal(published.layers["elevation"], newer)
    assert publisher.take() is None
    device.finish()
    assert publisher.take().stamp == 2.0


def test_the_memory_of_what_is_copied_is_kept_until_then(on_device, device):
    Publisher(on_device, ("elevation", "time")).offer(now=0.0)
    assert [tuple(value.shape) for value in device.kept] == [(2, 12, 10), (2, 12, 10), (2, 3)]


def test_pinned_memory_follows_the_precision(on_device, device):
    publisher = Publisher(on_device, rate=10)
    for now, dtype in ((0.0, torch.float32), (1.0, torch.float64), (2.0, torch.float64)):
        on_device.emap.to(dtype)
        publisher.offer(now=now)
        device.finish()
        np.testing.assert_array_equal(publisher.take().layers["elevation"], as_seen(on_device.emap))
    assert device.pinned == 3 * 2


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_on_a_gpu():
    emap = mapped().to("cuda")
    publisher = Publisher(emap, ("elevation", "variance"), rate=float("inf"))
    for k in range(20):
        expected = emap.layer("elevation").cpu().numpy()
        assert publisher.offer(now=float(k))
        cloud, T = (values.cuda() for values in scan(k, emap.num_envs))
        emap.update(cloud, T, T, 0.1)
        torch.cuda.synchronize()
        np.testing.assert_array_equal(publisher.take().layers["elevation"], expected)
