"""Products and quotients on lanes, of fewer operations than they are written with."""

from typing import Any

import numpy as np
from jax import lax

from ._rules import apply
from ._value import ONE, Entry, is_array, number


class Rewrites:
    """What is known of the numbers made so far within one body of code.

    Derivatives leave patterns that a compiler keeps, because another order rounds otherwise:
    reciprocals of one number in several powers, and products of a number with what is the same on
    all lanes, one after the other or added up.
    """

    def __init__(self):
        # By the id of a number, which is kept alive: its reciprocal; how it is c·x.
        self._reciprocals: dict[int, tuple[Entry, Entry]] = {}
        self._multiples: dict[int, tuple[Entry, Entry, Entry]] = {}

    def __call__(
        self, name: str, entries: list[Entry], dtypes: list[Any], params: dict[str, Any]
    ) -> Entry | None:
        """The result of a primitive, None where it is to be evaluated as it is."""
        dtype = dtypes[-1]
        if any(d != dtype for d in dtypes) or not np.issubdtype(dtype, np.floating):
            return None
        if name in ("integer_pow", "div"):
            return self._by_reciprocal(name, entries, dtype, params)
        if name == "neg":
            return self._multiple(np.asarray(-1, dtype)[()], entries[0], dtype)
        if name == "mul":
            a, b = entries
            return self._multiple(b, a, dtype) if _on_lanes(a) else self._multiple(a, b, dtype)
        if name in ("add", "add_any"):
            a, b = entries
            return self._sum(a, b, dtype)
        return None

    def _by_reciprocal(
        self, name: str, entries: list[Entry], dtype: Any, params: dict[str, Any]
    ) -> Entry | None:
        """x⁻ⁿ and c/x, with c a power of two, from 1/x, which is computed once.

        Derivatives of 1/|q| ask for both, and a division takes as long as ten products.
        """
        x = entries[-1]
        if not is_array(x):
            return None
        if name == "integer_pow":
            power = -params["y"]
        else:
            power = 1 if _is_power_of_two(entries[0]) else 0
        if power < 1:
            return None
        if id(x) not in self._reciprocals:
            self._reciprocals[id(x)] = x, apply(lax.div, [ONE, x], [dtype] * 2)
        _, reciprocal = self._reciprocals[id(x)]
        if power > 1:
            return lax.integer_pow(reciprocal, power)
        if name == "div" and entries[0] is not ONE and entries[0] != 1:
            return apply(lax.mul, [entries[0], reciprocal], [dtype] * 2)
        return reciprocal

    def _multiple(self, factor: Entry, x: Entry, dtype: Any) -> Entry | None:
        """s·(c·x) = (s c)·x, for s the same on all lanes."""
        if _on_lanes(factor) or not _on_lanes(x):
            return None
        if id(x) in self._multiples:
            _, c, base = self._multiples[id(x)]
            both = _scalar(lax.mul, np.multiply, factor, c, dtype)
            if is_array(both) or _is_normal(both, dtype):
                factor, x = both, base
        is_minus_one = not is_array(factor) and number(factor, dtype) == -1
        result = lax.neg(x) if is_minus_one else apply(lax.mul, [factor, x], [dtype] * 2)
        self._multiples[id(result)] = result, factor, x
        return result

    def _sum(self, a: Entry, b: Entry, dtype: Any) -> Entry | None:
        """b·x + c·x = (b + c)·x, as in a force −x and a weak one, −εx, beside it."""
        known = self._multiples
        if not (id(a) in known or id(b) in known):
            return None
        one = np.asarray(1, dtype)[()]
        (_, b_of_x, x), (_, c_of_x, same) = (known.get(id(e), (e, one, e)) for e in (a, b))
        if x is not same:
            return None
        return self._multiple(_scalar(lax.add, np.add, b_of_x, c_of_x, dtype), x, dtype)


def _on_lanes(entry: Entry) -> bool:
    return is_array(entry) and entry.ndim > 0


def _scalar(of_arrays: Any, of_numbers: Any, a: Entry, b: Entry, dtype: Any) -> Entry:
    """A sum or product of two numbers that are the same on all lanes."""
    if is_array(a) or is_array(b):
        return apply(of_arrays, [a, b], [dtype] * 2)
    with np.errstate(all="ignore"):
        return of_numbers(number(a, dtype), number(b, dtype))


def _is_normal(x: Any, dtype: Any) -> bool:
    return bool(np.finfo(dtype).tiny <= abs(x) < np.inf)


def _is_power_of_two(entry: Entry) -> bool:
    """Whether a product with the entry is exact."""
    return not is_array(entry) and abs(np.frexp(number(entry, np.float64))[0]) == 0.5
