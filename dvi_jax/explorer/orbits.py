"""Surfaces of sections, states on them that have a given energy, and colours of orbits."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from ..base.inputs import as_parameter
from ..dynamics import frequencies
from ..integration.integrate import integrate
from ..methods import Method
from ..observe import MEGNO
from ..observe.solution import Save
from ..problem.system import System

CHUNK = 8
"""Orbits of one call: a section of any number of orbits takes one program."""

SIGNAL = 8
"""Steps between two samples of a frequency analysis."""

_HALF = 1200  # of the trial values of a momentum, on either side of the minimum of H


class Plane(eqx.Module):
    """The surface q[index] = value; `value` is traced, so that another one compiles nothing."""

    index: tuple[int, ...] = eqx.field(static=True)
    value: Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t, q, p, args):
        return q[self.index] - self.value


class Strobe(eqx.Module):
    """The surface of a stroboscope, t = k·period, as `dvi.dynamics.stroboscope`."""

    period: Array = eqx.field(converter=jnp.asarray)

    def __call__(self, t, q, p, args):
        return jnp.sin(2 * jnp.pi * (t / self.period))


@eqx.filter_jit
def onto_energy(
    system: System, index: tuple[int, ...], q: Array, p: Array, energy: Array, epsilon: Any, args
) -> Array:
    """The momenta p of states (q, p), shape (orbits, …), with H = `energy`: p[index] is replaced.

    The root is that at which q[index] increases, ∂H/∂p[index] > 0; NaN without a root within about
    80 times the largest momentum.
    """

    def momentum(q, p):
        def excess(s):
            at_s = p.at[index].set(s)
            return system.hamiltonian(time, time, q, at_s, epsilon, args) - energy

        time, slope = jnp.zeros((), q.dtype), jax.grad(excess)
        # The minimum if H is quadratic in this momentum: narrow pairs of roots are next to it.
        minimum = -slope(0.0) / jax.grad(slope)(0.0)
        middle = jnp.where(jnp.isfinite(minimum), minimum, 0.0)
        size = jnp.max(jnp.abs(p))
        scale = jnp.where(size > 0, size, 1.0)
        trial = middle + scale * 1e-3 * jnp.sinh(jnp.arange(-_HALF, _HALF + 1) / (_HALF / 12))
        values = jax.vmap(excess)(trial)
        rises = (values[:-1] < 0) & (values[1:] >= 0)
        nearest = jnp.argmin(jnp.where(rises, jnp.abs(trial[1:] - middle), jnp.inf))

        def halve(_, ends):
            low, high = ends
            mean = (low + high) / 2
            is_below = excess(mean) < 0
            return jnp.where(is_below, mean, low), jnp.where(is_below, high, mean)

        low, high = lax.fori_loop(0, 60, halve, (trial[nearest], trial[nearest + 1]))
        return p.at[index].set(jnp.where(rises.any(), (low + high) / 2, jnp.nan))

    return jax.vmap(momentum)(q, p)


@eqx.filter_jit
def _megno(system: System, method: Method, q, p, h, epsilon, args, steps: int):
    def orbit(q, p):
        options = {"epsilon": epsilon, "args": args, "observe": MEGNO(), "throw": False}
        options |= {"h": h, "num_steps": steps, "method": method, "save": Save(final=True)}
        return integrate(system, q, p, **options).observed

    return jax.vmap(orbit)(q, p)


@eqx.filter_jit
def _samples(system: System, method: Method, q, p, h, epsilon, args, steps: int):
    def orbit(q, p):
        options = {"epsilon": epsilon, "args": args, "save": Save(every=SIGNAL), "throw": False}
        return integrate(system, q, p, h=h, num_steps=steps, method=method, **options)

    return jax.vmap(orbit)(q, p)


def indicator(
    kind: str, system: System, options: dict[str, Any], states: Any, index: Any, steps: int
) -> np.ndarray:
    """The MEGNO of orbits, or the frequency of the degree of freedom `index`; shape (orbits,).

    - `options`: h, epsilon, args and method. `states`: q and p of the orbits.
    """
    h, epsilon = (as_parameter(float(options[name])) for name in ("h", "epsilon"))
    inputs = h, epsilon, options["args"], steps

    def of_chunk(q, p):
        if kind == "MEGNO":
            return _megno(system, options["method"], q, p, *inputs)
        orbits = _samples(system, options["method"], q, p, *inputs)
        signal = orbits.qs[(..., *index)] - 1j * orbits.ps[(..., *index)]
        lines = frequencies(orbits.ts[0], signal, count=1, refine=False, throw=False)
        return jnp.abs(lines.frequencies[:, 0])

    return in_chunks(of_chunk, *states)


def in_chunks(function: Any, *arrays: np.ndarray) -> Any:
    """A function of batches with `CHUNK` rows, of any number of rows: the last are repeated."""
    count = len(arrays[0])
    parts = []
    for first in range(0, count, CHUNK):
        rows = np.minimum(np.arange(first, first + CHUNK), count - 1)
        parts.append(jax.tree.map(np.asarray, function(*(x[rows] for x in arrays))))
    return jax.tree.map(lambda *xs: np.concatenate(xs)[:count], *parts)
