"""Pictures of states: phase portraits, orbits in the plane and in space."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.ticker import MaxNLocator

from ..base.checks import positive, whole
from . import axes as draw, states
from .axes import canvas, check_shapes, entry, labels_of, legend, stack
from .states import Lane, Looks, index_label, lanes_of, looks_of, one_shape, place_in, troubles
from .style import COLOURS, CROSS, DASHES, MARKS, STAR, START, in_style, look_of, with_unit

_PANELS, _MARKS, _MESH, _NARROW = 6, 9, 161, 0.45
"""Largest number of panels without a selection; markers along a line; points of a side of the mesh
of a Hamiltonian; shortest side of a box in space, relative to the longest."""


@in_style
def phase_portrait(
    orbits: Any,
    dof: Any = None,
    hamiltonian: Callable[..., Any] | None = None,
    levels: int | Sequence[float] = 12,
    period: float | None = None,
    dots: bool = False,
    **options: Any,
) -> Any:
    """Momenta over positions, one panel for each degree of freedom.

    - `orbits`: a `Solution`, of one run or of a batch, the arrays (ts, qs, ps), of shapes (..., S)
      and (..., S, *shape), or a list of these.
    - `dof`: number of a degree of freedom from 0, of bodies (body, coordinate); or a list of them.
      None: all, up to six. Labels count from 1, as is usual in mechanics.
    - `hamiltonian`: function ``(q, p)`` → number of one state, whose level lines are drawn behind
      the orbits; the other degrees of freedom stay at the first initial condition. `levels`: how
      many, or which.
    - `period`: of q as an angle, which is drawn from −period/2 to period/2.
    - `dots`: draw the states alone, without a line between them.
    - `labels`, `colour`, `colour_label`, `units` (of "q" and "p"), `title`, `ax` (one `Axes` for
      each panel): as for all pictures.

    Circles are initial states; crosses mark early ends of orbits, with the reason in the legend.
    Up to seven orbits also differ by markers, because dashes overlap where an orbit retraces
    itself.

    **Returns** the `Axes`, an array of them for a list or for several degrees of freedom.
    **Raises** `TypeError` for input without orbits, `ValueError` for shapes and components that do
    not fit.
    """
    look = look_of(options)
    lanes = lanes_of(orbits, look.labels)
    planes = _planes(one_shape(lanes), dof)
    count = len(planes)
    looks = looks_of(len(lanes), look.colour)
    columns, height = min(3, count), 4.0 if count <= 3 else 6.8
    size = (5.2, 4.4) if count == 1 else (1.2 + 3.4 * columns, height)
    axes, new = stack(look.ax, count, "one for each degree of freedom", size, columns)
    for axis, plane in zip(axes, planes, strict=True):
        for i, lane in enumerate(lanes):
            q, p = plane.coordinates_of(lane)
            _draw_orbit(axis, lane, _fold(q, p, period), looks, i, dots)
        plane.name_axes(axis, look.units)
        if period is not None:
            axis.set_xlim(-period / 2, period / 2)
            if math.isclose(period, 2 * math.pi):
                axis.set_xticks(np.arange(-2, 3) * math.pi / 2, ["−π", "−π/2", "0", "π/2", "π"])
        if hamiltonian is not None:
            states.check_of_state("hamiltonian", hamiltonian)
            _level_lines(axis, hamiltonian, lanes[0], plane.place, levels)
    entries = _entries(lanes, looks)
    if hamiltonian is not None:
        level = entry("levels of H", color="#a8a8a8", lw=0.8)
        entries.insert(int(len(lanes) <= len(COLOURS)), level)
    looks.finish(axes, look, new, entries)
    return axes[0] if count == 1 and not isinstance(dof, list) else np.asarray(axes)


def _planes(shape: tuple[int, ...], dof: Any) -> list["Plane"]:
    places = list(np.ndindex(shape))
    if dof is not None:
        selection = dof if isinstance(dof, list) else [dof]
        places = [place_in("dof", shape, index) for index in selection]
    else:
        example = "0, 1" if len(shape) == 1 else "(0, 0), (0, 1)"
        draw.at_most(_PANELS, len(places), "degrees of freedom", f"dof=[{example}]")
    draw.check_not_empty("dof", places, f"choose some of {[*np.ndindex(shape)]}")
    return [Plane(place, shape) for place in places]


def _fold(q: np.ndarray, p: np.ndarray, period: float | None) -> tuple[np.ndarray, np.ndarray]:
    """An angle within one period, with a gap where it goes round."""
    if period is None:
        return q, p
    turns = np.round(q / positive("period", period))
    round_again = np.flatnonzero(np.diff(turns) != 0) + 1
    q = np.insert(q - period * turns, round_again, np.nan)
    return q, np.insert(p.astype(float), round_again, np.nan)


def _draw_orbit(axis: Any, lane: Lane, xy: Sequence[Any], looks: Looks, i: int, dots: bool) -> None:
    """A line with a circle at its start, and a cross at its end if that came too early."""
    look, n, count = looks.line(i, 1.0), len(xy[0]), len(looks.colours)
    look["label"] = lane.label or None
    if dots:
        look |= {"ls": "none", "marker": "o", "mew": 0}
        axis.plot(*xy, ms=2.2 if n < 3000 else 0.9, rasterized=n > 5000, **look)
    else:
        # Where an orbit retraces itself its dashes overlap to a full line, and only markers
        # distinguish it in a print without colours.
        if 1 < count <= len(COLOURS) and looks.scale is None:
            marks = _spread(xy, n // _MARKS * (2 * i + 1) // (2 * count))
            look |= {"marker": MARKS[i], "marks": marks, "ms": 4.5}
        draw.path(axis, *xy, **look)
    if count <= len(COLOURS):
        axis.plot(*(x[:1] for x in xy), color=looks.colours[i], zorder=3, **START)
    if lane.trouble:
        finite = np.flatnonzero(np.logical_and.reduce([np.isfinite(x) for x in xy]))[-1:]
        axis.plot(*(x[finite] for x in xy), ls="none", zorder=4, **CROSS)


def _spread(xy: Sequence[np.ndarray], first: int) -> list[int]:
    """Places of markers along a line, each as far in the picture as possible from those before.

    Equal steps in time would put them on top of one another where an orbit retraces itself.
    """
    points = np.stack(xy)
    finite = np.flatnonzero(np.isfinite(points).all(axis=0))
    finite = finite[:: max(1, len(finite) // 2000)]
    if not finite.size:
        return []
    size = np.ptp(points[:, finite], axis=1, keepdims=True)
    points = points[:, finite] / np.where(size > 0, size, 1.0)
    places = [min(int(np.searchsorted(finite, first)), len(finite) - 1)]
    distance = np.full(len(finite), np.inf)
    while len(places) < min(_MARKS, len(finite)):
        gaps = np.linalg.norm(points - points[:, places[-1:]], axis=0)
        distance = np.minimum(distance, gaps)
        places.append(int(np.argmax(distance)))
    return finite[places].tolist()


def _entries(lanes: Sequence[Lane], looks: Looks) -> list[Any]:
    """Legend entries of a picture of orbits after their names."""
    start = [entry("start", color="#444444", **START)] if len(lanes) <= len(COLOURS) else []
    return start + looks.entries + troubles(lanes)


def _level_lines(axis: Any, energy: Any, lane: Lane, place: tuple[int, ...], levels: Any) -> None:
    """Level lines over the whole panel, after the orbits have set its limits."""
    x, y = (np.linspace(low, high, _MESH) for low, high in (axis.get_xlim(), axis.get_ylim()))
    assert lane.ps is not None
    q, p = (jnp.asarray(state[0], float) for state in (lane.qs, lane.ps))

    def value(a, b):
        return energy(q.at[place].set(a), p.at[place].set(b))

    H = np.asarray(jax.jit(jax.vmap(jax.vmap(value, (0, None)), (None, 0)))(x, y))
    rule = "hamiltonian(q, p) must return one number"
    check_shapes(H.shape == (_MESH, _MESH), rule, hamiltonian=H[0, 0])
    axis.autoscale(False)
    if np.isfinite(H).any():
        look: dict[str, Any] = {"colors": "#a8a8a8", "linewidths": 0.7, "linestyles": "-"}
        axis.contour(x, y, np.ma.masked_invalid(H), levels, zorder=0.9, **look)


@in_style
def orbit(
    orbits: Any,
    coordinates: tuple[int, ...] | None = None,
    bodies: Sequence[int] | None = None,
    centre: Any = None,
    names: Sequence[str] | None = None,
    dots: bool = False,
    **options: Any,
) -> Any:
    """Orbits in the plane or in space, with equal scales on all axes.

    - `orbits`: a `Solution`, of one run or of a batch, the arrays (ts, qs), of shapes (..., S) and
      (..., S, n) or (..., S, bodies, dim), or a list of these.
    - `coordinates`: two or three numbers of coordinates from 0; None: all.
    - `bodies`: numbers of those that are drawn; None: all. `names`: one for each of these, of a
      single orbit; `labels` name the orbits of a batch.
    - `centre`: number of the body that is the origin, marked by a star; or a point, shape (dim,),
      that is marked. None: no mark.
    - `dots`: draw the states alone, without a line between them.
    - `labels`, `colour`, `colour_label`, `units` (of "q"), `title`, `ax` (with ``projection="3d"``
      for three coordinates): as for all pictures. Colours distinguish the orbits of a batch, or the
      bodies of one orbit.

    Circles are initial states; crosses mark early ends of orbits, with the reason in the legend.

    **Returns** the `Axes`. **Raises** `TypeError` for input without orbits, `ValueError` for one
    coordinate, for bodies and coordinates that do not exist, for names in a batch, and for axes of
    another dimension.
    """
    look = look_of(options)
    lanes = lanes_of(orbits, look.labels, momenta=False)
    view = view_of(lanes, coordinates, bodies, centre, names)
    if look.colour is not None and len(lanes) == 1:
        raise ValueError("colour requires several orbits, got one: leave colour out.")
    looks = looks_of(len(lanes) if len(lanes) > 1 else len(view.bodies), look.colour)
    axis, new = canvas(look.ax, (5.4, 5.0), len(view.coordinates) == 3)
    for i, k, number, name in view.lines(lanes):
        lane = lanes[i]._replace(label=name)
        _draw_orbit(axis, lane, view.coordinates_of(lane, k), looks, number, dots)
    if view.mark is not None:
        axis.plot(*([x] for x in view.mark), label=view.mark_name, **STAR)
    view.name_axes(axis, look.units)
    looks.finish([axis], look, new, _entries(lanes, looks))
    return axis


class Plane(NamedTuple):
    """The position and the momentum of one degree of freedom as coordinates of a picture."""

    place: tuple[int, ...]
    shape: tuple[int, ...]
    coordinates: tuple[int, ...] = (0, 1)
    mark: None = None

    def coordinates_of(self, lane: Lane, k: int = 0) -> Any:
        """(q, p) along an orbit, shape (S,) each."""
        states.check_momenta([lane])
        assert lane.ps is not None
        return [x[(slice(None), *self.place)] for x in (lane.qs, lane.ps)]

    def lines(self, lanes: Sequence[Lane]) -> Iterator[tuple[int, int, int, str]]:
        """As `View.lines`."""
        return ((i, 0, i, lane.label) for i, lane in enumerate(lanes))

    def name_axes(self, axis: Any, units: Mapping[str, str]) -> None:
        for letter, name in (("x", "q"), ("y", "p")):
            label = with_unit(index_label(name, self.place, self.shape), units.get(name))
            axis.set(**{f"{letter}label": label})


class View(NamedTuple):
    """Which coordinates of which bodies are drawn, relative to which point.

    `has_bodies`: whether a state has bodies; `origin`: number of the body at the origin, or None;
    `mark`: the point that has a star, or None.
    """

    coordinates: tuple[int, ...]
    bodies: list[int]
    names: list[str]
    has_bodies: bool
    origin: int | None = None
    mark: np.ndarray | None = None
    mark_name: str = "centre"

    def coordinates_of(self, lane: Lane, k: int) -> list[np.ndarray]:
        """Coordinates of drawn body number k, shape (S,) each."""
        x = lane.qs[:, self.bodies[k]] if self.has_bodies else lane.qs
        if self.origin is not None:
            x = x - lane.qs[:, self.origin]
        return [x[:, c] for c in self.coordinates]

    def lines(self, lanes: Sequence[Lane]) -> Iterator[tuple[int, int, int, str]]:
        """(number of the orbit, of the drawn body, of the colour; name) of every line."""
        is_batch = len(lanes) > 1  # then a colour is an orbit, else a body
        for i, k in np.ndindex(len(lanes), len(self.bodies)):
            yield i, k, i if is_batch else k, self.names[k] or (lanes[i].label if k == 0 else "")

    def name_axes(self, axis: Any, units: Mapping[str, str]) -> None:
        """Set the names of the axes, and one scale for all."""
        for letter, c in zip("xyz", self.coordinates, strict=False):
            name = "xyz"[c] if self.has_bodies else index_label("q", (c,), (2,))
            if self.origin is not None:
                name += f" − {name}$_{{{self.origin + 1}}}$"
            axis.set(**{f"{letter}label": with_unit(name, units.get("q"))})
        if len(self.coordinates) == 2:
            axis.set_aspect("equal", adjustable="datalim")
            return
        # In space the box is widened about an orbit that is much narrower than long.
        limits = np.asarray([axis.get_xlim(), axis.get_ylim(), axis.get_zlim()])
        wide = np.ptp(limits, axis=1)
        sides = np.maximum(wide, _NARROW * wide.max())
        for letter, middle, side in zip("xyz", limits.mean(1), sides, strict=True):
            axis.set(**{f"{letter}lim": (middle - side / 2, middle + side / 2)})
            bins = int(np.clip(round(6 * side / wide.max()), 3, 6))
            getattr(axis, f"{letter}axis").set_major_locator(MaxNLocator(bins))
        # A smaller box, so that the labels fit into the figure.
        axis.set_box_aspect(sides, zoom=0.84)
        axis.zaxis.labelpad = 9


def view_of(
    lanes: Any, coordinates: Any = None, bodies: Any = None, centre: Any = None, names: Any = None
) -> View:
    """The checked choice of what is drawn of orbits."""
    shape = one_shape(lanes)
    if names is not None and (len(lanes) > 1 or math.prod(shape) == 1):
        cause = f"{len(lanes)} orbits" if len(lanes) > 1 else f"states of shape {shape}"
        raise ValueError(
            f"names requires one orbit with several coordinates, got {cause}: use labels=[...]."
        )
    rule = "the states of orbits must have shape (n,) or (bodies, dim)"
    check_shapes(len(shape) in (1, 2), rule, state=lanes[0].qs[0])
    has_bodies, dim, count = len(shape) == 2, shape[-1], shape[0] if len(shape) == 2 else 1
    axes = tuple(states.selected_numbers("coordinates", coordinates, dim))
    if len(axes) not in (2, 3):
        remedy = "use coordinates=(0, 1)" if dim > 1 else "use phase_portrait"
        raise ValueError(f"coordinates must select two or three, got {len(axes)}: {remedy}.")
    numbers = states.selected_numbers("bodies", bodies, count)
    view = View(axes, numbers, [], has_bodies)
    if isinstance(centre, int | np.integer) and has_bodies:
        origin = whole("centre", centre, 0, count - 1)
        name = f"body {origin + 1}"
        view = view._replace(origin=origin, mark=np.zeros(len(axes)), mark_name=name)
        numbers = [b for b in numbers if b != origin] if bodies is None else numbers
    elif centre is not None:
        point = np.asarray(centre, float)
        body = f"the number of a body (0 to {count - 1}) or " if has_bodies else ""
        rule = f"centre must be {body}a point of shape {(dim,)}"
        check_shapes(point.shape == (dim,), rule, centre=point)
        view = view._replace(mark=point[list(axes)])
    return view._replace(bodies=numbers, names=labels_of(names, len(numbers), "bodies", "names"))


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
    """A plot of a trajectory: phase portrait, orbit or time series, by the shape of its states.

    One degree of freedom: (q, p). Two, or bodies in the plane or in space: orbits in the first
    two coordinates. More: every position against time.

    - `ts`: a `Solution` of one run; or times, shape (S,), with `qs`, `ps`: shape (S, n) or
      (S, bodies, dim).
    - `time`: label of its axis; `position`, `momentum`: units or None.

    **Returns** the `Axes`.
    """
    lanes = lanes_of(ts if qs is None else (ts, qs, ps))
    if len(lanes) > 1:
        raise ValueError(f"ts must be a single orbit, got {len(lanes)}: use orbit.")
    t, q, p = lanes[0][:3]
    assert p is not None
    units, shape = {"q": position or "", "p": momentum or ""}, q.shape[1:]
    if math.prod(shape) == 1:
        arrays = t, q.reshape(-1, 1), p.reshape(-1, 1)
        return phase_portrait(arrays, dots=True, units=units, title=title, ax=ax)
    if shape == (2,) or (len(shape) == 2 and shape[-1] in (2, 3)):
        return orbit((t, q), (0, 1), units=units, title=title, ax=ax)
    axis, new = canvas(ax, (6.4, 4.2))
    flat = q.reshape(len(t), -1)
    for i, values in enumerate(flat.T):
        look: Any = {"color": COLOURS[i % len(COLOURS)], "ls": DASHES[i % len(DASHES)]}
        label = f"q$_{{{i + 1}}}$" if flat.shape[1] <= 12 else None
        draw.path(axis, t, values, lw=1, label=label, **look)
    axis.set(xlabel=time, ylabel=with_unit("q", position), title=title)
    legend(axis, new, troubles(lanes))
    return axis
