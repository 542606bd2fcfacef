"""A ring: elements in a row, with their parameters in arrays."""

import difflib
import fnmatch
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import instance, positive, whole
from ...base.precision import require_double
from ._elements import C, Element
from ._maps import Part, distinct

Where = str | int | Sequence[int]


class Program(eqx.Module):
    """What a ring consists of, without its parameters: compared as a whole, and hashed once."""

    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    known: tuple[frozenset[str], ...] = eqx.field(static=True)
    """The parameters of each element."""
    parts: tuple[Part, ...] = eqx.field(static=True)
    """The different parts."""
    rows: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(number of the part, number of the element), in the order of passage."""


class Ring(eqx.Module):
    r"""A ring or a cell of one: elements in the order of passage.

    **Arguments** `elements`: see `drift`, `bend`, `quadrupole`, …; `energy`: of the reference
    particle [eV]; `periods`: number of such cells in the whole ring. One *turn* of tracking and of
    analysis is one passage of `elements`, as in pyAT.

    A ring is a pytree whose leaves are the parameters of its elements, so that results can be
    differentiated by them, or computed for a batch of rings: ``ring.set("QF*", b1=values)`` is the
    ring with other parameters.

    **Raises** `TypeError` for what is not an element, `ValueError` for no element, and in a process
    that computes in float32.

    **Example**

    ```python
    cell = [rings.quadrupole("QF", 0.5, k1=0.6), rings.drift("D", 2.0),
            rings.quadrupole("QD", 0.5, k1=-0.5), rings.drift("D", 2.0)]
    print(rings.optics(rings.Ring(cell, energy=1e9)).tune.round(4))
    # [0.1325 0.0634]
    ```
    """

    columns: dict[str, Array]
    """Parameter → its values, one for each element (zero where an element has no such one)."""
    extra: dict[str, Array]
    """What ε times is added to the columns; see `perturbed`."""
    program: Program = eqx.field(static=True)
    energy: float = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    def __init__(self, elements: Iterable[Element], energy: float = 1e9, periods: int = 1):
        require_double("a ring")
        elements = list(elements)
        for i, e in enumerate(elements):
            instance(f"elements[{i}]", e, Element, "an element such as rings.drift('D', 1.0)")
        if not any(e.parts for e in elements):
            raise ValueError("elements must contain an element that acts on a particle, got none.")
        self.energy = positive("energy", energy)
        self.periods = whole("periods", periods)
        parts = tuple(distinct(part for e in elements for part in e.parts))
        number = {part: i for i, part in enumerate(parts)}
        rows = [(number[part], i) for i, e in enumerate(elements) for part in e.parts]
        self.program = Program(
            tuple(e.name for e in elements),
            tuple(e.kind for e in elements),
            tuple(frozenset(e.values) for e in elements),
            parts,
            tuple(rows),
        )
        names = {name: np.shape(v) for e in elements for name, v in e.values.items()}
        columns = {
            name: np.stack([np.asarray(e.values.get(name, np.zeros(shape)), float)
                            for e in elements])
            for name, shape in sorted(names.items())
        }  # fmt: skip
        self.columns = {name: jnp.asarray(column) for name, column in columns.items()}
        self.extra = {}

    # --- elements and their parameters ------------------------------------------------------------

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the elements."""
        return self.program.names

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the elements: "drift", "quadrupole", …"""
        return self.program.kinds

    def __len__(self) -> int:
        return len(self.names)

    @property
    def places(self) -> Array:
        """s at the entrance of each element and at the end [m], shape (elements + 1,)."""
        return jnp.concatenate([jnp.zeros(1), jnp.cumsum(self.columns["length"])])

    @property
    def period(self) -> Array:
        """The time of one turn of the reference particle [s]."""
        return self.places[-1] / C

    def where(self, which: Where) -> np.ndarray:
        """The numbers of the elements whose name or kind matches a pattern such as "QF*", or
        the given numbers. **Raises** `ValueError` if no element matches."""
        if not isinstance(which, str):
            numbers = np.atleast_1d(np.asarray(which))
            if numbers.dtype.kind != "i" or (numbers >= len(self)).any() or (numbers < 0).any():
                raise ValueError(
                    f"elements must be given by a pattern of their name or by numbers from 0 to "
                    f"{len(self) - 1}, got {which!r}."
                )
            return numbers
        found = [
            i
            for i, names in enumerate(zip(self.names, self.kinds, strict=True))
            if any(fnmatch.fnmatchcase(name, which) for name in names)
        ]
        if not found:
            known = sorted({*self.names, *self.kinds})
            near = difflib.get_close_matches(which, known, 3, 0.4) or known[:8]
            raise ValueError(f"no element matches {which!r}. Names are, for example: {near}.")
        return np.asarray(found)

    def get(self, which: Where, parameter: str) -> Array:
        """The values of a parameter, one for each element of `where(which)`."""
        numbers = self._numbers(which, parameter)
        return self.columns[parameter][numbers]

    def set(self, which: Where, **values: Any) -> "Ring":
        """The ring with other parameters: one number for all elements of `where(which)`, or one
        for each of them. **Raises** `ValueError` for a parameter that an element does not have."""
        columns = dict(self.columns)
        for name, value in values.items():
            numbers, value = self._numbers(which, name), jnp.asarray(value)
            if value.ndim and len(value) != len(numbers):
                raise ValueError(
                    f"{name} must be one number or {len(numbers)} numbers, one for each element "
                    f"that matches {which!r}, got an array of shape {value.shape}."
                )
            columns[name] = columns[name].at[numbers].set(value)
        return eqx.tree_at(lambda ring: ring.columns, self, columns)

    def _numbers(self, which: Where, parameter: str) -> np.ndarray:
        numbers = self.where(which)
        for i in numbers:
            if parameter not in self.program.known[i]:
                raise ValueError(
                    f"element {i}, the {self.kinds[i]} {self.names[i]!r}, has no parameter "
                    f"{parameter!r}. Its parameters are {sorted(self.program.known[i])}; those of "
                    "a magnet with more multipoles: rings.multipole(name, length, b=[...])."
                )
        return numbers

    def perturbed(self, which: Where, *parameters: str) -> "Ring":
        """The ring in which `parameters` of the elements `where(which)` are multiplied by ε, and
        are zero in the unperturbed ring."""
        columns, extra = dict(self.columns), dict(self.extra)
        for name in parameters:
            numbers = self._numbers(which, name)
            moved = jnp.zeros_like(columns[name]).at[numbers].set(columns[name][numbers])
            extra[name] = extra.get(name, 0.0) + moved
            columns[name] = columns[name].at[numbers].set(0.0)
        return eqx.tree_at(lambda r: (r.columns, r.extra), self, (columns, extra))

    def check(self) -> None:
        """**Raises** `ValueError` for a parameter that is not finite, unless it is traced."""
        for name, column in {**self.columns, **self.extra}.items():
            if not is_traced(column):
                bad = np.argwhere(~np.isfinite(np.asarray(column)))
                if len(bad):
                    i = bad[0][0]
                    raise ValueError(
                        f"{name} of element {i}, the {self.kinds[i]} {self.names[i]!r}, must be "
                        f"finite, got {column[tuple(bad[0])]}."
                    )
