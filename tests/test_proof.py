"""Proved bounds of the drift: never below the truth, and a checker that refuses what is false."""

import copy
import dataclasses
import json
import runpy
import subprocess
import sys
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import dvi_jax as dvi

pytest.importorskip("flint")
from dvi_jax.proof import checker as exact
from dvi_jax.proof.components import NotAnalytic, program_of

CUBIC = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + q @ q) / 2, force=lambda t0, t1, q, p, args: -(q**3)
)


def found(system, degree, order, r):
    samples = np.random.default_rng(0).uniform(-r, r, (2, 800, 1))
    return dvi.discover_invariants(
        system, dvi.Polynomials(degree), order=order, h=0.1, samples=samples
    )


@pytest.fixture(scope="module")
def cubic():
    """The bound of order 2 on the box of half-width 0.5."""
    return dvi.bound_drift(found(CUBIC, 8, 2, 0.5), CUBIC, h=0.1, epsilon=0.01, domain=0.5)


def energy_of_the_map(q, p, epsilon):
    return (p @ p + q @ q - 0.1 * (q @ p)) / 2


def proved(function, system=CUBIC, n=1, r=0.5, **options):
    """The bound on the box of half-width r."""
    given = {"h": 0.1, "epsilon": 0.01, "domain": np.full(n, r), **options}
    return dvi.bound_drift(function, system, **given)


# --- the bounds ----------------------------------------------------------------------------------


def test_the_cubic_oscillator(cubic):
    assert cubic.per_step[0] <= 3e-10
    assert cubic.seen[0] <= cubic.per_step[0] <= 2 * cubic.seen[0]
    assert 1e-17 < cubic.rounding[0] < 3e-16
    assert cubic.num_steps(1e-3) == int(1e-3 / (cubic.per_step[0] + cubic.rounding[0]))
    assert cubic.level is not None
    assert cubic.steps > 3e6
    assert 0.5 < cubic.start < 0.8
    assert "leaves it in" in str(cubic)


SYSTEMS = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "proof.py"))


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS["CASES"])
def test_the_table_of_systems(name):
    """Bounds at most 30 times the largest change of 100 000 points, below their limits, in time."""
    assert SYSTEMS["row"](name) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rounding", "cubic, order 1"])
def test_computed_trajectories_stay_below_the_line(name):
    assert SYSTEMS["long_run"](name, 30_000) == []


class Digits(SYSTEMS["Extended"]):
    """The arithmetic of mpmath for the `run` of the checker."""

    @staticmethod
    def constant(value):
        return mpmath.mpf(value.numerator) / value.denominator

    @staticmethod
    def apply(name, a):
        return 1 / a if name == "inverse" else getattr(mpmath, name)(a)


def changes_in_digits(certificate, k, points):
    """|I_k(Φ(x)) − I_k(x)| at states with ε, in 50 digits."""
    with mpmath.workdps(50):
        h = mpmath.mpf(float.fromhex(certificate["h"]))
        values = []
        for point in points:
            *x, epsilon = (mpmath.mpf(float(v)) for v in point)
            end = exact.run(certificate["step"], [*x, 0, epsilon, h], Digits)
            invariant = certificate["invariants"][k]
            inputs = [0, epsilon, h]
            after, before = (exact.run(invariant, [*z, *inputs], Digits)[0] for z in (end, x))
            values.append(abs(after - before))
        return values


