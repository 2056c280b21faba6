"""The processes that share a site, and the messages between them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.errors import message, require
from torchelev.site.ending import rest_at_end
from torchelev.site.storage.interface import InDoubtError, Overtaken

if TYPE_CHECKING:
    from torch.distributed import ProcessGroup

_MESSAGE_BYTES, _BYTES_OF_RANK, _MAX_TEXT = 2048, 16, 300
_NOTHING = torch.zeros(0, dtype=torch.uint8)
_ERRORS = {error.__name__: error for error in (InDoubtError, Overtaken, ValueError, TypeError, KeyError, OSError)}


class LostRankError(RuntimeError):
    """Another rank has ended, or did not answer in time. The site holds the last merge, and can still be read."""


class Ranks:
    """The processes that share a site. With one process, no call waits.

    Args:
        group: of `torch.distributed`; None: this process alone.

    Raises:
        ValueError: `torch.distributed` is not initialised, or this process is not in the group.
    """

    def __init__(self, group: ProcessGroup | None) -> None:
        self.group, self.rank, self.size = group, 0, 1
        self._lost: LostRankError | None = None
        if group is not None:
            import torch.distributed as dist

            is_ready = dist.is_available() and dist.is_initialized()
            hint = "call torch.distributed.init_process_group first"
            require(is_ready, "group", "must be initialised", "none", hint)
            self.rank, self.size = dist.get_rank(group), dist.get_world_size(group)
            require(self.rank >= 0, "group", "must hold this process", "another group", "call it on its ranks alone")
            rest_at_end()

    def exchange(self, call: str, make: Callable[[], dict[str, Any]]) -> list[dict[str, Any]]:
        """Return what `make` returns on each rank: JSON values. If it raises on one rank, all raise.

        Args:
            call: name of the method that is called, for errors.
            make: returns values; those below "same" must not differ between ranks.

        Raises:
            ValueError: ranks call different methods, or what must be the same differs. On all ranks.
            LostRankError: another rank has ended, or did not answer in time.
        """
        if self.size == 1:
            return [make()]
        failure, own = None, {}
        try:
            own = make()
        except LostRankError:
            raise
        except Exception as error:
            failure = error
        values = self._exchange(call, own | {"call": call, "error": failure and _describe(failure)})
        for rank, value in enumerate(values):
            if value["error"]:
                name, text = value["error"]
                raise _ERRORS.get(name, RuntimeError)(f"rank {rank}: {text}") from failure
        self._require_same(values)
        return values

    @contextmanager
    def together(self, call: str, make: Callable[[], dict[str, Any]] = dict) -> Iterator[list[dict[str, Any]]]:
        """Wait at the end of the block for all ranks; if it raises on one rank, all raise.

        Args:
            call: as of `exchange`.
            make: as of `exchange`, called at the end.

        Yields:
            A list, which holds what `make` returns on each rank once the block has ended.
        """
        values: list[dict[str, Any]] = []
        if self.size == 1:
            yield values
            values.append(make())
            return
        failure = None
        try:
            yield values
        except LostRankError:
            raise
        except Exception as error:
            failure = error
        values += self.exchange(call, lambda: _raise(failure) or make())

    def _exchange(self, call: str, values: dict[str, Any]) -> list[dict[str, Any]]:
        encoded = json.dumps(values).encode()
        size = _MESSAGE_BYTES + _BYTES_OF_RANK * self.size
        assert len(encoded) <= size
        sent = torch.tensor([list(encoded.ljust(size))], dtype=torch.uint8)
        return [json.loads(bytes(row.tolist())) for row in self.all_gather(call, sent)[:, 0]]

    def _require_same(self, values: list[dict[str, Any]]) -> None:
        """Raise the same ValueError on all ranks if their arguments differ."""
        plans = [{"call": value["call"]} | value.get("same", {}) for value in values]
        for name, first in plans[0].items():
            rank = next((rank for rank, plan in enumerate(plans) if plan.get(name, first) != first), None)
            if rank is not None:
                actual = f"{first} on rank 0 and {plans[rank][name]} on rank {rank}"
                raise ValueError(message(name, "must be the same on all ranks", actual, "call all ranks alike"))

    def gather(self, call: str, make: Callable[[], Tensor]) -> list[Tensor]:
        """Return the rows (n, ...) that `make` returns on each rank; n may differ. If it raises on one, all raise."""
        made: list[Tensor] = []

        def count() -> dict[str, int]:
            made.append(make())
            return {"rows": len(made[0])}

        numbers = [value["rows"] for value in self.exchange(call, count)]
        if self.size == 1 or not any(numbers):
            return made * self.size
        rows = made[0].new_zeros(max(numbers), *made[0].shape[1:])
        rows[: len(made[0])] = made[0]
        gathered = self.all_gather(call, rows)
        return [part[:number] for part, number in zip(gathered, numbers, strict=True)]

    def gather_bytes(self, call: str, data: bytes) -> list[bytes]:
        """Return the bytes of all ranks."""
        memory = bytearray(data)
        rows = self.gather(call, lambda: torch.frombuffer(memory, dtype=torch.uint8) if memory else _NOTHING)
        return [part.numpy().tobytes() for part in rows]

    def all_gather(self, call: str, rows: Tensor) -> Tensor:
        """Return the rows (R, ...) of all ranks, on the device of these."""
        import torch.distributed as dist

        sent = rows.to(self._device).contiguous()
        gathered = [torch.empty_like(sent) for _ in range(self.size)]
        with self._not_lost(call):
            dist.all_gather(gathered, sent, group=self.group)
        return torch.stack(gathered).to(rows.device)

    def all_to_all(self, call: str, rows: Tensor, sent: list[int], received: list[int]) -> Tensor:
        """Send so many of the rows to each rank; return the rows from all, so many from each, on their device."""
        import torch.distributed as dist

        source = rows.to(self._device).contiguous()
        target = source.new_empty(sum(received), *source.shape[1:])
        with self._not_lost(call):
            dist.all_to_all_single(target, source, received, sent, group=self.group)
        return target.to(rows.device)

    @property
    def _device(self) -> torch.device:
        """The device whose tensors the group sends."""
        import torch.distributed as dist

        return torch.device("cuda" if dist.get_backend(self.group) == "nccl" else "cpu")

    @contextmanager
    def _not_lost(self, call: str) -> Iterator[None]:
        """Raise LostRankError if a rank is lost, or gets lost in the block."""
        if self._lost is not None:
            raise self._lost
        try:
            yield
        except RuntimeError as error:
            self._lost = _lost(call, error)
            raise self._lost from error


def _lost(call: str, error: Exception) -> LostRankError:
    reason = " ".join(str(error).split())[:_MAX_TEXT]
    return LostRankError(
        f"{call}: a rank has ended or did not answer within the timeout of init_process_group ({reason}); the site on "
        "disk is as of the last merge that rank 0 committed: end all ranks, start them again, and open it anew"
    )


def _describe(error: Exception) -> tuple[str, str]:
    name = next((name for name, known in _ERRORS.items() if isinstance(error, known)), "")
    text = str(error) if name else f"{type(error).__name__}: {error}"
    return name, text[:_MAX_TEXT].encode("ascii", "replace").decode()


def _raise(error: Exception | None) -> dict[str, Any]:
    if error is not None:
        raise error
    return {}
