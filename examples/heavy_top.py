"""The integrals of heavy tops, found by discovery in the reduced variables.

    python examples/heavy_top.py

The functions are polynomials in the angular momentum π and the vertical γ on the axes of the body.
They are evaluated at random rotation matrices and momenta, and mapped by one step of order 8.
"""

import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems import rigid

NAMES = ("π1", "π2", "π3", "γ1", "γ2", "γ3")
POWERS = ("", "", "²", "³", "⁴")


def reduced(q, p):
    """(π, γ), shape (6,)."""
    return jnp.concatenate([rigid.body_momentum(q, p), q[2]])


def polynomials(degree: int) -> dvi.Basis:
    """All monomials in (π, γ) up to a degree, without the constant."""
    functions = {}
    for size in range(1, degree + 1):
        for factors in itertools.combinations_with_replacement(range(6), size):
            count = np.bincount(factors, minlength=6)
            name = " ".join(NAMES[i] + POWERS[n] for i, n in enumerate(count) if n)
            which = np.array(factors)
            functions[name] = lambda q, p, which=which: jnp.prod(reduced(q, p)[which])
    return dvi.Basis(functions)


def states(count: int, I, seed: int = 0):  # noqa: E741
    """Random rotations, with angular momenta between −1 and 1 on each axis of the body."""
    rng = np.random.default_rng(seed)
    R = jnp.asarray(Rotation.random(count, random_state=rng).as_matrix())
    pi = jnp.asarray(rng.uniform(-1, 1, (count, 3)))
    return np.asarray(R), np.asarray(jax.vmap(rigid.momentum, (0, 0, None))(R, pi, jnp.asarray(I)))


def found(top, degree: int, h: float = 0.04) -> dvi.Discovery:
    """What discovery finds for a heavy top with polynomials of a degree."""
    basis = polynomials(degree)
    samples = states(2 * len(basis.names) + 60, top.args["I"])
    method = dvi.KahanLi(8, base=dvi.Rattle())
    return dvi.discover_invariants(
        top.system, basis, h=h, samples=samples, args=top.args, method=method
    )


def asymmetric():
    """A top without a third integral."""
    top = systems.heavy_top()
    args = {"I": np.array([1.0, 1.3, 0.8]), "c": np.array([0.4, 0.3, 0.7])}
    return systems.Problem("asymmetric", top.system, top.q0, top.p0, h=top.h, args=args)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    tops = {
        "Lagrange's top": (systems.heavy_top(), 2),
        "Kovalevskaya's top": (systems.heavy_top("kovalevskaya"), 4),
        "three different moments": (asymmetric(), 4),
    }
    for name, (top, degree) in tops.items():
        began = time.process_time()
        result = found(top, degree)
        print(f"{name}, degree {degree}, {time.process_time() - began:.0f} s:\n{result}\n")
