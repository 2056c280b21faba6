"""What a GPU would make the host wait for, without a GPU."""

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map_only

from torchelev.filters.inpainting import holes
from torchelev.sim.sensors import body_casting, tracing

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


class OneDevice(TorchDispatchMode):
    """Refuses operations between devices, for which the host waits."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        tensors = [t for t in tree_leaves((args, kwargs, result)) if isinstance(t, torch.Tensor)]
        devices = {t.device.type for t in tensors if t.ndim > 0}
        assert len(devices) <= 1, f"{function} mixes {devices}"
        return result


class NoConstants(TorchFunctionMode):
    """Refuses tensors made of the host's numbers, whose copy to a device the host waits for."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        name = getattr(function, "__name__", "")
        assert name not in ("tensor", "as_tensor", "new_tensor"), f"{name} copies a constant from the host"
        return function(*args, **(kwargs or {}))


class Unread(torch.Tensor):
    """A tensor whose values nobody looks at, as on a GPU."""


def unread(value):
    """A tensor, or all tensors of a tuple, as the host of a GPU has them."""
    return tree_map_only(torch.Tensor, lambda tensor: tensor.as_subclass(Unread), value)


def never_wait(monkeypatch):
    """Let rays and the filling of holes on a CPU go the way of a GPU, where the host would wait to read anything."""
    for module, name in ((tracing, "can_select_rays"), (body_casting, "can_select_rays"), (holes, "may_wait")):
        monkeypatch.setattr(module, name, lambda device: False)
