"""Primitives that move elements: reshapes, slices, pads and the like, as changes of boxes."""

from collections.abc import Callable, Sequence

from .boxes import Array, Box, IndexMap, NotABoxError, joined, repeat

MOST_PARTS = 16
"""Boxes that a reshape makes at most; an array of more is written to memory."""


def _broadcast_in_dim(x: Array, *, shape, broadcast_dimensions) -> Array:
    return repeat(x, shape, broadcast_dimensions)


def _reshape(x: Array, *, new_sizes, dimensions=None) -> Array:
    if dimensions is not None:
        x = _transpose(x, permutation=dimensions)
    new_sizes = tuple(map(int, new_sizes))
    if not x.size:
        return Array(x.table, new_sizes, x.dtype, [])
    old = [a for a, n in enumerate(x.shape) if n != 1]
    new = [k for k, n in enumerate(new_sizes) if n != 1]
    y = x.along([x.shape[a] for a in old], _places(old, len(x.shape)))
    for axis, n in enumerate(new_sizes[k] for k in new):
        # One axis becomes two, or two become one, until the sizes agree from the left.
        while axis < len(y.shape) and y.shape[axis] != n:
            y = _split_axis(y, axis, n) if y.shape[axis] > n else _join_axes(y, axis)
    if y.shape != tuple(new_sizes[k] for k in new):
        raise NotABoxError
    return y.along(new_sizes, new)


def _places(axes: Sequence[int], rank: int) -> list[int | None]:
    """For each of `rank` axes its place in a list of some of them."""
    return [axes.index(a) if a in axes else None for a in range(rank)]


def _split_axis(x: Array, axis: int, count: int) -> Array:
    """The axis as two, of which the first has `count` elements."""
    size, rest = divmod(x.shape[axis], count)
    if rest:
        raise NotABoxError
    shape = [*x.shape[:axis], count, size, *x.shape[axis + 1 :]]
    axes_of_old = [k + (k > axis) for k in range(len(x.shape))]
    if all(low[axis] == 0 and end[axis] == x.shape[axis] for low, end, _ in x.boxes):
        rows = [[int(k == other) for k in range(len(shape))] for other in axes_of_old]
        rows[axis][axis : axis + 2] = [size, 1]
        index_map = IndexMap(len(shape), tuple(map(tuple, rows)), (0,) * len(axes_of_old))
        boxes = [
            Box(
                (*low[:axis], 0, 0, *low[axis + 1 :]),
                (*end[:axis], count, size, *end[axis + 1 :]),
                node.moved(index_map),
            )
            for low, end, node in x.boxes
        ]
        return Array(x.table, shape, x.dtype, boxes)
    axes_of_old[axis] = axis + 1
    boxes = []
    for i in range(_part_count(count, x)):
        offsets = [i * size if k == axis else 0 for k in range(len(x.shape))]
        part = x.along([n if k != axis else 1 for k, n in enumerate(shape)], axes_of_old, offsets)
        boxes += [_box_at(box, axis, i) for box in part.boxes]
    return Array(x.table, shape, x.dtype, joined(boxes, len(shape)))


def _join_axes(x: Array, axis: int) -> Array:
    """Two neighbouring axes as one, if the first has few elements."""
    if axis + 1 == len(x.shape):
        raise NotABoxError
    count, size = x.shape[axis : axis + 2]
    shape = [*x.shape[:axis], count * size, *x.shape[axis + 2 :]]
    boxes = []
    for index in range(_part_count(count, x)):
        axes = [None if k == axis else k - (k > axis) for k in range(len(x.shape))]
        offsets = [index if k == axis else 0 for k in range(len(x.shape))]
        part = x.along([size if k == axis else n for k, n in enumerate(shape)], axes, offsets)
        # Moved to its place on the new axis.
        rank = len(shape)
        rows = [[int(k == a) for k in range(rank)] for a in range(rank)]
        boxes += part.moved(
            shape, rows, [-index * size if k == axis else 0 for k in range(rank)]
        ).boxes
    return Array(x.table, shape, x.dtype, joined(boxes, len(shape)))


def _part_count(count: int, x: Array) -> int:
    if count * len(x.boxes) > MOST_PARTS:
        raise NotABoxError
    return count


def _box_at(box: Box, axis: int, index: int) -> Box:
    lower, upper, node = box
    return Box(
        (*lower[:axis], index, *lower[axis + 1 :]),
        (*upper[:axis], index + 1, *upper[axis + 1 :]),
        node,
    )


def _squeeze(x: Array, *, dimensions) -> Array:
    return _reshape(x, new_sizes=[n for a, n in enumerate(x.shape) if a not in dimensions])


