"""Singular potentials with samples that come close to the singularity, which does not change the
symmetry (Noether's theorem)."""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import dvi_jax as dvi

from . import case, named
from .maps import *
from .momenta import bilinear, of_bodies


def on_line(V, n):
    """Particles on a line with a pair potential V(r²)."""
    pairs = [f"(q{i} - q{j})**2" for i in range(1, n + 1) for j in range(1, i)]
    return separable(" + ".join(V.replace("r2", f"({x})") for x in pairs))


LENNARD_JONES = "4 * (r2**-6 - r2**-3)"
RADII = ("((q1 - 0.5)**2 + q2**2 + q3**2)", "((q1 + 0.5)**2 + q2**2 + q3**2)")
IN_SPRING = separable("q @ q / 2 + 1 / (q1 - q2)**2 + 1 / (q1 - q3)**2 + 1 / (q2 - q3)**2")

_CASES = {
    "Lennard-Jones pair on a line": case((on_line(LENNARD_JONES, 2), poly(2),
        box(2, 100, -2.0, 2.0), 0.01), "sum(p)"),
    "three Lennard-Jones particles on a line, Strang": case((on_line(LENNARD_JONES, 3), poly(2),
        box(3, 120, -2.0, 2.0), 0.005), "sum(p)", method=dvi.Strang()),
    # angular momentum, also that of the centre of mass
    "Lennard-Jones pair in the plane": case((system(
        f"sum(p**2) / 2 + {LENNARD_JONES.replace('r2', 'sum((q[0] - q[1])**2)')}"), bilinear(2),
        box((2, 2), 80), 0.005), of_bodies(1, 1)),
    # the total momentum; what else the flow conserves the map does not
    "Calogero–Moser pair": case((on_line("1 / r2", 2), poly(3), box(2, 100), 0.05), "sum(p)"),
    # the centre of mass is an oscillator: P² + Q² − hQP with P = Σp, Q = Σq
    "Calogero–Moser particles in a spring": case((IN_SPRING, poly(2), box(3, 120)),
        "sum(p)**2 + sum(q)**2 - 0.1 * sum(q) * sum(p)"),
    "Kepler with samples from 1e-6 to 1": case((KEPLER, ENERGIES, shell(2, 120, 1e-6, 1.0)), L),
    "Kepler with samples in a box around the centre": case((KEPLER, ENERGIES, box(2, 200), 1.0), L),
    "Kepler with a softening of 1e-6": case((separable("-1 / sqrt(q @ q + 1e-12)"), ENERGIES,
        shell(2, 120, 1e-8, 1.0), 0.01), L),
    "Coulomb repulsion of three charges on a line": case((on_line("1 / sqrt(r2)", 3), poly(2),
        box(3, 120), 0.1), "sum(p)"),
    "force of a logarithmic potential": case((separable("log(q @ q) / 2"),
        poly(2) + functions("log(q @ q) / 2"), shell(2, 100, 1e-4, 1.0)), L),
    "Yukawa potential in space": case((separable("-exp(-sqrt(q @ q)) / sqrt(q @ q)"),
        poly(2) + dvi.Radial((-1, 1)), shell(3, 120, 1e-3, 3.0)), ANGULAR),
    "attraction by 1/r⁶ in the plane": case((separable("-1 / (q @ q)**3"),
        poly(2) + dvi.Radial((-6, -2)), shell(2, 120, 0.05, 2.0), 0.01), L),
    # two centres on the first axis in space: rotations about it
    "Kepler with a fixed second centre": case((separable(
        f"-1 / sqrt{RADII[0]} - 1 / sqrt{RADII[1]}"), poly(2), box(3, 100), 0.05), L23),
    # q₊ − 2q + q₋ = h²/q³ is no QRT map with a polynomial invariant up to degree 4; checked in 60
    # digits
    "inverse square in one dimension": case((separable("sum(0.5 / q**2)"), poly(4), box(1, 120),
        0.1)),
}  # fmt: skip
CASES = named("singular potentials", _CASES)
