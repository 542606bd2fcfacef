"""Input of the pictures: trajectories, their components, colours and failures."""

import math
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D

from .axes import check_labels, interval
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
        parts = [self.qs] if self.ps is None else [self.qs, self.ps]
        finite = [np.isfinite(x).reshape(len(x), -1).all(1) for x in parts]
        return np.logical_and.reduce([np.isfinite(self.ts), *finite])

    @property
    def ended(self) -> int:
        """Place of the last state there is, −1 if there is none."""
        there = np.flatnonzero(self.there)
        return int(there[-1]) if there.size else -1

    @property
    def trouble(self) -> str:
        """Why it has no states to the end, "" if it has."""
        if self.status not in _GOOD:
            return self.status
        if not self.there.all():
            return self.status if self.status == "stopped" else "not finite"
        return ""


def lanes_of(
    orbits: Any, what: str, labels: Sequence[str] | None = None, momenta: bool = True
) -> list[Lane]:
    """Every orbit of what a picture was given.

    - `orbits`: a `Solution`, of one run or of a batch (any axes in front), anything else with `ts`,
      `qs`, `ps`; the tuple (ts, qs, ps) or (ts, qs) of arrays, of which qs has the axes of ts in
      front; or a list of these.

    **Raises** `TypeError` for anything else and for missing momenta; `ValueError` for shapes that
    do not fit one another and another number of `labels`.
    """
    several = orbits if isinstance(orbits, list) else [orbits]
    lanes = [lane for one in several for lane in _lanes_of_one(one, what)]
    if not lanes:
        raise ValueError(f"{what} was given no orbit: the list or the batch is empty.")
    if momenta and any(lane.ps is None for lane in lanes):
        raise TypeError(f"{what} needs momenta: a Solution, or the arrays (ts, qs, ps).")
    check_labels(labels, len(lanes), "orbits")
    if labels is None:
        return lanes
    return [lane._replace(label=str(name)) for lane, name in zip(lanes, labels, strict=True)]


def _lanes_of_one(one: Any, what: str) -> list[Lane]:
    if all(hasattr(one, name) for name in ("ts", "qs")):
        arrays = [one.ts, one.qs, getattr(one, "ps", None)]
        status = getattr(one, "status", "")
    elif isinstance(one, tuple) and len(one) in (2, 3):
        arrays, status = [*one, None][:3], ""
    else:
        raise TypeError(
            f"{what} takes a Solution, the arrays (ts, qs, ps), or a list of either, got "
            f"{type(one).__name__}."
        )
    ts, qs = (_real(x, what) for x in arrays[:2])
    ps = None if arrays[2] is None else _real(arrays[2], what)
    if ts.ndim == 0:
        raise ValueError(f"{what} needs saved times, shape (S,), got a single number.")
    if qs.shape == ts.shape:  # a state that is one number
        qs, ps = qs[..., None], None if ps is None else ps[..., None]
    _check_shapes(ts, qs, ps, what)
    lead, n = ts.shape[:-1], ts.shape[-1]
    count = math.prod(lead)
    names = np.broadcast_to(np.asarray(status, object), lead).ravel()
    shape = qs.shape[ts.ndim :]
    ts, qs = ts.reshape(count, n), qs.reshape(count, n, *shape)
    ps = None if ps is None else ps.reshape(count, n, *shape)
    return [
        Lane(ts[i], qs[i], None if ps is None else ps[i], str(names[i]), "") for i in range(count)
    ]


def _real(x: Any, what: str) -> np.ndarray:
    x = np.asarray(x)
    if x.dtype.kind not in "iuf":
        raise TypeError(f"{what} draws real numbers, got an array of {x.dtype}.")
    return x


def _check_shapes(ts: np.ndarray, qs: np.ndarray, ps: np.ndarray | None, what: str) -> None:
    if qs.shape[: ts.ndim] != ts.shape or qs.ndim == ts.ndim or ts.shape[-1] == 0:
        raise ValueError(
            f"{what} takes ts of shape (..., S) and qs of shape (..., S, n) or (..., S, bodies, "
            f"dim) with the same axes in front, got {ts.shape} and {qs.shape}. Times that a "
            "batch shares: np.broadcast_to(ts, (batch, S))."
        )
    if ps is not None and ps.shape != qs.shape:
        raise ValueError(f"{what} takes qs and ps of one shape, got {qs.shape} and {ps.shape}.")


# --- components ---------------------------------------------------------------------------------


def one_shape(lanes: Sequence[Lane], what: str) -> tuple[int, ...]:
    """The shape of a state, refused if the orbits have different ones."""
    shapes = sorted({lane.shape for lane in lanes})
    if len(shapes) > 1:
        raise ValueError(f"{what} takes orbits of one system, got states of shapes {shapes}.")
    return shapes[0]


def place_in(shape: tuple[int, ...], index: Any, what: str) -> tuple[int, ...]:
    """A component of a state as a tuple of numbers from 0.

    **Raises** `ValueError` for one that is not there.
    """
    place = (index,) if isinstance(index, int | np.integer) else index
    fits = isinstance(place, tuple) and len(place) == len(shape)
    fits = fits and all(isinstance(i, int | np.integer) for i in place)
    if not fits or not all(-n <= i < n for i, n in zip(place, shape, strict=True)):
        wanted = "one number" if len(shape) == 1 else f"a tuple of {len(shape)} numbers"
        most = ", ".join(str(n - 1) for n in shape)
        raise ValueError(
            f"{what}: a state of shape {shape} has no component {index!r}; take {wanted} from 0 to "
            f"{most}."
        )
    return tuple(int(i) % n for i, n in zip(place, shape, strict=True))


