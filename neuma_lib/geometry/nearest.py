"""Nearest neighbours between many pairs of point sets at once, on their device.

The points of a set are sorted into the cubic cells of a grid. A search begins in the cell of the query and proceeds in
rings of cells until no point outside can be nearer, so the result is exact at any distance.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
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
    def beyond(q: vec3, c: wp.vec3i, shape: wp.vec3i, width: real, ring: wp.int32):
        """Lower bound of the squared distance from q to the points outside the rings 0 .. ring about its cell c.

        Infinite if the rings cover the grid. Positions are relative to the corner of the grid.
        """
        out = vec3()  # distance from q to the grid along each axis
        for a in range(3):
            out[a] = wp.max(wp.max(-q[a], q[a] - width * real(shape[a])), real(0.0))
        bound = real(wp.inf)
        for a in range(3):
            along = real(wp.inf)
            if c[a] - ring > 0:
                along = q[a] - width * real(c[a] - ring)
            if c[a] + ring + 1 < shape[a]:
                along = wp.min(along, width * real(c[a] + ring + 1) - q[a])
            along = wp.max(along, real(0.0))
            bound = wp.min(bound, along * along + wp.dot(out, out) - out[a] * out[a])
        return bound

    @wp.func
    def apart(q: real, i: wp.int32, width: real):
        """Squared distance from a coordinate to an interval of cells, less a hundredth of a cell for round-off."""
        low = width * (real(i) - real(0.01)) - q
        outside = wp.max(wp.max(low, -low - real(1.02) * width), real(0.0))
        return outside * outside

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
        c = wp.vec3i()
        for a in range(3):
            c[a] = wp.clamp(wp.int32(wp.floor(wp.clamp(q[a] / w, real(-1.0), real(n[a])))), 0, n[a] - 1)
        best, closest = real(wp.inf), wp.int32(-1)
        for ring in range(wp.max(n[0], wp.max(n[1], n[2]))):
            for i in range(wp.max(c[0] - ring, 0), wp.min(c[0] + ring + 1, n[0])):
                across = apart(q[0], i, w)
                if across > best:
                    continue
                for j in range(wp.max(c[1] - ring, 0), wp.min(c[1] + ring + 1, n[1])):
                    to_row, row = across + apart(q[1], j, w), first[s] + (i * n[1] + j) * n[2]
                    side = wp.abs(i - c[0]) == ring or wp.abs(j - c[1]) == ring
                    stride = wp.where(side or ring == 0, 1, 2 * ring)
                    if to_row <= best and starts[row] < starts[row + n[2]]:
                        for m in range(c[2] - ring, c[2] + ring + 1, stride):
                            if m >= 0 and m < n[2] and to_row + apart(q[2], m, w) <= best:
                                for p in range(starts[row + m], starts[row + m + 1]):
                                    offset = points[p] - queries[k]
                                    distance = wp.dot(offset, offset)
                                    if distance < best:
                                        best, closest = distance, p
            if best <= beyond(q, c, n, w, ring):
                break
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
