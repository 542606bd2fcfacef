"""Single and multiple shooting: arcs as one trajectory, or cut into segments tied together."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..base.checks import fraction, whole
from ..integration.integrate import integrate
from ..observe.solution import Save
from .checks import require_shape, requires
from .first_order import field_of
from .model import make_group, predict, specification, weigh
from .observations import Observations, nearest_branch
from .problem import FitProblem
from .roundoff import Evaluation


@dataclass(frozen=True)
class SingleShooting:
    """Single shooting: each arc is one trajectory from its initial state."""


@dataclass(frozen=True)
class MultipleShooting:
    """Multiple shooting: arcs in segments, each with an initial state, joined by continuity.

    - `segments`: how many, at least 2.
    - `guess`: initial guess of the states at the cuts: a function ``t`` → (q, p); ``"data"``, by
      interpolation of the observations, which must be of positions or of the state; or
      ``"model"``, the trajectory of the starting parameters. None uses ``"data"`` where it can.
    - `tolerance`: largest gap between the end of a segment and the next start, relative to the size
      of the orbit.

    For long or chaotic arcs, where the misfit as a function of the parameters alone has many
    narrow minima; over a short segment it has none. Continuity is a constraint of the fit,
    enforced by an augmented Lagrangian.

    **Source** Bock 1983, *Recent advances in parameter identification techniques for ODE*;
    Nocedal & Wright 2006, *Numerical Optimization*, 17.3.
    """

    segments: int
    guess: str | Callable[..., Any] | None = None
    tolerance: float = 1e-9

    def __post_init__(self):
        whole("segments", self.segments, 2)
        fraction("tolerance", self.tolerance)
        is_name = isinstance(self.guess, str) and self.guess in ("data", "model")
        if not (is_name or self.guess is None or callable(self.guess)):
            choices = '"data", "model", None or a function t → (q, p)'
            raise TypeError(f"guess must be {choices}, got {self.guess!r}.")


class _SegmentData:
    """The observations of an arc that belong to one segment."""

    def __init__(self, arc: Observations, keep: np.ndarray, t0: float, whitening: np.ndarray):
        if keep.any():
            self.ts, self.values, self._whitening = arc.ts[keep], arc.values[keep], whitening[keep]
        else:  # a segment without data: one time of no weight
            self.ts, self._whitening = np.array([t0]), np.zeros((1, *whitening.shape[1:]))
            self.values = np.full((1, *arc.values.shape[1:]), np.nan)
        self.t0, self.function, self.period = t0, arc.function, arc.period

    def whitening(self) -> np.ndarray:
        return self._whitening


class Segments:
    r"""The residuals of multiple shooting, in w = (u, starts of the segments after the first).

    The vector has the whitened residuals of all segments, the priors, and

        √ρ c + λ / √ρ,    c = (end of a segment − start of the next) / size of the orbit,

    so that half its square is the augmented Lagrangian of the constraints c = 0 up to a constant.
    """

    def __init__(self, problem: FitProblem, shooting: MultipleShooting):
        self.problem, self.shooting = problem, shooting
        spec, arcs, S = problem.specs[0], problem.arcs, shooting.segments
        other = next((s["h"] for s in problem.specs if s["h"] != spec["h"]), None)
        lattice = spec.get("lattice", getattr(spec.get("integrator"), "lattice", None))
        requires(
            other is None and problem.groups[0].block,
            "dvi.MultipleShooting",
            "lattice=dvi.Uniform() and the same h for all arcs",
            type(lattice).__name__ if other is None else f"h = {spec['h']} and h = {other}",
        )
        fits = not problem.groups[0].kinds
        requires(fits, "dvi.MultipleShooting", "observations without events", "dvi.EventTimes")
        names = "observe", "the shape of an observation", "the use of covariance"
        kinds = [(a.function, a.values.shape[1:], a.covariance is None) for a in arcs]
        for i, kind in enumerate(kinds):
            pairs = zip(names, kinds[0], kind, strict=True)
            differing = " and ".join(name for name, a, b in pairs if a != b)
            condition = "arcs that agree in " + ", ".join(names)
            value = f"other values for {differing} in arcs 0 and {i}"
            requires(not differing, "dvi.MultipleShooting", condition, value)
        h = float(spec["h"])
        steps = max(math.ceil(abs(a.ts[-1] - a.t0) / abs(h) - 1e-9) for a in arcs)
        self.steps = math.ceil(steps / S)
        hint = f"The longest arc has {steps} steps."
        whole("segments of dvi.MultipleShooting", S, 2, steps, hint=hint)
        self.cuts = np.array([[arc.t0 + s * self.steps * h for s in range(S)] for arc in arcs])
        parts = []
        for arc, cuts in zip(arcs, self.cuts, strict=True):
            whitening = arc.whitening()
            place = (arc.ts - arc.t0) / (self.steps * h)
            numbers_of_segments = np.clip(np.ceil(place - 1e-9).astype(int) - 1, 0, S - 1)
            for s, cut in enumerate(cuts):
                parts.append(_SegmentData(arc, numbers_of_segments == s, float(cut), whitening))
        numbers = np.repeat(np.arange(len(arcs)), S)
        self.group = make_group(numbers.tolist(), parts, spec, self.steps)
        self.shape = np.shape(spec["q0"])
        self.half = math.prod(self.shape)
        # Segments after the first of an arc start at a node, an unknown state (2 half,).
        self.first = np.tile(np.arange(S) == 0, len(arcs))
        self.num_nodes = len(arcs) * (S - 1)
        self.node_of = np.where(self.first, -1, np.cumsum(~self.first) - 1)
        self.inner = np.flatnonzero(np.tile(np.arange(S) < S - 1, len(arcs)))
        self.next_of = self.node_of[self.inner + 1]
        self.num_gaps = self.num_nodes * 2 * self.half
        self.n = problem.size
        self.size = self.n + self.num_gaps
        self.orbit = np.ones(2 * self.half)

    def begin(self, u: np.ndarray) -> np.ndarray:
        """w with the guesses of the segments' starts; sets the size of the orbit."""
        indices = range(len(self.problem.arcs))
        states = np.stack([self._guess(i, u) for i in indices])  # (A, S, 2 half)
        flat = states.reshape(-1, 2, self.half)
        size = np.abs(flat).max(axis=(0, 2))
        size = np.where(size > 0, size, 1.0)  # zero is the size of momenta without an effect
        self.orbit = np.repeat(size, self.half)
        return np.concatenate([u, states[:, 1:].ravel()])

    def _guess(self, i: int, u: np.ndarray) -> np.ndarray:
        guess, arc, times = self.shooting.guess, self.problem.arcs[i], self.cuts[i]
        spec = self._specification(jnp.asarray(u), i)
        if guess is None:
            is_state = arc.observe in ("positions", "state")
            is_dense = np.isfinite(arc.values.reshape(len(arc.ts), -1)).all(axis=1).sum() >= 4
            guess = "data" if is_state and is_dense else "model"
        if callable(guess):
            pairs = [[np.ravel(q), np.ravel(p)] for q, p in map(guess, times)]
            states_of_cuts = np.array([np.concatenate(pair) for pair in pairs], float)
            name = f"the array of q and p by guess, each of shape {self.shape}, at all cuts"
            require_shape(name, states_of_cuts, (len(times), 2 * self.half))
        elif guess == "data":
            states_of_cuts = from_data(arc, spec, times)
        else:
            steps = {"num_steps": self.steps * len(times), "save": Save(every=self.steps)}
            sol = integrate(**{**spec, **steps, "t0": arc.t0, "throw": False})
            flat = [np.asarray(x[:-1]).reshape(len(times), -1) for x in (sol.qs, sol.ps)]
            states_of_cuts = np.concatenate(flat, axis=1)
        if not np.isfinite(states_of_cuts).all():
            t = times[np.argmin(np.isfinite(states_of_cuts).all(axis=1))]
            source = "by a function" if callable(guess) else repr(guess)
            raise ValueError(
                f"the states of guess, {source}, must be finite, got NaN or inf for arc {i} at "
                f"t = {t:g}. Give other starting parameters or another function t → (q, p)."
            )
        return states_of_cuts

    def _specification(self, u: Array, arc: Any) -> dict[str, Any]:
        space, core = self.problem.space, self.problem.core
        return specification(core.model, space.to_params(space.to_x(u)), arc, core.is_list)

    def _segment(self, x: Array, segment: dict[str, Any]) -> tuple[Array, Array]:
        """Residuals of one segment and its end, relative to the orbit, from x = (u, own start)."""
        problem, node_state = self.problem, x[self.n :]
        spec = self._specification(x[: self.n], segment["arc"])
        for name, of_node in (("q0", node_state[: self.half]), ("p0", node_state[self.half :])):
            # The first segment of an arc starts where the model says.
            start = jnp.asarray(spec[name], float)
            spec[name] = jnp.where(segment["first"], start, of_node.reshape(self.shape))
        times = segment["t0"], segment["ts"], segment["pick"]
        predictions, (q1, p1), _ = predict(spec, *times, self.group)
        predictions = nearest_branch(predictions, segment["values"], segment["period"])
        difference = jnp.where(segment["mask"], predictions - segment["values"], 0.0)
        r = problem.core.root(weigh(difference, segment["whiten"])).ravel()
        return r, jnp.concatenate([q1.ravel(), p1.ravel()]) / self.orbit

    def _all_segments(self, w: Array) -> Any:
        """Residuals and ends of all segments, and their derivatives in (u, own start)."""
        names = ("t0", "ts", "pick", "values", "mask", "whiten", "period")
        segments = {name: getattr(self.group, name) for name in names}
        segments |= {"arc": self.group.arcs, "first": self.first}
        nodes = self._nodes(w)[np.maximum(self.node_of, 0)]

        def with_derivative(node, segment):
            x = jnp.concatenate([w[: self.n], node])
            return jax.jacfwd(lambda x: (self._segment(x, segment),) * 2, has_aux=True)(x)

        J, values = jax.vmap(with_derivative)(nodes, jax.tree.map(jnp.asarray, segments))
        return values, J

    def _nodes(self, w: Array) -> Array:
        return w[self.n :].reshape(self.num_nodes, 2 * self.half)

    def evaluate(self, w: Array, horizon: Any, extra: tuple[Array, Array]) -> Evaluation:
        """The residual vector, its derivative assembled from those of the segments, and c."""
        del horizon
        root, multipliers = extra  # √ρ, λ
        (r, ends), (Jr, Je) = self._all_segments(w)
        n, u = self.n, w[: self.n]
        gaps = ends[self.inner] - self._nodes(w)[self.next_of] / self.orbit[None]
        prior = self.problem.core.prior_rows
        weighted_gaps = root * gaps + multipliers.reshape(gaps.shape) / root
        residual = jnp.concatenate([r.ravel(), prior(u), weighted_gaps.ravel()])
        # The end of a segment depends on its own start, a gap on the next start as well.
        J_tied = root * self._in_place(Je[self.inner], self.inner)
        gap, part = np.arange(len(self.inner))[:, None], np.arange(2 * self.half)
        columns = n + self.next_of[:, None] * 2 * self.half + part
        J_tied = J_tied.at[gap, part, columns].add(-root / self.orbit[None])
        J_prior = jnp.zeros((n, self.size)).at[:, :n].set(jax.jacfwd(prior)(u))
        blocks = self._in_place(Jr, np.arange(len(r))), J_prior, J_tied
        J = jnp.concatenate([x.reshape(-1, self.size) for x in blocks])
        return Evaluation(residual, J, gaps.ravel())

    def _in_place(self, J: Array, segments: np.ndarray) -> Array:
        """Derivatives (S, R, n + 2 half) of some segments in (u, own start) as ones in w."""
        width = 2 * self.half
        # The start of an arc's first segment is not an unknown: its columns go behind w, and off.
        node = np.where(self.node_of < 0, self.num_nodes, self.node_of)[segments]
        node_columns = self.n + node[:, None] * width + np.arange(width)
        columns = np.hstack([np.tile(np.arange(self.n), (len(node_columns), 1)), node_columns])
        s, rows = np.arange(J.shape[0])[:, None, None], np.arange(J.shape[1])[:, None]
        wide = jnp.zeros((*J.shape[:2], self.size + width))
        return wide.at[s, rows, columns[:, None, :]].set(J)[..., : self.size]


