"""The variational lattice at work and at its limits: a damped oscillator, Kepler, conditioning.

Run: python examples/variational_lattice.py [DIRECTORY for the pictures]
"""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from scipy.optimize import root

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

DAMPING, H, STEPS = 0.05, 0.1, 400
START = 1.0, 0.5


def velocity(t0, t1, q0, p1):
    """(q1 − q0)/h of the implicit midpoint rule for the oscillator."""
    h = t1 - t0
    return (p1 + h * q0 / 2) / (1 - h**2 / 4)


def midpoint(t0, t1, q0, p1, args):
    """Its H_D: p1·v − L at the middle."""
    v = velocity(t0, t1, q0, p1)
    return jnp.sum(p1 * v - v**2 / 2 + (q0 + (t1 - t0) * v / 2) ** 2 / 2)


DAMPED = dvi.System(midpoint, force=lambda t0, t1, q0, p1, args: -velocity(t0, t1, q0, p1))


def one_sided():
    """The damped oscillator with the package: the whole impulse εhW of a step at its end, (13)."""
    sol = dvi.integrate(
        DAMPED,
        [START[0]],
        [START[1]],
        h=H,
        num_steps=STEPS,
        epsilon=DAMPING,
        lattice=dvi.Variational(),
        observe=dvi.LatticeCondition(),
        throw=False,
    )
    n = np.flatnonzero(np.isfinite(np.asarray(sol.hs))).size
    return np.asarray(sol.ts)[:n], np.asarray(sol.hs)[:n], jacobians(sol, n), sol.observed[:n]


def jacobians(sol, n):
    """2-norm condition numbers of ∂(13, 14)/∂(p1, h), as they are solved, at each step."""

    def equations(x, t0, q0, p0, arriving):
        p1, h = x[:1], x[1]
        at = (t0, t0 + h, q0, p1, DAMPING, None)
        gradient, force = jax.grad(DAMPED.hamiltonian, 2)(*at), DAMPED.disturbing_force(*at)
        q1 = q0 + h * jax.grad(DAMPED.hamiltonian, 3)(*at)
        leaving = dvi.outgoing_energy(DAMPED, *at, h=h)
        momentum = p1 - p0 + h * (gradient - force)
        return jnp.append(momentum, leaving - arriving - jnp.sum(force * (q1 - q0)))

    @jax.vmap
    def condition(t0, q0, p0, p1, h):
        return jnp.linalg.cond(jax.jacobian(equations)(jnp.append(p1, h), t0, q0, p0, 0.0))

    return condition(sol.ts[:n], sol.qs[:n], sol.ps[:n], sol.ps[1 : n + 1], sol.hs[:n])


def two_sided():
    """The published scheme: half of the impulse at each end, the work of both halves balanced.

    Midpoint rule, unknowns (v, h) of a step; SciPy solves, nothing of this package.
    """
    q, p, h = *START, H
    v = (p - h * q / 2) / (1 + h**2 / 4 + DAMPING * h / 2)
    t, ts, hs, conditions = 0.0, [], [], []
    while len(hs) < STEPS:
        middle = q + h * v / 2
        energy, work = (v**2 + middle**2) / 2, DAMPING * h * v**2 / 2
        q, p = q + h * v, v - h * middle / 2 - DAMPING * h * v / 2
        ts.append(t)
        hs.append(h)
        t += h

        def equations(x, q=q, p=p, energy=energy, work=work):
            v, h = x
            middle = q + h * v / 2
            momentum = v * (1 + DAMPING * h / 2) + h * middle / 2 - p
            return [momentum, (v**2 + middle**2) / 2 - energy + work + DAMPING * h * v**2 / 2]

        found = root(equations, [v - h * (middle + DAMPING * v), h], tol=1e-13)
        if np.abs(equations(found.x)).max() > 1e-11 or not 0 < found.x[1] < 2 * h:
            break
        v, h = found.x
        step = 1e-6
        columns = [
            (np.array(equations(found.x + d)) - equations(found.x - d)) / (2 * step)
            for d in step * np.eye(2)
        ]
        conditions.append(np.linalg.cond(np.array(columns).T))
    return np.array(ts), np.array(hs), np.array(conditions)


def damped_oscillator(out):
    """Does h grow monotonically under damping, and do the equations lose their conditioning?"""
    t1, h1, jacobian1, kappa = one_sided()
    t2, h2, jacobian2 = two_sided()
    for name, h in (("one-sided force, (13)", h1), ("two-sided force", h2)):
        grows = np.mean(np.diff(h) > 0)
        print(f"damped, {name}: h from {h[0]:.3g} to {h[-1]:.3g} in {len(h)} steps, ", end="")
        print(f"{100 * grows:.0f} % of the steps grow")
    print(
        f"  ∂(13, 14)/∂(p1, h): condition {jacobian1[0]:.0f} to {jacobian1.max():.0f}, one-sided;"
    )
    print(f"  {jacobian2[0]:.0f} to {jacobian2[-1]:.0f}, two-sided; of h alone, relative: ", end="")
    print(f"{kappa[0]:.0f} to {kappa[-1]:.2g}")
    with plot.style():
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.2))
        left.semilogy(t1, h1, lw=0.9, label="force of the step at its end: (13), this package")
        left.semilogy(t2, h2, lw=1.4, label="half of it at each end: the published scheme")
        left.axhline(H, color="0.6", lw=0.8, ls=":", label="no damping")
        left.set(xlabel="time", ylabel="step size h")
        left.set_title("Steps grow as the damped oscillator loses energy")
        right.semilogy(t1, jacobian1, lw=0.9, label="condition of ∂(13, 14)/∂(p₁, h)")
        right.semilogy(t2[1 : len(jacobian2) + 1], jacobian2, lw=1.4, label="published scheme")
        right.semilogy(t1, kappa, lw=0.9, label="κ, of h with respect to the energies")
        right.set(xlabel="time", ylabel="condition number", title="Conditioning of the equations")
        for axes in (left, right):
            axes.legend(loc="upper left", fontsize="small")
        left.set_ylim(0.05, 200)
        right.set_ylim(0.5, 1e7)
        print(f"written: {plot.save(figure, out / 'variational_damped.png')}")


