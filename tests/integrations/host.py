"""See that nothing waits for a device, as far as a CPU shows it.

Left out is what happens on CPUs alone: values are checked there, and C++ does what other devices leave to PyTorch.
"""

import contextlib
import sys
from unittest.mock import patch

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class NoSync(TorchDispatchMode):
    """Refuse what would wait for a GPU: to read a value, or a shape that depends on values."""

    FORBIDDEN = ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero", "equal", "unique")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        assert name not in self.FORBIDDEN, f"{name} waits for the device"
        is_masked = name in ("index", "index_put", "index_put_") and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        assert not is_masked, f"{name} with a mask waits for the device"
        return func(*args, **(kwargs or {}))


@contextlib.contextmanager
def no_sync():
    """Raise AssertionError for what would wait for a GPU."""
    with contextlib.ExitStack() as stack:
        for name, module in list(sys.modules.items()):
            if name.startswith("torchelev.") and hasattr(module, "is_readable"):
                stack.enter_context(patch.object(module, "is_readable", lambda *args: False))
        stack.enter_context(NoSync())
        yield
