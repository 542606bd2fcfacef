"""One trajectory with the interface of `scipy.integrate.solve_ivp`."""

import inspect
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi

from ..base.checks import function, positive, whole
from ..base.inputs import refuse_unit_or_mask
from ..systems import Problem
from .extras import require, system_of

_JACOBIAN = "Jacobians of implicit steps are computed by autodiff. Leave this argument out"
_ESTIMATE = (
    "The size of the steps is fixed, so that the invariants are conserved. Leave this argument "
    "out, choose h, and compare the results for h and h/2 to estimate the error"
)
_REASONS = {
    **dict.fromkeys(("rtol", "atol"), _ESTIMATE),
    **dict.fromkeys(("max_step", "min_step", "first_step"), "Give the largest step size as h"),
    **dict.fromkeys(("jac", "jac_sparsity", "lband", "uband"), _JACOBIAN),
    "fun": "Give a dvi.System as the first argument",
    "vectorized": "Functions are written for one state. Use jax.vmap for a batch",
    "dense_output": "The result has no interpolant. Give the output times as t_eval",
}
"""Argument of SciPy's → why it has no meaning here."""

_ROOM = 200
"""Crossings of an event that are stored at first; with more the run is repeated."""


class _Event(eqx.Module):
    """event(t, y) or event(t, y, args) of SciPy as g(t, q, p, args).

    `terminal`: how many crossings end the run (0: none). Static fields, so that the same event at
    another call compiles nothing.
    """

    event: Callable[..., Any] = eqx.field(static=True)
    with_args: bool = eqx.field(static=True)
    terminal: int = eqx.field(static=True)
    direction: int = eqx.field(static=True)

    def __call__(self, t, q, p, args):
        y = jnp.concatenate([jnp.ravel(q), jnp.ravel(p)])
        return self.event(t, y, args) if self.with_args else self.event(t, y)


