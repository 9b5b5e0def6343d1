"""The CUDA code of the laws and of the tile compositor, compiled for the CPU by ``cuda_emulator.h``."""

import ctypes
import functools
import shutil
import subprocess
from pathlib import Path

import torch

from neuma_lib.device import launch
from neuma_lib.mechanics import analytic_kernels, neural_fused, structured_kernels
from neuma_lib.splatting import compositor_cuda

COMPILER = shutil.which("g++")


class _Array(ctypes.Structure):
    _fields_ = [("data", ctypes.c_void_p)]


@functools.cache
def _library(folder: Path, name: str, bodies: tuple[tuple[str, str, str], ...], *flags: str) -> ctypes.CDLL:
    """Kernels (name, parameters, body), each as a function (blocks, threads, bytes of shared memory, parameters)."""
    code = '#include "cuda_emulator.h"\n'
    for kernel, parameters, body in bodies:
        names = ", ".join(part.split()[-1] for part in parameters.split(","))
        code += f"static void {kernel}_body({parameters})\n{{\n{body}\n}}\n"
        code += f'extern "C" int {kernel}(int blocks, int threads, int bytes, {parameters})\n'
        code += f"{{\n    return emulator::launch(blocks, threads, bytes, [&] {{ {kernel}_body({names}); }});\n}}\n"
    path = folder / name
    path.with_suffix(".cpp").write_text(code)
    options = [
        "-std=c++17",
        "-O1",
        "-ffp-contract=off",
        "-shared",
        "-fPIC",
        "-w",
        f"-I{Path(__file__).parent}",
        *flags,
    ]
    subprocess.run([COMPILER, *options, "-o", path.with_suffix(".so"), path.with_suffix(".cpp")], check=True)
    return ctypes.CDLL(str(path.with_suffix(".so")))


def _launch(function, blocks: int, threads: int, shared: int, *arguments) -> None:
    """Numbers are handed over as C's int and float, unless they are C's double, tensors as the struct ``Array``."""

    def value(x):
        if isinstance(x, torch.Tensor):
            assert x.is_contiguous()
            return _Array(x.data_ptr())
        if isinstance(x, ctypes.c_double):
            return x
        return ctypes.c_int(x) if isinstance(x, int) else ctypes.c_float(x)

    assert function(*map(value, (blocks, threads, shared, *arguments))) == 0, (
        "the emulation failed, see stderr"
    )


