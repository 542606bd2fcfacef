"""A fit as functions of one vector: predictions, residuals, Jacobian, a scalar to minimise."""

import warnings
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from ..base.checks import instance
from ..base.keywords import user_level
from ..base.reads import Reads, reads
from ..base.results import RESULTS, status_name
from ..problem.system import check_system
from .checks import enough_values, require_shape, requires
from .losses import LeastSquares, Likelihood, Loss
from .model import Group, Model, check_observable, make_groups, predict, specification, weigh
from .observations import Observations, nearest_branch
from .parameters import Space, make_space
from .roundoff import Evaluation

# Factor by which data and model may differ in size at the start of a fit: beyond it the units
# differ, or the trajectory diverges.
_UNITS = 1e3


class Core(eqx.Module):
    """The functions of a fit with their data as arrays, which are compiled once for all fits of one
    model with data of one shape.

    - `is_list`: whether arcs were given as a list. `reads`: values that functions of the user read
      from outside.
    """

    model: Any
    groups: tuple[Group, ...]
    space: Space
    loss: Any
    is_list: bool = eqx.field(static=True)
    reads: Reads = eqx.field(static=True)

    def predict(self, params: PyTree, group: Group) -> tuple[Array, RESULTS]:
        """Predictions (A, N, K) and a status for each arc of a group."""

        def predict_arc(arc, t0, ts, pick, observed, period, events):
            spec = specification(self.model, params, arc, self.is_list)
            values, _, result = predict(spec, t0, ts, pick, group, events)
            return nearest_branch(values, observed, period), result

        names = ("arcs", "t0", "ts", "pick", "values", "period", "events")
        arrays = jax.tree.map(jnp.asarray, tuple(getattr(group, name) for name in names))
        if len(group.arcs) == 1:  # a batch of one takes twice the time of a single trajectory
            values = predict_arc(*jax.tree.map(lambda x: x[0], arrays))
            return jax.tree.map(lambda x: x[None], values)
        return jax.vmap(predict_arc)(*arrays)

    def weighted_residuals(self, u: Array, horizon: Any = np.inf) -> tuple[list[Array], list[Any]]:
        """Residuals predicted − observed in standard errors, (A, N, K) for each group, zero for
        missing values and those later than `horizon` after the start; predictions and statuses."""
        params = self.space.to_params(self.space.to_x(u))
        predictions = [self.predict(params, group) for group in self.groups]
        pairs = zip(self.groups, predictions, strict=True)
        return [_whiten(group, values, horizon) for group, (values, _) in pairs], predictions

    def residuals(self, u: Array, horizon: Any = np.inf) -> Array:
        """The vector whose half square is the loss, priors last."""
        return self.root_rows(u, self.weighted_residuals(u, horizon)[0])

    def root_rows(self, u: Array, rows: list[Array]) -> Array:
        """The same from whitened residuals."""
        return jnp.concatenate([self.root(r).ravel() for r in rows] + [self.prior_rows(u)])

    def root(self, r: Array) -> Array:
        """Whitened residuals with the loss ½ r²; for a likelihood unchanged."""
        return self.loss.root(r) if isinstance(self.loss, Loss) else r

    def prior_rows(self, u: Array) -> Array:
        """Parameters minus their prior means in prior standard errors, 0 without a prior."""
        return (self.space.to_x(u) - self.space.prior_mean) * self.space.prior_weight

    def evaluate(self, u: Array, horizon: Any = np.inf) -> Evaluation:
        """Residual vector and Jacobian; for each group predictions and statuses.

        By forward mode: memory does not grow with the number of steps.
        """

        def residual_and_aux(u):
            rows, predictions = self.weighted_residuals(u, horizon)
            r = self.root_rows(u, rows)
            return r, (r, rows, predictions)

        J, (r, rows, predictions) = jax.jacfwd(residual_and_aux, has_aux=True)(u)
        return Evaluation(r, J, (rows, predictions))

    def scalar(self, u: Array, horizon: Any = np.inf, choice: Any = None) -> Array:
        """The loss: ½ Σ ρ(r²), or −log likelihood; −log prior is added.

        With `choice`, indices of arcs for each group, of those arcs, weighted to stand for all.
        """
        params = self.space.to_params(self.space.to_x(u))
        total = jnp.sum(self.prior_rows(u) ** 2) / 2
        for i, full_group in enumerate(self.groups):
            group, weight = full_group, 1.0
            if choice is not None:
                group = jax.tree.map(lambda x, i=i: jnp.asarray(x)[choice[i]], full_group)
                weight = len(full_group.arcs) / len(choice[i])
            predictions, _ = self.predict(params, group)
            if isinstance(self.loss, Likelihood):
                part = self._likelihood(group, predictions, horizon, params)
            else:
                part = jnp.sum(self.loss.root(_whiten(group, predictions, horizon)) ** 2) / 2
            total = total + weight * part
        return total

    def _likelihood(self, group: Group, predictions: Array, horizon: Any, params: PyTree) -> Array:
        hint = "dvi.LeastSquares() accepts both."
        requires(group.whiten.ndim < 4, "dvi.Likelihood", "sigma of the data", "covariance", hint)
        keep, values = horizon_mask(group, horizon), jnp.asarray(group.values)
        sigma = 1 / jnp.where(keep, jnp.asarray(group.whiten), 1.0)
        # Missing values get the observed ones as predictions, so that no NaN reaches the density.
        density = jax.vmap(self.loss.negative_log_density, in_axes=(0, 0, 0, None))
        densities = density(jnp.where(keep, predictions, values), values, sigma, params)
        label = "−log density by dvi.Likelihood, with all arcs,"
        require_shape(label, densities, predictions.shape)
        return jnp.sum(jnp.where(keep, densities, 0.0))

    def hessian(self, u: Array) -> Array:
        """Exact second derivatives of the loss, (n, n), forward over reverse."""
        return jax.jacfwd(jax.grad(self.scalar))(u)

    def curvature(self, u: Array, directions: Array) -> Array:
        """Exact second derivatives of the loss along directions, the rows of an array."""

        def second(d):
            def loss(t):
                r = self.residuals(u + t * d)
                return r @ r / 2

            def slope(t):
                return jax.jvp(loss, (t,), (1.0,))[1]

            return jax.jvp(slope, (0.0,), (1.0,))[1]

        return jax.vmap(second)(directions)