def solve_ivp(
    system: Any,
    t_span: Any,
    y0: Any,
    method: dvi.Method | str = dvi.GaussLegendre(2),
    t_eval: Any = None,
    *,
    h: float,
    args: Any = None,
    epsilon: Any = None,
    events: Any = None,
    shape: tuple[int, ...] | None = None,
    root_finder: dvi.RootSolver | None = None,
    **excess: Any,
) -> Any:
    r"""One trajectory with the arguments and the results of `scipy.integrate.solve_ivp`.

        y = (q, p) in one vector;  the times t0, t0 + h', …, t1 of the steps, with h' = (t1 − t0)/N

    where N is the smallest number of steps that are not longer than h.

    - `system`: a `System` in place of SciPy's right-hand side; or a problem of the library, whose
      own args are used if `args` is omitted.
    - `t_span`: (t0, t1); t1 < t0 runs backwards. `y0`: q0 and p0 in one vector, which determines
      the precision of the run. `shape`: of q, if q is not a vector, such as (bodies, 3).
    - `method`: a `Method`, or its name in ``testing.METHODS``, such as ``"KahanLi8"``.
    - `t_eval`: times of the output, in order and within t_span; default: the times of all steps. A
      time within a step is reached by a shorter step of the method.
    - `h`: the longest step [time]. `epsilon`, `args`, `root_finder`: as for ``dvi.integrate``.
    - `events`: one function or several, ``event(t, y)`` or ``event(t, y, args)`` → scalar, written
      with jax.numpy, with SciPy's attributes `terminal` (False, True, or a number of crossings) and
      `direction` (positive, negative, 0). Two crossings within one step are not seen, and a zero at
      t0 does not count. A terminal event truncates the output, not the computation (use
      ``dvi.Stop`` to end it).

    **Returns** SciPy's `OptimizeResult` (the base of its OdeResult) with `t`, shape (points,); `y`,
    shape (2n, points); `t_events`, `y_events`, lists, or None without events; `status`, 0 at t1, 1
    at a terminal event, −1 for a failure; `message`, `success`; `sol` None; and ours: `h` = h',
    `num_steps`, `newton_iterations`, `solution` (the `Solution`). A failure raises no error, as in
    SciPy: `t` and `y` end before it. There is no `nfev`.

    **Raises** `TypeError` for arguments of SciPy that have no meaning for equal steps (rtol, …),
    with the reason, and as ``dvi.integrate``; `ValueError` for invalid t_span, t_eval, y0 and h.

    **Accuracy** the order of the method in h. Results are NumPy arrays without derivatives; use
    ``dvi.integrate`` for gradients.
    """
    for name in excess:
        reason = _REASONS.get(name, "Check its name: SciPy's solve_ivp does not have it either")
        raise TypeError(f"interop.solve_ivp has no argument {name!r}. {reason}.")
    for name, value in (("t_span", t_span), ("y0", y0), ("t_eval", t_eval), ("h", h)):
        refuse_unit_or_mask(name, value)
    bunch = require("scipy.optimize", "interop.solve_ivp").OptimizeResult
    if isinstance(system, Problem):
        args = system.args if args is None else args
        shape = np.shape(system.q0) if shape is None else shape
    system = system_of(system)
    t0, t1, num_steps = _span(t_span, h)
    q0, p0 = _halves(y0, shape)
    times = _times(t_eval, t0, t1)
    functions = events if isinstance(events, list | tuple) else [] if events is None else [events]
    conditions = [_event(e) for e in functions]
    ahead = 1 if t1 > t0 else -1  # SciPy's direction is along the run, that of `Section` in time
    # The last point of the lattice, t0 + N h', differs from t1 by round-off: its state is that at
    # t1.
    tolerance = 16 * float(np.spacing(max(abs(t0), abs(t1))))
    inner_times = None if times is None else times[np.abs(times - t1) > tolerance]
    save = dvi.Save() if inner_times is None else dvi.Save(final=True)
    if inner_times is not None and inner_times.size:
        save = dvi.Save(ts=inner_times)
    options: dict[str, Any] = {"h": (t1 - t0) / num_steps, "num_steps": num_steps, "t0": t0}
    options |= {"epsilon": epsilon, "args": args, "method": _method(method), "save": save}
    options |= {} if root_finder is None else {"root_finder": root_finder}

    def run(crossings: int) -> dvi.Solution:
        watch = [dvi.Section(e, ahead * e.direction, crossings) for e in conditions]
        return dvi.integrate(
            system, q0, p0, observe=[*watch, dvi.Last(_end)], throw=False, **options
        )

    sol = run(_ROOM)
    count = max((int(c.count) for c in sol.observed[:-1]), default=0)
    if count > _ROOM:
        sol = run(count)
    output = {"sol": None, "h": options["h"], "num_steps": num_steps, "solution": sol}
    output["newton_iterations"] = int(sol.stats["newton_iterations"])
    return bunch(output | _output(sol, conditions, ahead, t1, times, inner_times))


def _end(t0, t1, q0, p0, q1, p1, args):
    return jnp.concatenate([jnp.ravel(q1), jnp.ravel(p1)])


def _output(
    sol: Any, events: list[_Event], sign: int, t1: float, times: Any, inner_times: Any
) -> dict[str, Any]:
    """The output in SciPy's form, truncated at a terminal event, or before a failure."""
    *sections, last = sol.observed
    has_failed = not bool(sol.result == dvi.RESULTS.successful)
    t, y = np.array(sol.ts), _rows(sol.qs, sol.ps)
    if times is None:
        t[-1] = t1
    else:  # the times that were requested, in their precision
        end = np.where(has_failed, np.nan, np.asarray(last))
        y = np.concatenate([y[: inner_times.size], end[None]])
        t, y = times, y[np.minimum(np.arange(times.size), inner_times.size)]
    crossings = [(np.asarray(c.ts), _rows(c.qs, c.ps)) for c in sections]
    crossings = [(ts[np.isfinite(ts)], ys[np.isfinite(ts)]) for ts, ys in crossings]
    ends = [
        (ts[e.terminal - 1], ys[e.terminal - 1])
        for e, (ts, ys) in zip(events, crossings, strict=True)
        if 0 < e.terminal <= len(ts)
    ]
    good = np.isfinite(y).all(axis=1)
    status, message = 0, "The solver successfully reached the end of the integration interval."
    if ends:
        end, y_end = min(ends, key=lambda pair: sign * pair[0])
        status, message = 1, "A termination event occurred."
        at_end = np.asarray([end]) if times is None else times[np.asarray(times) == end]
        early = good & (sign * t < sign * end)
        t = np.append(t[early], at_end)
        y = np.concatenate([y[early], y_end[None][: at_end.size]])
        crossings = [
            (ts[sign * ts <= sign * end], ys[sign * ts <= sign * end]) for ts, ys in crossings
        ]
    elif has_failed:
        status, message = -1, str(dvi.RESULTS[sol.result])
        t, y = t[good], y[good]
    return {
        "t": t,
        "y": y.T,
        "t_events": [ts for ts, _ in crossings] if events else None,
        "y_events": [ys for _, ys in crossings] if events else None,
        "status": status,
        "message": message,
        "success": status >= 0,
    }


