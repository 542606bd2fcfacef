# %% [markdown]
# # How the magnetic moment breaks down
#
# In this notebook you find the magnetic moment of a charged particle and its corrections by
# `dvi.discover_invariants` from steps of the explicit method `dvi.Boris`, measure how well each
# order is conserved, and see at which gyroradius no correction helps any more, because the motion
# is chaotic.
#
# The field is the magnetic mirror of the notebook [on the magnetic
# moment](magnetic_moment.ipynb), $B = (-xz, -yz, \ell^2 + z^2)/\ell^2$, with $e = m = 1$ and the
# speed 1: the gyroradius $\rho$ is at most 1. The small parameter is $\rho/\ell$. It enters the
# field by its square, $\varepsilon = 1/\ell^2$.

# %%
import itertools

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi
from dvi_jax import plot, systems

jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Discovery in positions and velocities
#
# The search requires a system whose step depends on $\varepsilon$. Here the Hamiltonian contains
# the uniform field, and the force $\varepsilon\, v \times (-xz, -yz, z^2)$ the rest. The velocity
# is then $v = p - (-y, x, 0)/2$ for every $\varepsilon$, and functions of $(q, v)$ are functions
# of $(q, p)$.
#
# The field has two symmetries: rotations about the axis, and $z \to -z$. The basis contains the
# polynomials up to degree 6 that have both symmetries, in $r^2 = x^2 + y^2$, $s = x v_x + y v_y$,
# $L = x v_y - y v_x$, $w = v_x^2 + v_y^2$, $z$ and $v_z$. (It leaves out $s^2 = r^2 w - L^2$.)


# %%
def velocity(q, p):
    return p - jnp.stack([-q[1], q[0], 0 * q[2]]) / 2


def hamiltonian(q, p):
    return jnp.sum(velocity(q, p) ** 2) / 2


def rest_of_the_field(t0, t1, q, p, args):
    x, y, z = q
    return jnp.cross(velocity(q, p), jnp.stack([-x * z, -y * z, z * z]))


NAMES, DEGREES = ["r²", "s", "L", "w", "z", "v_z"], np.array([2, 2, 2, 2, 1, 1])