def subscript(letter: str, place: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """A component as the field writes it: counted from 1, none where there is but one."""
    if shape == (1,):
        return letter
    return f"{letter}$_{{{','.join(str(i + 1) for i in place)}}}$"


_NAME = re.compile(r"([qp])(?:\[\s*(-?\d+(?:\s*,\s*-?\d+)*)\s*\])?")


def component(
    chosen: Any, shape: tuple[int, ...], units: Mapping[str, str], what: str
) -> tuple[Callable[[np.ndarray, np.ndarray], np.ndarray], str]:
    """(function of (qs, ps), shape (N, *shape) → numbers, shape (N,); label with units).

    - `chosen`: "q[0]", "p[-1]", of bodies "q[0, 2]", "q" where there is but one; or a function
      ``(q, p)`` → number of one state, labelled by its name.
    """
    if callable(chosen):
        name = getattr(chosen, "__name__", "")
        label = "" if name == "<lambda>" else name.replace("_", " ")
        return lambda qs, ps: each_state(chosen, qs, ps, what), label
    found = _NAME.fullmatch(chosen) if isinstance(chosen, str) else None
    if found is None:
        raise ValueError(
            f'{what} draws a component such as "q[0]" or "p[1]", or a function (q, p) → number, '
            f"got {chosen!r}."
        )
    letter, inside = found.groups()
    numbers = (0,) * len(shape) if inside is None else tuple(int(i) for i in inside.split(","))
    if inside is None and math.prod(shape) != 1:
        example = f"{letter}[{', '.join('0' * len(shape))}]"
        raise ValueError(
            f'{what}: a state of shape {shape} has several "{letter}": '
            f'choose one, as in "{example}".'
        )
    place = place_in(shape, numbers, what)
    label = named(subscript(letter, place, shape), units.get(letter))
    return lambda qs, ps: (qs if letter == "q" else ps)[(slice(None), *place)], label


def each_state(
    function: Callable[..., Any], qs: np.ndarray, ps: np.ndarray, what: str
) -> np.ndarray:
    """A function ``(q, p)`` of every state, shape (N, ...)."""
    values = np.asarray(jax.vmap(function)(qs, ps))
    if values.dtype.kind not in "biuf":
        raise TypeError(f"{what}: a function returned {values.dtype}, no real numbers.")
    return values


# --- colours and dashes of orbits -----------------------------------------------------------------


class Looks(NamedTuple):
    """Colours and dashes, one for each orbit, and the scale of their values or None."""

    colours: list[Any]
    dashes: list[Any]
    scale: ScalarMappable | None
    unknown: int = 0

    def colour_bar(self, axes: Sequence[Any], label: str) -> None:
        """A bar of the scale of values next to the axes, if there is a scale."""
        if self.scale is not None:
            axes[0].figure.colorbar(self.scale, ax=list(axes), label=label)

    def entries(self) -> list[Line2D]:
        """Legend entry of the orbits without a value."""
        if not self.unknown:
            return []
        text = f"{self.unknown} of {len(self.colours)} orbits have no value"
        return [Line2D([], [], color=PALE, label=text)]


def looks_of(
    count: int, values: Any = None, limits: tuple[float, float] | None = None, what: str = "colour"
) -> Looks:
    """Colours of orbits: of the palette for a few, along a scale for many or for their `values`.

    - `values`: shape (count,), any axes of a batch; NaN is grey and named.
    """
    if values is None:
        if count <= len(COLOURS):
            return Looks(list(COLOURS[:count]), list(DASHES[:count]), None)
        shades = SHADES(np.linspace(0, 1, count))
        return Looks([tuple(c) for c in shades], ["-"] * count, None)
    values = np.ravel(np.asarray(values, float))
    if len(values) != count:
        raise ValueError(f"{what} has {len(values)} values for {count} orbits: give one for each.")
    known = np.isfinite(values)
    scale = ScalarMappable(Normalize(*interval(values, limits)[:2]), SHADES)
    shades = [tuple(scale.to_rgba(v)) if k else PALE for v, k in zip(values, known, strict=True)]
    return Looks(shades, ["-"] * count, scale, int(np.sum(~known)))


def troubles(lanes: Sequence[Lane]) -> list[str]:
    """Legend texts of orbits without states to the end, one for each reason."""
    reasons = [lane.trouble for lane in lanes]
    lines = []
    for reason in dict.fromkeys(r for r in reasons if r):
        text = reason.replace("_", " ")
        verb = "" if reason == "stopped" else "failed: "
        if len(lanes) == 1:
            lines.append(f"{verb}{text}")
        else:
            lines.append(f"{reasons.count(reason)} of {len(lanes)} orbits {verb}{text}")
    return lines


def cross(text: str) -> Line2D:
    """The entry of a legend for the places where orbits ended."""
    return Line2D([], [], linestyle="none", label=text, **CROSS)
