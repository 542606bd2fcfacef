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

from ..base.checks import known, whole
from ..base.signature import check_takes
from ..observe import OfState
from . import axes as draw
from .axes import check_shapes, counts_text, entry, labels_of, legend, scale_of
from .style import COLOURS, CROSS, DASHES, PALE, SHADES, Look, with_unit

_GOOD = ("", "successful", "stopped")


class Lane(NamedTuple):
    """One orbit: shapes (S,) and (S, *shape); its status and its name, "" if unknown."""

    ts: np.ndarray
    qs: np.ndarray
    ps: np.ndarray | None
    status: str
    label: str = ""

    @property
    def finite(self) -> np.ndarray:
        """Where there is a state, shape (S,)."""
        parts = [x.reshape(len(x), -1) for x in (self.ts, self.qs, self.ps) if x is not None]
        return np.all(np.isfinite(np.hstack(parts)), axis=1)

    @property
    def trouble(self) -> str:
        """Why it has no states to the end, "" if it has."""
        if self.status in ("", "successful") and not self.finite.all():
            return "not finite"
        return "" if self.status in _GOOD and self.finite.all() else self.status


def lanes_of(orbits: Any, labels: Sequence[str] | None = None, momenta: bool = True) -> list[Lane]:
    """Every orbit of a `Solution` or another object with `ts`, `qs`, `ps`, of a tuple of arrays
    (ts, qs, ps) or (ts, qs), or of a list of these.

    **Raises** `TypeError` for anything else and for missing momenta; `ValueError` for shapes that
    do not fit one another and another number of `labels`.
    """
    parts = orbits if isinstance(orbits, list) else [orbits]
    lanes = [lane for part in parts for lane in _lanes_of_one(part)]
    draw.check_not_empty("orbits", lanes, "give at least one orbit")
    if momenta:
        check_momenta(lanes)
    names = labels_of(labels, len(lanes), "orbits")
    return [lane._replace(label=name) for lane, name in zip(lanes, names, strict=True)]


def check_momenta(lanes: Sequence[Lane]) -> None:
    """**Raises** `TypeError` for orbits without states, or with positions alone."""
    if not lanes or any(lane.ps is None for lane in lanes):
        raise TypeError("this picture needs momenta: give each orbit as (ts, qs, ps).")


def _lanes_of_one(part: Any) -> list[Lane]:
    if hasattr(part, "ts") and hasattr(part, "qs"):
        arrays = [part.ts, part.qs, getattr(part, "ps", None)]
    elif isinstance(part, tuple) and len(part) in (2, 3):
        arrays = list(part)
    else:
        kind = type(part).__name__ + (f" of length {len(part)}" if isinstance(part, tuple) else "")
        raise TypeError(f"each orbit must be a Solution or arrays (ts, qs, ps), got {kind}.")
    ts, *states = (known("an orbit", x) for x in arrays if x is not None)
    for name, x in zip(("ts", "qs", "ps"), (ts, *states), strict=False):
        draw.check_real(f"{name} of an orbit", x, "iuf")
    if ts.ndim and states[0].shape == ts.shape:  # a state that is one number
        states = [x[..., None] for x in states]
    fits = all(x.shape[: ts.ndim] == ts.shape and x.ndim > ts.ndim for x in states)
    rule = (
        "orbits must have ts of shape (..., S), and qs and ps of shape (..., S, n) or (..., S, "
        "bodies, dim), with the same leading axes (for times that a batch shares: "
        "np.broadcast_to(ts, (batch, S)))"
    )
    fits = fits and ts.ndim and ts.shape[-1] and len({x.shape for x in states}) == 1
    check_shapes(fits, rule, ts=ts, **dict(zip(("qs", "ps"), states, strict=False)))
    lead = ts.shape[:-1]
    names = np.broadcast_to(np.asarray(getattr(part, "status", ""), object), lead)
    qs, *ps = states
    return [Lane(ts[i], qs[i], ps[0][i] if ps else None, str(names[i])) for i in np.ndindex(lead)]


def one_shape(lanes: Sequence[Lane]) -> tuple[int, ...]:
    """The shape of a state. **Raises** `ValueError` if the orbits have different ones."""
    shapes = sorted({lane.qs.shape[1:] for lane in lanes})
    if len(shapes) > 1:
        raise ValueError(f"orbits must have states of one shape, got the shapes {shapes}.")
    return shapes[0]


def selected_numbers(name: str, selection: Any, count: int) -> list[int]:
    """Numbers below `count`: all of them for None."""
    numbers = range(count) if selection is None else np.ravel(selection).tolist()
    draw.check_not_empty(name, numbers, f"choose numbers from 0 to {count - 1}")
    return [whole(name, i, 0, count - 1) for i in numbers]


def place_in(name: str, shape: tuple[int, ...], index: Any) -> tuple[int, ...]:
    """A component of a state, called `name`, from 0. **Raises** `ValueError` if invalid."""
    place = index if isinstance(index, tuple) else (index,)
    fits = len(place) == len(shape) and all(isinstance(i, int | np.integer) for i in place)
    if not fits or not all(-n <= i < n for i, n in zip(place, shape, strict=True)):
        last = tuple(n - 1 for n in shape)
        rule = f"a number from 0 to {last[0]}"
        if len(shape) != 1:
            rule = f"a tuple of {len(shape)} numbers from {(0,) * len(shape)} to {last}"
        raise ValueError(f"{name} must be {rule} for states of shape {shape}, got {index!r}.")
    return tuple(int(i) % n for i, n in zip(place, shape, strict=True))


