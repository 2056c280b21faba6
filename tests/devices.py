"""What a GPU would make the host wait for, without a GPU."""

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

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
    return value.as_subclass(Unread)