def _warn_of_times(model: Model, params: Any, arcs: list[Observations]) -> None:
    """Warn of initial states that are known for a time which was not given."""
    fixed = [n for n in ("q0", "p0") if model.fixed[n] is not None and n not in params]
    for i, arc in enumerate(arcs):
        if fixed and not arc.t0_is_given and arc.t0 != 0:
            warnings.warn(
                f"arc {i}: t0 is not given, so the fit uses {' and '.join(fixed)} of the model at "
                f"the first observation, t = {arc.t0:g}. If the state of the model belongs to "
                "another time, give this time: dvi.Observations(..., t0=...).",
                stacklevel=user_level(),
            )


def horizon_mask(group: Group, horizon: Any) -> Array:
    """Which values were observed within the horizon, shape (A, N, K)."""
    return group.mask & (abs(group.ts - group.t0[:, None]) <= horizon)[..., None]


def _whiten(group: Group, predictions: Array, horizon: Any) -> Array:
    # First where, then subtract: a trajectory that fails after the horizon leaves no NaN behind.
    mask = horizon_mask(group, horizon)
    difference = jnp.where(mask, predictions - jnp.asarray(group.values), 0.0)
    return weigh(difference, jnp.asarray(group.whiten))


# Functions of the module: a method of an instance would be compiled again for each fit.
_evaluate = eqx.filter_jit(Core.evaluate)
_weighted_residuals = eqx.filter_jit(Core.weighted_residuals)
_root_rows = eqx.filter_jit(Core.root_rows)
_hessian = eqx.filter_jit(Core.hessian)
_curvature = eqx.filter_jit(Core.curvature)


