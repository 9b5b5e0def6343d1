"""Nearest neighbours between many pairs of point sets at once, on their device.

The points of a set are sorted into the cubic cells of a grid. A search begins in the cell nearest to the query and
proceeds outwards over planes and rows of cells as far as a point can be nearer, so the result is exact at any distance.
"""

import functools
from collections.abc import Sequence

import torch
import warp as wp
from torch import Tensor

from neuma_lib.device import launch, start_warp

start_warp()


@functools.cache
def _search_kernel(dtype: torch.dtype) -> wp.Kernel:
    """Kernel over the queries for a dtype."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")

    @wp.func
    def apart(q: real, i: wp.int32, width: real):
        """Squared distance from a coordinate to an interval of cells, less a hundredth of a cell for round-off."""
        low = width * (real(i) - real(0.01)) - q
        outside = wp.max(wp.max(low, -low - real(1.02) * width), real(0.0))
        return outside * outside

    @wp.func
    def cell(q: real, count: wp.int32, width: real):
        """Index of the cell nearest to a coordinate."""
        return wp.int32(wp.clamp(wp.floor(q / width), real(0.0), real(count - 1)))

    @wp.func
    def cells(q: real, squared: real, count: wp.int32, width: real):
        """First and last cell that may be within a distance of a coordinate, if any is."""
        reach = wp.sqrt(wp.max(squared, real(0.0))) + real(0.01) * width
        return wp.vec2i(cell(q - reach, count, width), cell(q + reach, count, width))

    @wp.func
    def outwards(k: wp.int32, start: wp.int32):
        """The k-th of the cells on both sides of a first one: 0, -1, 1, -2 ... from there."""
        return start + wp.where(k % 2 == 0, k // 2, -(k + 1) // 2)

    @wp.func
    def turns(start: wp.int32, ends: wp.vec2i):
        """Number of cells of `outwards` that hold all from the first to the last."""
        return 2 * wp.max(start - ends[0], ends[1] - start) + 1

    @wp.kernel(enable_backward=False, module=module)
    def search(
        points: wp.array(dtype=vec3),  # sorted by cell
        starts: wp.array(dtype=wp.int32),  # first point of each cell, and the end
        corner: wp.array(dtype=vec3),  # of the grid of each set
        width: wp.array(dtype=real),
        shape: wp.array(dtype=wp.vec3i),
        first: wp.array(dtype=wp.int32),  # first cell of each set
        queries: wp.array(dtype=vec3),
        of: wp.array(dtype=wp.int32),  # set of each query
        out: wp.array(dtype=wp.int32),
    ):
        """Index of the point nearest to each query."""
        k = wp.tid()
        s = of[k]
        w, n = width[s], shape[s]
        q = queries[k] - corner[s]
        a, b, c = cell(q[0], n[0], w), cell(q[1], n[1], w), cell(q[2], n[2], w)
        best, closest = real(wp.inf), wp.int32(-1)
        own = first[s] + (a * n[1] + b) * n[2] + c
        for p in range(starts[own], starts[own + 1]):  # a first bound
            offset = points[p] - queries[k]
            distance = wp.dot(offset, offset)
            if distance < best:
                best, closest = distance, p
        planes = cells(q[0], best, n[0], w)
        for u in range(turns(a, planes)):
            i = outwards(u, a)
            if i < planes[0] or i > planes[1]:
                continue
            across = apart(q[0], i, w)
            if across > best:
                continue
            rows = cells(q[1], best - across, n[1], w)
            for v in range(turns(b, rows)):
                j = outwards(v, b)
                if j < rows[0] or j > rows[1]:
                    continue
                to_row, row = across + apart(q[1], j, w), first[s] + (i * n[1] + j) * n[2]
                if to_row <= best and starts[row] < starts[row + n[2]]:
                    ends = cells(q[2], best - to_row, n[2], w)
                    for p in range(starts[row + ends[0]], starts[row + ends[1] + 1]):
                        offset = points[p] - queries[k]
                        distance = wp.dot(offset, offset)
                        if distance < best:
                            best, closest = distance, p
        out[k] = closest

    return search


def nearest(points: Tensor, points_of: Sequence[int], queries: Tensor, queries_of: Sequence[int]) -> Tensor:
    """Nearest point of its set for each query.

    Args:
        points: finite positions [m], shape (P, 3), set after set.
        points_of: number of points in each set, at least one.
        queries: finite positions [m], shape (Q, 3), in the order of the sets.
        queries_of: number of queries of each set.

    Returns:
        Rows of `points`, shape (Q,).
    """
    device, count = points.device, len(points_of)
    sizes = torch.tensor(points_of, device=device)
    sets = torch.arange(count, device=device)
    of = sets.repeat_interleave(sizes)
    ranges = [own.aminmax(dim=0) for own in points.split(list(points_of))]
    low, high = torch.stack([own.min for own in ranges]), torch.stack([own.max for own in ranges])
    # as many cells along the longest side as possible without more cells than points
    extent = (high - low).amax(dim=1)
    along = sizes.to(points).pow(1 / 3).floor().clamp(min=1)
    width = (extent / along).clamp(min=torch.finfo(points.dtype).tiny ** 0.25)
    shape = ((high - low) / width[:, None]).floor().long() + 1
    shape = torch.minimum(shape, along[:, None].long())
    cells = shape.prod(dim=1)
    first = cells.cumsum(0) - cells
    index = ((points - low[of]) / width[of, None]).floor().long().clamp(min=0)
    index = torch.minimum(index, shape[of] - 1)
    cell = first[of] + (index[:, 0] * shape[of, 1] + index[:, 1]) * shape[of, 2] + index[:, 2]
    order = cell.argsort(stable=True)
    counts = torch.bincount(cell, minlength=int(cells.sum()))
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    which = sets.repeat_interleave(torch.tensor(queries_of, device=device))
    out = torch.empty(len(queries), dtype=torch.int32, device=device)
    launch(
        _search_kernel(points.dtype),
        len(queries),
        points[order].contiguous(),
        starts.int(),
        low.contiguous(),
        width.contiguous(),
        shape.int().contiguous(),
        first.int(),
        queries.detach().contiguous(),
        which.int(),
        out,
    )
    return order[out.long()]
