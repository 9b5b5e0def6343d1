"""Time and memory of work on a device, the limits of the device, and the parser of a benchmark's arguments."""

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path

import torch


def parser_of(description: str) -> argparse.ArgumentParser:
    """A parser that prints the docstring of a benchmark without new line breaks."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def core_seconds() -> float:
    """Processor time [s] that this process has used."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def synchronize(device: torch.device) -> None:
    """Wait for all queued work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def seconds(
    work: Callable[[], object],
    device: torch.device,
    repetitions: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """Time of the fastest of some repetitions, after one that is not counted (compilation, memory).

    Other load only adds time, so the best is the least disturbed. Wall time, or core seconds by `time.process_time`.
    """
    best = float("inf")
    for repetition in range(repetitions + 1):
        synchronize(device)
        started = clock()
        work()
        synchronize(device)
        if repetition:
            best = min(best, clock() - started)
    return best


def seconds_a_call(work: Callable[[], object], device: torch.device, calls: int = 20) -> float:
    """Time of one of many small calls: on a GPU inside a CUDA graph, free of the cost of launching from Python."""
    if device.type == "cpu":
        return seconds(work, device)
    work()
    synchronize(device)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph, capture_error_mode="thread_local"):
        for _ in range(calls):
            work()
    return seconds(graph.replay, device) / calls


def peak_memory(work: Callable[[], object], device: torch.device) -> float:
    """Largest memory during the work [bytes]: of torch on a GPU, or else of the whole process (Linux)."""
    if device.type == "cpu":
        Path("/proc/self/clear_refs").write_text("5")  # the peak restarts at the present value
        work()
        peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if "VmHWM" in line)
        return 1024.0 * int(peak.split()[1])
    torch.cuda.reset_peak_memory_stats(device)
    work()
    return torch.cuda.max_memory_allocated(device)


def bandwidth(device: torch.device) -> float:
    """Measured bytes a second of a large copy, read and written bytes together."""
    size = 2**30 if device.type == "cuda" else 2**27
    source = torch.empty(size // 4, device=device).normal_()
    target = torch.empty_like(source)
    return 2 * size / seconds(lambda: target.copy_(source), device)


def arithmetic(device: torch.device) -> float:
    """Measured float32 operations a second of a large matrix product, without reduced-precision modes."""
    n = 8192 if device.type == "cuda" else 1024
    a, b = (torch.empty(n, n, device=device).normal_() for _ in range(2))
    return 2 * n**3 / seconds(lambda: a @ b, device)


def device_name(device: torch.device) -> str:
    """Name of a device for tables."""
    if device.type == "cuda":
        return f"one {torch.cuda.get_device_name(device)}"
    return f"CPU, {torch.get_num_threads()} thread(s)"
