"""Input of the pictures: trajectories, their components, colours and failures."""

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from .._checks import whole
from .axes import check_shapes, counted, interval, labels_of
from .style import COLOURS, CROSS, DASHES, PALE, SHADES, named

_GOOD = ("", "successful", "stopped")


class Lane(NamedTuple):
    """One orbit.

    - `ts`: shape (S,). `qs`, `ps`: shape (S, *shape); no `ps` if none were given.
    - `status`: how it ended, "" if that is not known. `label`: its name, or "".
    """

    ts: np.ndarray
    qs: np.ndarray
    ps: np.ndarray | None
    status: str
    label: str

    @property
    def shape(self) -> tuple[int, ...]:
        return self.qs.shape[1:]

    @property
    def there(self) -> np.ndarray:
        """Where there is a state, shape (S,)."""
        parts = [x.reshape(len(x), -1) for x in (self.ts, self.qs, self.ps) if x is not None]
        return np.all(np.isfinite(np.hstack(parts)), axis=1)

    @property
    def ended(self) -> int:
        """Place of the last state there is, −1 if there is none."""
        there = np.flatnonzero(self.there)
        return int(there[-1]) if there.size else -1

    def plane(self, place: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
        """Position and momentum of one degree of freedom, shape (S,) each."""
        assert self.ps is not None
        return self.qs[(slice(None), *place)], self.ps[(slice(None), *place)]

    @property
    def trouble(self) -> str:
        """Why it has no states to the end, "" if it has."""
        if self.status not in _GOOD:
            return self.status
        if not self.there.all():
            return self.status if self.status == "stopped" else "not finite"
        return ""


def lanes_of(orbits: Any, labels: Sequence[str] | None = None, momenta: bool = True) -> list[Lane]:
    """Every orbit of what a picture was given.

    - `orbits`: a `Solution`, of one run or of a batch (any axes in front), anything else with `ts`,
      `qs`, `ps`; the tuple (ts, qs, ps) or (ts, qs) of arrays, of which qs has the axes of ts in
      front; or a list of these.

    **Raises** `TypeError` for anything else and for missing momenta; `ValueError` for shapes that
    do not fit one another and another number of `labels`.
    """
    several = orbits if isinstance(orbits, list) else [orbits]
    lanes = [lane for one in several for lane in _lanes_of_one(one)]
    if not lanes:
        raise ValueError("there is no orbit to draw: the list or the batch is empty.")
    if momenta and any(lane.ps is None for lane in lanes):
        raise TypeError("this picture needs momenta: a Solution, or the arrays (ts, qs, ps).")
    names = labels_of(labels, len(lanes), "orbits")
    return [lane._replace(label=name) for lane, name in zip(lanes, names, strict=True)]


def _lanes_of_one(one: Any) -> list[Lane]:
    if hasattr(one, "ts") and hasattr(one, "qs"):
        given = [one.ts, one.qs, getattr(one, "ps", None)]
    elif isinstance(one, tuple) and len(one) in (2, 3):
        given = list(one)
    else:
        raise TypeError(
            "orbits must be a Solution, the arrays (ts, qs, ps), or a list of either, got "
            f"{type(one).__name__}."
        )
    ts, *states = (np.asarray(x) for x in given if x is not None)
    if bad := [x.dtype for x in (ts, *states) if x.dtype.kind not in "iuf"]:
        raise TypeError(f"orbits must be real numbers, got an array of {bad[0]}.")
    if ts.ndim and states[0].shape == ts.shape:  # a state that is one number
        states = [x[..., None] for x in states]
    fits = all(x.shape[: ts.ndim] == ts.shape and x.ndim > ts.ndim for x in states)
    wanted = (
        "orbits must be ts of shape (..., S), qs and ps of shape (..., S, n) or (..., S, bodies, "
        "dim), with the same axes in front (times that a batch shares: np.broadcast_to(ts, "
        "(batch, S)))"
    )
    fits = fits and ts.ndim and ts.shape[-1] and len({x.shape for x in states}) == 1
    check_shapes(fits, wanted, ts=ts, **dict(zip(("qs", "ps"), states, strict=False)))
    lead, last = ts.shape[:-1], (math.prod(ts.shape[:-1]), ts.shape[-1])
    names = np.broadcast_to(np.asarray(getattr(one, "status", ""), object), lead).ravel()
    qs, ps = [
        *(x.reshape(*last, *x.shape[ts.ndim :]) for x in states),
        np.full(last[0], None),
    ][:2]
    return [
        Lane(t, q, p, str(name), "")
        for t, q, p, name in zip(ts.reshape(last), qs, ps, names, strict=True)
    ]


# --- components ---------------------------------------------------------------------------------


def one_shape(lanes: Sequence[Lane]) -> tuple[int, ...]:
    """The shape of a state, refused if the orbits have different ones."""
    shapes = sorted({lane.shape for lane in lanes})
    if len(shapes) > 1:
        raise ValueError(f"orbits must be of one system, got states of shapes {shapes}.")
    return shapes[0]


def chosen(name: str, which: Any, count: int) -> list[int]:
    """Numbers below `count`: all of them for None."""
    numbers = range(count) if which is None else np.ravel(which).tolist()
    if not len(numbers):
        raise ValueError(f"{name} is empty: choose at least one, from 0 to {count - 1}.")
    return [whole(name, i, 0, count - 1) for i in numbers]


def place_in(shape: tuple[int, ...], index: Any) -> tuple[int, ...]:
    """A component of a state as a tuple of numbers from 0.

    **Raises** `ValueError` for one that is not there.
    """
    place = index if isinstance(index, tuple) else (index,)
    fits = len(place) == len(shape) and all(isinstance(i, int | np.integer) for i in place)
    if not fits or not all(-n <= i < n for i, n in zip(place, shape, strict=True)):
        wanted = "one number" if len(shape) == 1 else f"a tuple of {len(shape)} numbers"
        most = ", ".join(str(n - 1) for n in shape)
        raise ValueError(
            f"a state of shape {shape} has no component {index!r}; take {wanted} from 0 to {most}."
        )
    return tuple(int(i) % n for i, n in zip(place, shape, strict=True))


def subscript(letter: str, place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """A component as the field writes it: counted from 1, none where there is but one."""
    if shape == (1,):
        return letter
    return f"{letter}$_{{{','.join(str(i + 1) for i in place)}}}$"


_NAME = re.compile(r"([qp])(?:\[\s*(-?\d+(?:\s*,\s*-?\d+)*)\s*\])?")


def component(
    which: Any, shape: tuple[int, ...], units: Mapping[str, str]
) -> tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], str]:
    """(function of (qs, ps), shape (N, *shape) → numbers, shape (N,); label with units).

    - `which`: "q[0]", "p[-1]", of bodies "q[0, 2]", "q" where there is but one; or a function
      ``(q, p)`` → number of one state, labelled by its name.
    """
    if callable(which):
        name = getattr(which, "__name__", "")
        return partial(each_state, which), "" if name == "<lambda>" else name.replace("_", " ")
    found = _NAME.fullmatch(which) if isinstance(which, str) else None
    if found is None or (found[2] is None and math.prod(shape) != 1):
        example = f"q[{', '.join('0' * len(shape))}]"
        raise ValueError(
            f'a component of a state of shape {shape} is one such as "{example}", or a function '
            f"(q, p) → number, got {which!r}."
        )
    letter, inside = found.groups()
    place = place_in(shape, tuple(map(int, inside.split(","))) if inside else (0,) * len(shape))
    label = named(subscript(letter, place, shape), units.get(letter))
    return lambda qs, ps: (qs if letter == "q" else ps)[(slice(None), *place)], label