class FitProblem:
    """A fit in free variables u.

    - `core`: its functions. `space`: the parameters, `start` their x. `data`: the data as given,
      `arcs`: in the order of time, `specs`: the arguments of `integrate` for each at the start.
    - `count`: number of observed values.
    """

    def __init__(
        self,
        model: Callable[..., Any],
        arcs: list[Observations],
        is_list: bool,
        params: PyTree,
        *,
        bounds: PyTree = None,
        priors: PyTree = None,
        loss: Loss | Likelihood = LeastSquares(),
    ):
        losses = "a dvi.LeastSquares(), dvi.SoftL1(), dvi.Cauchy() or dvi.Likelihood(f)"
        instance("loss", loss, Loss | Likelihood, losses)
        self.data, self.loss = list(arcs), loss
        self.arcs = arcs = [arc.in_time_order() for arc in arcs]
        self.space, self.start = make_space(params, bounds, priors)
        self.size = self.space.size
        self.has_errors = arcs[0].has_errors
        if not self.has_errors and not isinstance(loss, Likelihood):
            robust = not isinstance(loss, LeastSquares)
            subject = f"a robust loss ({type(loss).__name__})" if robust else "a fit with priors"
            fits = not (self.space.count_of_priors or robust)
            requires(fits, subject, "sigma or covariance of dvi.Observations", "neither")
        if isinstance(model, Model):
            check_system(model.settings["system"])
        arrays = self.space.to_params(jnp.asarray(self.start))
        if is_list and isinstance(model, Model):
            specification(model, arrays, 0, is_list)  # which reports what is missing
            model.check_rows(arrays, len(arcs))
        self.specs = [specification(model, arrays, i, is_list) for i in range(len(arcs))]
        if isinstance(model, Model):
            _warn_of_times(model, params, self.data)
        for i, arc in enumerate(arcs):
            if check_observable(i, arc, self.specs[i]):
                arcs[i], self.data[i] = arc.in_columns(), self.data[i].in_columns()
        self.groups = make_groups(arcs, self.specs)
        functions = [kind[0] for group in self.groups for kind in group.kinds]
        values_read = reads(model, loss, [arc.function for arc in arcs] + functions)
        self.core = Core(model, tuple(self.groups), self.space, loss, is_list, values_read)
        self.count = int(sum(group.mask.sum() for group in self.groups))

    @property
    def steps(self) -> int:
        """Steps of all trajectories together."""
        return sum(len(group.arcs) * group.num_steps for group in self.groups)

    @property
    def degrees_of_freedom(self) -> int:
        """Observed values and priors minus parameters."""
        return self.count + self.space.count_of_priors - self.size

    def start_in_words(self) -> str:
        """``initial state at t0 = 0: q0 fitted, p0 of the model``."""
        times = np.array([arc.t0 for arc in self.data])
        moment = f"t0 = {times.min():g}" + (f" to {times.max():g}" if np.ptp(times) else "")
        if all(arc.t0 == arc.ts[0] for arc in self.data):
            moment += " (the first observation)"
        roots = {name.split("[")[0] for name in self.space.names}
        model = getattr(self.core.model, "model", self.core.model)  # that inside of `identify`
        roots &= {"q0", "p0"} if isinstance(model, Model) else set()
        sources = [f"{n} {'fitted' if n in roots else 'of the model'}" for n in ("q0", "p0")]
        return f"initial state at {moment}: {', '.join(sources)}"

    def check_count(self) -> None:
        """**Raises** `ValueError` for fewer observed values than parameters."""
        minimum = self.size - self.space.count_of_priors
        enough_values(self.count, minimum, f"{minimum} parameters without a prior")

    # ---- the functions of `core`, compiled; see there

    def evaluate(self, u: Any, horizon: Any = np.inf, extra: Any = None) -> Evaluation:
        """`Core.evaluate`; there is nothing `extra`."""
        return _evaluate(self.core, jnp.asarray(u), jnp.asarray(horizon, float))

    def weighted_residuals(self, u: Any, horizon: Any = np.inf) -> tuple[list[Array], list[Any]]:
        return _weighted_residuals(self.core, jnp.asarray(u), jnp.asarray(horizon, float))

    def root_rows(self, u: Any, rows: list[Any]) -> np.ndarray:
        return np.asarray(_root_rows(self.core, jnp.asarray(u), rows))

    def hessian(self, u: Any) -> Array:
        return _hessian(self.core, jnp.asarray(u))

    def curvature(self, u: Any, directions: Any) -> Array:
        return _curvature(self.core, jnp.asarray(u), jnp.asarray(directions))

    def by_arc(self, rows: list[Any], predictions: list[Any]) -> tuple[list, list, list[str]]:
        """For each arc predictions (N, ...), observed minus predicted in standard errors (N, K),
        and the status; rows in the order of `data`."""
        rows_of_arcs: list[Any] = [None] * len(self.arcs)
        for group, r, (values, result) in zip(self.groups, rows, predictions, strict=True):
            status = np.atleast_1d(status_name(result))
            for a, i in enumerate(group.arcs):
                arc, n = self.arcs[i], len(self.arcs[i].ts)
                order = slice(None, None, 1 if arc.ts[0] == self.data[i].ts[0] else -1)
                values_of_arc = np.asarray(values[a, :n]).reshape(arc.values.shape)[order]
                residual = np.where(group.mask[a, :n], -np.asarray(r[a, :n]), np.nan)[order]
                rows_of_arcs[i] = values_of_arc, residual, str(status[a])
        values_of_arcs, residuals, names = map(list, zip(*rows_of_arcs, strict=True))
        return values_of_arcs, residuals, names

    def rows_within(self, horizon: float) -> np.ndarray:
        """Which entries of the residual vector lie within a horizon; priors do."""
        masks = [np.asarray(horizon_mask(g, horizon)).ravel() for g in self.groups]
        return np.concatenate([*masks, np.ones(self.size, bool)])

    # ---- checks of the start

    def check_start(self, predictions: list[Any], check_units: bool = True) -> None:
        """Raise an error if the model fails at the first observation for the initial parameters.

        Also if the `predictions` (with the statuses of each group) differ in size from the data.
        """
        for group, (values_of_group, result) in zip(self.groups, predictions, strict=True):
            names = np.atleast_1d(status_name(result))
            for a, arc in enumerate(group.arcs):
                first = group.mask[a].any(axis=1).argmax()
                values = np.asarray(values_of_group)[a, first][group.mask[a, first]]
                if not np.isfinite(values).all():
                    hint = f"a smaller h: the status of the trajectory is {str(names[a])!r}"
                    if str(names[a]) == "successful":
                        hint = "another observe: the trajectory does not fail"
                    if group.kinds and str(names[a]) == "not_reached":
                        hint = "another g, direction or max_events: there is no such event"
                    value, t = values[~np.isfinite(values)][0], group.ts[a, first]
                    moment = f"the first observation of arc {arc}, at t = {t:g}"
                    self._refuse_start(f"{value} for {moment}", hint)
        if check_units:
            self._check_sizes([np.asarray(values_of_group) for values_of_group, _ in predictions])

    def _refuse_start(self, defect: str, hint: str) -> None:
        raise ValueError(
            f"at the starting parameters ({self.space.in_words(self.start)}) the model gives "
            f"{defect}. Give other starting parameters, or {hint}."
        )

    def _check_sizes(self, predictions: list[np.ndarray]) -> None:
        pairs = list(zip(self.groups, predictions, strict=True))
        data = max(float(np.abs(g.values[g.mask]).max()) for g, _ in pairs)
        sizes = [np.where(g.mask & np.isfinite(f), np.abs(f), 0.0).max(axis=2) for g, f in pairs]
        largest = max(float(size.max()) for size in sizes)
        if data == 0 or largest == 0 or 1 / _UNITS < data / largest < _UNITS:
            return
        hint = "data in the same units; check_units=False permits the difference"
        largest_observed = f"but the largest observed value is {data:.3g}"
        if largest < data:
            self._refuse_start(f"values of at most {largest:.3g}, {largest_observed}", hint)
        large, pairs_of_sizes = _UNITS * data, zip(self.groups, sizes, strict=True)
        group, size = next((g, s) for g, s in pairs_of_sizes if (s >= large).any())
        a, row = np.argwhere(size >= large)[0]
        arc = int(group.arcs[a])
        spec, observations = self.specs[arc], self.arcs[arc]
        q0, p0 = (jnp.asarray(spec[name], float) for name in ("q0", "p0"))
        values = observations.function(observations.t0, q0, p0, spec.get("args"))
        first = float(jnp.max(jnp.abs(values)))
        self._refuse_start(
            f"{size[a, row]:.3g} for arc {arc} at t = {group.ts[a, row]:g}, {largest_observed}; at "
            f"the start, t = {group.t0[a]:g}, the model gives {first:.3g}, later at most "
            f"{size[a].max():.3g}",
            f"a smaller h if the trajectory diverges, or {hint}",
        )
