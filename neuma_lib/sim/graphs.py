"""Fixed sequences of launches as CUDA graphs.

A rollout consists of thousands of kernels that take less time than their launch from Python. On a GPU the loop over the
steps is therefore recorded once and replayed, on buffers with fixed addresses (`Workspace`).
"""

import gc
from collections.abc import Callable, Hashable

import torch

MAX_GRAPHS = 16  # graphs kept by a `GraphCache`, which drops the least recently used one


class GraphCache:
    """Sequences of launches by name: executed directly the first time, recorded the second, then replayed.

    The first run compiles kernels and allocates scratch memory, which is not allowed in a recording.
    """

    def __init__(self):
        self._graphs: dict[Hashable, torch.cuda.CUDAGraph | None] = {}

    def run(self, name: Hashable, launches: Callable[[], None]) -> None:
        """Run `launches`, which must do the same on the same memory whenever the name is the same."""
        if name not in self._graphs:
            launches()
            graph = None
        else:
            graph = self._graphs.pop(name) or _record(launches)
            graph.replay()
        self._graphs[name] = graph
        while len(self._graphs) > MAX_GRAPHS:
            del self._graphs[next(iter(self._graphs))]


def _record(launches: Callable[[], None]) -> torch.cuda.CUDAGraph:
    # The garbage collector may release an array, which invalidates a recording.
    collects = gc.isenabled()
    gc.disable()
    try:
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, capture_error_mode="thread_local"):
            launches()
    finally:
        if collects:
            gc.enable()
    return graph
