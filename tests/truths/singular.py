"""Singular potentials with samples that come close to the singularity."""

import jax.numpy as jnp

import dvi_jax as dvi

from . import Case
from .maps import box, separable, shell, total, turning
from .momenta import bilinear, of_centre, plane_samples, spin

KIND = "singular potentials"
NOETHER = "Noether's theorem: the samples close to the singularity do not change the symmetry"


def lennard_jones(r2):
    """4 (r⁻¹² − r⁻⁶) by r²."""
    return 4 * (r2**-6 - r2**-3)


def on_line(V, n):
    """Particles on a line with a pair potential V(r²)."""

    def energy(q):
        return sum(V((q[i] - q[j]) ** 2) for i in range(n) for j in range(i))

    return separable(energy)


def in_plane(V):
    """Two particles in the plane with a pair potential V(r²)."""
    return dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2) / 2 + V(jnp.sum((q[0] - q[1]) ** 2)))


def sum_of_momenta(q, p):
    """Σ p."""
    return jnp.sum(p)


KEPLER = separable(lambda q: -1 / jnp.sqrt(q @ q))
ENERGIES = dvi.Polynomials(2) + dvi.Radial()

CASES = (
    Case(
        "Lennard-Jones pair on a line",
        KIND,
        NOETHER,
        on_line(lennard_jones, 2),
        dvi.Polynomials(2),
        box(2, 100, -2.0, 2.0),
        truth=(sum_of_momenta,),
        h=0.01,
    ),
    Case(
        "three Lennard-Jones particles on a line, Strang",
        KIND,
        NOETHER,
        on_line(lennard_jones, 3),
        dvi.Polynomials(2),
        box(3, 120, -2.0, 2.0),
        truth=(sum_of_momenta,),
        h=0.005,
        options={"method": dvi.Strang()},
    ),
    Case(
        "Lennard-Jones pair in the plane",
        KIND,
        NOETHER + "; angular momentum, also that of the centre of mass",
        in_plane(lennard_jones),
        bilinear(2),
        plane_samples(80, 2),
        truth=(total(0), total(1), spin, of_centre(1, 1)),
        h=0.005,
    ),
    Case(
        "Calogero–Moser pair",
        KIND,
        "the total momentum; what else the flow conserves the map does not",
        on_line(lambda r2: 1 / r2, 2),
        dvi.Polynomials(3),
        box(2, 100),
        truth=(sum_of_momenta,),
        h=0.05,
    ),
    Case(
        "Calogero–Moser particles in a spring",
        KIND,
        "the centre of mass is an oscillator: P² + 3Q² − h…, with P = Σp, Q = Σq: P² + Q² − hQP",
        separable(
            lambda q: (
                q @ q / 2 + 1 / (q[0] - q[1]) ** 2 + 1 / (q[0] - q[2]) ** 2 + 1 / (q[1] - q[2]) ** 2
            )
        ),
        dvi.Polynomials(2),
        box(3, 120),
        truth=(lambda q, p: jnp.sum(p) ** 2 + jnp.sum(q) ** 2 - 0.1 * jnp.sum(q) * jnp.sum(p),),
    ),
    Case(
        "Kepler with samples from 1e-6 to 1",
        KIND,
        NOETHER,
        KEPLER,
        ENERGIES,
        shell(2, 120, 1e-6, 1.0),
        truth=(turning(0, 1),),
    ),
    Case(
        "Kepler with samples in a box around the centre",
        KIND,
        NOETHER,
        KEPLER,
        ENERGIES,
        box(2, 200),
        truth=(turning(0, 1),),
        h=1.0,
    ),
    Case(
        "Kepler with a softening of 1e-6",
        KIND,
        NOETHER,
        separable(lambda q: -1 / jnp.sqrt(q @ q + 1e-12)),
        ENERGIES,
        shell(2, 120, 1e-8, 1.0),
        truth=(turning(0, 1),),
        h=0.01,
    ),
    Case(
        "Coulomb repulsion of three charges on a line",
        KIND,
        NOETHER,
        on_line(lambda r2: 1 / jnp.sqrt(r2), 3),
        dvi.Polynomials(2),
        box(3, 120),
        truth=(sum_of_momenta,),
        h=0.1,
    ),
    Case(
        "force of a logarithmic potential",
        KIND,
        NOETHER,
        separable(lambda q: jnp.log(q @ q) / 2),
        dvi.Polynomials(2) + dvi.Basis({"log r": lambda q, p: jnp.log(q @ q) / 2}),
        shell(2, 100, 1e-4, 1.0),
        truth=(turning(0, 1),),
    ),
    Case(
        "Yukawa potential in space",
        KIND,
        NOETHER,
        separable(lambda q: -jnp.exp(-jnp.sqrt(q @ q)) / jnp.sqrt(q @ q)),
        dvi.Polynomials(2) + dvi.Radial((-1, 1)),
        shell(3, 120, 1e-3, 3.0),
        truth=(turning(0, 1), turning(0, 2), turning(1, 2)),
    ),
    Case(
        "attraction by 1/r⁶ in the plane",
        KIND,
        NOETHER,
        separable(lambda q: -1 / (q @ q) ** 3),
        dvi.Polynomials(2) + dvi.Radial((-6, -2)),
        shell(2, 120, 0.05, 2.0),
        truth=(turning(0, 1),),
        h=0.01,
    ),
    Case(
        "Kepler with a fixed second centre",
        KIND,
        "two centres on the first axis in space: rotations about it",
        separable(
            lambda q: (
                -1 / jnp.sqrt((q[0] - 0.5) ** 2 + q[1] ** 2 + q[2] ** 2)
                - 1 / jnp.sqrt((q[0] + 0.5) ** 2 + q[1] ** 2 + q[2] ** 2)
            )
        ),
        dvi.Polynomials(2),
        box(3, 100),
        truth=(turning(1, 2),),
        h=0.05,
    ),
    Case(
        "inverse square in one dimension",
        KIND,
        "q₊ − 2q + q₋ = h²/q³ is no QRT map with a polynomial invariant up to degree 4; checked in "
        "60 digits",
        separable(lambda q: jnp.sum(0.5 / q**2)),
        dvi.Polynomials(4),
        box(1, 120),
        h=0.1,
    ),
)
