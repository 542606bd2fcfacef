"""The runs of large.py: one trajectory with many coordinates, as users of the package write it."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from _workloads import A, B, C, chain

import dvi_jax as dvi
from dvi_jax import systems

WORK = 10**8
"""Coordinates times steps of a run at most; those of pairs are counted as coordinates."""


# The systems


def sine_gordon(t0, t1, q0, p1, args):
    """Σ p²/2 + (q_{i+1} − q_i)²/2 + 1 − cos q_i on a ring."""
    return jnp.sum(p1**2 / 2 + (jnp.roll(q0, -1) - q0) ** 2 / 2 + 1 - jnp.cos(q0))


def phi4(t0, t1, q0, p1, args):
    """Σ p²/2 + Σ over bonds (difference)²/2 + q²/2 + c q⁴/4, periodic in each direction."""
    bonds = sum((jnp.roll(q0, -1, axis) - q0) ** 2 for axis in range(q0.ndim))
    return jnp.sum(p1**2 / 2 + bonds / 2 + q0**2 / 2 + args * q0**4 / 4)


def bodies(t0, t1, q0, p1, args):
    """Σ |p|²/(2m) − Σ over pairs m²/√(r² + s), all masses m equal: args s, m."""
    softening, m = args
    d = q0[:, None] - q0[None]
    inverse = 1 / jnp.sqrt(jnp.sum(d**2, -1) + softening)
    return jnp.sum(p1**2) / (2 * m) - m**2 * jnp.sum(jnp.triu(inverse, 1))


def fput_energy(t, q, p, args):
    """Energy of the FPUT chain."""
    return systems.fput(2).system.hamiltonian(t, t, q, p, 0.0, args)


class Case(NamedTuple):
    """A run: the package's system, its start, and the function of large.c that does the same."""

    kernel: str
    system: Any
    shape: tuple[int, ...]
    h: float
    spread: tuple[float, float]
    constants: tuple[float, ...]
    work: int = 0  # numbers of memory that C needs, times n
    args: Any = None
    options: Any = None  # more keywords of `integrate`
    cost: int = 1  # coordinates of a step are multiplied by this

    @property
    def steps(self) -> int:
        return int(np.clip(WORK // (self.cost * np.prod(self.shape)), 10, 20_000))

    @property
    def is_iterated(self) -> bool:
        """Whether the function in C makes a given number of iterations."""
        return "root_finder" in (self.options or {}) and not self.kernel.endswith("_tested")

    def start(self) -> list[np.ndarray]:
        rng = np.random.default_rng(5)
        return [s * rng.uniform(-1, 1, self.shape) for s in self.spread]

    def integrate(self, q0, p0, steps: int, **more) -> Any:
        """What a user writes."""
        settings = {"save": dvi.Save(final=True), **(self.options or {}), **more}
        return dvi.integrate(
            self.system,
            q0,
            p0,
            h=self.h,
            num_steps=steps,
            args=self.args,
            throw=False,
            **settings,
        )

    def final(self, steps: int, **more) -> Callable:
        """(q0, p0) → state after the last step, and status."""

        def one(q0, p0):
            solution = self.integrate(q0, p0, steps, **more)
            return solution.qs[-1], solution.ps[-1], solution.result

        return one

    def loss(self, steps: int) -> Callable:
        """(q0, p0) → (|q|² + |p|²)/2 after the last step."""

        def value(q0, p0):
            q1, p1, _ = self.final(steps, adjoint=dvi.Reversible())(q0, p0)
            return (jnp.sum(q1**2) + jnp.sum(p1**2)) / 2

        return value


def fput(n: int, kernel: str = "fput", work: int = 0, **options) -> Case:
    problem = systems.fput(n, alpha=0.0, beta=0.5)
    spread, cost = (0.1, 0.1), 1 if kernel == "fput" else 100
    constants = (0.0, 0.5)
    return Case(
        kernel, problem.system, (n,), 0.05, spread, constants, work, problem.args, options, cost
    )


def lattice(n: int, dimensions: int) -> Case:
    system, shape = dvi.System(phi4), (n,) * dimensions
    return Case(f"phi4_{dimensions}d", system, shape, 0.05, (0.5, 0.5), (0.3,), args=0.3)


def n_body(n: int, kernel: str = "n_body") -> Case:
    constants = (1e-2, 1.0 / n)
    spread = (1.0, 0.1 / n)
    return Case(kernel, dvi.System(bodies), (n, 3), 0.01, spread, constants, 6, constants, cost=n)


def toda(n: int) -> Case:
    return Case("toda", systems.toda(n).system, (n,), 0.05, (0.5, 0.5), (), 1)


def field(n: int) -> Case:
    return Case("sine_gordon", dvi.System(sine_gordon), (n,), 0.05, (1.0, 1.0), ())


def nls(n: int, kernel: str = "nls", work: int = 2) -> Case:
    system, args = systems.nls_lattice(n).system, {"kappa": 1.0, "gamma": 1.0}
    options = {"root_finder": dvi.Picard()}
    return Case(kernel, system, (n,), 0.01, (0.5, 0.5), (1.0, 1.0), work, args, options, 20)


def newton(n: int) -> Case:
    options = {"root_finder": dvi.Newton()}
    spread, constants = (0.3, 0.3), (A, B, C)
    return Case("band", dvi.System(chain), (n,), 0.02, spread, constants, 4, None, options, 2000)


CASES: dict[str, tuple[Callable[[], Case], float | None]] = {
    **{f"FPUT {n}": (functools.partial(fput, n), 2.0) for n in (16, 32, 48)},
    **{f"FPUT {n}": (functools.partial(fput, n), 1.3) for n in (64, 128, 1024, 16_384, 10**6)},
    "Toda 1000": (functools.partial(toda, 1000), 1.5),
    "sine-Gordon 1000": (functools.partial(field, 1000), 1.5),
    **{f"phi4 {n}²": (functools.partial(lattice, n, 2), 1.3) for n in (16, 64, 256, 1024)},
    "phi4 32³": (functools.partial(lattice, 32, 3), 1.5),
    **{f"N-body {n}": (functools.partial(n_body, n), 1.3) for n in (32, 100, 500)},
    **{
        f"N-body {n}, half of the pairs": (functools.partial(n_body, n, "n_body_half"), None)
        for n in (32, 100, 500)
    },
    "NLS 512, Picard": (functools.partial(nls, 512), 1.5),
    "FPUT 1000, GaussLegendre(2)": (
        functools.partial(
            fput, 1000, "fput_gauss", 6, method=dvi.GaussLegendre(2), root_finder=dvi.Picard()
        ),
        2.0,
    ),
    "NLS 512, Picard, with the test of convergence": (
        functools.partial(nls, 512, "nls_tested", 5),
        1.5,
    ),
    "FPUT 1000, GaussLegendre(2), with the test of convergence": (
        functools.partial(
            fput,
            1000,
            "fput_gauss_tested",
            18,
            method=dvi.GaussLegendre(2),
            root_finder=dvi.Picard(),
        ),
        2.0,
    ),
    "chain 1000, Newton with a band": (functools.partial(newton, 1000), 1.5),
}
"""Name → case and target of its ratio to C."""
