# %% [markdown]
# # Your own system
#
# In this notebook you define your own system and check that it is correct. The example is an
# elastic pendulum, a weight on a spring, in polar coordinates $q = (r, \theta)$ about the point of
# suspension,
#
# $$H = \frac{p_r^2}{2m} + \frac{p_\theta^2}{2 m r^2} + \frac{k}{2}(r - 1)^2 - m g r \cos\theta,$$
#
# with the mass $m$, the stiffness $k$, the natural length 1 m and the gravitational acceleration
# $g$. The perturbation is air drag, $\varepsilon W = -\varepsilon\, (p_r, p_\theta)$. The kinetic
# energy depends on $r$. Therefore the equations of a step are implicit. The package detects this
# and solves the equations by iteration.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot

jax.config.update("jax_enable_x64", True)


# %% [markdown]
# ## Hamiltonian, force, observables
#
# `H(t, q, p, args)` is the usual Hamiltonian; `args` contains its parameters. `dvi.discretise`
# converts it to a discrete Hamiltonian, a function of one step with the arguments `(t0, t1, q0, p1,
# args)`: `q0` is the position at the beginning of the step, `p1` the momentum at its end. A force
# has the same arguments. An observable is a function of `(q, p)`, of `(t, q, p, args)`, or of one
# step, `(t0, t1, q0, p0, q1, p1, args)`.


# %%
def H(t, q, p, args):
    r, theta = q
    kinetic = (p[0] ** 2 + (p[1] / r) ** 2) / (2 * args["m"])
    return kinetic + args["k"] / 2 * (r - 1) ** 2 - args["m"] * args["g"] * r * jnp.cos(theta)


def drag(t0, t1, q0, p1, args):
    return -p1


def angular_momentum(q, p):
    return p[1]


system = dvi.System(dvi.discretise(H), force=drag)
args = {"m": 1.0, "k": 30.0, "g": 9.81}
q0, p0 = [1.4, 1.0], [0.0, 1.0]


def run(h=0.01, num_steps=1000, epsilon=0.0, args=args, method=dvi.Strang()):
    return dvi.integrate(
        system, q0, p0, h=h, num_steps=num_steps, epsilon=epsilon, args=args, method=method,
        observe={"energy": H, "angular momentum": angular_momentum},
    )  # fmt: skip


free, damped = run(), run(epsilon=0.3)
print(free.status, free.qs.shape, "explicit:", dvi.Strang().is_explicit(system, jnp.zeros(2), args))

# %%
with plot.style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8))
    for sol, name in ((free, "ε = 0"), (damped, "ε = 0.3")):
        r, theta = np.asarray(sol.qs).T
        left.plot(r * np.sin(theta), -r * np.cos(theta), lw=0.8, label=name)
        right.plot(sol.ts, sol.observed["energy"], lw=1.2, label=name)
    left.plot(0, 0, "k+")
    left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="Path of the weight")
    right.set(xlabel="time [s]", ylabel="energy [J]", title="Energy along the path")
    right.legend()
plt.show()

# %% [markdown]
# ## Four checks
#
# **1. Order.** `dvi.Strang` is the composition of a half step of the map with a half step of its
# adjoint. It has order 2: if the step is halved, the error is divided by four. The reference is the
# same method with a much smaller step.

# %%
reference = run(h=2.0 / 6400, num_steps=6400)
steps = np.array([100, 200, 400])
errors = [np.linalg.norm(run(h=2.0 / n, num_steps=int(n)).qs[-1] - reference.qs[-1]) for n in steps]
order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
print("errors:", ", ".join(f"{e:.1e}" for e in errors), f"  order {order:.2f}")
assert abs(order - 2) < 0.1

# %% [markdown]
# **2. Symplecticity.** Without the force, the Jacobian $M$ of the map satisfies $M^T \Omega M =
# \Omega$, where $\Omega$ is the symplectic matrix (`omega` below). With the drag force the
# phase-space volume decreases. The map is then not symplectic, and the difference must not be zero.


# %%
def final(state, epsilon):
    sol = dvi.integrate(
        system, state[:2], state[2:], h=0.01, num_steps=50, epsilon=epsilon, args=args,
        method=dvi.Strang(), save=dvi.Save(final=True),
    )  # fmt: skip
    return jnp.concatenate([sol.qs[-1], sol.ps[-1]])


omega = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
defects = []
for epsilon in (0.0, 0.3):
    M = np.asarray(jax.jacfwd(final)(jnp.array([*q0, *p0]), epsilon))
    defects.append(np.abs(M.T @ omega @ M - omega).max())
    print(f"ε = {epsilon}: MᵀΩM − Ω is at most {defects[-1]:.1e}")
assert defects[0] < 1e-11
assert defects[1] > 0.1

# %% [markdown]
# **3. Conservation.** Without gravity the map has a rotational symmetry and conserves the angular
# momentum to round-off. With gravity the angular momentum must change. The energy must oscillate
# with an amplitude $O(h^2)$ and must not drift.