def random_system(seed, analytic):
    """A system with a random potential and force of one degree of freedom, and a function."""
    a, b, c, d = np.random.default_rng(seed).uniform(-1, 1, 4)

    def V(x):
        if analytic:
            return jnp.sum(a * jnp.cos(x) + b * jnp.exp(x / 2) + jnp.sqrt(1.5 + c * x / 2))
        return jnp.sum(a * x**2 + b * x**3 + c * x**4)

    def W(t0, t1, x, p, args):
        return d * jnp.sin(2 * x) / (2 + x) if analytic else d * x**2 - a * x**5

    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + V(q), force=W)
    return system, lambda q, p, epsilon: p @ p / 2 + V(q) + epsilon * c * jnp.sum(q * p)


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(s, marks=pytest.mark.slow) for s in range(2, 30))]
)
@pytest.mark.parametrize("analytic", [False, True])
def test_a_bound_is_never_below_the_truth(seed, analytic):
    system, function = random_system(seed, analytic)
    bound = proved(function, system, r=0.4, epsilon=0.05, ratio=1.2, max_boxes=300)
    certificate = bound.certificate
    grid = np.linspace(-0.4, 0.4, 9)
    points = [(q, p, e) for q in grid for p in grid for e in (0.0, 0.05)]
    values = changes_in_digits(certificate, 0, points)
    best = points[int(np.argmax([float(v) for v in values]))]
    rng = np.random.default_rng(seed)
    for scale in (0.05, 0.01, 0.002):
        near = np.clip(best + rng.normal(0, scale, (60, 3)), [-0.4, -0.4, 0], [0.4, 0.4, 0.05])
        more = changes_in_digits(certificate, 0, near)
        values.extend(more)
        best = near[int(np.argmax([float(v) for v in more]))]
    largest = float(max(values))
    assert largest <= bound.per_step[0] <= 2 * largest
    # A bound that is 1 % below the largest change is false, and is refused.
    with pytest.raises(exact.Failure, match="larger than stated"):
        exact.check(changed(certificate, per_step=[(0.99 * largest).hex()]))


def changed(certificate, **entries):
    """A certificate with other entries, and their hash."""
    new = copy.deepcopy(certificate) | entries
    return new | {"hash": exact.digest(new)}


class Rational(SYSTEMS["Extended"]):
    """The arithmetic of rational numbers for the `run` of the checker."""

    constant = Fraction


def largest_rounding(bound, q, p, *errors, **options):
    """The largest change of I_0 in 500 computed steps against exact ones, in rational numbers."""
    certificate, worst = bound.certificate, 0.0
    h = float.fromhex(certificate["h"])
    given = {"h": h, "num_steps": 1, "epsilon": 0.01, **options}
    sol = jax.vmap(lambda q, p: dvi.integrate(CUBIC, q, p, **given))(q, p)
    for i in range(500):
        *x, h = (Fraction(float(v)) for v in (q[i, 0], p[i, 0], 0.0, 0.01, h))
        step = exact.run(certificate["step"], [*x, h, *errors], Rational)
        computed = [Fraction(float(v[i, 1, 0])) for v in (sol.qs, sol.ps)]
        invariant = certificate["invariants"][0]
        values = [exact.run(invariant, [*z, *x[2:], h], Rational)[0] for z in (step, computed)]
        worst = max(worst, abs(float(values[0] - values[1])))
    return worst


def test_rounding_is_bounded(cubic):
    worst = largest_rounding(cubic, *np.random.default_rng(1).uniform(-0.5, 0.5, (2, 500, 1)))
    assert cubic.rounding[0] / 30 < worst <= cubic.rounding[0]


def test_rounding_on_a_grid_is_bounded():
    """`FixedPoint`: increments have errors of up to half a quantum, here 4.7e-10."""
    rng, how = np.random.default_rng(3), {"arithmetic": dvi.FixedPoint(2.0**-30)}
    bound = proved(energy_of_the_map, h=0.125, **how)
    q, p = (np.round(rng.uniform(-0.5, 0.5, (2, 500, 1)) * 2**30) / 2**30).clip(-0.5, 0.5)
    worst = largest_rounding(bound, q, p, 0, method=dvi.TypeII(), **how)
    assert bound.rounding[0] / 3 < worst <= bound.rounding[0] < 6e-10
    assert "on a grid of 9.31" in str(bound)
    assert f"multiples of {2.0**-30}" in exact.check(bound.certificate)


