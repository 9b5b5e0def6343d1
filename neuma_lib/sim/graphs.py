"""Replaying a fixed sequence of launches as one CUDA graph.

A rollout is thousands of kernels of a few microseconds each, less than it takes Python to launch one. On a GPU
the loop over the steps is therefore recorded once and replayed. What it reads and writes must stay where it is:
the buffers of a `Workspace`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

import torch

MOST_GRAPHS = 16
"""Graphs kept by one `GraphCache`; the least recently used one goes first."""


class GraphCache:
    """Sequences of launches by name: run as they are the first time, recorded the second, replayed from then on.

    The first run compiles kernels and allocates scratch memory, which a recording must not do; what runs only
    once is never recorded.
    """

    def __init__(self):
        self._graphs: dict[Hashable, torch.cuda.CUDAGraph | None] = {}

    def run(self, name: Hashable, launches: Callable[[], None]) -> None:
        """Do `launches`, which must do the same on the same memory whenever the name is the same."""
        if name not in self._graphs:
            launches()
            graph = None
        else:
            graph = self._graphs.pop(name) or _recorded(launches)
            graph.replay()
        self._graphs[name] = graph
        while len(self._graphs) > MOST_GRAPHS:
            del self._graphs[next(iter(self._graphs))]


def _recorded(launches: Callable[[], None]) -> torch.cuda.CUDAGraph:
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        launches()
    return graph
