"""Kernels of the simulator as text for a GPU, on a machine without one."""

import pytest
import torch
import warp as wp

from neuma_lib.sim.adjoint_kernels import adjoint_kernels
from neuma_lib.sim.kernels import forward_kernels


@pytest.mark.parametrize("features", [(), ("contact", "clamps", "bodies")], ids=["plain", "all"])
@pytest.mark.parametrize("scatter", ["atomic", "runs"])
@pytest.mark.parametrize("make", [forward_kernels, adjoint_kernels])
def test_kernels_compile_for_a_gpu(make, scatter, features, tmp_path):
    """Nothing runs, so this finds errors of types and syntax only."""
    kernels = [k for k in vars(make(torch.float32, scatter, features)).values() if isinstance(k, wp.Kernel)]
    (module,) = {kernel.module for kernel in kernels}
    (file,) = wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    entries = [line for line in file.read_text().splitlines() if ".entry" in line]
    assert kernels and len(entries) >= len(kernels)
