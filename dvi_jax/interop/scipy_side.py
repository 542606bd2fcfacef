"""A run in the manner of `scipy.integrate.solve_ivp`."""

import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from ..engine.names import both_names
from ..engine.quantities import refuse_unit_or_mask
from ..systems import Problem
from .extras import needed, system_of

_REFUSED = {
    "rtol": "steps are not chosen by an estimate of the error: the lattice is fixed, which is what "
    "keeps the invariants. Choose h, and compare with h/2",
    "atol": "steps are not chosen by an estimate of the error: the lattice is fixed, which is what "
    "keeps the invariants. Choose h, and compare with h/2",
    "max_step": "every step is h",
    "min_step": "every step is h",
    "first_step": "every step is h",
    "jac": "Jacobians of implicit steps come from autodiff",
    "jac_sparsity": "Jacobians of implicit steps come from autodiff",
    "lband": "Jacobians of implicit steps come from autodiff",
    "uband": "Jacobians of implicit steps come from autodiff",
    "vectorized": "functions are written for one state, and jax.vmap makes a batch",
    "dense_output": "there is no interpolant: ask for the times, t_eval=, and each is a step of "
    "the method",
}

_ROOM = 200
"""Crossings of an event that there is room for at first."""


class _OfVector(eqx.Module):
    """event(t, y) or event(t, y, args) as g(t, q, p, args); of one event the same at every call, so
    that a run is compiled once."""

    event: Callable[..., Any] = eqx.field(static=True)
    with_args: bool = eqx.field(static=True)

    def __call__(self, t, q, p, args):
        y = jnp.concatenate([jnp.ravel(q), jnp.ravel(p)])
        return self.event(t, y, args) if self.with_args else self.event(t, y)


class _Event(NamedTuple):
    """An event of SciPy's manner: g(t, q, p, args), how many end the run (0: none), direction."""

    g: Callable[..., Any]
    terminal: int
    direction: int


@both_names
def solve_ivp(
    system: Any,
    t_span: Any,
    y0: Any,
    method: dvi.Method | str = dvi.GaussLegendre(2),
    t_eval: Any = None,
    *,
    h: float,
    args: Any = None,
    epsilon: Any = 0.0,
    events: Any = None,
    shape: tuple[int, ...] | None = None,
    newton: dvi.RootSolver | None = None,
    **unsupported: Any,
) -> Any:
    r"""One trajectory, asked for and told as by `scipy.integrate.solve_ivp`.

        y = (q, p) in one vector,    the map of method on t0, t0 + h', …, t1,   h' = (t1 − t0)/N

    with N the smallest number of steps that are not longer than h.

    - `system`: a `System` in place of SciPy's right side; or a problem of the library, whose args
      are taken where `args` is left out.
    - `t_span`: (t0, t1); t1 < t0 runs backwards. `y0`: q0 and p0, raveled, one after the other; the
      run has its precision.
    - `method`: a `Method`, or its name in ``testing.METHODS``, such as ``"KahanLi8"``.
    - `t_eval`: times to be told, in order and within t_span; all lattice points where left out.
      Between lattice points it is the step of the method to that time.
    - `h`: the longest step [time]. `epsilon`, `args`, `newton`: as for ``dvi.integrate``.
    - `events`: one function or several, ``event(t, y)`` or ``event(t, y, args)`` → scalar, written
      with jax.numpy, with SciPy's attributes `terminal` (False, True, or a number of crossings) and
      `direction` (positive, negative, 0). Two crossings within one step are not seen, and a
      start on the surface is none. A terminal event cuts what is told, not what is computed: the
      run goes on to t1 (``dvi.Stop`` ends it).
    - `shape`: of q, where it is more than a vector: (bodies, 3); that of a problem's q0.

    **Returns** SciPy's `OptimizeResult` (the base of its OdeResult) with `t`, shape (points,); `y`,
    shape (2n, points); `t_events`, `y_events`, lists, or None without events; `status`, 0 at t1, 1
    at a terminal event, −1 for a failure; `message`, `success`; `sol` None; and ours: `h` = h',
    `num_steps`, `newton_iterations`, `solution` (the `Solution` behind it). A failure is told and
    not raised, as in SciPy: `t` and `y` end before it. There is no `nfev`: the right side is
    not a function that is called a number of times.

    **Raises** `TypeError` for arguments of SciPy's that have no meaning on a fixed lattice (rtol,
    …), each with its reason, and as ``dvi.integrate``; `ValueError` for t_span, t_eval, y0 and h
    that cannot be meant.

    **Accuracy** the order of the method in h. Values are NumPy's: nothing can be differentiated
    through it; take ``dvi.integrate`` for that.
    """
    for name in unsupported:
        reason = _REFUSED.get(name)
        raise TypeError(
            f"interop.solve_ivp takes no {name}: "
            + (
                f"{reason}."
                if reason
                else "SciPy's solve_ivp does not know it either, or it is new."
            )
        )
    for name, given in (("t_span", t_span), ("y0", y0), ("t_eval", t_eval), ("h", h)):
        refuse_unit_or_mask(name, given)
    bunch = needed("scipy.optimize", "interop.solve_ivp").OptimizeResult
    problem = system if isinstance(system, Problem) else None
    system = system_of(system, "interop.solve_ivp")
    if problem is not None:
        args = problem.args if args is None else args
        shape = np.shape(problem.q0) if shape is None else shape
    t0, t1, num_steps = _span(t_span, h)
    q0, p0 = _halves(y0, shape)
    times = _times(t_eval, t0, t1)
    found = [_event(e) for e in _several(events)]
    ahead = 1 if t1 > t0 else -1  # SciPy's direction is along the run, that of `Section` in time

    step = (t1 - t0) / num_steps
    # The last point of the lattice, t0 + N h', is a rounding beside t1: its state is that at t1.
    near = 16 * float(np.spacing(max(abs(t0), abs(t1))))
    inside = None if times is None else times[np.abs(times - t1) > near]

    def run(room: int) -> dvi.Solution:
        save = dvi.Save(final=True) if inside is not None else dvi.Save()
        if inside is not None and inside.size:
            save = dvi.Save(ts=inside)
        more: dict[str, Any] = {} if newton is None else {"newton": newton}
        return dvi.integrate(
            system, q0, p0, h=step, num_steps=num_steps, t0=t0, epsilon=epsilon,
            args=args, method=_method(method), save=save, throw=False,
            observe=[dvi.Section(e.g, ahead * e.direction, room) for e in found]
            + [dvi.Last(_end)], **more,
        )  # fmt: skip

    sol = run(_ROOM)
    most = max((int(c.count) for c in sol.observed[:-1]), default=0)
    if most > _ROOM:
        sol = run(most)
    return bunch(_told(sol, found, t0, t1, num_steps, times, inside))


