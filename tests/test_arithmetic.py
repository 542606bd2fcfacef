"""Compensated summation and fixed point: accuracy, exact reversal, rejected input, gradients."""

import functools
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import ADJOINTS, ARGS, METHODS as REGISTERED, SYSTEMS, covering, pendulum

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.base.types import Interval
from dvi_jax.methods.step import Equations, _solve, to_grid
from lanewise.rules.exact import two_sum

METHODS = {
    **REGISTERED,
    "KahanLi6": dvi.KahanLi(6),
    "GaussLegendre2": dvi.GaussLegendre(2),
    "Lobatto3": dvi.LobattoIIIAIIIB(3),
}
QUANTUM = 2.0**-46
FINAL = dvi.Save(final=True)


def henon_heiles(t0, t1, q0, p1, args):
    """Two oscillators, coupled: H = (|p|² + |q|²)/2 + x²y − y³/3."""
    x, y = q0
    return jnp.sum(p1**2) / 2 + (x**2 + y**2) / 2 + x**2 * y - y**3 / 3


KEPLER, EIGHT = systems.kepler(), systems.n_body()
ORBITS = {
    "kepler": (KEPLER.system, [1.0, 0.3], [0.1, 0.9], 0.01, {"K": 1.0}),
    "figure_eight": (EIGHT.system, EIGHT.q0, EIGHT.p0, 0.01, EIGHT.args),
    "henon_heiles": (dvi.System(henon_heiles), [0.1, -0.2], [0.3, 0.25], 0.05, None),
}
THERE_AND_BACK = {
    "Strang by -h": (dvi.Strang(), dvi.Strang()),
    "Yoshida4 by -h": (dvi.Yoshida(4), dvi.Yoshida(4)),
    "TypeII by its inverse": (dvi.TypeII(), dvi.Adjoint()),
    "Strang by its inverse": (dvi.Strang(), dvi.Adjoint(dvi.Strang())),
}


def same_bits(a, b):
    return np.asarray(a).tobytes() == np.asarray(b).tobytes()


@pytest.mark.parametrize("order", [1, -1])
def test_the_sum_is_exact_under_jit(order):
    """s + e = a + b in rational arithmetic; without e it is not, nor with Dekker's three sums."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=200)
    b = rng.normal(size=200) * 2.0 ** rng.integers(-60, 4, 200)
    a, b = (a, b)[::order]
    s, e = map(np.asarray, jax.jit(two_sum)(a, b))

    def exact(*parts):
        return [sum(map(Fraction, x)) for x in zip(*parts, strict=True)]

    wanted = exact(a, b)
    assert exact(s, e) == wanted
    assert exact(s) != wanted
    assert exact(s, (a - s) + b) != wanted


def ensemble_error(arithmetic, num_steps, h):
    """Relative errors of the invariant of the oscillator's map, of 64 starts, after `num_steps`."""
    system = systems.oscillator().system
    how = {"h": h, "num_steps": num_steps, "arithmetic": arithmetic, "save": FINAL}

    def invariant(t0, t1, q0, p0, q1, p1, args):
        return jnp.sum(p1**2 + q1**2 - h * q1 * p1) / 2

    @jax.jit
    @jax.vmap
    def last(q, p):
        sol = dvi.integrate(system, q, p, observe=invariant, **how)
        return sol.observed[-1] / invariant(0.0, 0.0, q, p, q, p, None) - 1

    return np.asarray(last(*np.random.default_rng(0).uniform(-1, 1, (2, 64, 1))))