def _rows(qs: Any, ps: Any) -> np.ndarray:
    """States (q, p), one in each row."""
    return np.concatenate([np.asarray(x).reshape(len(x), -1) for x in (qs, ps)], axis=1)


def _span(t_span: Any, h: Any) -> tuple[float, float, int]:
    try:
        t0, t1 = (float(t) for t in t_span)
    except (TypeError, ValueError):
        t0 = t1 = math.nan
    if not (math.isfinite(t0) and math.isfinite(t1)) or t0 == t1:
        raise ValueError(f"t_span must be two finite times (t0, t1) that differ, got {t_span!r}.")
    step = positive("h", h, hint="t_span gives the direction of time.")
    # 1/0.1 is 10 steps, not 11.
    return t0, t1, max(1, math.ceil(abs(t1 - t0) / step * (1 - 1e-12)))


def _halves(y0: Any, shape: Any) -> tuple[np.ndarray, np.ndarray]:
    y0 = np.asarray(y0)
    size = "even" if shape is None else f"twice that of q of shape {shape}"
    shape = (y0.size // 2,) if shape is None else tuple(np.ravel(shape).tolist())
    if y0.ndim != 1 or y0.size == 0 or y0.size != 2 * math.prod(shape):
        raise ValueError(
            f"y0 must be a vector with all of q0 and then all of p0, of {size} length, got shape "
            f"{y0.shape}."
        )
    q0, p0 = np.split(y0, 2)
    return q0.reshape(shape), p0.reshape(shape)


def _times(t_eval: Any, t0: float, t1: float) -> np.ndarray | None:
    if t_eval is None:
        return None
    times, sign = np.asarray(t_eval, float), np.sign(t1 - t0)
    fits = times.ndim == 1 and (sign * (times - t0) >= 0).all() and (sign * (t1 - times) >= 0).all()
    if not fits or not (np.diff(times) * sign > 0).all():
        order = "increasing" if sign > 0 else "decreasing"
        raise ValueError(
            f"t_eval must be a strictly {order} vector of times within t_span, from {t0} to {t1}, "
            f"got {times!r:.200}."
        )
    return times


def _method(method: Any) -> dvi.Method:
    if isinstance(method, dvi.Method):
        return method
    from ..testing import METHODS

    if isinstance(method, str) and method in METHODS:
        return METHODS[method]
    raise ValueError(
        f"method must be a dvi.Method or one of {', '.join(METHODS)}, got {method!r}. For one of "
        "SciPy give interop.vector_field(system) to its solve_ivp."
    )


def _event(event: Any) -> _Event:
    function("each of the events", event, "(t, y) or (t, y, args)")
    terminal = getattr(event, "terminal", False)
    terminal = int(terminal or 0) if isinstance(terminal, bool | None | np.bool_) else terminal
    terminal = whole("terminal of an event", terminal, 0, hint="False or 0 does not end the run.")
    direction = int(np.sign(getattr(event, "direction", 0)))
    return _Event(event, _takes_args(event), terminal, direction)


def _takes_args(event: Callable[..., Any]) -> bool:
    """Whether an event is (t, y, args)."""
    try:
        parameters = list(inspect.signature(event).parameters.values())
        inspect.signature(event).bind(0, 0, 0)
    except (TypeError, ValueError):
        return False
    # A third parameter with a default is `args` only by name: ``lambda t, y, c=c: …`` has a value
    # of its own there.
    third = parameters[2] if len(parameters) > 2 else parameters[-1]
    return third.default is inspect.Parameter.empty or third.name == "args"
