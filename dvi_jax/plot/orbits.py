"""Pictures of states: phase portraits, orbits in the plane and in space."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from .axes import canvas, legend, path, stack
from .states import Lane, Looks, cross, lanes_of, looks_of, one_shape, place_in, subscript, troubles
from .style import COLOURS, CROSS, DASHES, MARKS, STAR, START, in_style, named

_PANELS = 6
"""Largest number of degrees of freedom that are drawn without a selection."""

_MARKS = 9
"""Number of markers along a line, which distinguish it from others."""

_NARROW = 0.45
"""Shortest side of a box in space, relative to the longest."""

_MESH = 161
"""Points of a side of the mesh on which a Hamiltonian is drawn."""


@in_style
def phase_portrait(
    orbits: Any,
    dof: Any = None,
    hamiltonian: Callable[..., Any] | None = None,
    levels: int | Sequence[float] = 12,
    period: float | None = None,
    dots: bool = False,
    labels: Sequence[str] | None = None,
    colour: Any = None,
    colour_label: str = "",
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Momenta over positions, one panel for each degree of freedom.

    - `orbits`: a `Solution`, of one run or of a batch, the arrays (ts, qs, ps), of shapes (..., S)
      and (..., S, *shape), or a list of these.
    - `dof`: number of a degree of freedom from 0, of bodies (body, coordinate); or a list of them.
      None: all, up to six. Labels count from 1, as the field does.
    - `hamiltonian`: function ``(q, p)`` → number of one state, whose level lines are drawn behind
      the orbits; the other degrees of freedom stay at the first start. `levels`: how many, or
      which.
    - `period`: of q as an angle, which is drawn from −period/2 to period/2.
    - `dots`: the states alone, without a line between them.
    - `labels`: one name for each orbit. `colour`: a number for each, shown by a bar with
      `colour_label`; NaN is grey.
    - `units`: of "q" and "p". `ax`: where to draw, one `Axes` for each panel.

    Circles are initial states; crosses mark early ends of orbits, with the reason in the legend.
    Up to seven orbits have marks along them, as dashes run into one another where an orbit retraces
    itself.

    **Returns** the `Axes`, an array of them for a list or for several degrees of freedom.

    **Raises** `TypeError` for what are no orbits, `ValueError` for shapes and components that do
    not fit.
    """
    what = "phase_portrait"
    lanes = lanes_of(orbits, what, labels)
    shape, units = one_shape(lanes, what), units or {}
    places = _places(shape, dof, what)
    looks = looks_of(len(lanes), colour)
    columns, height = min(3, len(places)), 4.0 if len(places) <= 3 else 6.8
    size = (5.2, 4.4) if len(places) == 1 else (1.2 + 3.4 * columns, height)
    axes, new = stack(ax, len(places), "one for each degree of freedom", size, ncols=columns)
    for axis, place in zip(axes, places, strict=True):
        at = (slice(None), *place)
        for i, lane in enumerate(lanes):
            assert lane.ps is not None
            q, p = lane.qs[at], lane.ps[at]
            _draw_orbit(axis, lane, _folded(q, p, period), looks, i, dots)
        label_plane(axis, place, shape, units)
        if period is not None:
            axis.set_xlim(-period / 2, period / 2)
            if math.isclose(period, 2 * math.pi):
                quarters = np.arange(-2, 3)
                axis.set_xticks(quarters * math.pi / 2, ["−π", "−π/2", "0", "π/2", "π"])
        if hamiltonian is not None:
            _level_lines(axis, hamiltonian, lanes[0], place, levels)
    axes[0].set_title(title)
    _finish(axes, lanes, looks, colour_label, new, hamiltonian is not None)
    single = len(axes) == 1 and not isinstance(dof, list)
    return axes[0] if single else np.asarray(axes)


def label_plane(axis: Any, place: Any, shape: tuple[int, ...], units: Mapping[str, str]) -> None:
    """Names of the axes of one degree of freedom, q and p."""
    axis.set_xlabel(named(subscript("q", place, shape), units.get("q")))
    axis.set_ylabel(named(subscript("p", place, shape), units.get("p")))


def _places(shape: tuple[int, ...], dof: Any, what: str) -> list[tuple[int, ...]]:
    if dof is None:
        count = math.prod(shape)
        if count > _PANELS:
            raise ValueError(
                f"{what}: there are {count} degrees of freedom and room for {_PANELS} panels: name "
                f"some, dof=[{'0, 1' if len(shape) == 1 else '(0, 0), (0, 1)'}]."
            )
        return list(np.ndindex(shape))
    chosen = dof if isinstance(dof, list) else [dof]
    if not chosen:
        raise ValueError(f"{what}: dof is empty, there is nothing to draw.")
    return [place_in(shape, one, what) for one in chosen]