@pytest.mark.slow
def test_round_off_is_a_random_walk_and_smaller_with_compensation():
    """√N, for plain sums as well; where h makes roundings repeat they add up (the control)."""
    number = np.array([30_000, 300_000, 3_000_000])
    growth = {}
    for arithmetic in (dvi.FloatingPoint(), dvi.Compensated()):
        errors = [ensemble_error(arithmetic, n, 2.0**-5) for n in number]
        rms = growth[arithmetic] = np.array([np.sqrt(np.mean(e**2)) for e in errors])
        assert 0.3 < np.polyfit(np.log(number), np.log(rms), 1)[0] < 0.65
        assert abs(np.mean(errors[-1])) < 4 * np.std(errors[-1]) / 8
    plain, compensated = growth.values()
    assert plain[0] > 5e-15
    assert np.all(compensated < plain / 8)
    repeated = ensemble_error(dvi.Compensated(), number[-1], 0.1)
    assert abs(np.mean(repeated)) > 10 * np.std(repeated) / 8


@functools.cache
def final_state(system, method, arithmetic, num_steps=40, newton=dvi.Newton()):
    how = {"h": 0.1, "num_steps": num_steps, "epsilon": 0.2, "args": ARGS, "save": FINAL}
    how |= {"method": METHODS[method], "arithmetic": arithmetic, "newton": newton}
    sol = dvi.integrate(*SYSTEMS[system], **how)
    return np.array([sol.qs[-1], sol.ps[-1]]), int(sol.stats["newton_iterations"])


PAIRS = dict.fromkeys(covering(("pendulum", "kepler", "non_separable"), METHODS))
WITHOUT_JACOBIAN = dvi.PicardThenNewton(newton_up_to=0)


@pytest.mark.parametrize(
    ("system", "method", "newton", "more"),
    [
        *((*pair, dvi.Newton(), 4) for pair in PAIRS),
        # Its iterations stop at round-off: one more or less in a step.
        ("kepler", "GaussLegendre2", WITHOUT_JACOBIAN, 40),
    ],
)
@pytest.mark.slow
def test_every_method_is_the_same_in_local_coordinates(system, method, newton, more):
    """The same map to round-off, with as many iterations, and a state with other bits."""
    plain, one = final_state(system, method, dvi.FloatingPoint(), newton=newton)
    compensated, two = final_state(system, method, dvi.Compensated(), newton=newton)
    np.testing.assert_allclose(compensated, plain, rtol=1e-12, atol=1e-13)
    assert not same_bits(compensated, plain)
    assert abs(two - one) <= more
    if newton == WITHOUT_JACOBIAN:
        assert two > final_state(system, method, dvi.Compensated())[1]


@pytest.mark.slow
def test_an_equilibrium_is_solved_for_in_its_own_size():
    """p relaxes to 3, where increments are round-off: by their own size they settle late."""
    s = dvi.System(pendulum, force=lambda t0, t1, q0, p1, args: jnp.sin(q0) + 3 - p1)
    how = {"h": 0.1, "num_steps": 20, "epsilon": 1.0, "arithmetic": dvi.Compensated()}
    sol = dvi.integrate(s, [1.0], [3.0], **how)
    assert int(sol.stats["newton_iterations"]) <= 20 * 2
    q, p, h = jnp.ones(1), 3 * jnp.ones(1), jnp.asarray(1.0)
    equations = Equations(s, jnp.ones(()), origin=(q, p))
    interval = Interval(0 * h, h, h)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, None))
    def solved(start, known):
        rate = functools.partial(equations.momentum_rate, interval, 0 * q)
        guess = start + h * rate(start)
        _, info = _solve(rate, h, start, guess, equations, known)
        return info.iterations, info.converged

    starts = np.linspace(-2e-15, 2e-15, 50)[:, None]
    iterations, converged = solved(starts, p)
    assert np.max(iterations) <= 2
    assert converged.all()
    iterations, converged = solved(starts, 0 * p)
    assert np.max(iterations) > 8


