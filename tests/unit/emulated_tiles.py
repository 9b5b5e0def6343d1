"""The CUDA code of ``compositor_cuda`` compiled for the CPU, warp by warp, as a compositor for tests."""

import ctypes
import functools
import shutil
import subprocess
from pathlib import Path

import torch
import warp as wp

from neuma_lib.splatting import compositor_cuda
from neuma_lib.splatting.arrays import plain, target

COMPILER = shutil.which("g++") or shutil.which("clang++")
PASSES = {"composite_patch": compositor_cuda._FORWARD, "composite_patch_adjoint": compositor_cuda._BACKWARD}
ARGUMENTS = {
    "composite_patch": """int width, int height, Array<float> splats, Array<int> ids, Array<int> starts,
        float alpha_min, float alpha_max, float transmittance_min, Array<float> background,
        Array<float> pictures, Array<float> alphas, Array<float> transmittances, Array<int> stops""",
    "composite_patch_adjoint": """int width, int height, Array<float> splats, Array<int> ids, Array<int> starts,
        Array<float> transmittances, Array<int> stops, float alpha_min, float alpha_max, Array<float> background,
        Array<float> grad_pictures, Array<float> grad_alphas, Array<float> grad_splats""",
}


def names(arguments):
    return [part.split()[-1] for part in arguments.replace("\n", " ").split(",")]


@functools.cache
def library(folder: Path, tile: int, lane_pixels: int) -> ctypes.CDLL:
    """Both passes, each as a function of the number of tiles and the kernel's arguments."""
    code = '#include "warp_emulation.hpp"\n'
    for name, arguments in ARGUMENTS.items():
        code += f"static void {name}(int tile, int thread, {arguments}) {{\n"
        code += compositor_cuda.source(PASSES[name], tile, lane_pixels) + "}\n"
        code += f'extern "C" void {name}_all(int tiles, {arguments}) {{\n'
        code += f"    for (int k = 0; k < tiles * {tile * tile // lane_pixels}; k += 32)\n"
        code += "        emulation::run([&](int lane) {\n"
        code += f"            const int threads = {tile * tile // lane_pixels};\n"
        code += f"            {name}((k + lane) / threads, (k + lane) % threads, {', '.join(names(arguments))});\n"
        code += "        });\n}\n"
    path = folder / f"tiles{tile}x{lane_pixels}"
    path.with_suffix(".cpp").write_text(code)
    subprocess.run(
        [
            COMPILER, "-std=c++17", "-O1", "-ffp-contract=off", "-shared", "-fPIC", "-w", f"-I{Path(__file__).parent}",
            "-o", path.with_suffix(".so"), path.with_suffix(".cpp"),
        ],
        check=True,
    )  # fmt: skip
    return ctypes.CDLL(str(path.with_suffix(".so")))


def call(function, *arguments):
    """Call a C function with numbers and tensors; an ``Array`` is a struct of one pointer."""

    class Array(ctypes.Structure):
        _fields_ = [("data", ctypes.c_void_p)]

    def value(x):
        if isinstance(x, torch.Tensor):
            assert x.is_contiguous()
            return Array(x.data_ptr())
        return ctypes.c_int(x) if isinstance(x, int) else ctypes.c_float(x)

    function(*map(value, arguments))


class EmulatedTiles:
    """``compositor_cuda`` on the CPU: the same lists, the same code for a warp, the same last kernel."""

    def __init__(
        self, folder: Path, tile: int = compositor_cuda.TILE, lane_pixels: int = compositor_cuda.LANE_PIXELS
    ):
        self.tile = tile
        self.library = library(folder, tile, lane_pixels)

    def composite(self, splats, depths, background, settings, empty):
        shape = (*depths.shape[:1], settings.height, settings.width)
        # filled with a value that would be noticed: every pixel must be written
        pictures, alphas = splats.new_full((*shape, 3), 1e9), splats.new_full(shape, 1e9)
        transmittances, stops = splats.new_full(shape, 1e9), splats.new_full(shape, -1, dtype=torch.int32)
        ids, starts = compositor_cuda.lists(splats, depths, settings.width, settings.height, self.tile)
        call(
            self.library.composite_patch_all, len(starts) - 1, settings.width, settings.height, splats, ids, starts,
            settings.alpha_min, settings.alpha_max, settings.transmittance_min, background, pictures, alphas,
            transmittances, stops,
        )  # fmt: skip
        return pictures, alphas, (ids, starts, transmittances, stops)

    def composite_adjoint(
        self, splats, kept, background, settings, grad_pictures, grad_alphas, grad_splats, empty
    ):
        ids, starts, transmittances, stops = kept
        grad_splats.zero_()
        call(
            self.library.composite_patch_adjoint_all, len(starts) - 1, settings.width, settings.height, splats, ids,
            starts, transmittances, stops, settings.alpha_min, settings.alpha_max, background, grad_pictures,
            grad_alphas, grad_splats,
        )  # fmt: skip
        _, _, finish = compositor_cuda.list_kernels()
        wp.launch(
            finish,
            dim=splats.shape[:2],
            inputs=[plain(splats)],
            outputs=[plain(grad_splats)],
            **target(splats),
        )