def _folded(q: np.ndarray, p: np.ndarray, period: float | None) -> tuple[np.ndarray, np.ndarray]:
    """An angle within one period, with a gap where it goes round."""
    if period is None:
        return q, p
    if not period > 0:
        raise ValueError(f"period must be positive, got {period!r}.")
    turns = np.round(q / period)
    round_again = np.flatnonzero(np.diff(turns) != 0) + 1
    q = np.insert(q - period * turns, round_again, np.nan)
    return q, np.insert(p.astype(float), round_again, np.nan)


def _draw_orbit(
    axis: Any, lane: Lane, xy: Sequence[np.ndarray], looks: Looks, i: int, dots: bool
) -> None:
    """A line with a circle at its start, and a cross at its end if that came too early."""
    look: dict[str, Any] = {"color": looks.colours[i], "label": lane.label or None}
    n = len(xy[0])
    if dots:
        look |= {"linestyle": "none", "marker": "o", "markeredgewidth": 0}
        size = 2.2 if n < 3000 else 0.9
        axis.plot(*xy, markersize=size, rasterized=n > 5000, **look)
    else:
        look |= {"linestyle": looks.dashes[i], "linewidth": 1.0} | _marks(looks, i, n)
        path(axis, *xy, **look)
    if len(looks.colours) <= len(COLOURS):
        axis.plot(*(x[:1] for x in xy), color=looks.colours[i], zorder=3, **START)
    if lane.trouble:
        finite = np.flatnonzero(np.logical_and.reduce([np.isfinite(x) for x in xy]))[-1:]
        axis.plot(*(x[finite] for x in xy), linestyle="none", zorder=4, **CROSS)