@pytest.mark.slow
def test_memory_of_sums_in_pieces_batches_and_single_precision():
    """With progress the run is in pieces; in a batch trajectories are as alone."""
    s, q, p = SYSTEMS["pendulum"]
    how = {"h": 0.0625, "num_steps": 3000, "epsilon": 0.0, "save": dvi.Save(every=10)}

    def run(q, p, **more):
        return dvi.integrate(s, q, p, arithmetic=dvi.Compensated(), **how, **more)

    q, p = jnp.asarray(q), jnp.asarray(p)
    whole, pieces = run(q, p), run(q, p, progress=lambda done, of: None)
    assert same_bits(whole.qs, pieces.qs)
    assert same_bits(whole.ps, pieces.ps)
    # A restart loses the memory, and the bits differ.
    half = run(whole.qs[100], whole.ps[100])
    assert not same_bits(half.qs[1:201], whole.qs[101:301])
    batch = jax.vmap(lambda a: run(a * q, a * p).qs)(jnp.array([1.0, 0.5]))
    np.testing.assert_allclose(batch[0], whole.qs, atol=1e-12)
    np.testing.assert_allclose(batch[1], run(q / 2, p / 2).qs, atol=1e-12)
    # Against double precision: the error of float32 without it is ten times as large.
    s = dvi.System(pendulum)
    q, p = np.array([0.4]), np.array([0.7])

    def last(dtype, arithmetic):
        how = {"h": 2.0**-6, "num_steps": 20_000, "arithmetic": arithmetic, "save": FINAL}
        return dvi.integrate(s, q.astype(dtype), p.astype(dtype), **how).qs[-1]

    q, p = np.float32(q).astype(float), np.float32(p).astype(float)
    exact = last(np.float64, dvi.FloatingPoint())
    plain = abs(last(np.float32, dvi.FloatingPoint()) - exact)
    compensated = abs(last(np.float32, dvi.Compensated()) - exact)
    assert last(np.float32, dvi.Compensated()).dtype == np.float32
    assert compensated < plain / 10


@pytest.mark.slow
@pytest.mark.parametrize("arithmetic", [dvi.Compensated(), dvi.FixedPoint(QUANTUM)])
def test_a_failed_trajectory_leaves_others_unchanged(arithmetic):
    how = {"h": 0.01, "num_steps": 20, "args": ARGS, "arithmetic": arithmetic, "throw": False}
    q = jnp.array([[1.0, 0.0], [0.0, 0.0], [0.9, 0.1]])
    p = jnp.tile(jnp.array([0.0, 1.0]), (3, 1))
    batch = jax.jit(jax.vmap(lambda q, p: dvi.integrate(KEPLER.system, q, p, **how)))(q, p)
    assert list(batch.status) == ["successful", "not_finite", "successful"]
    assert np.isfinite(batch.qs[::2]).all()
    assert np.isnan(batch.qs[1, 1:]).all()


def comes_back(orbit, methods, arithmetic, num_steps, batch=None):
    """Whether a run forth and one back from its end give the start, to the bit."""
    s, q, p, h, args = ORBITS[orbit]
    q, p = jnp.asarray(q), jnp.asarray(p)
    how = {"num_steps": num_steps, "args": args, "arithmetic": arithmetic, "save": FINAL}

    def program(method):
        def run(q, p, h):
            sol = dvi.integrate(s, q, p, h=h, method=method, throw=False, **how)
            return (sol.qs[0], sol.ps[0]), (sol.qs[-1], sol.ps[-1])

        return jax.jit(run if batch is None else jax.vmap(run, (0, 0, None)))

    if batch is not None:
        q, p = (x[None] * batch.reshape(-1, *[1] * x.ndim) for x in (q, p))
    forth = program(methods[0])
    back = forth if methods[0] == methods[1] else program(methods[1])
    start, far = forth(q, p, h)
    _, end = back(*far, -h)
    assert np.max(np.abs(far[0] - start[0])) > 1e-3  # it did move
    return all(map(same_bits, start, end))


ROUTES = [*covering(ORBITS, THERE_AND_BACK), ("henon_heiles", "TypeII by its inverse")]