class Symmetric(dvi.discover.AbstractBasis):
    """Polynomials in (q, v) that have the symmetries of the field."""

    degree: int

    def for_shape(self, shape):
        powers = map(np.array, itertools.product(*(range(self.degree // k + 1) for k in DEGREES)))
        powers = np.array([
            k for k in powers
            if 0 < k @ DEGREES <= self.degree and k[1] <= 1 and (k[4] + k[5]) % 2 == 0
        ])  # fmt: skip

        def values(q, p, t):
            (x, y, z), (u, v, along) = q, velocity(q, p)
            factors = jnp.stack(
                [x * x + y * y, x * u + y * v, x * v - y * u, u * u + v * v, z, along]
            )
            table = jnp.stack([factors**k for k in range(self.degree + 1)])
            return jnp.prod(table[powers, np.arange(6)], axis=-1)

        names = [
            " ".join(f"{n}^{k}" if k > 1 else n for n, k in zip(NAMES, row, strict=True) if k)
            for row in powers
        ]
        return dvi.discover.BoundBasis(values, tuple(names), tuple((powers @ DEGREES).tolist()))


system = dvi.System(dvi.discretise(hamiltonian), force=rest_of_the_field)
samples = np.random.default_rng(0).uniform(-1, 1, (2, 400, 3))
found = dvi.discover_invariants(
    system, Symmetric(6), order=2, h=0.2, samples=samples, method=dvi.Boris()
)
leading = [dict(zip(found.basis.names, c[0], strict=True)) for c in found.coefficients]
for terms, residual in zip(leading, found.residuals, strict=True):
    text = " + ".join(f"{c:.3g} {name}" for name, c in terms.items() if c)
    print(f"{text} + O(ε): a step changes it by {np.max(residual):.0e} of what its slopes predict")
mu = np.array(
    found.coefficients[["w" in terms and terms["w"] != 0 for terms in leading].index(True)]
)
assert len(leading) == 3

# %% [markdown]
# There are three invariants up to order $\varepsilon^2$: the energy, the canonical angular
# momentum and the magnetic moment, which begins with $w/2 = v_\perp^2/2$. (A sum of a magnetic
# moment and a function of the others, times $\varepsilon$, is as good: the search chooses a short
# one.) They are invariants of the *steps* of `Boris` with $h = 0.2$, not only of the differential
# equation.
#
# ## Conservation at each order
#
# The next cell measures the change of each truncated series over 60 steps, for several
# $\varepsilon$. A series of order $n$ should change by $O(\varepsilon^{n+1})$. (Over a whole
# bounce it changes by more, since $\varepsilon z^2$ is then not small.)


# %%
def series(order):
    """The magnetic moment up to this order in ε, as an observable of the state."""
    basis, coefficients = found.basis, jnp.asarray(mu[: order + 1])

    def moment(t, q, p, args, epsilon):
        powers = epsilon ** jnp.arange(order + 1)
        return basis(q, p) @ (powers @ coefficients)

    return moment


epsilons = np.geomspace(3e-5, 1e-3, 6)
q0, p0 = jnp.array([0.4, 0.1, 0.2]), jnp.array([0.3, 0.9, 0.1])


@jax.jit
@jax.vmap
def changes(epsilon):
    """Largest change of the series of orders 0, 1, 2 in a run of 60 steps."""
    sol = dvi.integrate(system, q0, p0, h=0.2, num_steps=60, epsilon=epsilon,
                        method=dvi.Boris(), save=dvi.Save(every=2), throw=False)  # fmt: skip
    values = [
        jax.vmap(lambda q, p, f=series(n): f(0.0, q, p, None, epsilon))(sol.qs, sol.ps)
        for n in range(3)
    ]
    return jnp.ptp(jnp.stack(values), axis=1)


table = np.asarray(changes(epsilons))
slopes = np.polyfit(np.log(epsilons), np.log(table), 1)[0]
for n, slope in enumerate(slopes):
    print(f"order {n}: changes by {table[0, n]:.0e} to {table[-1, n]:.0e}, ∝ ε^{slope:.2f}")
assert np.abs(slopes - [1, 2, 3]).max() < 0.3

# %% [markdown]
# ## The breakdown
#
# Now the particle bounces through the whole mirror. Its canonical angular momentum is chosen as
# zero. In a frame that turns with half the gyrofrequency the motion is then in a plane through
# the axis, and the state at $z = 0$, $v_z > 0$ has two coordinates: $X/2$, with the distance $X$
# from the axis, and the radial velocity $v_X$. The radius in this plane is $v_\perp$. A particle
# that conserves a magnetic moment therefore remains on a closed curve near a circle.
#
# All orbits are one batch, with `length` as a parameter that differs.


# %%
def crossings(lengths, v_perp, phases, count, direction=1, h=0.2):
    """(X/2, v_X) where orbits cross the middle plane, shape (orbits, count, 2)."""
    X, v_X = 2 * v_perp * np.cos(phases), v_perp * np.sin(phases)
    zero = np.zeros_like(X)
    q0 = np.stack([X, zero, zero], axis=-1)
    p0 = np.stack([v_X, zero, np.sqrt(1 - v_perp**2)], axis=-1)  # A is along y here, and v_y = −X/2
    mirror = systems.magnetic_mirror()
    section = dvi.poincare_section(
        mirror.system, q0, p0, lambda t, q, p, args: q[2], direction=direction, crossings=count,
        h=h, num_steps=int(count * 30 * np.max(lengths) / h), method=dvi.Boris(), throw=False,
        args=mirror.args | {"length": dvi.Axis("length", lengths)},
    )  # fmt: skip
    q, p = np.asarray(section.qs), np.asarray(section.ps)
    r = np.hypot(q[..., 0], q[..., 1])
    return np.stack([r / 2, (q[..., 0] * p[..., 0] + q[..., 1] * p[..., 1]) / r], axis=-1), section


lengths = np.array([3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 12.0, 16.0])
speeds = np.linspace(0.2, 0.95, 16)
points, _ = crossings(np.repeat(lengths, 16), np.tile(speeds, 8), np.full(128, 0.3), 80)
points = points.reshape(8, 16, 80, 2)
with plot.style():
    figure, axes = plt.subplots(1, 4, figsize=(9.4, 2.7), dpi=90, sharey=True)
    for axis, i in zip(axes, (6, 3, 1, 0), strict=True):
        for k, orbit in enumerate(points[i]):
            both = np.concatenate([orbit, -orbit])  # the plane has two sides of the axis
            axis.plot(*both.T, ".", ms=1.2, color=plt.cm.viridis(k // 4 / 4))
        axis.set(xlabel="X/2", title=f"ρ/ℓ = 1/{lengths[i]:.0f}", aspect="equal")
    axes[0].set_ylabel("radial velocity")
plt.show()

# %% [markdown]
# At $\rho/\ell = 1/12$ all orbits are closed curves. At 1/6 the particles with a small $v_\perp$,
# which go far into the mirror, fill areas, next to chains of islands. At 1/4 most particles do,
# and at 1/3 all but those with the largest $v_\perp$.
#
# ## Where corrections do not help
#
# In half a bounce the magnetic moment changes by a *kick* that depends on the phase of the
# gyration. The next cell measures the amplitude of the kick at $v_\perp = 0.5$, from 24 phases,
# for the series of orders 0, 1 and 2. At small $\rho/\ell$ it is the error of the series, and
# each order is better than the one before. At large $\rho/\ell$ the second correction does not
# help: the remaining kick is a property of the motion.
#
# Let $\Delta v_\perp$ be the kick, and $\Phi$ the phase of the particle in the turning frame in a
# whole bounce, which for $v_z^2 = 1 - v_\perp^2 (1 + z^2/\ell^2)$ on the axis is
#
# $$\Phi(v_\perp) = \oint \frac{B}{2}\,\frac{dz}{v_z}
#   = \frac{\pi\ell}{2} \left(\frac1{v_\perp} + \frac1{v_\perp^3}\right) .$$
#
# Half a bounce is then close to a standard map with the parameter $K = |\Delta v_\perp\,
# d\Phi/dv_\perp|$. According to Chirikov's criterion, resonances between gyration and bounce
# overlap if $K$ is about 1 or more. The last column is independent of $K$: the range of $v_\perp$
# in 150 bounces of the particle with $v_\perp = 0.5$ in the pictures above.

# %%
phases = np.linspace(0, np.pi, 24, endpoint=False) + 0.05
_, section = crossings(np.repeat(lengths, 24), np.full(192, 0.5), np.tile(phases, 8), 1, -1)
X, v_X = np.cos(np.tile(phases, 8)), 0.5 * np.sin(np.tile(phases, 8))
start = np.stack([X, 0 * X, 0 * X], axis=-1), np.stack([v_X, 0 * X, 0 * X + 0.75**0.5], axis=-1)


def kick(order):
    """Amplitude of the change of the series in half a bounce, for each length."""
    moment = jax.jit(jax.vmap(lambda q, p, e: series(order)(0.0, q, p, None, e)))
    strengths = 1 / np.repeat(lengths, 24) ** 2
    change = moment(section.qs[:, 0], section.ps[:, 0], strengths) - moment(*start, strengths)
    return np.ptp(np.asarray(change).reshape(8, 24), axis=-1) / 2


kicks = np.array([kick(n) for n in range(3)])
K = kicks[2] / 0.5 * np.pi * lengths / 2 * (1 / 0.5**2 + 3 / 0.5**4)
ranges = np.ptp(np.linalg.norm(points[:, 6], axis=-1), axis=-1)
print("ρ/ℓ    kick of μ at order 0, 1, 2      K       range of v⊥ in 150 bounces")
for i, length in enumerate(lengths):
    row = "  ".join(f"{x:.1e}" for x in kicks[:, i])
    print(f"1/{length:<4.0f} {row}   {K[i]:7.3f}   {ranges[i]:.3f}")
assert ranges[K > 2].min() > 5 * ranges[K < 0.5].max()
assert (kicks[2] < kicks[1])[lengths >= 10].all()
assert (kicks[2] > kicks[1])[lengths <= 5].all()

# %%
with plot.style():
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 3.2), dpi=90)
    for n, row in enumerate(kicks):
        left.loglog(1 / lengths, row, "os^"[n] + "-", label=f"order {n}")
    left.set(xlabel="ρ/ℓ", ylabel="kick of μ", title="Half a bounce, v⊥ = 0.5")
    left.legend()
    right.loglog(K, ranges, "o-")
    right.axvline(1, color="0.5", ls="--")
    right.set(xlabel="Chirikov's parameter K", ylabel="range of v⊥", title="150 bounces")
plt.show()

# %% [markdown]
# ## Control
#
# The chaos is a property of the motion, not of the step: with half the step, the particles at
# $\rho/\ell = 1/6$ have similar ranges of $v_\perp$.

# %%
finer, _ = crossings(np.full(14, 6.0), speeds[2:], np.full(14, 0.3), 150, h=0.1)
for name, orbits in (("h = 0.2", points[3, 2:]), ("h = 0.1", finer)):
    spread = np.ptp(np.linalg.norm(orbits, axis=-1), axis=-1)
    low, high = spread[:4].mean(), spread[9:].mean()
    print(f"{name}: range of v⊥ for 0.3 to 0.45 is {low:.2f}, for 0.75 to 0.95 {high:.3f}")
    assert low > 4 * high

# %% [markdown]
# ## Next steps
#
# - The two adiabatic invariants of a mirror at small $\rho/\ell$: [the magnetic
#   moment](magnetic_moment.ipynb).
# - Explicit methods for charged particles, fields of coils and on grids:
#   `docs/charged-particles.md`.
# - How the search works: `docs/discovery.md`.