def test_rounding_in_pairs_is_bounded():
    """An invariant that is conserved exactly, in `DoubleDouble`: only rounding changes it."""
    spring = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)

    def function(q, p, epsilon):
        return (p @ p + q @ q - q @ p / 8) / 2

    how = {"arithmetic": dvi.DoubleDouble(), "h": 0.125, "method": dvi.TypeII()}
    bound = proved(function, spring, r=1.0, epsilon=0.1, **how)
    assert bound.per_step == (0.0,)
    assert "in pairs of float64" in exact.check(bound.certificate)
    drift = dvi.integrate(
        spring, [0.3], [0.7], num_steps=1000,
        observe=dvi.MaxDrift(lambda q, p: function(q, p, 0)), **how,
    ).observed  # fmt: skip
    assert 1e-33 < float(drift) < 1000 * bound.rounding[0] < 1e-27


def test_the_rounding_of_times_is_that_of_the_largest_one():
    """t = t0 + kh near 0 has the round-off of t0 and kh, where a force of 1000 t feels it."""
    system = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2,
        force=lambda t0, t1, q, p, args: jnp.arctan(1000 * t0) * jnp.ones(1),
    )
    how = {"r": 1.0, "epsilon": (0.5, 1.0), "time": (-1000.0, 1000.0), "max_boxes": 300}
    bound = proved(lambda q, p, e, t: jnp.sum(p), system, **how)
    t0, k = -999.9871, 9998
    sol = dvi.integrate(system, [0.0], [0.0], h=0.1, t0=t0, num_steps=k + 4, epsilon=1.0)
    with mpmath.workdps(40):
        h, momenta = mpmath.mpf(0.1), [mpmath.mpf(float(x)) for x in sol.ps[k:, 0]]
        kicks = [h * mpmath.atan(1000 * (mpmath.mpf(t0) + j * h)) for j in range(k, k + 4)]
        errors = [abs(b - a - x) for a, b, x in zip(momenta[:-1], momenta[1:], kicks, strict=True)]
        assert bound.rounding[0] / 3000 < max(errors) <= bound.rounding[0]


def test_trajectories_stay_below_the_line(cubic):
    k, s = 0, cubic.start * 0.5
    q, p = np.random.default_rng(2).uniform(-s, s, (2, 64, 1))
    invariant = found(CUBIC, 8, 2, 0.5).invariants[k]
    run = jax.vmap(
        lambda q, p: dvi.integrate(
            CUBIC, q, p, h=0.1, num_steps=20_000, epsilon=0.01,
            observe={"I": dvi.MaxDrift(invariant), "q": dvi.Range(lambda q, p: q[0])},
        ).observed
    )(q, p)  # fmt: skip
    each = cubic.per_step[k] + cubic.rounding[k]
    assert float(np.max(run["I"])) < 20_000 * each + 1e-15
    assert float(np.max(np.abs(run["q"]))) < 1.0  # max − min of a coordinate of the domain


def test_an_implicit_step_is_a_function_of_q0_and_p1():
    """H_D = p²(1 + q²)/2 + q²/2: p0 follows from (q0, p1)."""
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p) * (1 + q @ q) / 2 + q @ q / 2)

    def function(q, p, epsilon):
        return (p @ p) * (1 + q @ q) / 2 + q @ q / 2

    bound = proved(function, system, r=0.3, h=0.05)
    assert bound.certificate["implicit"]
    sol = dvi.integrate(system, [0.2], [0.25], h=0.05, num_steps=500, epsilon=0.0)
    values = [float(function(q, p, 0)) for q, p in zip(sol.qs, sol.ps, strict=True)]
    measured = np.max(np.abs(np.diff(values)))
    assert measured <= bound.per_step[0] <= 10 * measured
    assert "a step changes I" in exact.check(bound.certificate)


def angular_momentum(q, p, epsilon):
    return q[0] * p[1] - q[1] * p[0]