def index_label(letter: str, place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """A component as the field writes it: counted from 1, without a number if there is only one."""
    if shape == (1,):
        return letter
    return f"{letter}$_{{{','.join(str(i + 1) for i in place)}}}$"


_NAME = re.compile(r"([qp])(?:\[\s*(-?\d+(?:\s*,\s*-?\d+)*)\s*\])?")


def component(
    coordinate: Any, shape: tuple[int, ...], units: Mapping[str, str]
) -> tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], str]:
    """(function of (qs, ps), shape (N, *shape) → numbers, shape (N,); label with units) of
    "q[0]", "q[0, 2]", "q" if there is only one; or of a function ``(q, p)`` of one state.
    """
    if callable(coordinate):
        name = getattr(coordinate, "__name__", "")
        return partial(each_state, coordinate), "" if name == "<lambda>" else name.replace("_", " ")
    match = _NAME.fullmatch(coordinate) if isinstance(coordinate, str) else None
    if match is None or (match[2] is None and math.prod(shape) != 1):
        example = f"q[{', '.join('0' * len(shape))}]"
        raise ValueError(
            f'x or y must be a component of a state of shape {shape}, such as "{example}", or a '
            f"function (q, p), got {coordinate!r}."
        )
    letter, indices = match.groups()
    index = tuple(map(int, indices.split(","))) if indices else (0,) * len(shape)
    place = place_in(f"the index in {coordinate!r}", shape, index[0] if len(index) == 1 else index)
    label = with_unit(index_label(letter, place, shape), units.get(letter))
    return lambda qs, ps: (qs if letter == "q" else ps)[(slice(None), *place)], label


def each_state(function: Callable[..., Any], qs: Any, ps: Any, name: str = "") -> np.ndarray:
    """A function ``(q, p)`` of every state, shape (N, ...); `name`: of the function, in errors."""
    name = name or f"the function {getattr(function, '__name__', type(function).__name__)}"
    check_of_state(name, function)
    values = np.asarray(jax.vmap(function)(qs, ps))
    draw.check_real(f"the results of {name}", values)
    return values


def check_of_state(name: str, function: Any) -> None:
    """**Raises** `TypeError` for a function that needs more than (q, p), such as t and args."""
    hint = "Plot the values of observe={...} of integrate, or give lambda q, p: f(t, q, p, args)."
    inner = function.function if isinstance(function, OfState) else function
    check_takes(name, inner, "(q, p)", dict.fromkeys((4, 7), hint))


class Looks(NamedTuple):
    """Colours and dashes, one for each orbit, and the scale of their values or None."""

    colours: list[Any]
    dashes: list[Any]
    scale: ScalarMappable | None = None
    without_value: int = 0

    def line(self, i: int, width: float) -> dict[str, Any]:
        """How line number i is drawn."""
        return {"color": self.colours[i], "ls": self.dashes[i], "lw": width}

    @property
    def entries(self) -> list[Any]:
        """Legend entry of the orbits without a value."""
        texts = counts_text({f"of {len(self.colours)} orbits have no value": self.without_value})
        return [entry(text, color=PALE) for text in texts]

    def finish(self, axes: Sequence[Any], look: Look, new: bool, entries: Sequence[Any]) -> Any:
        """Draw the title, the bar of the scale of values if there is one, and the legend."""
        axes[0].set_title(look.title)
        if self.scale is not None:
            axes[0].figure.colorbar(self.scale, ax=list(axes), label=look.colour_label)
        return legend(axes[0], new, entries)


def looks_of(count: int, values: Any = None, limits: tuple[float, float] | None = None) -> Looks:
    """Colours of orbits: of the palette for a few, along a scale for many or for their `values`."""
    if values is None and count <= len(COLOURS):
        return Looks(list(COLOURS[:count]), list(DASHES[:count]))
    if values is None:
        return Looks([tuple(c) for c in SHADES(np.linspace(0, 1, count))], ["-"] * count)
    values = np.ravel(np.asarray(values, float))
    rule = f"colour must have one value for each orbit or line, shape {(count,)}"
    check_shapes(len(values) == count, rule, colour=values)
    finite = np.isfinite(values)
    scale = ScalarMappable(scale_of(values, limits)[0], SHADES)
    shades = [tuple(scale.to_rgba(v)) if k else PALE for v, k in zip(values, finite, strict=True)]
    return Looks(shades, ["-"] * count, scale, int(np.sum(~finite)))


def troubles(lanes: Sequence[Lane]) -> list[Any]:
    """Legend entries of orbits without states to the end, a cross for each reason."""
    texts = []
    for reason, count in Counter(lane.trouble for lane in lanes if lane.trouble).items():
        orbits = "" if len(lanes) == 1 else f"{count} of {len(lanes)} orbits "
        verdict = "" if reason == "stopped" else "failed: "
        texts.append(f"{orbits}{verdict}{reason.replace('_', ' ')}")
    return [entry(text, ls="none", **CROSS) for text in texts]
