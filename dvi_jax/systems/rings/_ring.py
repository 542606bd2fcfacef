"""A ring: elements in a row, with their parameters in arrays."""

import difflib
import fnmatch
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import electronvolts, instance, whole
from ...base.inputs import real_numbers
from ...base.precision import require_double
from ...base.printing import printable, short
from ._elements import C, Element
from ._maps import RingPart, distinct

Where = str | int | Sequence[int]


READERS = {
    "length": (
        "drift", "half_drift", "exact_drift", "corrector", "solenoid", "straight", "exact_straight",
        "bend", "exact_bend", "at_exact_bend", "second_order_bend",
    ),
    "h": ("bend", "exact_bend", "at_exact_bend", "second_order_bend"),
}  # fmt: skip
"""Parameters of elements whose maps have other parts if it is zero → the parts that depend on it.
"""


class RingStructure(eqx.Module):
    """What a ring consists of, without its parameters: compared as a whole, and hashed once."""

    names: tuple[str, ...] = eqx.field(static=True)
    kinds: tuple[str, ...] = eqx.field(static=True)
    parameters: tuple[frozenset[str], ...] = eqx.field(static=True)
    """The parameters of each element."""
    parts: tuple[RingPart, ...] = eqx.field(static=True)
    """The different parts."""
    rows: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(number of the part, number of the element), in the order of passage."""


@printable
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
    program: RingStructure = eqx.field(static=True)
    energy: float = eqx.field(static=True)
    periods: int = eqx.field(static=True)

    def __init__(self, elements: Iterable[Element], energy: float = 1e9, periods: int = 1):
        require_double("a ring")
        elements = list(instance("elements", elements, Iterable, "a list of elements"))
        for i, element in enumerate(elements):
            instance(f"elements[{i}]", element, Element, "an element such as rings.drift('D', 1.0)")
        if not any(element.parts for element in elements):
            raise ValueError("elements must contain one that acts on particles, got none.")
        self.energy = electronvolts("energy of a ring", energy, 1e5)
        self.periods = whole("periods", periods)
        parts = tuple(distinct(part for element in elements for part in element.parts))
        number = {part: i for i, part in enumerate(parts)}
        rows = [(number[part], i) for i, element in enumerate(elements) for part in element.parts]
        self.program = RingStructure(
            tuple(element.name for element in elements),
            tuple(element.kind for element in elements),
            tuple(frozenset(element.values) for element in elements),
            parts,
            tuple(rows),
        )
        # In NumPy, which is faster, unless a value is traced.
        values = [x for element in elements for x in element.values.values()]
        xp = jnp if any(map(is_traced, values)) else np
        names = {name: np.shape(x) for element in elements for name, x in element.values.items()}
        names.setdefault("length", ())
        columns = {
            name: xp.stack([xp.asarray(element.values.get(name, np.zeros(shape)), float)
                            for element in elements])
            for name, shape in sorted(names.items())
        }  # fmt: skip
        self.columns = jax.device_put(columns)  # `jnp.asarray` compiles a program
        self.extra = {}

    def __str__(self) -> str:
        counts = Counter(self.kinds).most_common()
        length = "" if is_traced(self.columns["length"]) else f", {self.places[-1]:.8g} m"
        lines = [
            f"Ring of {len(self)} elements{length}, energy {self.energy:.6g} eV, "
            f"{self.periods} period{'s' * (self.periods != 1)}",
            f"  kinds: {', '.join(f'{n} {kind}' for kind, n in counts)}",
            f"  names: {short(', '.join(dict.fromkeys(self.names)))[1:-1]}",
            f"  parameters: {', '.join(self.columns)}",
        ]
        if self.extra:
            lines.append(f"  perturbed, times epsilon: {', '.join(self.extra)}")
        return "\n".join(lines)

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
    def elements(self) -> tuple[Element, ...]:
        """The elements with their parameters, at ε = 0, to make other rings of them: for example
        ``rings.Ring(ring.elements[5:] + ring.elements[:5])`` begins with element 5."""
        table = {k: x if is_traced(x) else np.asarray(x) for k, x in self.columns.items()}
        parts: list[list[RingPart]] = [[] for _ in self.names]
        for part, i in self.program.rows:
            parts[i].append(self.program.parts[part])
        rows = zip(self.names, self.kinds, parts, self.program.parameters, strict=True)
        return tuple(
            Element(name, kind, tuple(own), {k: table[k][i] for k in table if k in keys})
            for i, (name, kind, own, keys) in enumerate(rows)
        )

    @property
    def places(self) -> Array:
        """s at the entrance of each element and at the end [m], shape (elements + 1,)."""
        length = self.columns["length"]
        if is_traced(length):
            return jnp.concatenate([jnp.zeros(1), jnp.cumsum(length)])
        return jax.device_put(np.append(0.0, np.cumsum(length)))

    @property
    def period(self) -> Array:
        """The time of one turn of the reference particle [s]."""
        return self.places[-1] / C

    def where(self, selection: Where) -> np.ndarray:
        """The numbers of the elements whose name or kind matches a pattern such as "QF*", or
        the given numbers. **Raises** `ValueError` if no element matches."""
        if not isinstance(selection, str):
            numbers = np.atleast_1d(np.asarray(selection))
            if numbers.dtype.kind != "i" or (numbers >= len(self)).any() or (numbers < 0).any():
                raise ValueError(
                    f"elements must be a pattern or numbers below {len(self)}, got {selection!r}."
                )
            return numbers
        matches = [
            i
            for i, names in enumerate(zip(self.names, self.kinds, strict=True))
            if any(fnmatch.fnmatchcase(name, selection) for name in names)
        ]
        if not matches:
            labels = sorted({*self.names, *self.kinds})
            suggestions = difflib.get_close_matches(selection, labels, 3, 0.4) or labels[:8]
            raise ValueError(
                f"no element matches {selection!r}. Names are, for example, {suggestions}."
            )
        return np.asarray(matches)

    def get(self, selection: Where, parameter: str) -> Array:
        """The values of a parameter, one for each element of `where(selection)`."""
        numbers = self._numbers(selection, parameter)
        return self.columns[parameter][numbers]

    def set(self, selection: Where, **values: Any) -> "Ring":
        """The ring with other parameters: one number for all elements of `where(selection)`, or one
        for each of them. **Raises** `ValueError` for a parameter that an element does not have."""
        columns = dict(self.columns)
        for name, value in values.items():
            numbers = self._numbers(selection, name, changes=True)
            value = real_numbers(name, value)
            if value.ndim and len(value) != len(numbers):
                raise ValueError(
                    f"{name} must be one number or {len(numbers)}, one for each element that "
                    f"matches {selection!r}, got shape {value.shape}."
                )
            if is_traced(value) or is_traced(columns[name]):
                columns[name] = columns[name].at[numbers].set(value)
            else:
                column = np.array(columns[name])  # JAX would compile it
                column[numbers] = value
                columns[name] = jax.device_put(column)
        return eqx.tree_at(lambda ring: ring.columns, self, columns)

    def _label(self, i: int) -> str:
        return f"element {i}, the {self.kinds[i]} {self.names[i]!r},"

    def _numbers(self, selection: Where, parameter: str, changes: bool = False) -> np.ndarray:
        numbers = self.where(selection)
        readers = READERS.get(parameter) if changes else None
        if readers:
            part, element = np.asarray(self.program.rows).T
            reads = element[[self.program.parts[i].name in readers for i in part]]
            if len(others := np.setdiff1d(numbers, reads)):
                raise ValueError(
                    f"{self._label(others[0])} was made with {parameter} = 0, which is not a "
                    "parameter of its map: make it with the value that it has."
                )
        for i in numbers:
            if parameter not in self.program.parameters[i]:
                raise ValueError(
                    f"{self._label(i)} has no parameter {parameter!r}, only "
                    f"{sorted(self.program.parameters[i])}; `rings.multipole` has more."
                )
        return numbers

    def perturbed(self, selection: Where, *parameters: str) -> "Ring":
        """The ring in which `parameters` of the elements `where(selection)` are multiplied by ε,
        and are zero in the unperturbed ring: that of functions without an argument `epsilon`, for
        which there is `at`."""
        columns, extra = dict(self.columns), dict(self.extra)
        for name in parameters:
            numbers = self._numbers(selection, name, changes=True)
            slope = jnp.zeros_like(columns[name]).at[numbers].set(columns[name][numbers])
            extra[name] = extra.get(name, 0.0) + slope
            columns[name] = columns[name].at[numbers].set(0.0)
        return eqx.tree_at(lambda r: (r.columns, r.extra), self, (columns, extra))

    def at(self, epsilon: Any) -> "Ring":
        """The ring at ε: what `perturbed` set aside is added, times ε."""
        sums = {name: self.columns[name] + epsilon * slope for name, slope in self.extra.items()}
        return eqx.tree_at(lambda r: (r.columns, r.extra), self, ({**self.columns, **sums}, {}))

    def check(self) -> None:
        """**Raises** `ValueError` for a parameter that is not finite, unless it is traced."""
        for name, column in {**self.columns, **self.extra}.items():
            if not is_traced(column):
                bad = np.argwhere(~np.isfinite(np.asarray(column)))
                if len(bad):
                    i = bad[0][0]
                    raise ValueError(
                        f"{name} of {self._label(i)} must be finite, got {column[tuple(bad[0])]}."
                    )