def test_what_is_conserved_exactly_is_an_identity():
    """The angular momentum of a central force, and McMillan's map, a rational one."""
    central = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 + q @ q, force=lambda t0, t1, q, p, args: -q * (q @ q)
    )
    assert proved(angular_momentum, central, 2, epsilon=0.1).per_step == (0.0,)
    # q1 = q0 + p1, p1 = p0 + f(q0): in x = q1 and y = q0, x' = −y + 2x + f(x).
    mcmillan = dvi.System(
        lambda t0, t1, q, p, args: p @ p / 2 + q @ q - jnp.sum(jnp.log(1 + q * q))
    )

    def invariant(q, p, epsilon):
        x, y = q[0], q[0] - p[0]
        return x**2 * y**2 + x**2 + y**2 - 2 * x * y

    given = {"system": mcmillan, "r": 0.3, "h": 1.0, "epsilon": 0.1}
    bound = proved(invariant, **given)
    assert bound.per_step == (0.0,)
    assert "by ≤ [0.0]" in exact.check(bound.certificate)
    false = proved(lambda q, p, e: invariant(q, p, e) + 1e-6 * q[0] ** 2, **given)
    assert false.per_step[0] > 1e-8


@pytest.mark.slow
def test_a_combination_of_invariants_confines():
    """Two uncoupled oscillators: neither energy is large all around the domain, their sum is."""
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)

    def energy(i):
        return lambda q, p, e: (p[i] ** 2 + q[i] ** 2 - 0.1 * q[i] * p[i]) / 2

    bound = proved([energy(0), energy(1)], system, 2, epsilon=0.1)
    assert bound.per_step == (0.0, 0.0)
    weights, level = bound.level
    np.testing.assert_allclose(weights, [1.0, 1.0], rtol=0.1)
    assert 0.05 < level < 0.125
    assert bound.steps > 1e11
    assert bound.steps_inside([0.2, 0.1], [0.1, 0.2], 0.05) >= bound.steps
    assert bound.steps_inside([0.5, 0.4], [0.4, 0.5], 0.05) == 0


def test_epsilon_is_not_necessary_without_a_perturbation():
    """Also an invariant (q, p); with ε = 0.0 the perturbed map is the unperturbed one."""
    spring, domain = dvi.System(CUBIC.H_D), np.array([0.5])

    def function(q, p):
        return energy_of_the_map(q, p, 0.0)

    bound = dvi.bound_drift(function, spring, h=0.1, domain=domain)
    assert bound.per_step == (0.0,)
    assert bound.certificate["epsilon"] == [(0.0).hex()] * 2
    assert bound.steps_inside([0.1], [0.1]) > bound.steps > 1e11
    assert "for all ε in [0, 0]" in str(bound)
    assert "all ε in [0.0, 0.0]" in exact.check(bound.certificate)
    assert dvi.proof.holds_for(spring, bound, function)
    assert not dvi.proof.holds_for(spring, bound, lambda q, p: function(q, p) + 1e-9 * q @ q)
    assert proved(function, epsilon=0.0).per_step == (0.0,)  # of a system with a force
    with pytest.raises(ValueError, match=r"Only systems without force, .* need no epsilon"):
        dvi.bound_drift(function, CUBIC, h=0.1, domain=domain)
    with pytest.raises(TypeError, match=r"found must take the arguments \(q, p\)"):
        proved(lambda q: q[0])


