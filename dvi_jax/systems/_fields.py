r"""Scalar fields on cubic lattices of one to three dimensions: energy, momentum, ends.

The lattice has the spacing dx in every direction, q is the field u at its sites, and p is the
momentum of a cell, p = ∂u/∂t dx^dim. Sums over sites are then integrals, and the energy is that of
the field. All functions use slices of whole arrays, so that one loop over the sites evaluates them.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import lax

from ..base.checks import finite, one_of, positive, whole
from ._problem import Parameter, Start, bound

ENDS = ("periodic", "fixed", "free")
Ends = tuple[str, ...]


def shape_of(name: str, shape: Any, smallest: int = 3) -> tuple[int, ...]:
    """One to three numbers of sites. **Raises** `ValueError`."""
    sizes = (shape,) if np.ndim(shape) == 0 else tuple(shape)
    one_of(f"number of axes in {name}", len(sizes), (1, 2, 3))
    hint = f"The lattice has at least {smallest} sites in each direction."
    return tuple(whole(name, size, smallest, hint=hint) for size in sizes)


def ends_of(ends: str | Sequence[str], dim: int) -> Ends:
    """The kind of ends of each axis; one word is for all. **Raises** `ValueError`."""
    kinds = (ends,) * dim if isinstance(ends, str) else tuple(ends)
    one_of("number of words in ends", len(kinds), (dim,), hint="One word is for all axes.")
    return tuple(one_of("ends", kind, ENDS) for kind in kinds)


def differences(u, axis, end, args):
    r"""u_{j+1} − u_j along an axis.

    - periodic: n of them, the last one from site n − 1 to site 0, where the field is larger by
      2π ``args["winding"]`` if there is a winding number.
    - fixed: n + 1 of them; the field beyond the ends is ``args["left"]`` and ``args["right"]``.
    - free: n + 1 of them, the first and the last are zero.
    """
    if end == "free":
        widths = [(1, 1) if i == axis else (0, 0) for i in range(u.ndim)]
        return jnp.pad(jnp.diff(u, axis=axis), widths)
    if end == "periodic" and "winding" not in args:
        return jnp.roll(u, -1, axis) - u
    first = lax.slice_in_dim(u, 0, 1, axis=axis)
    if end == "periodic":
        turn = jnp.asarray(2 * jnp.pi * args["winding"], u.dtype)
        return jnp.diff(jnp.concatenate([u, first + turn], axis), axis=axis)
    walls = [jnp.full_like(first, args[side]) for side in ("left", "right")]
    return jnp.diff(jnp.concatenate([walls[0], u, walls[1]], axis), axis=axis)


def field_energy(q0, p1, args, ends, potential):
    r"""Σ_j p1_j²/(2 dx^dim) + dx^dim [Σ (difference of neighbours)²/(2 dx²) + Σ_j V_j].

    `potential`: V at the sites, or a part of them whose sum is the integral.
    """
    dx = args["dx"]
    cell = dx**q0.ndim
    slopes = sum(jnp.sum(differences(q0, i, end, args) ** 2) for i, end in enumerate(ends))
    return jnp.sum(p1**2) / (2 * cell) + cell * (slopes / (2 * dx**2) + jnp.sum(potential))


def _field_momentum(ends, t0, t1, q0, p0, q1, p1, args):
    """−Σ_j p_j (u_{j+1} − u_{j−1})/(2 dx) at t1: a number in one dimension, else shape (dim,)."""

    def along(axis, end):
        d = differences(q1, axis, end, args)
        if end == "periodic":
            both = d + jnp.roll(d, 1, axis)
        else:
            n = d.shape[axis]
            parts = (lax.slice_in_dim(d, i, n - 1 + i, axis=axis) for i in (0, 1))
            both = sum(parts)
        return -jnp.sum(p1 * both) / (2 * args["dx"])

    components = [along(axis, end) for axis, end in enumerate(ends)]
    return components[0] if len(ends) == 1 else jnp.stack(components)


def _topological_charge(period, t0, t1, q0, p0, q1, p1, args):
    """(u at the right end − u at the left end)/(distance of neighbouring vacua) at t1."""
    return (jnp.mean(q1[-1]) - jnp.mean(q1[0])) / period


@functools.cache  # functions are compared by identity: another one would compile again
def hamiltonian_of(function: Callable[..., Any], ends: Ends) -> Callable[..., Any]:
    """The Hamiltonian ``function(ends, t0, t1, q0, p1, args)`` for these ends."""
    return bound(function, ends)


@functools.cache
def observables_of(ends: Ends, period: float | None = None) -> tuple[Callable[..., Any], ...]:
    """`field_momentum`; at free ends also `topological_charge`, for vacua at this distance."""
    functions = [bound(_field_momentum, ends)]
    if period is not None and ends[0] == "free":
        functions.append(bound(_topological_charge, period))
    return tuple(functions)


def parameters_of(dx: float, ends: Ends, left: float, right: float) -> dict[str, Parameter]:
    """The spacing, and the values of the field beyond fixed ends."""
    known = {"dx": Parameter(positive("dx", dx), "distance of neighbouring sites [length]")}
    if "fixed" in ends:
        for name, value in (("left", left), ("right", right)):
            meaning = f"field beyond the {name} end [field]"
            known[name] = Parameter(finite(name, value), meaning, finite)
    return known


def start_of(system: str, dim: int) -> Start:
    """The check of initial conditions on a lattice of this dimension."""
    return Start(f"{system} has a field on {dim} axes", (None,) * dim, smallest=3)


def places(n: int, dx: float) -> np.ndarray:
    """Positions of the sites of an axis, with zero in the middle: shape (n,)."""
    return dx * (np.arange(n) - (n - 1) / 2)


def sech(x):
    """1/cosh x without overflow."""
    return 1 / np.cosh(np.clip(x, -700, 700))


def step_size(dx: float, dim: int) -> float:
    """A quarter of dx/√dim, the largest stable step of the leapfrog method for short waves."""
    return dx / (4 * np.sqrt(dim))
