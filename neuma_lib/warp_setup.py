"""One place that starts Warp: quiet, and with a kernel cache that several processes can share.

The cache folder is taken from the environment variable ``NEUMA_KERNEL_CACHE`` when it is set (the workflow sets
it to a folder of the project and fills it by one warm-up rule, so that two jobs never compile the same kernels);
otherwise Warp's own per-user cache is used.
"""

from __future__ import annotations

import os

import torch
import warp as wp

_started = False


def init() -> None:
    """Start Warp once per process. Safe to call from every module that defines kernels."""
    global _started
    if _started:
        return
    wp.config.log_level = wp.LOG_WARNING
    cache = os.environ.get("NEUMA_KERNEL_CACHE")
    if cache:
        wp.config.kernel_cache_dir = cache
    wp.init()
    _started = True


def stream(device: torch.device) -> wp.Stream | None:
    """Warp's view of torch's current stream, so that kernels queue in order with torch; None on the CPU."""
    return None if device.type == "cpu" else wp.stream_from_torch(torch.cuda.current_stream(device))
