"""Axes of an array that are written out, and not computed by loops."""

from collections.abc import Sequence

from ..jaxprs.extent import SHORT

MOST_WRITTEN_OUT = 32
"""The short axes of an array have at most so many indices together: for each of them there is code,
and the time that LLVM takes grows faster than the code."""


def short_axes(shape: Sequence[int]) -> list[int]:
    """The axes that are written out, the shortest ones of the array."""
    short, count = [], 1
    # Of equal axes the first one: the last one then stays contiguous.
    for n, a in sorted((n, a) for a, n in enumerate(shape)):
        count *= max(n, 1)
        if n <= SHORT and count <= MOST_WRITTEN_OUT:
            short.append(a)
    return sorted(short)
