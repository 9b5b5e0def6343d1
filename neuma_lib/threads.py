"""Independent pieces of work on several threads of Python, whose native code runs at the same time.

One thread does a piece from start to end, so results do not depend on the number of threads.
"""

from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")
Result = TypeVar("Result")

_count = 1
_loaded: set[Hashable] = set()


def use_threads(count: int) -> None:
    """Set the number of threads of `in_threads`, 1 by default. Torch keeps one, because its sums depend on theirs."""
    global _count
    _count = count
    torch.set_num_threads(1)


def thread_count() -> int:
    """Number of threads of `in_threads`."""
    return _count


def in_threads(
    work: Callable[[Item], Result],
    items: Sequence[Item],
    kernels: Sequence[Hashable],
    count: int | None = None,
) -> list[Result]:
    """Results of ``work`` for each of the items.

    Args:
        work: a function that releases Python's lock for most of its time. Torch's gradient mode is not inherited.
        kernels: for each item, a key of the kernels that it loads. Warp may unload a kernel that another thread runs
            while it loads one, hence the first item of each key is processed alone.
        count: number of threads, by default `thread_count`.
    """
    count = min(count or _count, len(items))
    first = {key: index for index, key in reversed(list(enumerate(kernels)))}
    alone = range(len(items)) if count < 2 else sorted(i for key, i in first.items() if key not in _loaded)
    results = {index: work(items[index]) for index in alone}
    _loaded.update(kernels)
    others = [index for index in range(len(items)) if index not in results]
    if others:
        with ThreadPoolExecutor(count) as executor:
            results |= zip(others, executor.map(work, [items[index] for index in others]), strict=True)
    return [results[index] for index in range(len(items))]
