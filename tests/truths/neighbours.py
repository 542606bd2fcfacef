"""Neighbours of integrable maps, which conserve less, and integrable flows whose maps do not."""

import jax.numpy as jnp

import dvi_jax as dvi

from . import Case
from .integrable import (
    EXPONENTIALS,
    WAVES,
    asymmetric,
    duffing,
    energy,
    garnier,
    lyness,
    spring,
    suris,
    toda,
    toda_basis,
)
from .maps import additive, box, separable, shell, turning

KIND = "neighbours"
NONE = "checked in 60 digits: the changes of the basis have full rank"

KEPLER = separable(lambda q: -1 / jnp.sqrt(q @ q))
PENDULUM = separable(lambda q: -jnp.sum(jnp.cos(q)))
ENERGIES = dvi.Polynomials(2) + dvi.Radial()
"""Functions of Kepler's problem with the energy p²/2 − 1/r in their span."""

PENDULUM_BASIS = (
    dvi.Polynomials(3, ["p"])
    + dvi.Trigonometric(2, "q")
    + (dvi.Polynomials(1, ["p"]) * dvi.Trigonometric(1, "q"))
)


def mcmillan_and(size):
    """McMillan's map with a force of `size` q³ more."""
    return separable(lambda q: jnp.sum(q**2 - 0.7 * jnp.log(1 + q**2) + size * q**4 / 4))


def squeezed(size):
    """A central force with an anisotropy."""
    return separable(lambda q: (q @ q) ** 2 / 4 + size * q[0] ** 2)


def kepler_with(name, method, h, source):
    """Kepler's problem with the energy in the basis: only L is conserved."""
    return Case(
        f"Kepler with its energy in the basis, {name}, h = {h:g}",
        KIND,
        source,
        KEPLER,
        ENERGIES,
        shell(2, 100),
        truth=(turning(0, 1),),
        h=h,
        options={"method": method},
    )


ENERGY = "angular momentum is exact; the energy changes in a step by O(h^{r+1}): "

