"""Independent pieces of work on all cores: where tensors are small, better than sharing each operation."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_order(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield the function of each item, in their order, computed by as many threads as torch uses, without gradients.

    At most two items per thread are in work, so that memory stays bounded.
    """
    num_threads = torch.get_num_threads()
    if num_threads == 1:
        yield from map(function, items)
        return

    def run(item: Item) -> Result:
        with torch.no_grad():  # of the thread
            return function(item)

    with ThreadPoolExecutor(num_threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        working: deque[Future[Result]] = deque()
        try:
            for item in items:
                working.append(pool.submit(run, item))
                if len(working) > 2 * num_threads:
                    yield working.popleft().result()
            while working:
                yield working.popleft().result()
        finally:
            torch.set_num_threads(num_threads)  # threads that start later would have one
            for future in working:
                future.cancel()