def from_data(arc: Observations, spec: dict[str, Any], times: np.ndarray) -> np.ndarray:
    """States (T, 2 q.size) at `times` by interpolation of an arc's observations.

    From positions alone, momenta are those p for which ∂H_D/∂p is the velocity by differences.

    **Raises** `ValueError` for an arc that observes something else.
    """
    requires(
        arc.observe in ("positions", "state"),
        'guess="data"',
        'observe="positions" or observe="state"',
        repr(arc.observe) if isinstance(arc.observe, str) else "a function",
    )
    flat = arc.values.reshape(len(arc.ts), -1)
    good = np.isfinite(flat).all(axis=1)
    ts, flat = arc.ts[good], flat[good].copy()
    if arc.period is not None:  # Interpolate between neighbouring branches, from that of the model.
        start = np.concatenate([np.ravel(spec["q0"]), np.ravel(spec["p0"])])
        for k in np.flatnonzero(np.isfinite(arc.period)):
            length = arc.period.flat[k]
            column = np.unwrap(flat[:, k], period=length)
            flat[:, k] = column + length * np.round((start[k] - column[0]) / length)
    order = np.argsort(ts)

    def interpolate(x):
        return np.stack([np.interp(times, ts[order], column[order]) for column in x.T], axis=1)

    if arc.observe == "state":
        return interpolate(flat)
    import optimistix as optx  # here, so that importing the package does not import it

    q = interpolate(flat)
    if field_of(spec["system"]):  # the velocity does not depend on p
        return np.concatenate([q, np.zeros_like(q)], axis=1)
    v = interpolate(np.gradient(flat, ts, axis=0))
    shape = np.shape(spec["q0"])
    system, args, epsilon = spec["system"], spec.get("args"), spec.get("epsilon", 0.0)
    start = jnp.ravel(jnp.asarray(spec["p0"], float))

    def momentum(t, q, v):
        def mismatch(p, _):
            slope = jax.grad(lambda p: system.hamiltonian(t, t, q, p.reshape(shape), epsilon, args))
            return slope(p) - v

        return optx.root_find(mismatch, optx.Newton(1e-8, 1e-8), start, throw=False).value

    p = jax.vmap(momentum)(jnp.asarray(times), jnp.asarray(q.reshape(-1, *shape)), jnp.asarray(v))
    return np.concatenate([q, np.asarray(p)], axis=1)
