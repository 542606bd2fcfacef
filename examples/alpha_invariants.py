"""Which invariant describes which orbits, when the symmetry of the magnetic field is broken.

A field with the modes (m, n) = (0, 0) and (1, 0), which is axisymmetric, and ε times the mode
(1, 4). Alpha particles of 100 keV that are passing, trapped, and between both. Left: the second
invariant J∥ at the bounce points. Right: the momentum p_ζ, and p_ζ with the corrections that
`dvi.discover_invariants` finds for passing orbits.

Run: python examples/alpha_invariants.py [DIRECTORY for the picture]
"""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import boozer

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

EPSILONS = np.geomspace(0.003, 1.0, 9)
STRENGTHS = np.geomspace(0.01, 3.0, 8)  # of the runs of passing particles
METHOD, H = dvi.GaussLegendre(2), 2.0
S, PITCH, MU = 0.5, 0.8, (1 - 0.8**2) / 2 / 5.0


def particles():
    """Alpha particles of 100 keV; `breaking` is the mode (1, 4), 2.8 % of |B| at ε = 1."""
    field = boozer.from_modes(
        [0, 1, 1], [0, 0, 4], [[5.0], [-0.3], [0.2]],
        psi_edge=8.0, iota=[0.42, 0.02], G=50.0, periods=4,
    )  # fmt: skip
    symmetric, breaking = field.split(0)
    return boozer.GuidingCentres(symmetric, 1e5, breaking=breaking, coordinates="angles")


def passing(alphas, count, width, seed):
    """States of passing particles, p_θ within ± width of that at s = 0.5, all with one μ."""
    rng = np.random.default_rng(seed)
    s = S + rng.uniform(-width, width, count) * alphas.rho / alphas.field.psi_edge
    pitch = PITCH + rng.uniform(-width, width, count) * 0.03
    q, p, _ = alphas.state(*map(jnp.asarray, (s, *rng.uniform(0, 2 * np.pi, (2, count)), pitch)))
    return q, p


def momenta(alphas):
    """The drifts of p_ζ with corrections up to order 0, 1 and 2, in fresh passing orbits."""
    found = dvi.discover_invariants(
        alphas.system, boozer.momentum_basis(alphas.field, degree=3, poloidal=4, toroidal=2),
        order=2, h=H, samples=passing(alphas, 900, 1.5, 0), args=alphas.args(MU),
        method=METHOD, tolerance=1e-5,
    )  # fmt: skip
    print(found)
    series = found.invariants[0]
    c = series.coefficients / series.coefficients[0, 0]  # in units of p_ζ, the first function
    q, p = passing(alphas, 16, 0.2, 1)
    for order in range(3):
        cut = eqx.tree_at(lambda x: x.coefficients, series, c.at[order + 1 :].set(0))
        measured = dvi.drift_order(
            alphas.system, cut, q, p, batched=True, epsilons=STRENGTHS, h=H, num_steps=2000,
            args=alphas.args(MU), method=METHOD,
        )  # fmt: skip
        print(f"passing, order {order}: {measured}")
        print(f"  drifts [m] {measured.drifts}")
        yield measured


def orbits(alphas, pitch, bounces=60):
    """Smallest and largest margin, range of p_ζ, spread of J∥ at bounces; shapes (ε, orbits, …)."""
    theta, zeta = np.zeros(len(pitch)), np.linspace(0, 1.5, len(pitch))
    q, p, args = alphas.start(S, theta, zeta, pitch)

    def one(epsilon, q, p, mu):
        complete = alphas.at_epsilon(epsilon)
        observe = {
            "margin": boozer.Extremes(complete.trapping),
            "bounces": complete.bounces(bounces),
            "momentum": dvi.Range(lambda q, p: p[1]),
        }
        seen = dvi.integrate(
            complete.system, q, p, args=complete.args(mu), h=H, num_steps=8000, method=METHOD,
            stop=complete.loss, observe=observe, save=dvi.Save(final=True), throw=False,
        ).observed  # fmt: skip
        J = complete.second_invariant_at(seen["bounces"], complete.args(mu))
        spread = (jnp.nanmax(J) - jnp.nanmin(J)) / jnp.nanmean(J)
        return seen["margin"], seen["momentum"], spread

    over_orbits = jax.vmap(one, (None, 0, 0, 0))
    return jax.jit(jax.vmap(over_orbits, (0, None, None, None)))(EPSILONS, q, p, args["mu"])


def bouncing(alphas):
    """Class, range of p_ζ and spread of J∥ of trapped orbits and of some between both classes."""
    # |B| is smallest at θ = 0; with the pitch `edge` there, μ B_max = E.
    B_min, B_max = (float(alphas.field.strength(S, x, 0.0)) for x in (0.0, np.pi))
    edge = np.sqrt(1 - B_min / B_max)
    pitch = edge * np.concatenate([np.linspace(0.4, 0.7, 8), np.linspace(0.985, 1.015, 8)])
    margin, momentum, spread = map(np.asarray, orbits(alphas, pitch))
    labels = boozer.classify(margin)
    for epsilon, names, *values in zip(EPSILONS, labels, spread, momentum, strict=True):
        for name in ("trapped", "transitional"):
            J, P = (np.append(x[(names == name) & np.isfinite(values[0])], np.nan) for x in values)
            print(
                f"ε = {epsilon:.3f}, {len(J) - 1} {name} orbits that bounce: median spread of J∥ "
                f"{np.nanmedian(J) if len(J) > 1 else np.nan:.1e}, "
                f"range of p_ζ {np.nanmedian(P) if len(P) > 1 else np.nan:.1e} m"
            )
    return labels, momentum, spread


def main(directory="."):
    """Compute, print and draw."""
    Path(directory).mkdir(parents=True, exist_ok=True)
    alphas = particles()
    labels, momentum, spread = bouncing(alphas)
    marks = {"trapped": "s", "transitional": "^"}
    with dvi.plot.style():
        figure, (left, right) = plt.subplots(1, 2, figsize=(10.5, 4.4), layout="constrained")
        for (name, mark), colour in zip(marks.items(), dvi.plot.COLOURS[:2], strict=True):
            of_class = labels == name
            x = np.broadcast_to(EPSILONS[:, None], labels.shape)[of_class]
            look = {"marker": mark, "color": colour, "ls": "none", "ms": 4.5, "alpha": 0.7}
            left.loglog(x, spread[of_class], **look, label=name)
            right.loglog(x, momentum[of_class], **look, label=f"{name}: $p_ζ$")
        for order, measured in enumerate(momenta(alphas)):
            name = ("$p_ζ$", "with order 1", "with orders 1, 2")[order]
            label = f"passing: {name}, ∝ ε$^{{{measured.slope:.2f}}}$"
            colour, mark = dvi.plot.COLOURS[2 + order], "oDv"[order]
            right.loglog(STRENGTHS, measured.drifts, marker=mark, color=colour, label=label)
        left.set(xlabel="ε", ylabel="(largest − smallest $J_∥$) / mean")
        left.set_title("$J_∥$ at the bounce points of each orbit")
        right.set(xlabel="ε", ylabel="largest change along an orbit [m]", ylim=(1e-7, 1e4))
        right.set_title("The momentum $p_ζ$, and its corrections")
        left.set_ylim(1e-7, 1e3)
        left.legend(loc="upper left")
        right.legend(loc="upper left", fontsize=7.5, ncols=2)
        dvi.plot.save(figure, Path(directory) / "alpha_invariants.png")


if __name__ == "__main__":
    main(*sys.argv[1:2])
