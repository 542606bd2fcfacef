"""Methods that compute in coordinates of their own: the run stays in them, whatever is observed."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.problem import flows

MASS, H, STEPS = 1e-3, 0.06, 20000
TWO = systems.n_body(
    masses=[1.0, MASS],
    q0=[[0.0, 0.0], [1.0, 0.0]],
    p0=[[0.0, -1.05 * MASS], [0.0, 1.05 * MASS]],
    h=H,
)
"""The map of `WisdomHolman` is the exact motion of two bodies: all errors are rounding errors."""
ENERGY = TWO.observables["energy"]


def energy(q, p):
    """In extended precision."""
    q, p = (np.asarray(x, np.longdouble) for x in (q, p))
    masses = np.array([1, MASS], np.longdouble)
    return (p**2 / masses[:, None]).sum() / 2 - masses[1] / np.sqrt(((q[1] - q[0]) ** 2).sum())


def exact_separation(t):
    """Of the two bodies, which begin at the pericentre of an ellipse."""
    total, speed = np.longdouble(1) + np.longdouble(MASS), np.longdouble(1.05 * MASS)
    speed = speed / np.longdouble(MASS) + speed
    a = 1 / (2 - speed**2 / total)
    e, mean = 1 - 1 / a, np.sqrt(total / a**3) * t
    u = mean
    for _ in range(50):
        u = u - (u - e * np.sin(u) - mean) / (1 - e * np.cos(u))
    return np.array([a * (np.cos(u) - e), a * np.sqrt(1 - e**2) * np.sin(u)])


def never(t, q, p, args):
    return q[1, 0] - 100.0


def plain_speed(t, q, p, args):
    return 1.0 + 0.0 * q[1, 0]


MODES = {
    "a reduction": {"observe": dvi.MaxDrift(ENERGY)},
    "requested times": {"save": dvi.Save(ts=[STEPS * H])},
    "a stop": {"stop": dvi.Stop(never)},
    "a section": {"observe": dvi.Section(lambda t, q, p, args: q[1, 1])},
    "another grid": {"lattice": dvi.Given(np.arange(STEPS + 1) * H)},
    "adaptive steps": {"lattice": dvi.AdaptiveReversible(plain_speed)},
    "generalised orders": {
        "method": dvi.WisdomHolman(scheme=(4, 2)),
        "observe": dvi.Mean(ENERGY),
    },
    "a composition": {
        "method": dvi.Yoshida(4, base=dvi.WisdomHolman()),
        "save": dvi.Save(every=STEPS // 4),
    },
    "an adjoint": {"method": dvi.Adjoint(dvi.WisdomHolman()), "save": dvi.Save(every=1)},
}
FAST = ("a reduction", "requested times", "a composition")


@pytest.mark.slow
@pytest.mark.parametrize(
    "mode", [m if m in FAST else pytest.param(m, marks=pytest.mark.slow) for m in MODES]
)
def test_rounding_does_not_accumulate_in_any_mode(mode):
    """A conversion of the coordinates in every step would change the energy by 3e-12."""
    options = {"method": dvi.WisdomHolman(), "save": dvi.Save(final=True), **MODES[mode]}
    if mode != "another grid":
        options |= {"h": H, "num_steps": STEPS}
    sol = dvi.integrate(TWO, **options)
    q, p, initial = sol.qs[-1], sol.ps[-1], energy(TWO.q0, TWO.p0)
    assert abs(energy(q, p) / initial - 1) < 3e-13
    apart = np.asarray(q[1] - q[0]) - exact_separation(np.longdouble(H) * STEPS)
    assert np.abs(apart).max() < 3e-10


@pytest.mark.slow
def test_the_energy_of_a_million_observed_steps():
    options = {"h": H, "num_steps": 10**6, "method": dvi.WisdomHolman()}
    save, drift = dvi.Save(final=True), dvi.MaxDrift(ENERGY)
    sol = dvi.integrate(TWO, **options, save=save, observe=drift)
    initial = energy(TWO.q0, TWO.p0)
    assert float(sol.observed) < 1e-12 * abs(initial)
    assert abs(energy(sol.qs[-1], sol.ps[-1]) / initial - 1) < 1e-12


THREE = systems.n_body(
    masses=[1.0, 1e-3, 3e-4],
    q0=[[0.0, 0.0], [1.0, 0.0], [-0.3, 1.8]],
    p0=[[0.0, 0.0], [0.0, 1e-3], [-2.2e-4, -0.3e-4]],
    h=0.3,
)


def quartic(t0, t1, q0, p1, args):
    return 1e-2 * jnp.sum(q0**4)


SPLIT = dvi.System(dvi.Split([flows.Kepler(k=1.0), quartic]))


def waves(q, p):
    """A sum of 120 terms, which is computed in another order if the program has long arrays."""
    return jnp.sum(jnp.sin(jnp.outer(jnp.arange(1.0, 31.0), jnp.concatenate([q, p]))))


CORRECTED = dvi.WisdomHolman(corrector=3)
RUNS = {
    # A program of the start alone had other arrays than the loop, and was compiled in another way.
    "sum": (SPLIT, {"q0": [1.0, 0.0], "p0": [0.2, 1.1], "h": 0.3, "observe": dvi.MaxDrift(waves)}),
    "times": (THREE, {"method": CORRECTED, "save": dvi.Save(ts=np.linspace(0.1, 70, 40))}),
    "joined": (THREE, {"method": dvi.WisdomHolman()}),
    "observed": (THREE, {"method": dvi.WisdomHolman(), "observe": dvi.MaxDrift(ENERGY)}),
    "corrected": (THREE, {"method": dvi.WisdomHolman(corrector=3), "save": dvi.Save(every=7)}),
    "split": (SPLIT, {"q0": [1.0, 0.0], "p0": [0.2, 1.1], "h": 0.3, "save": dvi.Save(every=1)}),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "joined",
        "split",
        "sum",
        *(pytest.param(n, marks=pytest.mark.slow) for n in ("observed", "corrected", "times")),
    ],
)
def test_progress_does_not_change_a_bit(name):
    system, options = RUNS[name]
    options = {"num_steps": 250, **options}
    reports = []
    sol = dvi.integrate(system, **options)
    other = dvi.integrate(system, **options, progress=lambda *steps: reports.append(steps))
    assert len(reports) > 10 or name == "times"
    for a, b in zip(jax.tree.leaves(sol), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_deviation_vectors_are_those_of_the_states():
    options = {"h": 0.3, "num_steps": 4, "method": dvi.WisdomHolman(), "args": TWO.args}

    def final(z):
        sol = dvi.integrate(TWO.system, *z.reshape(2, 2, 2), **options, save=dvi.Save(final=True))
        return jnp.concatenate([sol.q_final.ravel(), sol.p_final.ravel()])

    z = jnp.concatenate([jnp.ravel(TWO.q0), jnp.ravel(TWO.p0)])
    sol = dvi.integrate(TWO, **options, observe=dvi.TangentMap())
    np.testing.assert_allclose(sol.observed, jax.jit(jax.jacfwd(final))(z), rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", [dvi.Reversible(), dvi.Direct()])
def test_gradients_of_observed_runs(adjoint):
    def loss(mass):
        args = {**TWO.args, "masses": jnp.stack([1.0 + 0 * mass, mass])}
        sol = dvi.integrate(
            TWO.system, TWO.q0, TWO.p0, args=args, h=0.3, num_steps=8, adjoint=adjoint,
            method=dvi.WisdomHolman(), save=dvi.Save(final=True),
            observe=dvi.Mean(lambda q, p: q[1] @ q[1]),
        )  # fmt: skip
        return sol.observed + jnp.sum(sol.q_final**2)

    f = jax.jit(loss)
    expected = (f(1.0001e-3) - f(0.9999e-3)) / 2e-7
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(1e-3), expected, rtol=1e-6)


def driven(t0, t1, q0, p1, args):
    return 1e-3 * jnp.cos(3 * t0) * jnp.sum(q0[1:] ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("max_defect", [None, 1e-30], ids=["by inverse steps", "computed again"])
def test_gradients_with_a_corrector(max_defect):
    """With saved states and a time-dependent perturbation; a neighbour in the batch fails."""
    system = dvi.System(THREE.system.H_D, perturbation=driven)

    def losses(scale, mass):
        args = {**THREE.args, "masses": THREE.args["masses"] * jnp.stack([1.0, mass, 1.0])}
        sol = jax.vmap(
            lambda scale: dvi.integrate(
                system, scale * THREE.q0, mass * THREE.p0, args=args, h=0.3, num_steps=10,
                method=dvi.WisdomHolman(corrector=3), save=dvi.Save(every=5), throw=False,
                epsilon=0.5, adjoint=dvi.Reversible(max_defect=max_defect),
            )
        )(scale)  # fmt: skip
        ok = (sol.result == dvi.RESULTS.successful)[:, None, None, None]
        qs, ps = jnp.where(ok, sol.qs, 0.0), jnp.where(ok, sol.ps, 0.0)
        return jnp.sum(qs[:, 1] * ps[:, 2]) + jnp.sum(qs[:, -1] ** 2)

    point, f = (jnp.array([1.0, jnp.nan]), 1.0), jax.jit(losses)
    of_scale, of_mass = jax.jit(jax.grad(losses, (0, 1)))(*point)
    for i, slope in enumerate((of_scale[0], of_mass)):
        ends = [f(point[0] + s * (i == 0), point[1] + s * (i == 1)) for s in (1e-5, -1e-5)]
        np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-5, rtol=1e-8)


@pytest.mark.slow
def test_a_gradient_corrects_the_ends_and_not_each_step():
    """With the corrector in each step backwards it would take 14 times as long."""

    def seconds(method):
        def loss(q0):
            run = {"h": 0.3, "num_steps": 2000, "method": method, "save": dvi.Save(final=True)}
            return jnp.sum(dvi.integrate(THREE.system, q0, THREE.p0, args=THREE.args, **run).qs)

        gradient = jax.jit(jax.grad(loss))
        gradient(THREE.q0).block_until_ready()
        times = []
        for _ in range(5):
            start = time.perf_counter()
            gradient(THREE.q0).block_until_ready()
            times.append(time.perf_counter() - start)
        return min(times)

    assert seconds(dvi.WisdomHolman(corrector=3)) < 2.5 * seconds(dvi.WisdomHolman())


@pytest.mark.slow
def test_derivatives_of_runs_that_stop():
    """Stop time and state by a shared mass, in forward mode; one of the batch does not stop, and
    one fails in its first step."""
    speeds = jnp.array([1.0, 1.05, 0.4, jnp.nan])
    end = dvi.Stop(lambda t, q, p, args: q[1, 1] - 0.5)

    def run(mass, speed):
        args = {**TWO.args, "masses": jnp.stack([1.0 + 0 * mass, mass])}
        p0 = jnp.array([[0.0, -1.0], [0.0, 1.0]]) * speed * MASS
        return dvi.integrate(
            TWO.system, TWO.q0, p0, args=args, h=0.11, num_steps=6, stop=end, throw=False,
            method=dvi.WisdomHolman(), save=dvi.Save(final=True), adjoint=dvi.Direct(),
        ).stop  # fmt: skip

    batch = jax.jit(lambda mass: jax.vmap(run, (None, 0))(mass, speeds))
    assert batch(MASS).t[:2].max() < 0.6
    assert np.isnan(batch(MASS).t[2:]).all()
    _, slopes = jax.jit(lambda mass: jax.jvp(batch, (mass,), (1.0,)))(MASS)
    ends = batch(1.001 * MASS), batch(0.999 * MASS)
    for slope, a, b in zip(slopes, *ends, strict=True):
        np.testing.assert_allclose(
            slope[:2], (a[:2] - b[:2]) / (0.002 * MASS), rtol=1e-5, atol=1e-5
        )


@pytest.mark.slow
def test_masses_that_change_with_time():
    """The coordinates of one step are then not those of the next."""

    def heavier(t0, t1, q0, p1, args):
        masses = jnp.array([1.0, 1e-3]) * (1 + 0.2 * t0)
        r = jnp.sqrt(jnp.sum((q0[1] - q0[0]) ** 2))
        return jnp.sum(p1**2 / (2 * masses[:, None])) - 1e-3 / r

    def final(method, **options):
        sol = dvi.integrate(
            dvi.System(heavier), TWO.q0, TWO.p0, h=0.005, num_steps=400, method=method, **options
        )
        return np.asarray(sol.qs[-1])

    expected = final(dvi.GaussLegendre(2))
    for options in ({"save": dvi.Save(final=True)}, {"observe": dvi.MaxDrift(lambda q, p: q[0])}):
        assert np.abs(final(dvi.WisdomHolman(), **options) - expected).max() < 5e-3
