"""Close encounters in `WisdomHolman`: reversible switching, energy, order, batches, derivatives."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central_difference

import dvi_jax as dvi
from dvi_jax import elements, forces, systems
from dvi_jax.methods import _encounters, _wisdom_holman

MASSES = np.array([1.0, 1e-3, 1e-3])
Q0 = np.array([[-0.0016, 0.0003, 0.0], [0.2176, -0.8012, -0.0028], [1.3448, 0.4861, 0.0091]])
V0 = np.array([[-0.0007, -0.0012, 0.0], [1.0603, 0.4562, -0.0042], [-0.406, 0.732, 0.0041]])
TWO = systems.n_body(MASSES, Q0, MASSES[:, None] * V0, h=0.1)
"""Two planets that meet after five time units, at a hundredth of their distances."""

ORBITS = elements.Keplerian(np.array([1.0, 5.2]), np.array([0.95, 0.05]), 0.01, 1.0, 2.0, 2.0)
COMET = systems.n_body(MASSES, *elements.to_bodies(ORBITS, MASSES), h=0.1)
"""An eccentric orbit inside of that of another planet; at its pericentre after 4.3 time units."""

METHOD = dvi.WisdomHolman("democratic", encounters=3.0)
WITH_PERICENTRES = dvi.WisdomHolman("democratic", encounters=3.0, pericentres=1.0)
ENERGY = TWO.observables["energy"]
END = dvi.Save(final=True)


def shifted(shift, problem=TWO):
    return jnp.asarray(problem.q0).at[2, 0].add(shift)


def round_trip(method, shift, problem=TWO, name="encounter_steps"):
    """The difference from the start after 60 steps and as many back, and the steps with a pair."""
    run = {"num_steps": 60, "method": method, "save": END}

    def there_and_back(shift):
        start = shifted(shift, problem)
        out = dvi.integrate(problem, q0=start, h=0.1, **run)
        back = dvi.integrate(problem, q0=out.q_final, p0=out.p_final, h=-0.1, **run)
        counts = [sol.stats[name] for sol in (out, back)]
        return jnp.abs(back.q_final - start).max(), jnp.stack(counts)

    return jax.jit(jax.vmap(there_and_back))(shift)


def test_a_run_back_returns_to_the_start_through_an_encounter(monkeypatch):
    shifts = np.linspace(0, 4e-3, 200)
    defect, counts = round_trip(METHOD, shifts)
    assert defect.max() < 1e-11
    assert counts.min() > 20
    # Judged at the start of the step alone, the step back has other pairs.
    monkeypatch.setattr(_wisdom_holman, "_ATTEMPTS", 1)
    defect, _ = round_trip(dvi.WisdomHolman("democratic", encounters=3.0 + 1e-12), shifts)
    assert defect.min() > 1e-6


@pytest.mark.slow
def test_a_run_back_returns_to_the_start_through_a_pericentre(monkeypatch):
    case = np.linspace(0, 0.4, 50), COMET, "pericentre_steps"
    defect, counts = round_trip(WITH_PERICENTRES, *case)
    assert defect.max() < 1e-11
    assert counts.min() >= 4
    assert (counts[:, 0] == counts[:, 1]).all()
    monkeypatch.setattr(_wisdom_holman, "_ATTEMPTS", 1)
    method = dvi.WisdomHolman("democratic", encounters=3.0, pericentres=1.0 + 1e-12)
    assert round_trip(method, *case)[0].min() > 1e-5


def test_the_time_at_a_pericentre_is_that_of_the_derivatives():
    """Of the acceleration along the orbit, by automatic differentiation."""
    rng = np.random.default_rng(2)
    x, v, mu = rng.normal(size=(50, 3)), rng.normal(size=(50, 3)), rng.uniform(1, 2, 50)

    def of_one(x, v, mu):
        rate = lambda x: -mu * x / jnp.linalg.norm(x) ** 3  # noqa: E731
        jerk = lambda x, v: jax.jvp(rate, (x,), (v,))[1]  # noqa: E731
        snap = jax.jvp(jerk, (x, v), (v, rate(x)))[1]
        size = jnp.linalg.norm
        square = 2 * size(rate(x)) ** 2
        return jnp.sqrt(square / (size(jerk(x, v)) ** 2 + size(rate(x)) * size(snap)))

    tau = jax.vmap(of_one)(x, v, mu)
    for factor, expected in ((1 - 1e-12, False), (1 + 1e-12, True)):
        for h in (0.3 * factor * tau, -0.3 * factor * tau):
            test = jax.vmap(lambda h, *z: _encounters.at_pericentre(h, *z, 0.3)[0])
            found = test(h, x[:, None], v[:, None], mu[:, None])
            assert (found == expected).all()


@pytest.mark.slow
def test_pericentres_of_one_planet_and_of_a_batch():
    """One planet on its Kepler orbit; a batch in which one trajectory has none."""
    one = elements.Keplerian(1.0, 0.99, 0.01, 1.0, 2.0, 2.0)
    q, p = elements.to_bodies(jax.tree.map(lambda x: jnp.array([x]), one), MASSES[:2])
    alone = systems.n_body(MASSES[:2], q, p, h=0.05)
    run = {"method": dvi.WisdomHolman("democratic", pericentres=0.1), "save": END}
    end = dvi.integrate(alone, num_steps=2000, **run)
    exact = elements.Keplerian(*one[:5], 2.0 + 100.0 * (1 + 1e-3) ** 0.5)
    expected = exact.state(1 + 1e-3)[0]
    np.testing.assert_allclose(end.q_final[1] - end.q_final[0], expected, atol=2e-3)
    assert set(end.stats) & {"pericentre_steps", "encounter_steps"} == {"pericentre_steps"}

    def count(speed):
        p0 = jnp.asarray(COMET.p0).at[1].multiply(speed)
        sol = dvi.integrate(COMET, p0=p0, num_steps=60, method=WITH_PERICENTRES, save=END)
        return sol.q_final, sol.stats["pericentre_steps"]

    speeds = jnp.array([1.0, 3.0])  # the second leaves on a hyperbola
    ends, counts = jax.jit(jax.vmap(count))(speeds)
    for i, speed in enumerate(speeds):
        np.testing.assert_array_equal(ends[i], jax.jit(count)(speed)[0])
    assert counts.tolist() == [4, 0]


@pytest.mark.slow
def test_without_an_encounter_the_steps_are_those_of_the_plain_method():
    """And with one they are not; its energy error is that of the steps before."""
    energy = {"drift": dvi.MaxDrift(ENERGY)}

    def run(method, num_steps):
        return dvi.integrate(TWO, num_steps=num_steps, method=method, observe=energy, save=END)

    plain = dvi.WisdomHolman("democratic")
    before = run(METHOD, 10), run(plain, 10)
    assert before[0].stats["encounter_steps"] == 0
    assert "encounter_steps" not in before[1].stats
    np.testing.assert_array_equal(before[0].q_final, before[1].q_final)
    np.testing.assert_array_equal(before[0].p_final, before[1].p_final)
    after = run(METHOD, 60), run(plain, 60)
    assert after[0].stats["encounter_steps"] > 20
    assert abs(float(after[0].observed["drift"])) < 3e-9
    assert abs(float(after[1].observed["drift"])) > 3e-7


def test_each_trajectory_of_a_batch_decides_for_itself():
    shifts = np.array([0.0, 0.3, np.nan, 2e-3])  # the second meets nobody, the third is no state

    def end(shift):
        sol = dvi.integrate(
            TWO, q0=shifted(shift), num_steps=60, method=METHOD, save=END, throw=False
        )
        return sol.q_final, sol.stats["encounter_steps"], sol.result == dvi.RESULTS.successful

    batch = jax.jit(jax.vmap(end))(shifts)
    alone = jax.jit(end)
    for i, shift in enumerate(shifts):
        for together, single in zip(batch, alone(shift), strict=True):
            np.testing.assert_array_equal(together[i], single)
    assert batch[2].tolist() == [True, True, False, True]
    assert (batch[1] > 0).tolist() == [True, False, False, True]


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.0, 1e-3])
def test_the_order_is_kept_with_forces_and_softening(mass):
    """Against small steps of another method, which resolves the encounter. The second body is a
    test particle or a planet, and the force depends on velocities."""
    masses = np.array([1.0, 1e-3, mass])
    momenta = np.where(masses > 0, masses, 1)[:, None] * V0
    start = systems.n_body(masses, Q0, momenta, h=0.1, softening=1e-2)
    problem = forces.Relativity(lambda args: args["c"]).add_to(start)

    def end(steps, method):
        sol = dvi.integrate(
            problem, args=start.args | {"c": 30.0}, h=6.0 / steps, num_steps=steps, method=method,
            save=END,
        )  # fmt: skip
        return np.asarray(sol.q_final), sol.stats.get("encounter_steps", 0)

    exact, _ = end(6000, dvi.KahanLi(8))
    found = [end(steps, METHOD) for steps in (120, 240, 480)]
    errors = np.array([np.abs(q - exact).max() for q, _ in found])
    assert min(count for _, count in found) > 10
    np.testing.assert_allclose(errors[:-1] / errors[1:], 4, atol=0.5)


@pytest.mark.slow
def test_another_scheme_is_more_accurate():
    """Its parts have lengths that are rounded, some of them negative: the step failed with them."""

    def end(steps, method):
        return dvi.integrate(TWO, h=6.0 / steps, num_steps=steps, method=method, save=END).q_final

    exact = end(24_000, dvi.KahanLi(8))
    choice: Any = {"scheme": dvi.Yoshida(4), "encounters": 1e3}
    method = dvi.WisdomHolman("democratic", **choice)
    errors = np.array([np.abs(end(steps, method) - exact).max() for steps in (20, 40)])
    assert errors[0] / errors[1] > 5  # 4 with the order 2
    assert errors[1] < 2e-7


def loss_with(adjoint, problem, method):
    v0 = problem.p0 / MASSES[:, None]

    def loss(x):
        """Of a state after the encounter, by the initial state and the masses."""
        q, masses = x
        sol = dvi.integrate(
            problem, q0=q, p0=masses[:, None] * v0, args={"masses": masses, "G": 1.0}, num_steps=60,
            method=method, save=END, adjoint=adjoint,
        )  # fmt: skip
        return jnp.sum(sol.q_final**2)

    return loss


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    [
        (dvi.Direct(), TWO, METHOD),
        (dvi.Checkpointed(), TWO, METHOD),
        (dvi.Reversible(), TWO, METHOD),
        (dvi.Reversible(), COMET, WITH_PERICENTRES),
    ],
)
def test_gradients_are_those_of_the_pairs_taken(case):
    loss, x = loss_with(*case), (jnp.asarray(case[1].q0), jnp.asarray(MASSES))
    rng = np.random.default_rng(1)
    direction = tuple(jnp.asarray(rng.normal(size=a.shape)) * a for a in x)
    gradient = jax.jit(jax.grad(loss))(x)
    expected = central_difference(jax.jit(loss), x, direction, step=3e-7)
    ours = sum(jnp.vdot(g, d) for g, d in zip(gradient, direction, strict=True))
    assert abs(ours / expected - 1) < 1e-6
    assert abs(expected) > 1


@pytest.mark.slow
def test_a_motion_that_is_not_found_is_a_status(monkeypatch):
    monkeypatch.setattr(_encounters, "_MOST", 3)
    method = dvi.WisdomHolman("democratic", encounters=3.1)
    sol = dvi.integrate(TWO, num_steps=60, method=method, save=END, throw=False)
    assert sol.status == "not_converged"
    assert 0 < sol.stats["encounter_steps"] < 39
    assert np.isnan(sol.q_final).all()


def test_deep_encounters_are_resolved_and_collisions_are_a_status():
    """One step through a smallest distance of about 60 b², and a fall into the first body."""

    def drift(q, v, method):
        run = {"num_steps": 1, "method": method, "save": END, "throw": False}
        run |= {"q0": q, "p0": MASSES[:, None] * v, "observe": dvi.MaxDrift(ENERGY)}
        sol = dvi.integrate(TWO, **run)
        return sol.result, sol.observed

    @jax.jit
    @jax.vmap
    def planets(b):
        q = jnp.array([[0.0, 0, 0], [1, 0, 0], [1, -0.02, 0]]).at[2, 0].add(b)
        return drift(q, jnp.array([[0.0, 0, 0], [0, 1, 0], [0, 1.5, 0]]), METHOD)

    result, error = planets(jnp.array([0.1, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 0.0]))
    assert (result == dvi.RESULTS.successful).tolist() == [True] * 6 + [False] * 2
    assert (result == dvi.RESULTS.not_converged).tolist() == [False] * 6 + [True] * 2
    assert error[:6].max() < 3e-10

    @jax.jit
    @jax.vmap
    def star(speed):
        q = jnp.array([[0.0, 0, 0], [0.1, 0, 0], [5, 0, 0]])
        v = jnp.array([[0.0, 0, 0], [-4, 0, 0], [0, 0.4, 0]]).at[1, 1].set(speed)
        return drift(q, v, WITH_PERICENTRES)

    result, error = star(jnp.array([1.0, 1e-1, 1e-2, 1e-3, 0.0]))
    assert (result == dvi.RESULTS.successful).tolist() == [True] * 4 + [False]
    assert error[:4].max() < 1e-8


def test_what_the_encounters_require_is_named():
    with pytest.raises(ValueError, match="must be 'democratic', got 'jacobi'"):
        dvi.WisdomHolman(encounters=3.0)
    with pytest.raises(ValueError, match="encounters must be"):
        dvi.WisdomHolman("democratic", encounters=-1.0)

    def free(t0, t1, q0, p1, args):  # planets that do not attract one another
        inner = q0[1:] - q0[:1]
        pull = jnp.sum(args["masses"][1:] / jnp.sqrt(jnp.sum(inner**2, axis=1)))
        return jnp.sum(p1**2 / args["masses"][:, None]) / 2 - pull

    with pytest.raises(ValueError, match="attract one another"):
        dvi.integrate(
            dvi.System(free), TWO.q0, TWO.p0, args=TWO.args, h=0.1, num_steps=1, method=METHOD
        )
