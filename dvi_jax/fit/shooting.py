"""Single and multiple shooting: which starts are unknown besides the parameters."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._checks import fraction, whole
from .._integrate import integrate
from .._solution import Save
from .model import make_group, predict, weighed
from .observations import Observations
from .optimise import Evaluation
from .problem import Problem


@dataclass(frozen=True)
class SingleShooting:
    """Each arc is one trajectory from its start."""


@dataclass(frozen=True)
class MultipleShooting:
    """Each arc is cut into segments with starts of their own, tied by continuity.

    - `segments`: how many, at least 2.
    - `guess`: states at the cuts to begin with: a function ``t`` → (q, p); ``"data"``, by
      interpolation of the observations, which must be of positions or of the state; or
      ``"model"``, the trajectory of the starting parameters. None takes ``"data"`` where it can.
    - `tolerance`: by how much the end of a segment may miss the next start, relative to the size
      of the orbit.

    For long or chaotic arcs, where the misfit as a function of the parameters alone has many
    narrow minima: over a short segment it has none. Continuity is a constraint of the fit, met
    by an augmented Lagrangian.

    **Source** Bock 1983, *Recent advances in parameter identification techniques for ODE*;
    Nocedal & Wright 2006, *Numerical Optimization*, 17.3.
    """

    segments: int
    guess: str | Callable[..., Any] | None = None
    tolerance: float = 1e-9

    def __post_init__(self):
        whole("segments", self.segments, 2)
        fraction("tolerance", self.tolerance)
        if not (self.guess in (None, "data", "model") or callable(self.guess)):
            raise TypeError(
                f'guess must be "data", "model", a function t → (q, p) or None, got {self.guess!r}.'
            )


class _Part:
    """The observations of an arc that belong to one segment."""

    def __init__(self, arc: Observations, keep: np.ndarray, t0: float, whitening: np.ndarray):
        if not keep.any():  # a segment without data: one time of no weight
            self.ts = np.array([t0])
            self.values = np.full((1, *arc.values.shape[1:]), np.nan)
            self._whitening = np.zeros((1, *whitening.shape[1:]))
        else:
            self.ts, self.values = arc.ts[keep], arc.values[keep]
            self._whitening = whitening[keep]
        self.t0, self.function = t0, arc.function

    def whitening(self) -> np.ndarray:
        return self._whitening


class Segments:
    r"""The residuals of multiple shooting, in w = (u, starts of the segments after the first).

    The vector has the whitened residuals of all segments, the priors, and

        √ρ c + λ / √ρ,    c = (end of a segment − start of the next) / size of the orbit,

    so that half its square is the augmented Lagrangian of the constraints c = 0 up to a constant.
    """

    def __init__(self, problem: Problem, shooting: MultipleShooting):
        self.problem, self.shooting = problem, shooting
        space, S = problem.space, shooting.segments
        spec = problem.specs[0]
        if any(s["h"] != spec["h"] for s in problem.specs) or problem.groups[0].block == 0:
            raise ValueError("multiple shooting needs a uniform lattice, and one h for all arcs.")
        if len({(a.function, a.values.shape[1:], a.covariance is None) for a in problem.arcs}) > 1:
            raise ValueError("multiple shooting needs arcs that observe the same.")
        h = float(spec["h"])
        steps = max(math.ceil(abs(a.ts[-1] - a.t0) / abs(h) - 1e-9) for a in problem.arcs)
        self.steps = math.ceil(steps / S)
        if self.steps < 1 or steps < S:
            raise ValueError(f"{S} segments of {steps} steps: take fewer segments.")
        parts, arcs, self.first, cuts = [], [], [], []
        for i, arc in enumerate(problem.arcs):
            whitening = arc.whitening()
            place = (arc.ts - arc.t0) / (self.steps * h)
            which = np.clip(np.ceil(place - 1e-9).astype(int) - 1, 0, S - 1)
            for s in range(S):
                t0 = arc.t0 + s * self.steps * h
                parts.append(_Part(arc, which == s, t0, whitening))
                arcs.append(i)
                self.first.append(s == 0)
                cuts.append(t0)
        self.group = make_group(arcs, parts, spec, self.steps)
        self.cuts = np.reshape(cuts, (len(problem.arcs), S))
        self.shape = np.shape(spec["q0"])
        self.half = int(np.prod(self.shape, dtype=int))
        self.arcs = len(problem.arcs)
        self.num_nodes = self.arcs * (S - 1)
        later = ~np.array(self.first)
        self.node_of = np.where(later, np.cumsum(later) - 1, -1)
        self.next_of = np.array(
            [self.node_of[j + 1] if (j + 1) % S else -1 for j in range(len(parts))]
        )
        self.num_gaps = self.num_nodes * 2 * self.half
        self.n = space.size
        self.size = self.n + self.num_nodes * 2 * self.half
        self.orbit = np.ones(2 * self.half)

    def begin(self, u: np.ndarray) -> np.ndarray:
        """w with the guesses of the segments' starts; sets the size of the orbit."""
        states = np.stack([self._guess(i, u) for i in range(self.arcs)])  # (A, S, 2 half)
        flat = states.reshape(-1, 2, self.half)
        size = np.maximum(np.abs(flat).max(axis=(0, 2)), np.finfo(float).tiny)
        self.orbit = np.repeat(size, self.half)
        return np.concatenate([u, states[:, 1:].ravel()])

    def _guess(self, i: int, u: np.ndarray) -> np.ndarray:
        guess, arc = self.shooting.guess, self.problem.arcs[i]
        params = self.problem.space.to_params(self.problem.space.to_x(jnp.asarray(u)))
        spec = self.problem.core.specification(params, i)
        times = self.cuts[i]
        if guess is None:
            named = arc.observe in ("positions", "state")
            enough = np.isfinite(arc.values.reshape(len(arc.ts), -1)).all(axis=1).sum() >= 4
            guess = "data" if named and enough else "model"
        if callable(guess):
            pairs = [guess(t) for t in times]
            found = np.array([np.concatenate([np.ravel(q), np.ravel(p)]) for q, p in pairs], float)
            if found.shape != (len(times), 2 * self.half):
                raise ValueError(
                    f"the guess of MultipleShooting must return (q, p) of shape {self.shape}."
                )
        elif guess == "data":
            found = from_data(arc, spec, times)
        else:
            steps = {"num_steps": self.steps * len(times), "save": Save(every=self.steps)}
            sol = integrate(**{**spec, **steps, "t0": arc.t0, "throw": False})
            flat = (np.asarray(x[:-1]).reshape(len(times), -1) for x in (sol.qs, sol.ps))
            found = np.concatenate(list(flat), axis=1)
        if not np.isfinite(found).all():
            raise ValueError(
                f"arc {i}: the guess of the segments' starts is not finite at t = "
                f"{times[np.argmin(np.isfinite(found).all(axis=1))]:g}. Give "
                "dvi.MultipleShooting(guess=...) as a function t → (q, p)."
            )
        return found

    def _segment(self, u, node, arc, first, t0, ts, pick, values, seen, whiten):
        """Whitened residuals (N K,) and the end state (2 half,) of one segment."""
        problem = self.problem
        params = problem.space.to_params(problem.space.to_x(u))
        spec = problem.core.specification(params, arc)
        q = jnp.where(first, jnp.asarray(spec["q0"], float), node[: self.half].reshape(self.shape))
        p = jnp.where(first, jnp.asarray(spec["p0"], float), node[self.half :].reshape(self.shape))
        found, (q1, p1), _ = predict({**spec, "q0": q, "p0": p}, t0, ts, pick, self.group)
        off = jnp.where(seen, found - values, 0.0)
        r = weighed(off, whiten)
        return problem.core.root(r).ravel(), jnp.concatenate([q1.ravel(), p1.ravel()]) / self.orbit

    def _all(self, w: Array):
        """Residuals and ends of all segments, and their derivatives in (u, own start)."""
        g, nodes = self.group, w[self.n :].reshape(self.num_nodes, 2 * self.half)
        own = nodes[np.maximum(self.node_of, 0)]
        pick = None if g.pick is None else jnp.asarray(g.pick)
        rest = (g.arcs, np.array(self.first), g.t0, g.ts, pick, g.values, g.seen, g.whiten)
        rest = [x if x is None else jnp.asarray(x) for x in rest]
        axes = (None, 0, *(None if x is None else 0 for x in rest))

        def one(u, node, *rest):
            def twice(x):
                out = self._segment(x[: self.n], x[self.n :], *rest)
                return out, out

            return jax.jacfwd(twice, has_aux=True)(jnp.concatenate([u, node]))

        J, values = jax.vmap(one, in_axes=axes)(w[: self.n], own, *rest)
        return values, J

    def _gaps(self, w: Array, ends: Array) -> Array:
        nodes = w[self.n :].reshape(self.num_nodes, 2 * self.half)
        inner = self.next_of >= 0
        return ends[inner] - nodes[self.next_of[inner]] / self.orbit[None]

    def evaluate(self, w: Array, horizon: Any, extra: tuple[Array, Array]) -> Evaluation:
        """The residual vector, its derivative put together from those of the segments, and c."""
        del horizon
        root, multipliers = extra  # √ρ, λ
        (r, ends), (Jr, Je) = self._all(w)
        n, u = self.n, w[: self.n]
        inner = np.flatnonzero(self.next_of >= 0)
        gaps = self._gaps(w, ends)
        prior = self.problem.core.prior_rows
        tied = root * gaps + multipliers.reshape(gaps.shape) / root
        residual = jnp.concatenate([r.ravel(), prior(u), tied.ravel()])
        # The end of a segment depends on its own start, a gap on the next start as well.
        J_tied = root * self._in_place(Je[inner], inner)
        gap, part = np.arange(len(inner))[:, None], np.arange(2 * self.half)
        to = n + self.next_of[inner][:, None] * 2 * self.half + part
        J_tied = J_tied.at[gap, part, to].add(-root / self.orbit[None])
        J_prior = jnp.zeros((n, self.size)).at[:, :n].set(jax.jacfwd(prior)(u))
        J_data = self._in_place(Jr, np.arange(len(r)))
        blocks = (J_data, J_prior, J_tied)
        J = jnp.concatenate([x.reshape(-1, self.size) for x in blocks])
        return Evaluation(residual, J, gaps.ravel())

    def _in_place(self, J: Array, segments: np.ndarray) -> Array:
        """Derivatives (S, R, n + 2 half) of some segments in (u, own start) as ones in w."""
        width = 2 * self.half
        # The start of an arc's first segment is no unknown: its columns go behind w, and off.
        node = np.where(self.node_of < 0, self.num_nodes, self.node_of)[segments]
        own = self.n + node[:, None] * width + np.arange(width)
        columns = np.hstack([np.tile(np.arange(self.n), (len(own), 1)), own])
        s, rows = np.arange(J.shape[0])[:, None, None], np.arange(J.shape[1])[:, None]
        wide = jnp.zeros((*J.shape[:2], self.size + width))
        return wide.at[s, rows, columns[:, None, :]].set(J)[..., : self.size]