CASES = (
    *(
        Case(
            f"McMillan's map with a cubic force of {size:g}",
            KIND,
            NONE,
            mcmillan_and(size),
            dvi.Polynomials(4),
            box(1, 120),
            h=1.0,
        )
        for size in (1e-2, 1e-4, 1e-6, 1e-8)
    ),
    Case(
        "McMillan's map with another exponent",
        KIND,
        "q₊ + q₋ = 1.4 q/(1 + q⁴) is not of the form of Quispel, Roberts & Thompson; " + NONE,
        additive(lambda q: 1.4 * q / (1 + q**4)),
        dvi.Polynomials(6),
        box(1, 120),
        h=1.0,
    ),
    Case(
        "symmetric QRT map with one coefficient changed",
        KIND,
        "β differs between numerator and denominator by 0.001; " + NONE,
        additive(lambda q: -(0.501 * q**2 - 1.2 * q + 0.3) / (q**2 + 0.5 * q + 2)),
        dvi.Polynomials(4),
        box(1, 120),
        h=1.0,
    ),
    Case(
        "asymmetric QRT map with one coefficient changed",
        KIND,
        "D(y) has a term 0.01 y that the other curve has not; " + NONE,
        asymmetric(0.8, 0.3, 1.5, -0.4, change=0.01),
        dvi.Polynomials(4),
        box(1, 120),
        h=1.0,
    ),
    Case(
        "Lyness' map with another exponent",
        KIND,
        NONE,
        lyness(2.0, power=1.01),
        EXPONENTIALS,
        box(1, 80),
        h=1.0,
    ),
    Case(
        "Suris' trigonometric map with one coefficient changed",
        KIND,
        NONE,
        suris(0.4, other=1.02),
        WAVES + dvi.Polynomials(2),
        box(1, 100, -3.0, 3.0),
        h=1.0,
    ),
    Case(
        "discrete Toda lattice with another exponent",
        KIND,
        "e^{1.05 u} in place of e^u: the total momentum is left; " + NONE,
        toda(0.5, steepness=1.05),
        toda_basis(0.5, 3),
        box(3, 100),
        truth=(lambda q, p: jnp.sum(p),),
        h=0.5,
    ),
    Case(
        "Toda chain by Strang's method",
        KIND,
        "the flow is integrable, the map of Strang's method is not: the total momentum is left",
        separable(lambda q: jnp.sum(jnp.exp(q[1:] - q[:-1]))),
        dvi.Polynomials(3, ["p1", "p2", "p3"])
        + dvi.Basis(
            {
                f"{name}{f}": lambda q, p, k=k, m=m: (
                    jnp.exp(q[k + 1] - q[k]) * (p[m] if m >= 0 else 1.0)
                )
                for k, name in ((0, "e12 "), (1, "e23 "))
                for m, f in ((-1, "1"), (0, "p1"), (1, "p2"), (2, "p3"))
            }
        ),
        box(3, 100),
        truth=(lambda q, p: jnp.sum(p),),
        h=0.1,
        options={"method": dvi.Strang()},
    ),
    Case(
        "radial McMillan map with a quartic term",
        KIND,
        "central, so that L is conserved; " + NONE + " else",
        garnier([0.7, 0.7], change=0.01),
        dvi.Polynomials(4),
        box(2, 150),
        truth=(turning(0, 1),),
        h=1.0,
    ),
    Case(
        "Garnier's system with a quartic term",
        KIND,
        NONE,
        garnier([0.9, 0.5], change=0.01),
        dvi.Polynomials(4),
        box(2, 150),
        h=1.0,
    ),
    Case(
        "Duffing oscillator by symplectic Euler",
        KIND,
        "without the denominator of the integrable discretisation; " + NONE,
        separable(lambda q: jnp.sum(q**2 / 2 + q**4 / 4)),
        dvi.Polynomials(6),
        box(1, 120),
        h=0.25,
    ),
    Case(
        "integrable discrete Duffing oscillator at another step",
        KIND,
        "the denominator is made for h = 0.25, and the step is 0.26; " + NONE,
        duffing(1.0, 0.5, 0.25),
        dvi.Polynomials(4),
        box(1, 120),
        h=0.26,
    ),
    *(
        Case(
            f"central force with an anisotropy of {size:g}",
            KIND,
            NONE,
            squeezed(size),
            dvi.Polynomials(3),
            box(2, 100),
        )
        for size in (1e-3, 1e-6)
    ),
    Case(
        "oscillators detuned by 1e-6",
        KIND,
        "the two quadratic forms are left of the four of the isotropic oscillator",
        spring(1.0, 1.0 + 1e-6),
        dvi.Polynomials(2),
        box(2, 100),
        truth=(energy(1.0, 0.1, 0), energy(1.0 + 1e-6, 0.1, 1)),
    ),
    Case(
        "resonance 1:2 of the map, detuned by 0.001",
        KIND,
        "the cubic invariant needs the resonance",
        spring(0.5, 1.751),
        dvi.Polynomials(3),
        box(2, 120),
        truth=(energy(0.5, 1.0, 0), energy(1.751, 1.0, 1)),
        h=1.0,
    ),
    *(
        Case(
            f"resonance 1:2 of the flow at h = {h:g}",
            KIND,
            "the map turns by 2 arcsin(hω/2) in each step, so that frequencies 1 and 2 are "
            "detuned by O(h²)",
            spring(1.0, 4.0),
            dvi.Polynomials(3),
            box(2, 120),
            truth=(energy(1.0, h, 0), energy(4.0, h, 1)),
            h=h,
        )
        for h in (0.1, 1e-3)
    ),
    kepler_with("symplectic Euler", dvi.TypeII(), 0.01, ENERGY + "r = 1"),
    kepler_with("Strang", dvi.Strang(), 0.001, ENERGY + "r = 2"),
    kepler_with("Yoshida", dvi.Yoshida(4), 0.02, ENERGY + "r = 4"),
    kepler_with("Gauss–Legendre", dvi.GaussLegendre(2), 0.02, ENERGY + "r = 4"),
    *(
        Case(
            f"pendulum with its energy in the basis, {name}",
            KIND,
            "the map of a method is not the flow; " + NONE,
            PENDULUM,
            PENDULUM_BASIS,
            box(1, 80, -3.0, 3.0),
            h=h,
            options={"method": method},
        )
        for name, method, h in (
            ("symplectic Euler", dvi.TypeII(), 0.001),
            ("Strang", dvi.Strang(), 0.002),
            ("Yoshida", dvi.Yoshida(4), 0.05),
        )
    ),
    Case(
        "quartic oscillator with its energy in the basis, midpoint rule",
        KIND,
        "a Gauss method conserves quadratic invariants, not quartic ones; " + NONE,
        separable(lambda q: jnp.sum(q**4) / 4),
        dvi.Polynomials(4),
        box(1, 120),
        h=0.05,
        options={"method": dvi.GaussLegendre(1)},
    ),
    Case(
        "function of an action by the type II map",
        KIND,
        "H = N²: conserved by the Gauss methods, not by H_D(q0, p1) = N²; " + NONE,
        dvi.System(lambda t0, t1, q, p, args: jnp.sum((q**2 + p**2) ** 2) / 4),
        dvi.Polynomials(4),
        box(1, 120),
    ),
    Case(
        "isotropic oscillator with a weak quartic coupling",
        KIND,
        "1e-5 q₁²q₂²: " + NONE,
        separable(lambda q: q @ q / 2 + 1e-5 * q[0] ** 2 * q[1] ** 2),
        dvi.Polynomials(2),
        box(2, 100),
    ),
    Case(
        "Kepler with an oblateness of 1e-6 in space",
        KIND,
        "axial symmetry: L₃ is left of L; " + NONE + " else",
        separable(
            lambda q: -1 / jnp.sqrt(q @ q) + 1e-6 * (3 * q[2] ** 2 / (q @ q) - 1) / (q @ q) ** 1.5
        ),
        dvi.Polynomials(2),
        shell(3, 100),
        truth=(turning(0, 1),),
    ),
    Case(
        "twist map with a weak kick",
        KIND,
        "standard map with K = 1e-5: p changes; " + NONE,
        separable(lambda q: -1e-5 * jnp.sum(jnp.cos(q))),
        dvi.Polynomials(3, ["p"]) + dvi.Trigonometric(2, "q"),
        box(1, 80, -3.0, 3.0),
        h=1.0,
    ),
    Case(
        "oscillator that stiffens beyond the samples' middle",
        KIND,
        "a force of (q − 0.9)³ for q > 0.9, where few samples lie; " + NONE,
        separable(lambda q: jnp.sum(q**2 / 2 + jnp.maximum(q - 0.9, 0.0) ** 4 / 4)),
        dvi.Polynomials(3),
        box(1, 400),
    ),
    Case(
        "McMillan's map by Yoshida's method",
        KIND,
        "a composition of integrable maps of different steps is not integrable; " + NONE,
        separable(lambda q: jnp.sum(q**2 - 0.7 * jnp.log(1 + q**2))),
        dvi.Polynomials(4) + dvi.Basis({"1/(1+q²)": lambda q, p: 1 / (1 + q[0] ** 2)}),
        box(1, 100),
        h=1.0,
        options={"method": dvi.Yoshida(4)},
    ),
    Case(
        "McMillan's map by Strang's method in polynomials",
        KIND,
        "the invariant has 1/(1 + q²), which no polynomial is; " + NONE,
        separable(lambda q: jnp.sum(q**2 - 0.7 * jnp.log(1 + q**2))),
        dvi.Polynomials(6),
        box(1, 100),
        h=1.0,
        options={"method": dvi.Strang()},
    ),
    Case(
        "resonance 1:3 of the map, detuned by 1e-5",
        KIND,
        "the quartic invariant needs the resonance",
        spring(0.5, 3.12501),
        dvi.Polynomials(4, ["q1", "p1"])
        + dvi.Polynomials(3, ["q1", "p1"]) * dvi.Polynomials(1, ["q2", "p2"])
        + dvi.Polynomials(2, ["q2", "p2"]),
        box(2, 100),
        truth=(energy(0.5, 1.0, 0), energy(3.12501, 1.0, 1)),
        h=1.0,
    ),
    Case(
        "free top by two vectors, type II",
        KIND,
        "a type II map has the symmetries that are linear in q: of the three quadratic invariants "
        "of the flow q·p is left, that of q → λq, p → p/λ",
        dvi.System(
            lambda t0, t1, q, p, args: (
                jnp.sum(jnp.cross(q, p) ** 2 / jnp.array([1.0, 2.0, 3.0])) / 2
            )
        ),
        dvi.Polynomials(2),
        box(3, 70),
        truth=(lambda q, p: q @ p,),
        h=0.2,
    ),
)