def _expand_dims(x: Array, *, dimensions) -> Array:
    sizes = iter(x.shape)
    rank = len(x.shape) + len(dimensions)
    return _reshape(x, new_sizes=[1 if a in dimensions else next(sizes) for a in range(rank)])


def _slice(x: Array, *, start_indices, limit_indices, strides=None) -> Array:
    rank = len(x.shape)
    strides = strides or (1,) * rank
    ends = zip(start_indices, limit_indices, strides, strict=True)
    shape = [max(0, -((first - end) // step)) for first, end, step in ends]
    rows = [[int(strides[a]) if a == k else 0 for k in range(rank)] for a in range(rank)]
    return x.moved(shape, rows, start_indices)


def _transpose(x: Array, *, permutation) -> Array:
    axes = [list(permutation).index(a) for a in range(len(x.shape))]
    return x.along([x.shape[p] for p in permutation], axes)


def _rev(x: Array, *, dimensions) -> Array:
    rank = len(x.shape)
    signs = [-1 if a in dimensions else 1 for a in range(rank)]
    rows = [[signs[a] if a == k else 0 for k in range(rank)] for a in range(rank)]
    return x.moved(x.shape, rows, [n - 1 if a in dimensions else 0 for a, n in enumerate(x.shape)])


def _split(x: Array, *, sizes, axis) -> tuple[Array, ...]:
    parts, start = [], 0
    for size in sizes:
        first, end = [0] * len(x.shape), list(x.shape)
        first[axis], end[axis] = start, start + size
        parts.append(_slice(x, start_indices=first, limit_indices=end))
        start += size
    return tuple(parts)


def _unstack(x: Array, *, axis) -> tuple[Array, ...]:
    parts = _split(x, sizes=[1] * x.shape[axis], axis=axis)
    return tuple(_squeeze(part, dimensions=(axis,)) for part in parts)


def _part_boxes(x: Array, start: Sequence[int], shape: Sequence[int]) -> list[Box]:
    """The boxes of an array whose element 0 is element `start` of a larger one."""
    rank = len(shape)
    rows = [[int(a == k) for k in range(rank)] for a in range(rank)]
    return x.moved(shape, rows, [-s for s in start]).boxes


def _concatenate(*xs: Array, dimension) -> Array:
    shape = list(xs[0].shape)
    shape[dimension] = sum(x.shape[dimension] for x in xs)
    boxes, start = [], [0] * len(shape)
    for x in xs:
        boxes += _part_boxes(x, start, shape)
        start[dimension] += x.shape[dimension]
    return Array(xs[0].table, shape, xs[0].dtype, joined(boxes, len(shape)))


def _stack(*xs: Array, axis) -> Array:
    return _concatenate(*(_expand_dims(x, dimensions=(axis,)) for x in xs), dimension=axis)


def _tile(x: Array, *, reps) -> Array:
    for axis, count in enumerate(reps):
        x = _concatenate(*[x] * count, dimension=axis)
    return x


def _pad(x: Array, fill: Array, *, padding_config) -> Array:
    if any(inner for *_, inner in padding_config):
        raise NotABoxError
    sizes = zip(x.shape, padding_config, strict=True)
    shape = [max(0, n + int(low) + int(high)) for n, (low, high, _) in sizes]
    start = [int(low) for low, *_ in padding_config]
    (node,) = (box.expression for box in fill.boxes)
    boxes = _part_boxes(x, start, shape)
    sides = zip(start, x.shape, shape, strict=True)
    interior = [(min(max(s, 0), m), max(min(s + n, m), 0)) for s, n, m in sides]
    if any(p >= q for p, q in interior):
        return Array.uniform(node, shape)
    for axis, end in enumerate(shape):
        # Outside of x along this axis, and inside along those before it.
        front, tail = interior[:axis], [(0, n) for n in shape[axis + 1 :]]
        for side in ((0, interior[axis][0]), (interior[axis][1], end)):
            edges = [*front, side, *tail]
            if all(p < q for p, q in edges):
                boxes.append(Box(tuple(p for p, _ in edges), tuple(q for _, q in edges), node))
    return Array(x.table, shape, x.dtype, joined(boxes, len(shape)))


BOX_MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": _reshape,
    "squeeze": _squeeze,
    "expand_dims": _expand_dims,
    "slice": _slice,
    "transpose": _transpose,
    "rev": _rev,
    "split": _split,
    "unstack": _unstack,
    "concatenate": _concatenate,
    "stack": _stack,
    "tile": _tile,
    "pad": _pad,
}
"""Name of a primitive → function of arrays; **raises** `NotABoxError`."""