def test_a_map_that_depends_on_a_slow_time():
    """H = p²/2 + (1 + ε sin τ) q²/2, τ = εt: the energy changes by O(ε²) in a step, if h is 0."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2,
        force=lambda t0, t1, q, p, args: -jnp.sin(t0) * q,
        slow_time=True,
    )

    def energy(q, p, epsilon, t):
        w = 1 + epsilon * jnp.sin(t)
        return (p @ p + w * (q @ q) - 0.1 * w * (q @ p)) / 2

    with pytest.raises(ValueError, match="depends on the time: give time="):
        proved(energy, system)
    bound = proved(energy, system, time=(0.0, 3.0))
    sol = dvi.integrate(system, [0.4], [0.1], h=0.1, num_steps=2000, epsilon=0.01)
    values = jax.vmap(lambda q, p, t: energy(q, p, 0.01, 0.01 * t))(sol.qs, sol.ps, sol.ts)
    measured = float(jnp.max(jnp.abs(jnp.diff(values))))
    assert measured <= bound.per_step[0] <= 10 * measured
    assert "τ in [0, 3]" in str(bound)
    # The interval of τ ends after 3/(0.01·0.1) steps.
    assert bound.steps == min(3000, int(1e-3 / (bound.per_step[0] + bound.rounding[0])))
    assert "stay there for" in exact.check(bound.certificate)
    with pytest.raises(exact.Failure):
        exact.check(changed(bound.certificate, steps=3001))


KEPLER = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - 1 / jnp.sqrt(q @ q))


def test_an_identity_with_elementary_functions():
    """The angular momentum of a central force that is no rational function."""
    box = np.array([[1.0, 1.0], [1.1, 1.1]]), np.full(2, 0.2)
    bound = proved(angular_momentum, KEPLER, epsilon=0.1, domain=box)
    assert bound.per_step == (0.0,)
    assert "by ≤ [0.0]" in exact.check(bound.certificate)


def test_what_a_bound_says_of_a_start(cubic):
    far, near = cubic.steps_inside([0.3], [0.1], 0.01), cubic.steps_inside([0.1], [0.0], 0.0)
    assert cubic.steps < far < near
    assert cubic.steps_inside([0.6], [0.0], 0.01) == 0  # outside of the domain
    with pytest.raises(ValueError, match=r"epsilon must be from"):
        cubic.steps_inside([0.1], [0.1], 0.02)
    with pytest.raises(ValueError, match="1 finite"):
        cubic.steps_inside([np.nan], [0.1], 0.01)
    with pytest.raises(ValueError, match="each have 1 finite"):
        cubic.steps_inside([0.1, 0.2], [], 0.01)


def test_the_picture_of_a_bound(cubic):
    steps, values = np.arange(5), np.array([0.1, 0.1, 0.1 + 1e-12, 0.1 - 3e-12, 0.1])
    axis = dvi.plot.drift_bound(cubic, steps, values)
    computed, proved = axis.get_lines()[:2]
    each = cubic.per_step[0] + cubic.rounding[0]
    np.testing.assert_allclose(proved.get_ydata(), each * steps[1:])
    np.testing.assert_allclose(computed.get_ydata()[1:], [1e-12, 3e-12, 3e-12], rtol=1e-3)
    dvi.plot.plt.close(axis.figure)


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.1, pytest.param(0.3, marks=pytest.mark.slow)])
def test_exact_coefficients(h):
    """q² + p² − h q p and q1 p2 − q2 p1 of two oscillators, found, made exact, and proved."""
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))
    found = dvi.discover_invariants(system, dvi.Polynomials(2), order=0, h=h, samples=samples)
    series = found.invariants[0]
    energy = dvi.exact_coefficients(series, h)
    assert str(energy) == "1 q² − 1 h q p + 1 p²"
    bound = proved(energy, system, h=h, epsilon=0.1)
    assert bound.per_step == (0.0,)
    assert "by ≤ [0.0]" in exact.check(bound.certificate)

    def wrong(q, p, e):  # by one part in 10¹²: no identity
        return series.evaluate(q, p, e) + 1e-12 * (q @ q)

    assert 1e-14 < proved(wrong, system, h=h, epsilon=0.1).per_step[0] < 1e-12
    # Other coefficients: fractions with powers of h, and one that has no such form.
    ratios = np.zeros_like(series.coefficients)
    ratios[0, :4] = 1, 1 / 3, (2 - h**2) / 7, -h / 2
    other = dataclasses.replace(series, coefficients=ratios, errors=None)
    numbers = dvi.exact_coefficients(other, h).numbers[0, :4].tolist()
    assert numbers == [[1, 1, 0, 0], [3, 1, 0, 0], [7, 2, 0, -1], [2, 0, -1, 0]]
    ratios[0, 1] = np.sqrt(2) / 3
    with pytest.raises(ValueError, match="has no form"):
        dvi.exact_coefficients(dataclasses.replace(other, coefficients=ratios), h)


def test_noether_identities_of_the_paper():
    """(42) and (49) hold exactly; (34) and (50) are no identities; the balance law always holds."""
    kepler, oscillator = dvi.systems.kepler(), dvi.systems.oscillator()
    turn = dvi.generators.rotation()
    clock = dvi.Generator(xi0=lambda t, q, p, args: jnp.ones(()))
    scaling = dvi.Generator(xi=lambda t, q, p, args: q, eta=lambda t, q, p, args: p)
    gauges = [lambda t, q, p, args: -(q @ p)] * 2
    exactly = dvi.prove_noether(kepler, [turn, turn], [None, None])
    assert exactly.conserved
    assert "I_1 is conserved exactly by the map" in str(exactly)
    # With W = (1, 0) the torque is not zero.
    wind = dvi.System(kepler.system.H_D, force=lambda t0, t1, q, p, args: jnp.array([1.0, 0.0]))
    torque = dvi.prove_noether(wind, [turn], [None], kepler.q0, args=kepler.args)
    assert torque.identities == (True,)
    assert torque.balance
    assert not torque.work
    assert "D(I_0) = ε^1 W·(ξ_0 − Dq ξ0_0) on every time grid" in str(torque)
    printed = dvi.prove_noether(oscillator, [scaling, scaling], gauges)
    free = dvi.System(oscillator.system.H_D)
    assert printed.identities == (False, False)
    assert dvi.prove_noether(free, [scaling], gauges[:1], oscillator.q0).conserved
    clocked = [turn + clock, turn + clock]
    fifty = dvi.prove_noether(kepler, clocked, [None, lambda t, q, p, args: -(q @ q) / 2])
    assert fifty.identities == (True, False)
    assert not fifty.fixed_time
    assert printed.balance
    assert fifty.balance
    with pytest.raises(TypeError, match="q0 is missing"):
        dvi.prove_noether(free, [scaling], gauges[:1])
    with pytest.raises(ValueError, match="got Generator and NoneType"):
        dvi.prove_noether(kepler, turn, None)
    with pytest.raises(TypeError, match="q0"):
        dvi.prove_noether(free, [scaling], gauges[:1], "abc")


def test_a_wrong_balance_is_not_proved(monkeypatch):
    """With E⁻ in place of E⁺ the balance law is false if H_D depends on the time."""
    from dvi_jax.problem.energies import incoming_energy
    from dvi_jax.proof import noether

    driven = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.cos(t0 + t1) * (q @ q))
    clock = [dvi.Generator(xi0=lambda t, q, p, args: jnp.ones(()))]
    assert dvi.prove_noether(driven, clock, [None], jnp.zeros(1)).balance
    monkeypatch.setattr(noether, "outgoing_energy", incoming_energy)
    assert not dvi.prove_noether(driven, clock, [None], jnp.zeros(1)).balance


# --- nothing is claimed --------------------------------------------------------------------------


def test_a_singularity_in_the_domain():
    with pytest.raises(dvi.ProofError, match=r"no bound was found on .* is singular"):
        proved(angular_momentum, KEPLER, 2, epsilon=0.1, max_boxes=4)


def test_a_power_of_a_negative_number():
    free = dvi.System(lambda t0, t1, q, p, args: p @ p / 2)
    with pytest.raises(dvi.ProofError, match=r"log is singular.*x\*\*-0.3 .* must be positive"):
        proved(lambda q, p: jnp.sum((q - 1) ** -0.3) + p @ p, free, max_boxes=2)


def test_a_wrong_invariant_confines_nothing():
    bound = proved(lambda q, p, e: q[0] * p[0])
    assert bound.level is None
    assert "it is not shown that trajectories stay" in str(bound)


@pytest.mark.parametrize(
    ("epsilon", "function"),
    [
        (5.0, energy_of_the_map),  # ε is too large
        (0.01, lambda q, p, e: p @ p),  # not an invariant
    ],
)
def test_no_number_of_steps_is_claimed(epsilon, function):
    bound = proved(function, r=0.9, epsilon=epsilon, max_boxes=50)
    assert bound.num_steps(1e-3) == 0
    assert bound.level is None
    assert "no number of steps is proved: one step may already" in str(bound)


KICKED = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.sum(jnp.cos(q - t0)))
PERIODIC = dvi.System(  # of which whole times are alike
    lambda t0, t1, q, p, args: p @ p / 2 + jnp.sin(2 * jnp.pi * t0) * jnp.sum(q)
)
LATE = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + q @ q) / 2,
    force=lambda t0, t1, q, p, args: jnp.where(t0 > 5, 1.0, 0.0) * jnp.ones_like(q),
)
FOLDED = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + jnp.sum(jnp.abs(q)))


@pytest.mark.parametrize(
    ("how", "kind", "message"),
    [
        ({"function": lambda q, p, e: q}, ValueError, "<lambda> must return one number, got .*1,"),
        ({"function": "energy"}, TypeError, "found must be a Discovery"),
        ({"function": lambda q, p, e: jnp.abs(q[0])}, NotAnalytic, "<lambda>: .* not allow: abs"),
        ({"system": KICKED}, ValueError, "depends on the time"),
        ({"system": PERIODIC}, ValueError, "depends on the time"),
        ({"system": LATE}, ValueError, "depends on the time"),
        ({"system": FOLDED}, NotAnalytic, "select_n"),
        ({"epsilon": (0.1, 0.1)}, ValueError, "with least < largest"),
        ({"ratio": 1.0}, ValueError, "larger than 1"),
        ({"domain": 0.5}, ValueError, "domain must be an array like q"),
        ({"domain": (np.ones(1), np.ones(2))}, ValueError, r"of p must be .* got shape \(2,\)"),
        ({"domain": np.array([-1.0])}, ValueError, "lower < upper"),
        ({"method": dvi.GaussLegendre(2)}, ValueError, "explicit for this system"),
        ({"h": 0.0}, ValueError, "other than zero"),
        ({"epsilon": None}, ValueError, "epsilon must be a finite number"),
        ({"arithmetic": dvi.Compensated()}, ValueError, "arithmetic must be"),
    ],
)
def test_bad_input(how, kind, message):
    with pytest.raises(kind, match=message):
        proved(**{"function": energy_of_the_map, **how})


def test_a_step_of_times_is_no_time():
    """H_D may use t1 − t0, which is h: such a map does not depend on the time."""
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + (2 * t1 - 2 * t0) * (q @ q) / 8
    )
    assert proved(energy_of_the_map, system).per_step[0] > 0
    mean = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + (t1 + t0) * (q @ q))
    with pytest.raises(ValueError, match="depends on the time"):
        proved(energy_of_the_map, mean)


def test_an_implicit_step_that_depends_on_the_time():
    system = dvi.System(lambda t0, t1, q, p, a: (p @ p) * (1 + t0 * (q @ q) / 4) / 2 + q @ q / 2)
    bound = proved(energy_of_the_map, system, r=0.3, time=(1.0, 2.0), max_boxes=300)
    assert bound.certificate["implicit"]
    assert 0 < bound.per_step[0] < 0.01


def test_an_identity_with_many_functions(cubic):
    """41 sines; the polynomials have one variable for each."""
    still = {"operations": [["input", 0], ["input", 1]], "outputs": [0, 1]}
    sines = program_of(lambda x: jnp.sum(jnp.sin(jnp.arange(1.0, 42.0) * x[1])), (2,))
    checker = exact.Checker(cubic.certificate | {"step": still, "invariants": [sines]})
    assert checker.is_identity(0)


def test_functions_become_the_same_numbers():
    def function(q, p):
        A = jnp.outer(q, p) + jnp.eye(2)
        series = jnp.cumsum(q) ** 3 + jnp.where(jnp.arange(2) > 0, p, q)
        return jnp.sin(A @ q), jnp.tanh(series) / (2 + p[::-1] ** 2), jnp.prod(A[:, 1]) ** 1.5

    q, p = jnp.array([0.3, 0.7]), jnp.array([0.2, 0.9])
    program = program_of(function, (2,), (2,))
    values = exact.run(program, [mpmath.mpf(float(x)) for x in (*q, *p)], Digits)
    expected = np.concatenate([np.ravel(x) for x in function(q, p)])
    np.testing.assert_allclose([float(v) for v in values], expected, rtol=1e-14)


def test_constants_are_not_rounded():
    """√2 and 0.1/3 are operations, and 2·0.1 > 0.15 a decision."""
    k = jnp.asarray(0.1)
    program = program_of(lambda x: jnp.where(2 * k > 0.15, x * jnp.sqrt(2.0) * (k / 3), x), ())
    with mpmath.workdps(40):
        value = exact.run(program, [mpmath.mpf(1)], Digits)[0]
        assert abs(value - mpmath.sqrt(2) * mpmath.mpf(0.1) / 3) < 1e-38


# --- the certificate -----------------------------------------------------------------------------


def is_accepted(certificate):
    """Whether the checker proves something from it; any error is a refusal."""
    try:
        return bool(exact.check(certificate))
    except Exception:
        return False


def mutations(c):
    """Name → a certificate with one thing changed."""

    def changed_at(index, value):
        new = copy.deepcopy(c)
        place = new
        for key in index[:-1]:
            place = place[key]
        place[index[-1]] = value(place[index[-1]]) if callable(value) else value
        return new

    def place_of(name, program):
        return next(i for i, op in enumerate(program["operations"]) if op[0] == name)

    constant = place_of("constant", c["invariants"][0])
    product, total = (place_of(name, c["step"]) for name in ("multiply", "sum"))

    def times(factor):
        return lambda text: (float.fromhex(text) * factor).hex()

    where = ("invariants", 0, "operations", constant, 1)
    changes = [
        ("a coefficient", where, times(1.001)),
        ("a coefficient by one digit", where, times(1 + 1e-9)),
        ("h", ("h",), times(1.01)),
        ("the largest ε", ("epsilon", 1), times(1.5)),
        ("the least ε", ("epsilon", 0), (-0.02).hex()),
        ("the upper side of q", ("domain", 1, 0), times(1.2)),
        ("the lower side of p", ("domain", 0, 1), times(1.2)),
        ("the bound", ("per_step", 0), times(0.3)),
        ("the bound is zero", ("per_step", 0), (0.0).hex()),
        ("the bound is negative", ("per_step", 0), times(-1)),
        ("the rounding", ("rounding", 0), times(0.5)),
        ("another arithmetic", ("arithmetic",), "float32"),
        ("increments on a grid", ("quantum",), (2.0**-40).hex()),
        ("a cut that adds an axis", ("shell", 1), -1),
        ("an infinite bound", ("per_step", 0), "inf"),
        ("the reach", ("reach", 0), times(0.9)),
        ("the number of steps", ("steps",), lambda n: 10 * n),
        ("the level", ("level", 1), times(1.2)),
        ("a weight of the level", ("level", 0, 0), times(0.8)),
        ("the number of bits", ("bits",), 8),
        ("an operation", ("step", "operations", product, 0), "sum"),
        ("another operation", ("step", "operations", total, 0), "multiply"),
        ("the order of outputs", ("step", "outputs"), lambda x: x[::-1]),
        ("an unknown operation", ("step", "operations", total, 0), "abs"),
        ("a box left out", ("shell", -1), lambda node: "inside"),
        ("a box that is no box", ("shell",), lambda node: node[:-1]),
        ("all boxes outside", ("boxes",), "outside"),
        ("a cut elsewhere", ("shell", 2), times(1.5)),
        ("the format", ("format",), "drift bound 0"),
    ]
    return {name: changed_at(*change) for name, *change in changes}


def test_a_changed_certificate_fails(cubic):
    c = cubic.certificate
    assert "stay there for" in exact.check(c)
    certificates = mutations(c)
    assert len(certificates) >= 25
    for name, certificate in certificates.items():
        with pytest.raises(exact.Failure, match=r"was changed|the format"):
            exact.check(certificate)
        assert not is_accepted(changed(certificate)), name  # also with the right hash


def test_the_checker_is_a_small_program_of_its_own(cubic, tmp_path):
    path = tmp_path / "bound.json"
    cubic.save(path)
    code = f"""
import runpy, sys
sys.argv = ["checker.py", {str(path)!r}]
try:
    runpy.run_path({exact.__file__!r}, run_name="__main__")
finally:
    assert not {{"jax", "numpy", "dvi_jax"}} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("proved: on ")
    content = json.loads(path.read_text())
    content["h"] = (0.2).hex()
    path.write_text(json.dumps(content))
    assert exact.main(str(path)) == 1