def each_state(function: Callable[..., Any], qs: np.ndarray, ps: np.ndarray) -> np.ndarray:
    """A function ``(q, p)`` of every state, shape (N, ...)."""
    values = np.asarray(jax.vmap(function)(qs, ps))
    if values.dtype.kind not in "biuf":
        raise TypeError(f"a function of the state returned {values.dtype}, no real numbers.")
    return values


# --- colours and dashes of orbits -----------------------------------------------------------------


class Looks(NamedTuple):
    """Colours and dashes, one for each orbit, and the scale of their values or None."""

    colours: list[Any]
    dashes: list[Any]
    scale: ScalarMappable | None = None
    unknown: int = 0

    def line(self, i: int, width: float) -> dict[str, Any]:
        """How line number i is drawn."""
        return {"color": self.colours[i], "linestyle": self.dashes[i], "linewidth": width}

    def colour_bar(self, axes: Sequence[Any], label: str) -> None:
        """A bar of the scale of values next to the axes, if there is a scale."""
        if self.scale is not None:
            axes[0].figure.colorbar(self.scale, ax=list(axes), label=label)

    def entries(self) -> list[Line2D]:
        """Legend entry of the orbits without a value."""
        texts = counted({f"of {len(self.colours)} orbits have no value": self.unknown})
        return [Line2D([], [], color=PALE, label=text) for text in texts]


def looks_of(count: int, values: Any = None, limits: tuple[float, float] | None = None) -> Looks:
    """Colours of orbits: of the palette for a few, along a scale for many or for their `values`.

    - `values`: shape (count,), any axes of a batch; NaN is grey and named.
    """
    if values is None and count <= len(COLOURS):
        return Looks(list(COLOURS[:count]), list(DASHES[:count]))
    if values is None:
        return Looks([tuple(c) for c in SHADES(np.linspace(0, 1, count))], ["-"] * count)
    values = np.ravel(np.asarray(values, float))
    if len(values) != count:
        raise ValueError(f"colour has {len(values)} values for {count} orbits: give one for each.")
    known = np.isfinite(values)
    scale = ScalarMappable(Normalize(*interval(values, limits)[:2]), SHADES)
    shades = [tuple(scale.to_rgba(v)) if k else PALE for v, k in zip(values, known, strict=True)]
    return Looks(shades, ["-"] * count, scale, int(np.sum(~known)))


def troubles(lanes: Sequence[Lane]) -> list[Line2D]:
    """Legend entries of orbits without states to the end, a cross for each reason."""
    texts = []
    for reason, count in Counter(lane.trouble for lane in lanes if lane.trouble).items():
        who = "" if len(lanes) == 1 else f"{count} of {len(lanes)} orbits "
        texts.append(f"{who}{'' if reason == 'stopped' else 'failed: '}{reason.replace('_', ' ')}")
    return [Line2D([], [], linestyle="none", label=text, **CROSS) for text in texts]