def from_data(arc: Observations, spec: dict[str, Any], times: np.ndarray) -> np.ndarray:
    """States (T, 2 q.size) at `times` by interpolation of an arc's observations.

    Of positions alone, momenta are those p for which ∂H_D/∂p is the velocity by differences.

    **Raises** `ValueError` for an arc that observes something else.
    """
    if arc.observe not in ("positions", "state"):
        raise ValueError(
            'guess="data" needs observations of "positions" or of the "state"; this arc observes '
            f"{arc.observe!r}. Give guess as a function t → (q, p)."
        )
    flat = arc.values.reshape(len(arc.ts), -1)
    good = np.isfinite(flat).all(axis=1)
    ts, flat = arc.ts[good], flat[good]
    order = np.argsort(ts)

    def along(x):
        return np.stack([np.interp(times, ts[order], column[order]) for column in x.T], axis=1)

    if arc.observe == "state":
        return along(flat)
    import optimistix as optx  # here, so that importing the package does not import it

    q, v = along(flat), along(np.gradient(flat, ts, axis=0))
    shape = np.shape(spec["q0"])
    system, args, epsilon = spec["system"], spec.get("args"), spec.get("epsilon", 0.0)
    start = jnp.ravel(jnp.asarray(spec["p0"], float))

    def momentum(t, q, v):
        def off(p, _):
            slope = jax.grad(lambda p: system.hamiltonian(t, t, q, p.reshape(shape), epsilon, args))
            return slope(p) - v

        return optx.root_find(off, optx.Newton(1e-8, 1e-8), start, throw=False).value

    p = jax.vmap(momentum)(jnp.asarray(times), jnp.asarray(q.reshape(-1, *shape)), jnp.asarray(v))
    return np.concatenate([q, np.asarray(p)], axis=1)