def _end(t0, t1, q0, p0, q1, p1, args):
    return jnp.concatenate([jnp.ravel(q1), jnp.ravel(p1)])


def _told(
    sol: Any, events: list[_Event], t0: float, t1: float, num_steps: int, times: Any, inside: Any
) -> dict[str, Any]:
    """A run as SciPy tells it: cut at a terminal event, or before a failure."""
    *sections, last = sol.observed
    failed = not bool(sol.result == dvi.RESULTS.successful)
    t, y = np.array(sol.ts), _rows(sol.qs, sol.ps)
    if times is None:
        t[-1] = t1
    else:  # what was asked for, in its precision
        end = np.where(failed, np.nan, np.asarray(last))
        y = np.concatenate([y[: inside.size], end[None]])
        t, y = times, y[np.minimum(np.arange(times.size), inside.size)]
    crossings = [(np.asarray(c.ts), _rows(c.qs, c.ps)) for c in sections]
    crossings = [(ts[np.isfinite(ts)], ys[np.isfinite(ts)]) for ts, ys in crossings]
    sign = 1.0 if t1 > t0 else -1.0
    ends = [
        (ts[e.terminal - 1], ys[e.terminal - 1])
        for e, (ts, ys) in zip(events, crossings, strict=True)
        if 0 < e.terminal <= len(ts)
    ]
    good = np.isfinite(y).all(axis=1)
    status, message = 0, "The solver successfully reached the end of the integration interval."
    if ends:
        end, y_end = min(ends, key=lambda found: sign * found[0])
        status, message = 1, "A termination event occurred."
        before = good & (sign * t < sign * end)
        t, y = t[before], y[before]
        if times is None:
            t, y = np.append(t, end), np.concatenate([y, y_end[None]])
        elif times.size and (at_end := np.asarray(times) == end).any():
            t, y = np.append(t, times[at_end]), np.concatenate([y, y_end[None]])
        crossings = [
            (ts[sign * ts <= sign * end], ys[sign * ts <= sign * end]) for ts, ys in crossings
        ]
    elif failed:
        status, message = -1, str(dvi.RESULTS[sol.result])
        t, y = t[good], y[good]
    return {
        "t": t,
        "y": y.T,
        "sol": None,
        "t_events": [ts for ts, _ in crossings] if events else None,
        "y_events": [ys for _, ys in crossings] if events else None,
        "status": status,
        "message": message,
        "success": status >= 0,
        "h": (t1 - t0) / num_steps,
        "num_steps": num_steps,
        "newton_iterations": int(sol.stats["newton_iterations"]),
        "solution": sol,
    }


