"""The model of an arc: from parameters to the arguments of `integrate`, and to predictions."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import instance, whole
from ..base.inputs import as_parameter, start_state
from ..base.printing import printable
from ..base.results import RESULTS, first_failure
from ..base.signature import accepts, output_of
from ..discover.functions.basis import check_step_size
from ..integration.integrate import integrate
from ..integration.integrator import Integrator
from ..lattices import Uniform
from ..methods import GaussLegendre, Method
from ..observe import Section, refuse_slow_time
from ..observe.solution import Save
from ..problem.system import System
from .events import computed_times
from .first_order import LibraryField, field_of, first_order_system
from .library import ForceLibrary
from .observations import JoinedObservations, Observations

# Steps beyond the ends of shorter arcs above which another program is compiled for them.
_WASTE = 2_000_000
_OPTIONS = (
    *("method", "lattice", "newton", "root_finder", "adjoint", "arithmetic", "layout"),
    *("integrator", "num_steps"),
)
_MAY_BE_FITTED = ("q0", "p0", "epsilon", "args")
_MOST_STEPS = 2e9  # Steps of a trajectory: their number is a 32-bit integer
# Arguments of `integrate` that `fit` sets itself, and why, for messages.
_REASONS = {
    "num_steps": "it follows from h and the times of the data",
    "save": "the times of the data determine which states are saved",
    "stop": "each run must reach the last time of the data",
    **dict.fromkeys(("throw", "progress"), "it is an argument of the function that fits"),
    "observe": "it is an argument of dvi.Observations",
    "t0": "give it as dvi.Observations(..., t0=...)",
}


@printable
class Model(eqx.Module):
    """A system with its known quantities; parameters replace them or add the unknown ones.

    - `system`: a `System`. `h`: the step size [time]. `q0`, `p0`, `epsilon`, `args`: as in
      `integrate`; fitted ones may be left out here. When `data` is a list of arcs, q0 and p0 have
      one row for each arc, here and among the parameters.
    - `options`: further arguments of `integrate`: `method`, `lattice`, `root_finder`, `adjoint`,
      `arithmetic`, `layout`, or an `integrator` in place of them; for a lattice that is not
      `Uniform` also `num_steps`.

    Parameters are a dict with keys among ``"q0"``, ``"p0"``, ``"epsilon"``, ``"args"``. When args
    are dicts here and there, fitted entries are merged into the known ones. For any other
    dependence write the model as a function of the parameters, ``(params)`` or ``(params, arc)``
    with the number of the arc, that returns the arguments of `integrate` as a dict. One program
    computes all arcs, so that the number is traced: index JAX arrays with it,
    ``jnp.asarray(q0s)[arc]``.

    **Raises** `TypeError` for unknown arguments and parameters.
    """

    fixed: dict[str, Any]
    settings: dict[str, Any]

    def __init__(
        self,
        system: System,
        *,
        h: float,
        q0: Any = None,
        p0: Any = None,
        epsilon: Any = None,
        args: PyTree = None,
        **options: Any,
    ):
        instance("system", system, System, "a dvi.System", "That of a problem is problem.system.")
        for name in options:
            if name not in _OPTIONS:
                arguments = ", ".join(("system", "h", *_MAY_BE_FITTED, *_OPTIONS))
                hint = _REASONS.get(name, f"its arguments are {arguments}")
                raise TypeError(f"dvi.Model has no argument {name!r}: {hint}.")
        fixed = {"q0": q0, "p0": p0, "epsilon": epsilon, "args": args}
        self.fixed = jax.tree.map(_as_array, fixed)  # Arrays need no other compilation
        self.settings = {"system": system, "h": check_step_size(h), **options}

    @classmethod
    def first_order(
        cls,
        f: Callable[..., Any] | None = None,
        *,
        h: float,
        q0: Any = None,
        args: PyTree = None,
        method: Method = GaussLegendre(2),
        **options: Any,
    ) -> "Model":
        r"""The model of a differential equation x' = f(t, x, args), which need not be mechanical.

        x is stored as q: its start is q0, and it is observed as "positions". The Hamiltonian is
        p·f(t, q, args), whose equation of q is q̇ = f; the auxiliary p is zero and has no effect.

        - `f`: the known part, an array like x; None where all of it is unknown, for `identify`; or
          a `ForceLibrary`, whose coefficients are those of ``args["coefficients"]``.
        - `h`, `q0`, `args`, `options`: as for `Model`. `method`: of order 4 by default.

        **Raises** `TypeError` for an f that is not a function of (t, x, args).

        **Source** the Hamiltonian p·f: Pontryagin et al. 1962, *The Mathematical Theory of Optimal
        Processes*, chapter 1.
        """
        field = LibraryField(f) if isinstance(f, ForceLibrary) else f
        return cls(first_order_system(field), h=h, q0=q0, args=args, method=method, **options)

    def __call__(self, params: Mapping[str, Any], arc: Any = None) -> dict[str, Any]:
        """The arguments of `integrate` for an arc (None: there is one, without rows)."""
        surplus = "an array" if hasattr(params, "shape") else f"the type {type(params).__name__}"
        if isinstance(params, Mapping):
            surplus = "".join([f"the key {key!r}" for key in params if key not in self.fixed][:1])
        if surplus:
            raise TypeError(
                "params of a dvi.Model must be a dict with keys among q0, p0, epsilon, args, got "
                f"{surplus}. Parameters of the system belong into args; for others write the model "
                "as a function."
            )
        values = dict(self.fixed)
        for name, value in params.items():
            old = values[name]
            mergeable = isinstance(old, Mapping) and isinstance(value, Mapping)
            values[name] = {**old, **value} if mergeable else value
        if values["p0"] is None and values["q0"] is not None and field_of(self.settings["system"]):
            values["p0"] = jnp.zeros_like(jnp.asarray(values["q0"]))
        for name in ("q0", "p0"):
            if values[name] is None:
                raise TypeError(f"{name} is missing: give it to dvi.Model, or in params.")
            if arc is not None:
                values[name] = _row(name, values[name], arc)
        return {**self.settings, **values}

    def check_rows(self, params: Mapping[str, Any], arcs: int) -> None:
        """Reject q0 and p0 with more rows than there are arcs."""
        for name in ("q0", "p0"):
            shape = np.shape(params.get(name, self.fixed[name]))
            _check_rows(name, shape, shape[0] == arcs)


def _as_array(x: Any) -> Any:
    """A float, or a masked array without a masked number, as an array; anything else as it is."""
    is_plain = isinstance(x, np.ma.MaskedArray) and not np.ma.is_masked(x)
    return np.asarray(x) if is_plain or isinstance(x, float) else x


def _row(name: str, rows: Any, arc: Any) -> Array:
    rows = jnp.asarray(rows)
    # JAX takes the last row for a number that is too large, without an error.
    _check_rows(name, rows.shape, rows.ndim and (is_traced(arc) or arc < len(rows)))
    return rows[arc]


def _check_rows(name: str, shape: tuple[int, ...], fits: Any) -> None:
    if not fits:
        raise ValueError(
            f"{name} must have one row for each arc in data, got shape {shape}. Give a single arc "
            "without a list."
        )


def specification(model: Callable[..., Any], params: PyTree, arc: Any, is_list: bool) -> dict:
    """The arguments of `integrate` that the model returns for an arc, checked.

    **Raises** `TypeError` or `ValueError` for a model that returns something else.
    """
    kind = "a dvi.Model or a function of the parameters that returns the arguments of integrate"
    instance("model", model, Callable, kind)
    if isinstance(model, Model):
        spec = model(params, arc if is_list else None)
    else:
        spec = model(params, arc) if accepts(model, 2) else model(params)
    example = 'dict(system=..., q0=..., p0=..., h=..., epsilon=params["epsilon"])'
    kind = f"a dict of the arguments of dvi.integrate, such as {example}"
    spec = dict(instance("the return value of the model", spec, Mapping, kind))
    for name in ("system", "q0", "p0", "h"):
        if spec.get(name) is None:
            raise ValueError(
                f"the model must return system, q0, p0 and h, but {name!r} is missing or None; the "
                f"keys are {list(spec)}."
            )
    for name in _REASONS:
        if name in spec and not (name == "num_steps" and not _is_uniform(spec)):
            raise ValueError(f"the model must not set {name!r}: {_REASONS[name]}.")
    if isinstance(spec["h"], jax.Array):
        raise ValueError(
            "h of the model must be a number of Python, not a JAX array: it determines the number "
            "of steps, and cannot be fitted."
        )
    return spec


def _lattice(spec: Mapping[str, Any]) -> Any:
    integrator = spec.get("integrator") or Integrator()
    return spec.get("lattice", integrator.lattice)


def _is_uniform(spec: Mapping[str, Any]) -> bool:
    # Not isinstance: the equal steps of TimeTransformed are not equal in time.
    return type(_lattice(spec)) is Uniform


class Group(eqx.Module):
    """Arcs that are computed together: same observable, about the same number of steps.

    Arrays have the arcs in front and are padded to one number of observations N of K components:
    `arcs` (A,), `t0` (A,), `ts` (A, N), `values` and `mask` (A, N, K), `whiten` (A, N, K) or
    (A, N, K, K), `period` (A, K) or None. Padding is not seen, and has the time of the last
    observation. `block` and `pick` say how observations are found on the time grid, see `predict`.
    `kinds`: arguments of the `Section` of each event, the last E components of the values; `events`
    their `EventTimes.rows`, (A, N, E, 3).
    """

    arcs: np.ndarray
    t0: np.ndarray
    ts: np.ndarray
    values: np.ndarray
    mask: np.ndarray
    whiten: np.ndarray
    pick: np.ndarray | None
    period: np.ndarray | None
    observe: Callable[..., Any] = eqx.field(static=True)
    num_steps: int = eqx.field(static=True)
    block: int = eqx.field(static=True)
    kinds: tuple[tuple[Callable[..., Any], int, int], ...] = eqx.field(static=True, default=())
    events: np.ndarray | None = None


def weigh(residual: Any, whiten: Any) -> Any:
    """Residuals in standard errors: by those, or by matrices L⁻¹ of covariances L Lᵀ."""
    if whiten.ndim == residual.ndim:
        return residual * whiten
    return jnp.einsum("...ij,...j->...i", whiten, residual)


def make_groups(arcs: list[Observations], specs: list[dict[str, Any]]) -> list[Group]:
    """The arcs in groups, each of which one compiled program can compute.

    **Raises** `ValueError` for step sizes that do not suit the data.
    """
    pairs = list(zip(arcs, specs, strict=True))
    for i, (arc, spec) in enumerate(pairs):
        _check_direction(i, arc, float(check_step_size(spec["h"])))
    longest, h = max((abs((arc.ts[-1] - arc.t0) / spec["h"]), spec["h"]) for arc, spec in pairs)
    if _is_uniform(specs[0]) and longest and not 0.5 <= longest <= _MOST_STEPS:
        raise ValueError(
            f"the last observation must be 0.5 to {_MOST_STEPS:.0e} steps from t0, got "
            f"{longest:.3g} steps of h = {h:g}. Give another |h|, or h and times in one unit."
        )
    steps = [_steps(arc, spec) for arc, spec in pairs]
    # Compiling takes seconds for each program; some millions of steps too many do not.
    separate = len(arcs) * max(steps) - sum(steps) > _WASTE
    kinds: dict[Any, list[int]] = {}
    for i, (arc, spec) in enumerate(pairs):
        size = math.ceil(math.log2(steps[i])) if separate else 0
        key = (arc.function, arc.values.shape[1:], arc.covariance is not None, size, spec["h"])
        key += tuple((kind.g, kind.direction) for kind in getattr(arc, "kinds", ()))
        kinds.setdefault(key, []).append(i)
    return [
        make_group(n, [arcs[i] for i in n], specs[n[0]], max(steps[i] for i in n))
        for n in kinds.values()
    ]


def _check_direction(i: int, arc: Observations, h: float) -> None:
    """**Raises** `ValueError` for an h that does not lead from t0 to the observations."""
    span = arc.ts[-1] - arc.t0
    if span * h < 0:
        side, direction = ("before", "later") if span < 0 else ("after", "earlier")
        raise ValueError(
            f"arc {i}: the observations (t = {arc.ts.min():g} to {arc.ts.max():g}) lie {side} t0 = "
            f"{arc.t0:g}, but h = {h:g} leads to {direction} times. Give h = {-h:g}, or "
            "dvi.Observations(..., t0=...)."
        )


def _steps(arc: Observations, spec: Mapping[str, Any]) -> int:
    """Number of steps to the last observation."""
    if not _is_uniform(spec):
        hint = "A lattice other than dvi.Uniform() requires it."
        return whole("num_steps of the model", spec.get("num_steps"), hint=hint)
    end: Any = arc.reach if isinstance(arc, JoinedObservations) else arc.ts[-1]
    return max(1, math.ceil((end - arc.t0) / float(spec["h"]) - 1e-9))


def make_group(numbers: list[int], arcs: list[Any], spec: Mapping, num_steps: int) -> Group:
    """One group of arcs (`Observations` or parts of them) with `num_steps` steps each."""
    rows = max(len(arc.ts) for arc in arcs)

    def stack(quantity, **pad):
        arrays = [np.asarray(quantity(arc)) for arc in arcs]
        widths = [np.array([(0, rows - len(x))] + [(0, 0)] * (x.ndim - 1)) for x in arrays]
        return np.stack([np.pad(x, w, **pad) for x, w in zip(arrays, widths, strict=True)])

    def flat(arc):
        return arc.values.reshape(len(arc.ts), -1)

    ts, t0 = stack(lambda arc: arc.ts, mode="edge"), np.array([arc.t0 for arc in arcs])
    kinds = [
        (same[0].g, same[0].direction, max(kind.max_events for kind in same))
        for same in zip(*(getattr(arc, "kinds", ()) for arc in arcs), strict=True)
    ]
    block, pick = 0, None
    if _is_uniform(spec):
        block, pick = _blocks((ts - t0[:, None]) / float(spec["h"]), num_steps)
    return Group(
        arcs=np.array(numbers),
        t0=t0,
        ts=ts,
        values=stack(lambda arc: np.nan_to_num(flat(arc))),
        mask=stack(lambda arc: ~np.isnan(flat(arc))),
        whiten=stack(lambda arc: arc.whitening()),
        observe=arcs[0].function,
        num_steps=num_steps,
        block=block,
        pick=pick,
        period=_periods(arcs),
        kinds=tuple(kinds),
        events=stack(lambda arc: arc.rows, constant_values=np.nan) if kinds else None,
    )


def _periods(arcs: list[Any]) -> np.ndarray | None:
    """Periods of the components of each arc, (A, K); None if none is periodic."""
    if all(arc.period is None for arc in arcs):
        return None
    sizes = [
        np.full(arc.values.shape[1:], np.inf if arc.period is None else arc.period) for arc in arcs
    ]
    return np.stack([size.ravel() for size in sizes])


def _blocks(places: np.ndarray, num_steps: int) -> tuple[int, np.ndarray | None]:
    """Steps between saved states, and which saved state is which observation; None for the latter
    if observations lie between grid points, or too irregularly on them.

    `places` are times in steps from the start, shape (A, N).
    """
    count = places.shape[1]
    nodes = np.rint(places)
    if (np.abs(places - nodes) <= 1e-9 * np.maximum(1, np.abs(places))).all():
        block = max(1, int(np.gcd.reduce(nodes.astype(np.int64), axis=None)))
        if num_steps / block <= max(64, 16 * count):
            return min(block, num_steps), (nodes / block).astype(np.int64)
    return max(1, num_steps // (4 * count)), None


def predict(
    spec: dict[str, Any], t0: Array, ts: Array, pick: Any, group: Group, events: Any = None
) -> tuple[Array, tuple[Array, Array], RESULTS]:
    """Predicted observations along one arc, shape (N, K), the last state and the status.

    On a uniform time grid states are saved every `block` steps. Observations on them are picked;
    others are reached from the saved state before by `block` equal steps of their own, none longer
    than h. So an observation has the order of the method, each step runs in the fast loop, and
    memory grows with the number of observations, not of steps. `events`: those of the group for
    this arc, (N, E, 3).
    """
    spec = {**spec, "t0": t0, "throw": False}
    spec |= {"observe": [Section(*kind) for kind in group.kinds]} if group.kinds else {}
    if group.block > 0:
        spec["num_steps"] = group.num_steps
    save = Save(every=group.block, final=True) if group.block > 0 else Save(ts=ts)
    has_states = group.values.shape[-1] > len(group.kinds)
    sol = integrate(**spec, save=save if has_states else Save(final=True))
    result, end, rows = sol.result, (sol.qs[-1], sol.ps[-1]), jnp.zeros((len(ts), 0))
    if has_states:
        qs, ps = sol.qs, sol.ps
        if group.block > 0 and pick is None:
            spec.pop("observe", None)
            qs, ps = _states_off_grid(spec, t0, ts, sol, group)
        elif group.block > 0:
            qs, ps = sol.qs[pick], sol.ps[pick]
        args = jax.tree.map(
            lambda x: jnp.asarray(x) if isinstance(x, float) else x, spec.get("args")
        )
        values = jax.vmap(lambda t, q, p: group.observe(t, q, p, args))(ts, qs, ps)
        rows = jnp.reshape(values, (len(ts), -1))
    for i, crossed in enumerate(sol.observed if group.kinds else ()):
        times = computed_times(crossed, events[:, i])
        is_missing = jnp.any(jnp.isnan(times) & ~jnp.isnan(events[:, i, 0]))
        status = RESULTS.where(is_missing, RESULTS.not_reached, RESULTS.successful)
        rows, result = jnp.column_stack([rows, times]), first_failure(result, status)
    return rows, end, result


def _states_off_grid(spec: dict[str, Any], t0: Array, ts: Array, sol: Any, group: Group):
    """States at times between grid points."""
    stride = group.block * float(spec["h"])
    index = jnp.ceil((ts - t0) / stride - 1e-9).astype(int) - 1
    index = jnp.clip(index, 0, group.num_steps // group.block)
    nodes = sol.ts[index]
    is_start = ts == t0  # no step leads there
    h = jnp.where(is_start, stride, ts - nodes) / group.block

    def reach(t, q, p, h):
        arguments = {**spec, "t0": t, "q0": q, "p0": p, "h": h, "num_steps": group.block}
        end = integrate(**arguments, save=Save(final=True))
        return end.qs[-1], end.ps[-1]

    qs, ps = jax.vmap(reach)(nodes, sol.qs[index], sol.ps[index], h)
    wide = is_start.reshape(-1, *[1] * (qs.ndim - 1))
    return jnp.where(wide, sol.qs[0], qs), jnp.where(wide, sol.ps[0], ps)


def check_observable(i: int, arc: Observations, spec: Mapping[str, Any]) -> bool:
    """Whether values of shape (N,) have to become (N, 1), for an observable of one component.

    **Raises** as `integrate` does for the initial state and args; `ValueError` with both shapes for
    an observable that does not return one value of the data; errors of the function with a note.
    """
    if spec["system"].slow_time:
        refuse_slow_time(arc.function)
    q, p = start_state(spec["q0"], spec["p0"])
    args = jax.tree.map(as_parameter, spec.get("args"))
    out = output_of(f"observe of arc {i}", arc.function, jnp.asarray(arc.t0), q, p, args)
    shape, row_shape = out.shape, getattr(arc, "plain_shape", arc.values.shape[1:])
    if row_shape is None:  # there are only events
        return False
    if row_shape == () and shape == (1,) and arc.covariance is None:
        return True
    if shape != row_shape:
        name = f"observe={arc.observe!r}" if isinstance(arc.observe, str) else "observe"
        raise ValueError(
            f"arc {i}: values has shape {(len(arc.ts), *row_shape)}, so observe must return shape "
            f"{row_shape}, got shape {shape} from {name} for q of shape {q.shape}."
        )
    return False
