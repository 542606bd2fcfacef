"""Functions whose results have the same bits wherever they are evaluated."""

# A compiler may contract a product and a sum into one operation that rounds once (FMA), or not,
# depending on the surrounding code: the same function then has other bits in another program.
# Machine code of `lanewise` does not depend on the surrounding code.

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

import lanewise
from lanewise import Layout


def one_by_one(function: Callable[..., Any], *args: Any, layout: Layout = Layout()) -> Any:
    """``function(*args)`` of pytrees, compiled separately, so that no operation in it is joined
    with one outside. It must return a pytree of arrays."""
    arrays, constants = eqx.partition(args, eqx.is_array)
    return lanewise.call(
        lambda arrays: function(*eqx.combine(arrays, constants)), arrays, layout=layout
    )


def each(
    function: Callable[..., Any], constants: Any, *rows: Any, layout: Layout = Layout()
) -> Any:
    """``function(given, *row)`` for every row, with the bits of a call for one row alone."""
    return jax.vmap(lambda *row: one_by_one(function, constants, *row, layout=layout))(*rows)
