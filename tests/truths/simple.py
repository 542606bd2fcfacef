"""One degree of freedom, and the simplest maps with more."""

import jax.numpy as jnp

import dvi_jax as dvi
from dvi_jax.discover.library import rotation

from . import Case, SymmetryCase
from .maps import box

OSCILLATOR = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)
CENTRAL = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + (q @ q) ** 2 / 4)

CASES = (
    Case(
        "oscillator, symplectic Euler",
        "integrable",
        "the map is linear and keeps p²/2 + q²/2 − h q p/2",
        OSCILLATOR,
        dvi.Polynomials(4),
        box(1, 200),
        truth=(lambda q, p: jnp.sum(p * p + q * q - 0.1 * q * p) / 2,),
    ),
    SymmetryCase(
        "central force in the plane",
        "symmetry",
        "rotations; a quartic force has no other linear symmetry",
        CENTRAL,
        dvi.Polynomials(1),
        box(2, 200),
        truth=(rotation(0, 1),),
        variational=1,
        options={"time": False},
    ),
)