# %%
for g in (0.0, 9.81):
    momentum = run(args=args | {"g": g}).observed["angular momentum"]
    print(f"g = {g}: angular momentum changes by {np.ptp(momentum):.1e}")
    assert (np.ptp(momentum) < 1e-12) == (g == 0.0)

early, late = np.array_split(np.asarray(run(num_steps=20_000).observed["energy"]), 2)
finer = np.asarray(run(h=0.005, num_steps=40_000).observed["energy"])
bands = [np.ptp(early), np.ptp(late), np.ptp(finer)]
print("range of the energy: first half {:.4f}, second half {:.4f}; with h/2 {:.4f}".format(*bands))
assert abs(bands[1] / bands[0] - 1) < 0.1
assert abs(np.log2(bands[1] / bands[2]) - 2) < 0.3

# %% [markdown]
# **4. Work of the drag.** Since $\dot H = -\varepsilon\, \dot q \cdot p$, the energy decreases by
# $\varepsilon \int \dot q \cdot p\, dt$. The integrand $\dot q \cdot p$ is twice the kinetic
# energy.

# %%
r, p_r, p_t = damped.qs[:, 0], damped.ps[:, 0], damped.ps[:, 1]
power = 0.3 * (p_r**2 + (p_t / r) ** 2) / args["m"]
lost = float(damped.observed["energy"][0] - damped.observed["energy"][-1])
work = float(np.trapezoid(power, damped.ts))
print(f"energy lost {lost:.3f} J, work of the drag {work:.3f} J")
assert abs(lost / work - 1) < 2e-3

# %% [markdown]
# ## Forces that depend on the velocity
#
# A force law often contains the velocity, for example quadratic drag $F = -|v|\, v$.
# `dvi.velocity_force` converts it to a function of position and momentum by
# $v = \partial H_D / \partial p$. In these coordinates $v = (\dot r, \dot\theta)$, and the force
# on $\theta$ is a torque.


# %%
def quadratic_drag(t0, t1, q0, v, args):
    speed = jnp.sqrt(v[0] ** 2 + (q0[0] * v[1]) ** 2)
    return -speed * v * jnp.array([1.0, q0[0] ** 2])


H_D = dvi.discretise(H)
with_drag = dvi.System(H_D, force=dvi.velocity_force(H_D, quadratic_drag))
sol = dvi.integrate(
    with_drag, q0, p0, h=0.01, num_steps=1000, epsilon=0.1, args=args, method="strang", observe=H
)
print(f"energy: {sol.observed[0]:.2f} J at the beginning, {sol.observed[-1]:.2f} J at the end")
assert sol.observed[-1] < sol.observed[0]

# %% [markdown]
# ## Gradients
#
# The next cell differentiates the height $y$ of the weight after half a second with respect to the
# stiffness $k$ of the spring, by automatic differentiation through every implicit step. Central
# differences must give the same number.


# %%
def height(k):
    sol = dvi.integrate(
        system, q0, p0, h=0.01, num_steps=50, epsilon=0.0, args=args | {"k": k},
        method=dvi.Strang(), save=dvi.Save(final=True),
    )  # fmt: skip
    return -sol.qs[-1, 0] * jnp.cos(sol.qs[-1, 1])


height_and_slope = jax.jit(jax.value_and_grad(height))
slope = float(height_and_slope(30.0)[1])
above, below = (float(height_and_slope(30.0 + change)[0]) for change in (1e-4, -1e-4))
differences = (above - below) / 2e-4
print(f"∂y/∂k = {slope:.8f} m/(N/m), by differences {differences:.8f}")
assert abs(slope / differences - 1) < 1e-6

# %% [markdown]
# ## When the solver of a step does not converge
#
# In the next cell the weight moves fast towards the point of suspension, and the step is much too
# long. The solver does not converge for the equations of the Gauss–Legendre method with two stages.
# By default this raises an error that names the step. With `throw=False` the run returns its
# status, and the states are NaN from this step on. With `Strang` the solver converges even for this
# step, but the result is not accurate, because the step is too long.

# %%
too_long = {"h": 0.5, "num_steps": 20, "epsilon": 0.0, "args": args, "throw": False}
thrown = [0.1, 1.0], [-3.0, 2.0]
sol = dvi.integrate(system, *thrown, method=dvi.GaussLegendre(2), **too_long)
print(sol.status, "at step", int(sol.stats["failed_step"]))
assert sol.status == "not_converged"
assert np.isnan(sol.qs[-1]).all()
assert dvi.integrate(system, *thrown, method=dvi.Strang(), **too_long).status == "successful"

# %% [markdown]
# ## Next steps
#
# - Define a system by a Lagrangian: `dvi.from_lagrangian`.
# - Run a system from a file: `dvi-jax run examples/own_system.toml`.
# - Search for the quantities that a perturbed system conserves:
#   [discovering invariants](discovering_invariants.ipynb).
