"""A function whose numbers have the same bits wherever it is evaluated.

A compiler may join a product and a sum into one operation that rounds once (FMA), or not, depending
on what stands around them: the same function then has other bits in another program. Machine code
of `lanewise` does not depend on its surroundings.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

import lanewise


def one_by_one(
    function: Callable[..., Any], *args: Any, layout: lanewise.Layout = lanewise.Layout()
) -> Any:
    """``function(*args)``, compiled by itself: nothing in it is joined with operations outside,
    within a run or elsewhere. It takes pytrees, and returns a pytree of arrays."""
    arrays, rest = eqx.partition(args, eqx.is_array)
    return lanewise.call(lambda arrays: function(*eqx.combine(arrays, rest)), arrays, layout=layout)


def each(
    function: Callable[..., Any], given: Any, *rows: Any,
    layout: lanewise.Layout = lanewise.Layout(),
) -> Any:  # fmt: skip
    """``function(given, *row)`` for every row, with the bits that it has for one row alone."""
    return jax.vmap(lambda *row: one_by_one(function, given, *row, layout=layout))(*rows)
