"""Neighbours of integrable maps, which conserve less, and integrable flows whose maps do not.

What is not in a truth is not conserved: checked in 60 digits.
"""

# ruff: noqa: F403, F405 (the vocabulary of the tables is `maps`)

import dvi_jax as dvi

from . import case, named
from .integrable import (
    EXPONENTIALS,
    WAVES,
    asymmetric,
    duffing,
    garnier,
    lyness,
    suris,
    toda,
    toda_basis,
)
from .maps import *

PENDULUM_BASIS = poly(3, ["p"]) + trig(2, "q") + poly(1, ["p"]) * trig(1, "q")
CHAIN_BASIS = functions(
    *(f"exp({d}){p}" for d in ("q2 - q1", "q3 - q2") for p in ("", " * p1", " * p2", " * p3"))
)
FIRST, SECOND = ["q1", "p1"], ["q2", "p2"]
DETUNED = poly(4, FIRST) + poly(3, FIRST) * poly(1, SECOND) + poly(2, SECOND)
STRANG, YOSHIDA = dvi.Strang(), dvi.Yoshida(4)

_CASES = {
    **{f"McMillan's map with a cubic force of {size:g}": case(
        (separable(f"sum(q**2 - 0.7 * log(1 + q**2) + {size} * q**4 / 4)"), poly(4), box(1, 120),
        1.0)) for size in (1e-2, 1e-4, 1e-6, 1e-8)},
    # q₊ + q₋ = 1.4 q/(1 + q⁴) is not of the form of Quispel, Roberts & Thompson
    "McMillan's map with another exponent": case((additive(lambda q: 1.4 * q / (1 + q**4)), poly(6),
        box(1, 120), 1.0)),
    # β differs between numerator and denominator by 0.001
    "symmetric QRT map with one coefficient changed": case(
        (additive(lambda q: -(0.501 * q**2 - 1.2 * q + 0.3) / (q**2 + 0.5 * q + 2)), poly(4),
        box(1, 120), 1.0)),
    # D(y) has a term 0.01 y that the other curve has not
    "asymmetric QRT map with one coefficient changed": case(
        (asymmetric(0.8, 0.3, 1.5, -0.4, change=0.01), poly(4), box(1, 120), 1.0)),
    "Lyness' map with another exponent": case((lyness(2.0, power=1.01), EXPONENTIALS, box(1, 80),
        1.0)),
    "Suris' trigonometric map with one coefficient changed": case((suris(0.4, other=1.02),
        WAVES + poly(2), box(1, 100, -3.0, 3.0), 1.0)),
    # e^{1.05 u} in place of e^u: the total momentum remains
    "discrete Toda lattice with another exponent": case((toda(0.5, steepness=1.05),
        toda_basis(0.5, 3), box(3, 100), 0.5), "sum(p)"),
    # the flow is integrable, the map of Strang's method is not: the total momentum remains
    "Toda chain by Strang's method": case((separable("exp(q2 - q1) + exp(q3 - q2)"),
        poly(3, ["p1", "p2", "p3"]) + CHAIN_BASIS, box(3, 100)), "sum(p)", method=STRANG),
    # central, so that L is conserved
    "radial McMillan map with a quartic term": case((garnier(0.7, 0.7, change=0.01), poly(4),
        box(2, 150), 1.0), L),
    "Garnier's system with a quartic term": case((garnier(0.9, 0.5, change=0.01), poly(4),
        box(2, 150), 1.0)),
    # without the denominator of the integrable discretisation
    "Duffing oscillator by symplectic Euler": case((separable("sum(q**2 / 2 + q**4 / 4)"), poly(6),
        box(1, 120), 0.25)),
    # the denominator is made for h = 0.25, and the step is 0.26
    "integrable discrete Duffing oscillator at another step": case((duffing(1.0, 0.5, 0.25),
        poly(4), box(1, 120), 0.26)),
    **{f"central force with an anisotropy of {size:g}": case(
        (separable(f"(q @ q)**2 / 4 + {size} * q1**2"), poly(3), box(2, 100)))
        for size in (1e-3, 1e-6)},
    # the two quadratic forms remain of the four of the isotropic oscillator
    "oscillators detuned by 1e-6": case((spring(1.0, 1.0 + 1e-6), poly(2), box(2, 100)),
        energies(0.1, 1.0, 1.0 + 1e-6)),
    # the cubic invariant needs the resonance
    "resonance 1:2 of the map, detuned by 0.001": case((spring(0.5, 1.751), poly(3), box(2, 120),
        1.0), energies(1.0, 0.5, 1.751)),
    # the map turns by 2 arcsin(hω/2) in each step, so that frequencies 1 and 2 are detuned by
    # O(h²)
    **{f"resonance 1:2 of the flow at h = {h:g}": case((spring(1.0, 4.0), poly(3), box(2, 120), h),
        energies(h, 1.0, 4.0)) for h in (0.1, 1e-3)},
    # angular momentum is exact; the energy changes in a step by O(h^{r+1}), r = 1, 2, 4, 4
    **{f"Kepler with its energy in the basis, {name}, h = {h:g}": case((KEPLER, ENERGIES,
        shell(2, 100), h), L, method=method) for name, method, h in (("symplectic Euler",
        dvi.TypeII(), 0.01), ("Strang", STRANG, 0.001), ("Yoshida", YOSHIDA, 0.02),
        ("Gauss–Legendre", dvi.GaussLegendre(2), 0.02))},
    # the map of a method is not the flow
    **{f"pendulum with its energy in the basis, {name}": case((PENDULUM, PENDULUM_BASIS,
        box(1, 80, -3.0, 3.0), h), method=method) for name, method, h in (("symplectic Euler",
        dvi.TypeII(), 0.001), ("Strang", STRANG, 0.002), ("Yoshida", YOSHIDA, 0.05))},
    # a Gauss method conserves quadratic invariants, not quartic ones
    "quartic oscillator with its energy in the basis, midpoint rule": case((QUARTIC, poly(4),
        box(1, 120), 0.05), method=dvi.GaussLegendre(1)),
    # H = N²: conserved by the Gauss methods, not by H_D(q0, p1) = N²
    "function of an action by the type II map": case((system("sum((q**2 + p**2)**2) / 4"), poly(4),
        box(1, 120))),
    "isotropic oscillator with a weak quartic coupling": case(
        (separable("q @ q / 2 + 1e-5 * q1**2 * q2**2"), poly(2), box(2, 100))),
    # axial symmetry: L₃ remains of L
    "Kepler with an oblateness of 1e-6 in space": case(
        (separable("-1 / sqrt(q @ q) + 1e-6 * (3 * q3**2 / (q @ q) - 1) / (q @ q)**1.5"), poly(2),
        shell(3, 100)), L),
    # standard map with K = 1e-5: p changes
    "twist map with a weak kick": case((separable("-1e-5 * sum(cos(q))"),
        poly(3, ["p"]) + trig(2, "q"), box(1, 80, -3.0, 3.0), 1.0)),
    # a force of (q − 0.9)³ for q > 0.9, where few samples lie
    "oscillator that stiffens beyond the samples' middle": case(
        (separable("sum(q**2 / 2 + maximum(q - 0.9, 0.0)**4 / 4)"), poly(3), box(1, 400))),
    # a composition of integrable maps of different steps is not integrable
    "McMillan's map by Yoshida's method": case((MCMILLAN, poly(4) + functions("1 / (1 + q1**2)"),
        box(1, 100), 1.0), method=YOSHIDA),
    # the invariant has 1/(1 + q²), which no polynomial is
    "McMillan's map by Strang's method in polynomials": case((MCMILLAN, poly(6), box(1, 100), 1.0),
        method=STRANG),
    # the quartic invariant needs the resonance
    "resonance 1:3 of the map, detuned by 1e-5": case((spring(0.5, 3.12501), DETUNED, box(2, 100),
        1.0), energies(1.0, 0.5, 3.12501)),
    # a type II map has the symmetries that are linear in q: of the three quadratic invariants of
    # the flow q·p remains, that of q → λq, p → p/λ
    "free top by two vectors, type II": case((TWO_VECTORS, poly(2), box(3, 70), 0.2), "q @ p"),
}  # fmt: skip
CASES = named("neighbours", _CASES)