def balance():
    """Residual of (14) for a damped, driven pendulum, on this time grid and with equal steps."""
    system = dvi.System(
        lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2 - jnp.sum(jnp.cos(q0)),
        force=lambda t0, t1, q0, p1, args: -p1 + jnp.cos(t0),
    )
    for lattice in (dvi.Variational(), dvi.Uniform()):
        sol = dvi.integrate(
            system, [0.3], [0.9], h=0.02, num_steps=25, epsilon=0.1, lattice=lattice
        )
        points = [x[i : 23 + i] for x in (sol.ts, sol.qs, sol.ps) for i in range(3)]

        def defect(*x):
            before, here, after = (x[i::3] for i in range(3))
            return (after[0] - here[0]) * dvi.lattice_defect(system, (before, here, after), 0.1)

        print(
            f"{lattice}: |E⁺ − E⁻ − εW·Δq| up to {jnp.max(jnp.abs(jax.vmap(defect)(*points))):.1e}"
        )


def limits(out):
    """Where (14) loses its root, and how its conditioning depends on the order of H_D."""
    oscillator = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)
    for start in (([1.0], [0.5]), ([0.4], [0.7])):
        sol = dvi.integrate(
            oscillator, *start, h=0.1, num_steps=40, lattice=dvi.Variational(), throw=False
        )
        print(f"oscillator from {start}: {sol.status} after {int(sol.stats['failed_step'])} steps")
    problem = systems.kepler()
    with plot.style():
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 4.2))
        for first, color in ((0.1, "C0"), (0.01, "C1")):
            sol = dvi.integrate(
                problem.system,
                problem.q0,
                problem.p0,
                h=first,
                num_steps=2000,
                args=problem.args,
                lattice=dvi.Variational(),
                throw=False,
            )
            n = int(sol.stats["failed_step"])
            t, radius = np.asarray(sol.ts)[:n], np.linalg.norm(np.asarray(sol.qs)[:n], axis=1)
            print(f"Kepler, first h = {first}: {sol.status} after {n} steps, ", end="")
            print(f"t = {float(sol.ts[n]):.3f}, at radius {radius[-1]:.3f}")
            hs = np.asarray(sol.hs)[:n]
            ends = np.append(t, sol.ts[n])
            label = f"step size h, first step {first}"
            left.semilogy(ends, np.append(hs, hs[-1]), lw=1, color=color, label=label)
            left.semilogy(ends[-1], hs[-1], "x", color=color, ms=9, mew=2)
            if first == 0.01:
                label = "distance r from the centre"
                left.semilogy(t, radius, lw=0.8, color="0.6", ls="--", label=label)
        left.plot([], [], "kx", ms=7, mew=1.5, label="no root: the run ends")
        left.set(xlabel="time t", ylabel="step size h, distance r", ylim=(1e-3, 10))
        left.set(title="Kepler orbits with H$_D$ of order 1")
        left.legend(loc="lower right", fontsize="small", bbox_to_anchor=(1, 0.02))

        hs = np.geomspace(1e-3, 0.3, 25)
        q, p = jnp.asarray([0.7]), jnp.asarray([0.9])
        for order in (1, 2, 3, 4):

            def pendulum(t, q, p, args):
                return jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q))

            system = dvi.System(dvi.discretise(pendulum, order=order))
            kappa = dvi.LatticeCondition().bind(system, 0.0)
            values = jax.vmap(lambda h, f=kappa: f(0.0, h, q, p, q, p, None))(jnp.asarray(hs))
            slope = np.polyfit(np.log(hs[:10]), np.log(np.asarray(values)[:10]), 1)[0]
            print(f"pendulum, H_D of order {order}: κ ~ h^{slope:.2f}, {values[0]:.1e} at 1e-3")
            text = f"H$_D$ of order {order}: κ ∝ h$^{{{slope:.1f}}}$"
            right.loglog(hs, values, lw=1.2, label=text)
        digits = 1 / np.finfo(float).eps
        right.axhline(digits, color="0.5", lw=0.8, ls=":")
        right.annotate("no correct digit of h", (0.02, digits), (0, 3), textcoords="offset points")
        right.set(xlabel="step size h", ylabel="condition number κ of h")
        right.set(title="Pendulum: relative error of h, δh/h = κ δE/E")
        right.legend(loc="upper right", bbox_to_anchor=(1, 0.94), reverse=True)
        print(f"written: {plot.save(figure, out / 'variational_limits.png')}")


if __name__ == "__main__":
    directory = Path(sys.argv[1] if len(sys.argv) > 1 else ".")
    directory.mkdir(parents=True, exist_ok=True)
    balance()
    damped_oscillator(directory)
    limits(directory)