@pytest.mark.parametrize(("orbit", "route"), ROUTES)
@pytest.mark.slow
def test_fixed_point_comes_back_bit_for_bit(orbit, route):
    """A million steps forward and a million back return the state; plain and compensated sums
    do not."""
    methods = THERE_AND_BACK[route]
    assert comes_back(orbit, methods, dvi.FixedPoint(QUANTUM), 1_000_000)
    assert not comes_back(orbit, methods, dvi.FloatingPoint(), 20_000)


@pytest.mark.slow
@pytest.mark.parametrize(("orbit", "route"), covering(ORBITS, THERE_AND_BACK, shift=1))
def test_a_batch_in_fixed_point_comes_back_bit_for_bit(orbit, route):
    batch = np.linspace(0.999, 1.001, 5)
    methods = THERE_AND_BACK[route]
    assert comes_back(orbit, methods, dvi.FixedPoint(QUANTUM), 100_000, batch)
    assert not comes_back(orbit, methods, dvi.Compensated(), 20_000, batch)


@pytest.mark.slow
def test_random_forces_come_back_bit_for_bit():
    """Polynomials of many products, with observables that share products with the force.

    With products contracted to FMA this run did not return: the force was compiled in more than
    one way. The control changes the last bits of the coefficients.
    """
    rng = np.random.default_rng(1)
    size, terms = 2, int(rng.integers(4, 9))
    powers = rng.integers(0, 3, (terms, size))
    powers[:, 0] += 1  # none is constant

    def potential(q, factors):
        total = jnp.sum(q**2) / 2 + jnp.sum(q**2) ** 2 / 10
        for factor, power in zip(factors, powers, strict=True):
            total = total + factor * jnp.prod(jnp.stack([q[i] ** k for i, k in enumerate(power)]))
        return total

    def energy(t0, t1, q0, p0, q1, p1, args):
        return jnp.sum(p1**2) / 2 + p1[0] ** 4 / 50 + potential(q1, args)

    system = dvi.System(lambda t0, t1, q, p, args: energy(t0, t1, q, p, q, p, args))
    q, p = rng.normal(size=(2, 5, size)) / 2
    factors = jnp.asarray(rng.normal(size=terms) / 50)

    how = {"num_steps": 5_000, "save": FINAL, "arithmetic": dvi.FixedPoint(2.0**-48)}

    def run(q, p, h, factors, method):
        def one(q, p):
            more = {"args": factors, "method": method, "observe": dvi.MaxDrift(energy)}
            sol = dvi.integrate(system, q, p, h=h, **how, **more)
            return sol.qs[-1], sol.ps[-1]

        return jax.vmap(one)(q, p)

    h = 0.034
    start = q, p = run(q, p, h, factors, dvi.Strang())  # on the grid
    for method in (dvi.Strang(), dvi.Yoshida(4)):
        forth = jax.jit(functools.partial(run, method=method))
        back = jax.jit(functools.partial(run, method=dvi.Adjoint(method)))
        far = forth(q, p, h, factors)
        assert all(map(same_bits, start, forth(*far, -h, factors)))
        assert all(map(same_bits, start, back(*far, -h, factors)))
        nearly = factors * (1 + 2.0**-50)
        assert not any(map(same_bits, start, forth(*far, -h, nearly)))


def test_a_force_of_time_comes_back_where_times_are_exact():
    """h a power of two, t0 a multiple of it: then t0 + kh forth and back are the same numbers."""
    s = dvi.System(pendulum, force=lambda t0, t1, q0, p1, args: jnp.cos(t0) + jnp.sin(t1) * q0)

    def back(h):
        def run(q, p, t0, h):
            how = {"num_steps": 4000, "epsilon": 0.3, "method": dvi.Strang(), "save": FINAL}
            sol = dvi.integrate(s, q, p, t0=t0, h=h, arithmetic=dvi.FixedPoint(QUANTUM), **how)
            return (sol.qs[0], sol.ps[0]), (sol.qs[-1], sol.ps[-1]), sol.ts[-1]

        start, far, t = run([0.4], [0.7], 0.0, h)
        _, end, _ = run(*far, t, -h)
        return all(map(same_bits, start, end))

    assert back(2.0**-5)
    assert not back(0.03)