def _marks(looks: Looks, i: int, count: int) -> dict[str, Any]:
    """Marks along one line of several of the palette: where an orbit retraces itself its dashes
    overlap to a full line, and a print without colours would not distinguish it."""
    if not 1 < len(looks.colours) <= len(COLOURS) or looks.scale is not None:
        return {}
    step = max(1, count // _MARKS)
    first = step * (2 * i + 1) // (2 * len(looks.colours))
    return {"marker": MARKS[i], "markevery": (first, step), "markersize": 4.5}


def _finish(
    axes: Sequence[Any], lanes: Any, looks: Looks, label: str, new: bool, levels: bool = False
) -> None:
    """The bar of colours and the legend of a picture of orbits."""
    looks.colour_bar(axes, label)
    handles: list[Any] = []
    if len(lanes) <= len(COLOURS):
        handles.append(Line2D([], [], color="#444444", label="start", **START))
    if levels:
        handles.append(Line2D([], [], color="#a8a8a8", linewidth=0.8, label="levels of H"))
    handles += looks.entries()
    handles += [cross(text) for text in troubles(lanes)]
    legend(axes[0], new, handles)


def _level_lines(
    axis: Any, hamiltonian: Any, lane: Lane, place: tuple[int, ...], levels: Any
) -> None:
    """Level lines over the whole panel, as far as the orbits made it."""
    x, y = (np.linspace(low, high, _MESH) for low, high in (axis.get_xlim(), axis.get_ylim()))
    assert lane.ps is not None
    q, p = lane.qs[0].astype(float), lane.ps[0].astype(float)

    def value(a, b):
        return hamiltonian(jnp.asarray(q).at[place].set(a), jnp.asarray(p).at[place].set(b))

    H = np.asarray(jax.jit(jax.vmap(jax.vmap(value, (0, None)), (None, 0)))(x, y))
    if H.shape != (_MESH, _MESH):
        raise ValueError(
            "hamiltonian must be a function (q, p) → number of one state, it returned shape "
            f"{H.shape[2:]}."
        )
    limits = axis.get_xlim(), axis.get_ylim()
    if np.isfinite(H).any():
        look: dict[str, Any] = {"colors": "#a8a8a8", "linewidths": 0.7, "linestyles": "-"}
        axis.contour(x, y, np.ma.masked_invalid(H), levels, zorder=0.9, **look)
    axis.set(xlim=limits[0], ylim=limits[1])


# --- orbits -------------------------------------------------------------------------------------


@in_style
def orbit(
    orbits: Any,
    coordinates: tuple[int, ...] | None = None,
    bodies: Sequence[int] | None = None,
    centre: Any = None,
    names: Sequence[str] | None = None,
    dots: bool = False,
    labels: Sequence[str] | None = None,
    colour: Any = None,
    colour_label: str = "",
    units: Mapping[str, str] | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """Orbits in the plane or in space, the same scale along every axis.

    - `orbits`: a `Solution`, of one run or of a batch, the arrays (ts, qs), of shapes (..., S) and
      (..., S, n) or (..., S, bodies, dim), or a list of these.
    - `coordinates`: two or three numbers of coordinates from 0; None: all, if they are two or
      three.
    - `bodies`: numbers of those that are drawn; None: all. `names`: one for each of these, of a
      single orbit; `labels` name the orbits of a batch.
    - `centre`: number of the body that the others are drawn about, a star there; or a point, shape
      (dim,), that is marked. None: nothing is.
    - `dots`, `labels`, `colour`, `colour_label`: as for `phase_portrait`. In a batch a colour is an
      orbit, else a body.
    - `units`: of "q". `ax`: where to draw, with ``projection="3d"`` for three coordinates.

    Circles are initial states; crosses mark early ends of orbits, with the reason in the legend.

    **Returns** the `Axes`.

    **Raises** `TypeError` for what are no orbits, `ValueError` for one coordinate, for bodies and
    coordinates that are not there, for names in a batch, and for axes of another dimension.
    """
    lanes = lanes_of(orbits, "orbit", labels, momenta=False)
    shape = one_shape(lanes, "orbit")
    check_names(lanes, shape, names)
    view = view_of(shape, coordinates, bodies, centre, names)
    several = len(lanes) > 1
    looks = looks_of(len(lanes) if several else len(view.bodies), colour if several else None)
    if colour is not None and not several:
        raise ValueError("colour distinguishes orbits of a batch, and there is one orbit.")
    space = len(view.coordinates) == 3
    axis, new = canvas(ax, (5.4, 5.0), space)
    for (i, lane), (k, _) in itertools.product(enumerate(lanes), enumerate(view.bodies)):
        if not several:
            lane = lane._replace(label=view.names[k] or (lane.label if k == 0 else ""))
        elif k:
            lane = lane._replace(label="")
        _draw_orbit(axis, lane, view.of(lane.qs, k), looks, i if several else k, dots)
    if view.mark is not None:
        axis.plot(*([x] for x in view.mark), label=view.mark_name, **STAR)
    label_view(axis, view, units or {})
    axis.set_title(title)
    _finish([axis], lanes, looks, colour_label, new)
    return axis


class View(NamedTuple):
    """Which coordinates of which bodies are drawn, relative to which point.

    - `many`: whether a state has bodies. `about`: number of the body at the origin, or None.
    - `mark`: the point that has a star, or None, and `mark_name`: its name in the legend.
    """

    coordinates: tuple[int, ...]
    bodies: list[int]
    names: list[str]
    many: bool
    about: int | None
    mark: np.ndarray | None
    mark_name: str

    def of(self, qs: np.ndarray, k: int) -> list[np.ndarray]:
        """Coordinates of drawn body number k, shape (S,) each."""
        x = qs[:, self.bodies[k]] if self.many else qs
        if self.about is not None:
            x = x - qs[:, self.about]
        return [x[:, c] for c in self.coordinates]


def view_of(shape: tuple[int, ...], coordinates: Any, bodies: Any, centre: Any, names: Any) -> View:
    """The checked choice of what is drawn of states of a shape."""
    if len(shape) not in (1, 2):
        raise ValueError(f"orbit draws states of shape (n,) or (bodies, dim), got {shape}.")
    many, count = len(shape) == 2, shape[0] if len(shape) == 2 else 1
    coordinates = _coordinates(shape[-1], coordinates)
    chosen = list(range(count)) if bodies is None else [int(b) for b in bodies]
    if not chosen or not all(0 <= b < count for b in chosen):
        raise ValueError(f"bodies must be numbers from 0 to {count - 1}, got {bodies!r}.")
    about, mark, mark_name = None, None, "centre"
    if isinstance(centre, int | np.integer) and not isinstance(centre, bool):
        if not many or not 0 <= centre < count:
            raise ValueError(f"centre is no body of a state of shape {shape}: got {centre!r}.")
        about, mark, mark_name = int(centre), np.zeros(len(coordinates)), f"body {centre + 1}"
        if bodies is None:
            chosen = [b for b in chosen if b != about]
    elif centre is not None:
        point = np.asarray(centre, float)
        if point.shape != shape[-1:]:
            raise ValueError(
                f"centre must be the number of a body or a point of shape {shape[-1:]}, got shape "
                f"{point.shape}."
            )
        mark = point[list(coordinates)]
    if names is not None and (isinstance(names, str) or len(names) != len(chosen)):
        raise ValueError(f"names has {len(names)} entries for {len(chosen)} bodies.")
    names = [*(names or [""] * len(chosen))]
    return View(coordinates, chosen, names, many, about, mark, mark_name)


def _coordinates(dim: int, chosen: Any) -> tuple[int, ...]:
    """Two or three numbers of coordinates, all of them for None."""
    if chosen is None and dim not in (2, 3):
        other = "phase_portrait draws it" if dim == 1 else "name some, coordinates=(0, 1)"
        raise ValueError(f"an orbit has two or three coordinates, there are {dim}: {other}.")
    found = tuple(range(dim) if chosen is None else chosen)
    fits = all(isinstance(c, int | np.integer) and 0 <= c < dim for c in found)
    if len(found) not in (2, 3) or not fits:
        raise ValueError(
            f"coordinates must be two or three numbers from 0 to {dim - 1}, got {found!r}."
        )
    return found


def check_names(lanes: Sequence[Lane], shape: tuple[int, ...], names: Any) -> None:
    """Refuse names of bodies where a colour is an orbit."""
    if names is not None and len(lanes) > 1:
        raise ValueError(
            f"names are of bodies of one orbit, and there are {len(lanes)} orbits, which have "
            "a colour each: name these, labels=[...], or draw one orbit."
        )
    if names is not None and math.prod(shape) == 1:
        raise ValueError("names are of bodies, and the state is one number: take labels=[...].")


def label_view(axis: Any, view: View, units: Mapping[str, str]) -> None:
    """Names of the axes, and one scale for all."""
    letters = "xyz" if view.many else None
    for which, c in zip("xyz", view.coordinates, strict=False):
        name = letters[c] if letters else subscript("q", (c,), (2,))
        if view.about is not None:
            name += f" − {name}$_{{{view.about + 1}}}$"
        getattr(axis, f"set_{which}label")(named(name, units.get("q")))
    if len(view.coordinates) == 3:
        sides = _widen(axis)
        # One scale for all axes, and a smaller box, so that the labels fit into the figure.
        axis.set_box_aspect(sides, zoom=0.84)
        axis.zaxis.labelpad = 9
    else:
        axis.set_aspect("equal", adjustable="datalim")


def _widen(axis: Any) -> list[float]:
    """Room about an orbit that is much narrower than long, for numbers; the sides of the box."""
    sides = {which: np.ptp(getattr(axis, f"get_{which}lim")()) for which in "xyz"}
    longest = max(sides.values())
    for which, side in sides.items():
        wanted = max(side, _NARROW * longest)
        middle = np.mean(getattr(axis, f"get_{which}lim")())
        getattr(axis, f"set_{which}lim")(middle - wanted / 2, middle + wanted / 2)
        bins = int(np.clip(round(6 * wanted / longest), 3, 6))
        getattr(axis, f"{which}axis").set_major_locator(MaxNLocator(bins))
    return [max(float(side), _NARROW * float(longest)) for side in sides.values()]


# --- what a run shows ---------------------------------------------------------------------------


@in_style
def trajectory(
    ts: Any,
    qs: Any = None,
    ps: Any = None,
    time: str = "t",
    position: str | None = None,
    momentum: str | None = None,
    title: str = "",
    ax: Any = None,
) -> Any:
    """A trajectory as its shape suggests.

    One degree of freedom: (q, p). Two, or bodies in the plane or in space: orbits in the first
    two coordinates. More: every position against time.

    - `ts`: a `Solution` of one run; or times, shape (S,), with `qs`, `ps`: shape (S, n) or
      (S, bodies, dim).
    - `time`: label of its axis; `position`, `momentum`: units or None. `ax`: where to draw.

    **Returns** the `Axes`.
    """
    lanes = lanes_of(ts if qs is None else (ts, qs, ps), "trajectory")
    if len(lanes) > 1:
        raise ValueError(
            f"trajectory draws one orbit, got {len(lanes)}: see phase_portrait and orbit."
        )
    (lane,) = lanes
    assert lane.ps is not None
    units = {"q": position or "", "p": momentum or ""}
    arrays, shape = (lane.ts, lane.qs, lane.ps), lane.shape
    if math.prod(shape) == 1:
        if shape != (1,):
            arrays = (lane.ts, *(x.reshape(-1, 1) for x in (lane.qs, lane.ps)))
        return phase_portrait(arrays, dots=True, units=units, title=title, ax=ax)
    if shape == (2,) or (len(shape) == 2 and shape[-1] in (2, 3)):
        return orbit(arrays[:2], (0, 1), units=units, title=title, ax=ax)
    axis, new = canvas(ax, (6.4, 4.2))
    flat = lane.qs.reshape(len(lane.ts), -1)
    for i in range(flat.shape[1]):
        look: Any = {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % len(DASHES)]}
        path(axis, lane.ts, flat[:, i], linewidth=1, label=f"q$_{{{i + 1}}}$", **look)
    axis.set(xlabel=time, ylabel=named("q", position), title=title)
    if flat.shape[1] > 12:
        for line in axis.lines:
            line.set_label(None)
    legend(axis, new, [cross(text) for text in troubles(lanes)])
    return axis