class EmulatedTiles:
    """``compositor_cuda`` on the CPU: the same lists, the same code for a warp, the same last kernel."""

    parameters = {
        "forward": "int width, int height, Array<float> splats, Array<int> ids, Array<int> starts, float alpha_min,"
        " float alpha_max, float transmittance_min, Array<float> background, Array<float> pictures,"
        " Array<float> alphas, Array<float> transmittances, Array<int> stops",
        "backward": "int width, int height, Array<float> splats, Array<int> ids, Array<int> starts,"
        " Array<float> transmittances, Array<int> stops, float alpha_min, float alpha_max, Array<float> background,"
        " Array<float> grad_pictures, Array<float> grad_alphas, Array<float> grad_splats",
    }
    comparing = {
        "forward": "int width, int height, Array<float> splats, Array<int> ids, Array<int> starts, float alpha_min,"
        " float alpha_max, float transmittance_min, Array<float> background, Array<int> observed, Array<double> sums,"
        " Array<float> states, Array<int> stops",
        "backward": "int width, int height, Array<float> splats, Array<int> ids, Array<int> starts,"
        " Array<float> states, Array<int> stops, float alpha_min, float alpha_max, Array<float> background,"
        " Array<float> scales, Array<float> grad_splats",
    }

    def __init__(
        self, folder: Path, tile: int = compositor_cuda.TILE, lane_pixels: int = compositor_cuda.LANE_PIXELS
    ):
        self.tile, self.threads = tile, tile * tile // lane_pixels
        place = "const int tile = blockIdx.x, thread = threadIdx.x;\n"
        variants = (
            ("", False, True, self.parameters),
            ("comparing_", True, True, self.comparing),
            ("fixed_opacities_", True, False, {"backward": self.comparing["backward"]}),
        )
        bodies = tuple(
            (prefix + name, parameters, place + compositor_cuda.source(name, tile, lane_pixels, *flags))
            for prefix, *flags, passes in variants
            for name, parameters in passes.items()
        )
        self.library = _library(folder, f"tiles{tile}x{lane_pixels}", bodies)

    def composite(self, splats, depths, background, settings, empty):
        shape = (*depths.shape[:1], settings.height, settings.width)
        # filled with a value that would be noticed: every pixel must be written
        pictures, alphas = splats.new_full((*shape, 3), 1e9), splats.new_full(shape, 1e9)
        transmittances, stops = splats.new_full(shape, 1e9), splats.new_full(shape, -1, dtype=torch.int32)
        ids, starts = compositor_cuda.lists(splats, depths, settings.width, settings.height, self.tile)
        _launch(
            self.library.forward, len(starts) - 1, self.threads, 0, settings.width, settings.height, splats, ids,
            starts, settings.alpha_min, settings.alpha_max, settings.transmittance_min, background, pictures, alphas,
            transmittances, stops,
        )  # fmt: skip
        return pictures, alphas, (ids, starts, transmittances, stops)

    def composite_adjoint(
        self, splats, kept, background, settings, grad_pictures, grad_alphas, grad_splats, empty
    ):
        ids, starts, transmittances, stops = kept
        grad_splats.zero_()
        _launch(
            self.library.backward, len(starts) - 1, self.threads, 0, settings.width, settings.height, splats, ids,
            starts, transmittances, stops, settings.alpha_min, settings.alpha_max, background, grad_pictures,
            grad_alphas, grad_splats,
        )  # fmt: skip
        _, finish = compositor_cuda.list_kernels()
        launch(finish, splats.shape[:2], splats, grad_splats)

    def compare(self, splats, depths, background, settings, observed, empty):
        ids, starts = compositor_cuda.lists(splats, depths, settings.width, settings.height, self.tile)
        tiles = len(starts) - 1
        # no number: every sum must be written, and nothing be read that was not
        sums = splats.new_full((tiles, self.threads // 32), torch.nan, dtype=torch.float64)
        states = splats.new_full((tiles, self.tile**2, 4), torch.nan)
        stops = splats.new_full((tiles, self.tile**2), 10**9, dtype=torch.int32)
        _launch(
            self.library.comparing_forward, tiles, self.threads, 0, settings.width, settings.height, splats, ids,
            starts, settings.alpha_min, settings.alpha_max, settings.transmittance_min, background, observed, sums,
            states, stops,
        )  # fmt: skip
        empty_tiles = starts[1:] == starts[:-1]
        assert states[empty_tiles].isnan().all() and not states[~empty_tiles].isnan().any()
        return sums.view(len(observed), -1), (ids, starts, states, stops)

    def compare_adjoint(self, splats, kept, background, settings, scales, opacities, grad_splats):
        ids, starts, states, stops = kept
        grad_splats.zero_()
        library = self.library
        _launch(
            library.comparing_backward if opacities else library.fixed_opacities_backward, len(starts) - 1,
            self.threads, 0, settings.width, settings.height, splats, ids, starts, states, stops, settings.alpha_min,
            settings.alpha_max, background, scales, grad_splats,
        )  # fmt: skip
        _, finish = compositor_cuda.list_kernels()
        launch(finish, splats.shape[:2], splats, grad_splats)


def _addresses(parameters: str) -> str:
    """C++ that gives the kernels, which take addresses, those of the parameters "Array<...> name_"."""
    names = [part.split()[-1] for part in parameters.split(",") if "Array" in part]
    return "".join(f"    const uint64_t {n[:-1]} = uint64_t({n}.data);\n" for n in names)


class EmulatedLaws:
    """The kernels of ``neural_fused`` on the CPU, for any number of blocks."""

    def __init__(self, folder: Path):
        arrays = "Array<float> F_, Array<float> W0_, Array<float> W1_, Array<float> W2_"
        forward = f"{arrays}, float factor, int n, Array<float> out_"
        backward = f"{arrays}, Array<float> grad_out_, float factor, int n, Array<float> grad_F_"
        backward += ", int fresh, Array<float> partials_"

        def body(kind, is_backward, parameters, precision):
            text = neural_fused.source(kind, is_backward, "EMULATED_MACHINE\n", precision)
            return _addresses(parameters) + text

        passes = {
            "evaluate": (False, forward, "single"),
            "vjp_single": (True, backward, "single"),
            "vjp_half": (True, backward, "half"),
        }
        bodies = [
            (f"{name}_{kind}", parameters, body(kind, is_backward, parameters, precision))
            for kind in ("elasticity", "plasticity")
            for name, (is_backward, parameters, precision) in passes.items()
        ]
        self.library = _library(folder, "laws", tuple(bodies))

    def __call__(
        self, part, F, g, blocks: int, precision: str = "single", additions: int = 0
    ) -> list[torch.Tensor]:
        """Result, gradient of F (n, 3, 3) and gradients of the weights, in float64; computed in float32.

        The latter are set, or, so many times, added to zeros.
        """
        F, g, *weights = (x.detach().float().contiguous() for x in (F, g, *part.weights()))
        result, grad_F = torch.empty_like(F), torch.empty_like(F)
        partials = torch.full((blocks, neural_fused.WEIGHTS), 0.0 if additions else torch.nan)
        common = (F, *weights)
        sizes = (
            size - neural_fused.ALIGNMENT for size in (neural_fused.EVALUATE_BYTES, neural_fused.VJP_BYTES)
        )
        scale, fresh = float(part.scale), int(not additions)
        calls = (
            ("evaluate", neural_fused.EVALUATE_TILES, 1, (*common, scale, len(F), result)),
            (
                f"vjp_{precision}",
                neural_fused.VJP_TILES,
                max(additions, 1),
                (*common, g, scale, len(F), grad_F, fresh, partials),
            ),
        )
        for size, (name, tiles, times, arguments) in zip(sizes, calls, strict=True):
            function = getattr(self.library, f"{name}_{part.kind}")
            for _ in range(times):
                _launch(function, blocks, neural_fused.threads(tiles), size, *arguments)
        sums = partials.double().sum(0).split([w.numel() for w in weights])
        return [result.double(), grad_F.double(), *(x.view_as(w) for x, w in zip(sums, weights, strict=True))]


class EmulatedStructuredLaws:
    """The kernels of ``structured_kernels`` on the CPU, for any number of blocks."""

    def __init__(self, folder: Path, dtype: torch.dtype):
        self.dtype = dtype
        real = {torch.float32: "float", torch.float64: "double"}[dtype]
        array = f"Array<{real}>"
        constants = f"{real} p0, {real} p1, {real} p2, {real} p3"
        common = f"{array} F_, {array} W0_, {array} W1_, {array} W2_, int kind, {constants}, int n"
        totals = f"{array} total0_, {array} total1_, {array} total2_"
        forward = f"{common}, {array} out_"
        backward = f"{common}, {array} grad_out_, {array} grad_F_, {array} partials_"
        add = f"{array} partials_, int summands, {totals}"
        # a GPU caches nothing
        uncached = "    const int cached = 0, adds = 0;\n    const uint64_t cache = 0;\n"
        bodies = []
        for name in structured_kernels.KINDS:
            for which, parameters in (("evaluate", forward), ("vjp", backward)):
                text = structured_kernels.source(name, which == "vjp", dtype)
                bodies.append((f"{which}_{name}", parameters, _addresses(parameters) + uncached + text))
            text = structured_kernels.add_source(name, dtype)
            bodies.append((f"add_{name}", add, _addresses(add) + text))
        bodies = tuple((name, parameters, text) for name, parameters, text in bodies)
        self.library = _library(folder, f"structured_{real}", bodies, "-D__CUDA_ARCH__=800")

    def __call__(self, part, F, weights, g, blocks: int) -> list[torch.Tensor]:
        """Result, gradient of F (n, 3, 3) and gradients of the weights."""
        name, constants = part.network_kernel
        F, g, *weights = (x.to(self.dtype).contiguous() for x in (F, g, *weights))
        result, grad_F = (torch.full_like(F, torch.nan) for _ in range(2))
        partials = torch.full((blocks, structured_kernels.weight_count(name)), torch.nan, dtype=self.dtype)
        totals = [torch.zeros_like(w) for w in weights]
        number = ctypes.c_double if self.dtype == torch.float64 else float
        common = F, *weights, constants.kind, *map(number, constants.values), len(F)
        threads = structured_kernels.THREADS[self.dtype]
        lanes, groups = structured_kernels.LANES, structured_kernels.GROUPS
        columns = -(-partials.shape[1] // lanes)
        for which, size, arguments in (
            ("evaluate", (blocks, threads), (*common, result)),
            ("vjp", (blocks, threads), (*common, g, grad_F, partials)),
            ("add", (columns, lanes * groups), (partials, blocks, *totals)),
        ):
            _launch(getattr(self.library, f"{which}_{name}"), *size, 0, *arguments)
        return [result, grad_F, *totals]


class EmulatedAnalyticLaws:
    """The kernels of ``analytic_kernels`` on the CPU."""

    def __init__(self, folder: Path, dtype: torch.dtype):
        self.dtype = dtype
        real = {torch.float32: "float", torch.float64: "double"}[dtype]
        forward = f"Array<{real}> F_, Array<{real}> rows_, int copies, int n, Array<{real}> out_"
        backward = f"Array<{real}> F_, Array<{real}> rows_, int copies, int n, Array<{real}> grad_out_"
        backward += f", Array<{real}> grad_F_, Array<double> partials_"
        uncached = "    const uint64_t cache = 0;\n"  # a GPU caches nothing
        bodies = []
        for kind in ("elasticity", "plasticity"):
            for name, parameters in (("evaluate", forward), ("vjp", backward)):
                text = analytic_kernels.source(kind, name == "vjp", dtype)
                bodies.append((f"{name}_{kind}", parameters, _addresses(parameters) + uncached + text))
        self.library = _library(folder, f"analytic_{real}", tuple(bodies), "-D__CUDA_ARCH__=800")

    def __call__(self, part, F, weights, g) -> list[torch.Tensor]:
        """Result, gradient of F (copies n, 3, 3) and gradient of the rows (copies, 1 + COEFFICIENTS)."""
        F, rows, g = (x.to(self.dtype).contiguous() for x in (F, weights[0], g))
        result, grad_F = (torch.full_like(F, torch.nan) for _ in range(2))
        copies, n = len(rows), len(F) // len(rows)
        partials = torch.full((copies, n, analytic_kernels.COEFFICIENTS), torch.nan, dtype=torch.float64)
        threads = analytic_kernels.THREADS
        for name, arguments in (("evaluate", (result,)), ("vjp", (g, grad_F, partials))):
            function = getattr(self.library, f"{name}_{part.part}")
            _launch(function, -(-len(F) // threads), threads, 0, F, rows, copies, n, *arguments)
        return [result, grad_F, torch.nn.functional.pad(partials.sum(1), (1, 0)).to(self.dtype)]
