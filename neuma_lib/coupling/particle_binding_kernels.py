"""Kernel of :mod:`neuma_lib.coupling.particle_binding`: search for the points in an ellipsoid in columns of cells."""

import warp as wp

from neuma_lib.device import start_warp

start_warp()


@wp.func
def _sink(
    keys: wp.array(dtype=wp.float64),
    values: wp.array(dtype=wp.int32),
    start: wp.int32,
    size: wp.int32,
    place: wp.int32,
    key: wp.float64,
    value: wp.int32,
):
    """Insert a pair at a place of a max-heap ordered by (key, value), whose part below the place is a heap."""
    at, child = place, 2 * place + 1
    while child < size:
        k, other = start + child, start + wp.min(child + 1, size - 1)
        if keys[k] < keys[other] or (keys[k] == keys[other] and values[k] < values[other]):
            k = other
        if key < keys[k] or (key == keys[k] and value < values[k]):
            keys[start + at] = keys[k]
            values[start + at] = values[k]
            at = k - start
            child = 2 * at + 1
        else:
            child = size
    keys[start + at] = key
    values[start + at] = value


@wp.func
def _heap(
    keys: wp.array(dtype=wp.float64), values: wp.array(dtype=wp.int32), start: wp.int32, size: wp.int32
):
    """Arrange pairs as a max-heap."""
    for k in range(size // 2):
        place = size // 2 - 1 - k
        _sink(keys, values, start, size, place, keys[start + place], values[start + place])


@wp.kernel(enable_backward=False)
def search(
    begins: wp.array(dtype=wp.int32),  # first point of each column, and the end
    depths: wp.array(dtype=wp.int32),  # cell of each point along its column, ascending
    order: wp.array(dtype=wp.int32),  # index of each point
    points: wp.array(dtype=wp.vec3d),  # column after column
    across: wp.int32,  # number of columns along y
    centres: wp.array(dtype=wp.vec3d),
    whitening: wp.array(dtype=wp.mat33d),
    first: wp.array(dtype=wp.vec3i),  # first and last cell in the bounding box of each ellipsoid
    last: wp.array(dtype=wp.vec3i),
    threshold: wp.float64,
    limit: wp.int32,
    counts: wp.array(dtype=wp.int32),  # out: points in each ellipsoid, up to `limit`; None: rows are known
    starts: wp.array(dtype=wp.int32),  # start of each row of `nearest`, and the end
    distances: wp.array(dtype=wp.float64),  # scratch, shaped like `nearest`
    nearest: wp.array(
        dtype=wp.int32
    ),  # out: the nearest points, sorted by index, as many as fit into the row
):
    """Number of the points in each ellipsoid, or their indices."""
    g = wp.tid()
    centre, to_ball, low, high = centres[g], whitening[g], first[g], last[g]
    start, room = wp.int32(0), wp.int32(limit)
    if starts:
        start = wp.int32(starts[g])
        room = starts[g + 1] - start
    count, bound = wp.int32(0), wp.float64(threshold)
    for x in range(low[0], high[0] + 1):
        for y in range(low[1], high[1] + 1):
            place, end = wp.int32(begins[x * across + y]), wp.int32(begins[x * across + y + 1])
            past = wp.int32(end)
            while place < past:  # binary search for the first point in the box
                middle = (place + past) // 2
                if depths[middle] < low[2]:
                    place = middle + 1
                else:
                    past = middle
            while place < end:
                if depths[place] > high[2] or (counts and count == room):
                    break
                offset = points[place] - centre
                distance = wp.float64(0.0)
                for axis in range(3):  # the shortest axis first, which excludes most points of a disc
                    if distance <= bound:
                        along = wp.dot(to_ball[axis], offset)
                        distance += along * along
                if distance <= bound:
                    if not counts:
                        if count < room:
                            distances[start + count] = distance
                            nearest[start + count] = order[place]
                        elif distance < bound or order[place] < nearest[start]:
                            _sink(distances, nearest, start, room, 0, distance, order[place])
                        if count >= room - 1:
                            if count == room - 1:
                                _heap(distances, nearest, start, room)
                            bound = distances[start]
                    count += 1
                place += 1
    if counts:
        counts[g] = count
    else:  # heap sort by index
        for k in range(room):
            distances[start + k] = wp.float64(0.0)
        _heap(distances, nearest, start, room)
        for k in range(room - 1):
            size = room - 1 - k
            value = nearest[start + size]
            nearest[start + size] = nearest[start]
            _sink(distances, nearest, start, size, 0, wp.float64(0.0), value)