def test_states_are_multiples_of_the_quantum():
    """The start is rounded to one as well, and zero has no sign."""
    s, q, p, h, args = ORBITS["kepler"]
    for arithmetic in (dvi.FixedPoint(QUANTUM), dvi.FloatingPoint()):
        sol = dvi.integrate(s, q, p, h=h, num_steps=50, args=args, arithmetic=arithmetic)
        z = np.array([sol.qs, sol.ps]) / QUANTUM
        assert (np.max(np.abs(z - np.round(z))) == 0) == (arithmetic != dvi.FloatingPoint())
    start, how = ([0.3], [-(2.0**-9)]), {"h": 0.125, "num_steps": 1}
    sol = dvi.integrate(dvi.System(pendulum), *start, arithmetic=dvi.FixedPoint(2.0**-8), **how)
    assert sol.qs[0, 0] == 77 / 256  # 76.8 quanta
    assert same_bits(sol.ps[0], np.zeros(1))  # half a quantum goes to even, to zero
    x = jnp.array([0.3, 0.5, 1.5, -0.5, 2.49, 1e6 + 0.2])
    np.testing.assert_array_equal(to_grid(x, 1.0), [0, 0, 2, -0.0, 2, 1e6])
    np.testing.assert_array_equal(to_grid(-x, 0.25), -to_grid(x, 0.25))
    np.testing.assert_array_equal(jax.vmap(jax.grad(lambda x: 3 * to_grid(x, 1.0)))(x), 3)


@pytest.mark.slow
def test_leaving_the_range_has_a_status():
    """A free particle: q = n after n steps, up to 2⁵³ quanta."""
    free = dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**2) / 2)

    def run(quantum, dtype=np.float64, throw=False):
        how = {"h": 1.0, "num_steps": 20, "arithmetic": dvi.FixedPoint(quantum), "throw": throw}
        return dvi.integrate(free, np.zeros(1, dtype), np.ones(1, dtype), **how)

    assert run(2.0**-48).status == run(2.0**-19, np.float32).status == "successful"
    short = run(2.0**-49)  # up to 16
    assert short.status == "out_of_range"
    assert int(short.stats["failed_step"]) == 16
    assert np.isnan(short.qs[-1]).all()
    assert short.qs[16, 0] == 16
    assert int(run(2.0**-20, np.float32).stats["failed_step"]) == 16
    with pytest.raises(dvi.IntegrationError, match="step 16 of 20"):
        run(2.0**-49, throw=True)


@pytest.mark.parametrize("quantum", [0.1, 3.0, 0, -1.0, True, None, float("inf"), float("nan")])
def test_a_quantum_that_is_not_a_power_of_two_is_rejected(quantum):
    with pytest.raises(ValueError, match="power of two"):
        dvi.FixedPoint(quantum)


def test_steps_that_fixed_point_cannot_undo_are_rejected():
    separable = dvi.System(pendulum)

    def run(system, method=dvi.TypeII(), q0=(0.3,), quantum=QUANTUM, **more):
        how = {"h": 0.1, "num_steps": 1, "method": method, "arithmetic": dvi.FixedPoint(quantum)}
        return dvi.integrate(system, q0, np.ones_like(q0), **how, **more)

    for good in (dvi.TypeII(), dvi.Adjoint(dvi.Yoshida(4)), dvi.Strang(base=dvi.Adjoint())):
        run(separable, good)
    for method in (
        dvi.RungeKutta4(),
        dvi.GaussLegendre(1),
        dvi.Yoshida(4, base=dvi.GaussLegendre(1)),
        dvi.Adjoint(dvi.GaussLegendre(1)),
    ):
        with pytest.raises(ValueError, match="TypeII"):
            run(separable, method)
    damped = dvi.System(pendulum, force=lambda t0, t1, q0, p1, args: -p1)
    for system in (SYSTEMS["non_separable"][0], damped):
        for method in (dvi.TypeII(), dvi.Adjoint()):
            with pytest.raises(ValueError, match="separable"):
                run(system, method, epsilon=0.1)
    with pytest.raises(ValueError, match="float32"):
        run(separable, q0=np.array([0.3], np.float32), quantum=2.0**-140)
    with pytest.raises(TypeError, match="Arithmetic"):
        dvi.integrate(separable, [0.3], [1.0], h=0.1, num_steps=1, arithmetic=dvi.Compensated)