def _rows(qs: Any, ps: Any) -> np.ndarray:
    """States (q, p), one in each row."""
    return np.concatenate([np.asarray(x).reshape(len(x), -1) for x in (qs, ps)], axis=1)


def _span(t_span: Any, h: Any) -> tuple[float, float, int]:
    try:
        t0, t1 = (float(t) for t in t_span)
    except (TypeError, ValueError):
        raise ValueError(f"t_span must be two times (t0, t1), got {t_span!r}.") from None
    if not (math.isfinite(t0) and math.isfinite(t1)) or t0 == t1:
        raise ValueError(f"t_span must be two finite times that differ, got {t_span!r}.")
    try:
        h = float(h)
    except (TypeError, ValueError):
        h = math.nan if np.size(h) == 1 else h
    if not (isinstance(h, float) and math.isfinite(h) and h > 0):
        raise ValueError(
            f"h must be a positive and finite step, got {h}; the direction is that of t_span."
        )
    steps = abs(t1 - t0) / h
    return t0, t1, max(1, math.ceil(steps * (1 - 1e-12)))  # 1/0.1 is 10 steps, not 11


def _halves(y0: Any, shape: tuple[int, ...] | None) -> tuple[np.ndarray, np.ndarray]:
    y0 = np.asarray(y0)
    if y0.ndim != 1 or y0.size % 2 or y0.size == 0:
        raise ValueError(
            f"y0 must be one vector, q0 and then p0, of an even length; got shape {y0.shape}."
        )
    q0, p0 = np.split(y0, 2)
    if shape is None:
        shape = q0.shape
    elif isinstance(shape, int | np.integer):
        shape = (int(shape),)
    shape = tuple(shape)
    if math.prod(shape) != q0.size:
        raise ValueError(f"half of y0 holds {q0.size} numbers, and q has the shape {shape}.")
    return q0.reshape(shape), p0.reshape(shape)


def _times(t_eval: Any, t0: float, t1: float) -> np.ndarray | None:
    if t_eval is None:
        return None
    times = np.asarray(t_eval, float)
    if times.ndim != 1:
        raise ValueError(f"t_eval must be one-dimensional, got shape {times.shape}.")
    low, high = min(t0, t1), max(t0, t1)
    if not ((times >= low) & (times <= high)).all():
        raise ValueError(f"values in t_eval must lie within t_span, [{low}, {high}].")
    steps = np.diff(times)
    if not (steps > 0 if t1 > t0 else steps < 0).all():
        raise ValueError("values in t_eval must be in the order of the run, no two alike.")
    return times


def _method(method: Any) -> dvi.Method:
    if isinstance(method, dvi.Method):
        return method
    from ..testing import METHODS

    if isinstance(method, str) and method in METHODS:
        return METHODS[method]
    raise ValueError(
        f"method must be a dvi.Method or one of {', '.join(METHODS)}; got {method!r}. SciPy's own "
        "choose their steps and keep no structure: for those call scipy.integrate.solve_ivp on "
        "interop.vector_field."
    )


def _several(events: Any) -> list[Any]:
    if events is None:
        return []
    return list(events) if isinstance(events, list | tuple) else [events]


def _event(event: Any) -> _Event:
    if not callable(event):
        raise TypeError(f"an event must be a function event(t, y), got {event!r}.")
    direction, terminal = getattr(event, "direction", 0), getattr(event, "terminal", False)
    if isinstance(terminal, bool | type(None) | np.bool_):
        terminal = int(bool(terminal))
    if not isinstance(terminal, int | np.integer) or terminal < 0:
        raise ValueError(
            f"terminal of an event must be True, False or a number of crossings, got {terminal!r}."
        )
    with_args = _takes_args(event)
    return _Event(_OfVector(event, with_args), int(terminal), int(np.sign(direction)))


def _takes_args(event: Callable[..., Any]) -> bool:
    """Whether an event is (t, y, args). A third parameter with a default is one only if it is
    called so: ``lambda t, y, c=c: …`` keeps a value of its own there."""
    try:
        parameters = list(inspect.signature(event).parameters.values())
        inspect.signature(event).bind(0, 0, 0)
    except (TypeError, ValueError):
        return False
    third = parameters[2] if len(parameters) > 2 else parameters[-1]
    return third.default is inspect.Parameter.empty or third.name == "args"