@functools.cache
def derivatives(arithmetic, adjoint, is_implicit):
    """dL/d(q0, p0, h, ε) of a forced run, explicit or not, in reverse and in forward mode."""
    if is_implicit:
        system, method = SYSTEMS["non_separable"][0], dvi.TypeII()
    else:
        system = dvi.System(pendulum, force=lambda t0, t1, q0, p1, args: -(q0**3))
        method = dvi.Strang()
    how = {"num_steps": 23, "method": method, "save": dvi.Save(every=10, final=True)}
    how |= {"adjoint": ADJOINTS[adjoint], "arithmetic": arithmetic}

    def of(x):
        sol = dvi.integrate(system, x[:1], x[1:2], h=x[2], epsilon=x[3], **how)
        return jnp.sum(sol.qs**3) + jnp.sum(sol.ps[-1])

    x = jnp.array([0.3, 0.4, 0.1, 0.2])
    reverse = np.asarray(jax.jit(jax.grad(of))(x))
    if adjoint == "Direct":
        np.testing.assert_allclose(jax.jit(jax.jacfwd(of))(x), reverse, rtol=1e-12)
    return reverse


@pytest.mark.parametrize("adjoint", ADJOINTS)
@pytest.mark.slow
def test_gradients_are_those_of_the_map(adjoint):
    """As with plain sums: to round-off; in fixed point to the quantum, as a coarse one shows."""
    plain = derivatives(dvi.FloatingPoint(), "Direct", True)
    assert np.min(np.abs(plain)) > 1e-3
    np.testing.assert_allclose(derivatives(dvi.Compensated(), adjoint, True), plain, rtol=1e-11)
    plain = derivatives(dvi.FloatingPoint(), "Direct", False)
    fixed = derivatives(dvi.FixedPoint(QUANTUM), adjoint, False)
    np.testing.assert_allclose(fixed, plain, rtol=1e-9)
    if adjoint == "Reversible":
        coarse = derivatives(dvi.FixedPoint(2.0**-10), adjoint, False)
        assert 1e-6 < np.max(np.abs(coarse / plain - 1)) < 0.1


@pytest.mark.slow
def test_adaptive_steps_use_the_arithmetic():
    """With a transformed time, time is summed too; its Hamiltonian is not separable."""
    lattice = dvi.TimeTransformed(lambda t, q, p, args: jnp.sum(q**2))
    how = {"h": 0.02, "num_steps": 30, "args": ARGS, "lattice": lattice, "method": dvi.TypeII()}

    def run(arithmetic):
        start = [1.0, 0.0], [0.0, 1.1]
        return dvi.integrate(KEPLER.system, *start, arithmetic=arithmetic, **how)

    plain, compensated = run(dvi.FloatingPoint()), run(dvi.Compensated())
    np.testing.assert_allclose(compensated.qs, plain.qs, atol=1e-12)
    np.testing.assert_allclose(compensated.ts, plain.ts, atol=1e-12)
    assert not same_bits(compensated.qs, plain.qs)
    with pytest.raises(ValueError, match="explicit"):
        run(dvi.FixedPoint(QUANTUM))
