"""Every system of the library: equations, invariants, symmetries, defaults, exact solutions.

The matrix runs over `systems.LIBRARY`: a system is tested by being registered there, and with what
its `Problem` says of it. Its equations need a line in `derivations.py`.
"""

import copy
import functools
import itertools
import json
import math
import pickle
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivations import DERIVATIONS, EPSILON
from dvi_jax.run import run_file
from helpers import run_problem
from scipy.integrate import solve_ivp
from scipy.special import ellipe, ellipj, ellipk, ellipkinc, elliprf, elliprj

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.systems._elliptic import complete, first_kind, jacobi, swing, third_kind
from dvi_jax.systems.pendulum import action, period
from dvi_jax.systems.planets.solar_system import EphemerisMissing
from dvi_jax.systems.van_der_pol import amplitude

NAMES = list(systems.LIBRARY)
QUICK = {"duffing", "kepler"}
"""Those whose runs by `integrate` are in every run of the tests; the rest are marked slow."""
ALIKE = {"figure_eight", "pythagorean", "outer_solar_system", "solar_system"}
ALIKE |= {"perturbed_pendulum", "lorentz_pendulum", "van_der_pol", "sine_gordon", "phi4"}
ALIKE |= {"lennard_jones"}
"""Those with functions of another system, or with the symmetries of one."""
MOST = set(NAMES) - ALIKE
CONSTRAINED = {"spherical_pendulum", "chain", "slider_crank", "dumbbell", "heavy_top", "satellite"}
"""Those with a constraint, whose forces are added to the flow, and whose method is `Rattle`."""
FLOWS = {"oscillator", "pendulum", "duffing", "kepler", "relativistic_kepler", "henon_heiles"}
FLOWS |= {"lotka_volterra", "slow_oscillator", "dumbbell"}
"""Those whose flow is in every run of the tests, one of each kind."""
ELLIPTIC = {"spherical_pendulum", "heavy_top", "spinning_top", "rigid_body"}
"""Those whose exact solutions take more than two seconds to trace."""
slow = pytest.mark.slow


def listed(names, quick):
    """Parameters of a test: names, marked slow if they are not quick."""
    return [pytest.param(name, marks=() if name in quick else slow) for name in names]


@functools.cache
def problem(name):
    try:
        return systems.LIBRARY[name]()
    except EphemerisMissing as missing:
        pytest.skip(str(missing))


@functools.cache
def functions(name):
    """Compiled rates (t, q, p, ε, args) → (dq/dt, dp/dt), by the package's autodiff."""
    system = problem(name).system

    def rates(t, q, p, epsilon, args):
        H = functools.partial(system.hamiltonian, t, t, epsilon=epsilon, args=args)
        fall, rate = jax.grad(H, argnums=(0, 1))(q, p)
        return rate, system.disturbing_force(t, t, q, p, epsilon, args) - fall

    return jax.jit(rates)


def start(name):
    made = problem(name)
    return np.asarray(made.q0, float), np.asarray(made.p0, float)


def nearby(name, seed):
    """A random time, state and parameters near those of the library."""
    rng = np.random.default_rng(seed)
    (q, p), args = start(name), problem(name).args

    def moved(x, by=0.1):
        x = np.asarray(x, float)
        size = np.max(np.abs(x)) if np.any(x) else 1.0
        return x * (1 + by * rng.uniform(-1, 1, x.shape)) + by * size * rng.uniform(-1, 1, x.shape)

    def scaled(x):
        x = np.asarray(x, float)
        y = x * (1 + 0.1 * rng.uniform(-1, 1, x.shape))
        return y if y.shape else float(y)

    q, p = moved(q), moved(p)
    return rng.uniform(0, 2), q, p, jax.tree.map(scaled, args)


def test_every_system_has_a_derivation_and_symmetries_or_a_reason():
    """A slowly moved length or a pole that drifts: no shift of time; and no more to shift. With a
    constraint: symmetries are those of the type II map."""
    assert set(NAMES) == set(DERIVATIONS)
    assert set(NAMES) - set(SYMMETRIC) == {"lorentz_pendulum", "polar_motion", *CONSTRAINED}


@pytest.mark.parametrize("name", NAMES)
def test_equations_are_those_of_an_independent_derivation(name):
    epsilons, rates = EPSILON.get(name, (0.3,)), functions(name)
    for seed, epsilon in itertools.product(range(3), epsilons):
        t, q, p, args = nearby(name, seed)
        ours = rates(t, q, p, epsilon, args)
        theirs = DERIVATIONS[name](t, q, p, args, epsilon)
        for a, b in zip(ours, theirs, strict=True):
            assert np.max(np.abs(a - b)) <= 1e-12 * np.max(np.abs(b))
        # negative control: a change in the seventh digit of the state is detected
        other = DERIVATIONS[name](t, q * (1 + 1e-6), p * (1 + 1e-6), args, epsilon)
        pairs = zip(ours, other, strict=True)
        assert any(np.max(np.abs(a - b)) > 1e-8 * np.max(np.abs(b)) for a, b in pairs)


@functools.cache
def flow(name):
    """Times and states of 200 steps of the default size by SciPy's DOP853, 1e-13 per step."""
    made, rates = problem(name), functions(name)
    q0, p0 = start(name)
    if name in CONSTRAINED:
        free, force = rates, dvi.ConstraintForce().bind(made.system, 0.0)

        @jax.jit
        def rates(t, q, p, epsilon, args):
            q, p = jnp.asarray(q), jnp.asarray(p)
            v, push = free(t, q, p, epsilon, args)
            return v, push + force(t, jnp.asarray(t), q, p, q, p, args)

    def field(t, z):
        q, p = z.reshape(2, *q0.shape)
        return np.concatenate(
            [np.ravel(x) for x in rates(t, q, p, made.exact_epsilon, made.args)], axis=None
        )

    times = np.linspace(0, 200 * made.h, 21)
    z0 = np.concatenate([q0, p0], axis=None)
    # positions and momenta of very different sizes: each to its own rounding
    size = np.repeat([np.max(np.abs(x)) or 1.0 for x in (q0, p0)], q0.size)
    options = {"method": "DOP853", "t_eval": times, "rtol": 1e-13, "atol": 1e-15 * size}
    run = solve_ivp(field, times[[0, -1]], z0, **options)
    assert run.success
    return times, run.y.T.reshape(-1, 2, *q0.shape)


@functools.cache
def watched(name):
    """Observables (at ε = 0) along states, which are sheared by a little for a control."""
    made = problem(name)
    known = {
        key: f.bind(made.system, 0.0) if isinstance(f, systems.InSlowTime) else f
        for key, f in made.observables.items()
    }

    @jax.jit
    def along(ts, states, shear):
        def at(t, state):
            q, p = state
            p_size = jnp.max(jnp.abs(states[:, 1]))
            q, p = q * (1 + shear), p + shear * p_size * jnp.sin(q + 0.3)
            return {
                key: f(t, t, q, p, q, p, made.args)
                for key, f in known.items()
                if key in made.invariants or key not in made.adiabatic
            }

        return jax.vmap(at)(ts, states)

    return along


@pytest.mark.parametrize("name", listed(NAMES, FLOWS))
def test_declared_invariants_are_all_that_the_flow_conserves(name):
    """They are constant, and not along sheared states; other observables, if not adiabatic, change.

    So none has been forgotten.
    """
    made = problem(name)
    assert made.invariants or name == "polar_motion", "a system without an invariant"
    ts, states = flow(name)
    values, sheared, far = (watched(name)(ts, states, shear) for shear in (0.0, 1e-3, 0.1))
    for key in made.invariants:
        x, y, z = (np.asarray(v[key]) for v in (values, sheared, far))
        scale = np.max(np.abs(x)) + np.max(np.abs(z))
        if np.max(np.abs(x)) < 1e-6 * energy_size(name):  # a sum that is zero: size of its terms
            scale += energy_size(name)
        drift, control = (np.max(np.abs(v - v[0])) / scale for v in (x, y))
        assert drift < 1e-11, key
        assert control > 1e-7, key
    for key in set(made.observables) - set(made.invariants) - set(made.adiabatic):
        if key not in KEPT_BUT_FOR_THE_STEP and (name, key) not in CONSTANT_BETWEEN:
            x = np.asarray(values[key])
            assert np.max(np.abs(x - x[0])) > 1e-6 * np.max(np.abs(x)), key


KEPT_BUT_FOR_THE_STEP = ("mixed_energy", "map_invariant")
"""Invariants of the map at a step size, which are the energy at a step of zero."""

CONSTANT_BETWEEN = {("relativistic_kepler", "perihelion_angle")}
"""It jumps at aphelia."""


EXACT = [n for n in NAMES if n != "solar_system" and problem(n).exact is not None]


@pytest.mark.parametrize("name", EXACT)
@slow
def test_exact_solutions_are_those_of_the_flow(name):
    made = problem(name)
    ts, states = flow(name)
    exact = jax.jit(made.exact)
    found = np.stack(exact(ts.reshape(3, 7), *start(name), made.args), axis=2)
    assert found.shape == (3, 7, 2, *start(name)[0].shape)
    scale = np.max(np.abs(states), axis=0, keepdims=True)
    off = np.max(np.abs(found.reshape(states.shape) - states) / np.max(scale))
    assert off < 2e-11
    late = np.stack(exact(ts * (1 + 1e-6), *start(name), made.args), axis=1)
    assert np.max(np.abs(late - states)) / np.max(scale) > 1e-7


@functools.cache
def two_runs(name):
    """The same 0.1 × 40 default steps in 40 and in 80, by Gauss–Legendre of order 4.

    Returns times of the coarse run, and qs, ps and observables of both at these.
    """
    made = problem(name)
    steps = 80

    @jax.jit
    def run(h):
        method = RATTLE4 if name in CONSTRAINED else dvi.GaussLegendre(2)
        options = {"method": method, "observe": dict(made.observables)}
        options |= {"epsilon": made.exact_epsilon, "adjoint": dvi.Direct()}  # compiled soonest
        sol = run_problem(made, steps, h=h, **options)
        return sol.ts, sol.qs, sol.ps, sol.observed

    coarse = jax.tree.map(np.asarray, run(made.h * STRETCH.get(name, 2.0)))
    fine = jax.tree.map(np.asarray, run(made.h * STRETCH.get(name, 2.0) / 2))
    ts, qs, ps, seen = coarse
    half = steps // 2
    first = (qs[: half + 1], ps[: half + 1], {k: v[:half] for k, v in seen.items()})
    second = (fine[1][::2], fine[2][::2], {k: v[1::2] for k, v in fine[3].items()})
    return ts[: half + 1], first, second


RATTLE4 = dvi.Yoshida(4, base=dvi.Rattle())
STRETCH = {"rigid_body": 8.0, "solar_system": 32.0, "polar_motion": 30.0}
"""Steps that are large enough for an error to be seen, in default steps; 2 elsewhere."""


@pytest.mark.parametrize("name", listed(NAMES, QUICK))
@slow
def test_invariants_of_a_run_converge_with_its_order(name):
    """Drifts of declared invariants fall as h⁴ until they are round-off."""
    made = problem(name)
    _, (*_, coarse), (*_, fine) = two_runs(name)
    for key in made.invariants:
        a, b = (np.max(np.abs(x[key] - x[key][0])) for x in (coarse, fine))
        floor = 1e-13 * (np.max(np.abs(coarse[key])) + energy_size(name))
        if a > 100 * floor:
            assert abs(np.log2(a / b) - 4) < 0.6, key
        else:
            assert b < 10 * floor, key


def energy_size(name):
    _, (q, p, _), _ = two_runs(name)  # all states: bodies may start from rest
    return float(np.max(np.abs(p)) * max(np.max(np.abs(q)), 1.0))


@pytest.mark.parametrize("name", listed(EXACT, QUICK))
def test_runs_converge_to_the_exact_solution(name):
    made = problem(name)
    ts, *runs = two_runs(name)
    exact = np.stack(jax.jit(made.exact)(ts, *start(name), made.args), axis=1)
    off = [np.max(np.abs(np.stack([q, p], axis=1) - exact)) for q, p, _ in runs]
    assert off[0] > 1e-9 * np.max(np.abs(exact))  # there is something to converge
    assert abs(np.log2(off[0] / off[1]) - 4) < 0.35


BEND = dvi.Generator(xi=lambda t, q, p, args: jnp.sin(q))
"""What is added to a generator to make it wrong."""


@functools.cache
def residuals(name):
    """Compiled residuals (on the flow, on the mesh) of Σ c_i X_i + c BEND, over their terms.

    On the flow, with D = ∂/∂t + V: |X(V) − D(ξ, η) + D(ξ0) V|, the determining equation of a
    differential equation. On the mesh, `dvi.determining_residual` at the points of a solution.
    They are linear in X, so that one program evaluates every generator.
    """
    made = problem(name)
    generators = [*made.symmetries.values(), *made.flow_symmetries.values(), BEND]
    system, args = made.system, made.args

    def slopes(t, t1, q, p):
        H = functools.partial(system.hamiltonian, t, t1, epsilon=0.0, args=args)
        return jax.grad(H, argnums=(0, 1))(q, p)

    def field(t, q, p):
        fall, rate = slopes(t, t, q, p)
        return dvi.LatticePoint(jnp.ones_like(t), rate, -fall)

    def largest(*arrays):
        return jnp.max(jnp.stack([jnp.max(jnp.abs(x)) for x in arrays]))

    @jax.jit
    def of(c, t, q, p, h):
        X = sum((g * x for g, x in zip(generators[1:], c[1:], strict=True)), generators[0] * c[0])
        here = dvi.LatticePoint(t, q, p)
        V = field(*here)
        _, of_field = jax.jvp(field, tuple(here), tuple(X(here, args)))
        _, of_X = jax.jvp(lambda *at: X(dvi.LatticePoint(*at), args), tuple(here), tuple(V))
        left = [a - b + of_X.t * v for a, b, v in zip(of_field[1:], of_X[1:], V[1:], strict=True)]
        terms = largest(*of_field[1:], *of_X[1:])
        flow = largest(*left) / jnp.where(terms > 0, terms, 1)

        fall, rate = slopes(t, t + h, q, p)
        first, second = (t, q, p + h * fall), (t + h, q + h * rate, p)
        points = [dvi.LatticePoint(*at) for at in (first, second)]
        left = dvi.determining_residual(system, X, *points, args=args)
        moves = largest(*(x for point in points for x in X(point, args)[1:]))
        return flow, largest(left) / (moves / h + largest(fall) + largest(rate))

    return of


SYMMETRIC = [n for n in NAMES if n == "solar_system"
             or problem(n).symmetries or problem(n).flow_symmetries]  # fmt: skip


@pytest.mark.parametrize("name", listed(SYMMETRIC, MOST))
def test_declared_symmetries_solve_the_determining_equations(name):
    made, of = problem(name), residuals(name)
    t, q, p, _ = nearby(name, 5)
    keys = [*made.symmetries, *made.flow_symmetries]
    for i, key in enumerate(keys):
        true, bent = np.eye(len(keys) + 1)[i], np.eye(len(keys) + 1)[i]
        bent[-1] = 1.0
        flow, mesh = of(true, t, q, p, made.h)
        off_flow, off_mesh = of(bent, t, q, p, made.h)
        assert flow < 1e-13, key
        assert off_flow > 1e-3, key
        if key in made.symmetries:
            assert mesh < 1e-13, key
            assert off_mesh > 1e-6, key
        else:  # broken at first order: the residual scales as h, its measure as 1/h
            finer = of(true, t, q, p, made.h / 2)[1]
            assert abs(np.log2(mesh / finer) - 2) < 0.3, key


@pytest.mark.parametrize("name", listed(NAMES, QUICK))
def test_defaults_run_and_their_energy_is_bounded(name):
    """The paper's map, 1000 steps of the default size: the energy oscillates and does not drift."""
    made = problem(name)
    made.check(made.q0, made.p0, made.args)
    sol = run_problem(made, 1000, observe=dict(made.observables), throw=False)
    assert sol.result == dvi.RESULTS.successful
    for x in jax.tree.leaves((sol.qs, sol.ps, sol.observed)):
        assert np.all(np.isfinite(x))
    if "energy" in made.observables:
        energy = np.asarray(sol.observed["energy"])
        off = np.abs(energy - energy[0])
        assert off[500:].max() < 2.5 * off[:500].max() + 1e-12 * abs(energy[0])


@pytest.mark.parametrize("name", NAMES)
def test_parameters_have_meanings_and_units(name):
    made = problem(name)
    assert made.name == name
    assert set(made.units) == {"q", "p", "t", "energy"}
    assert all(made.units.values())
    assert len(made.source) > 5
    assert systems.LIBRARY[name].__doc__
    known = set(made.args or {})
    assert set(made.parameters) == known, f"parameters without meaning: {known}"
    for key, meaning in made.parameters.items():
        assert re.fullmatch(r".*\S \[.+\]", meaning), f"{key}: {meaning!r} has no unit"
    for key, f in made.observables.items():
        told = f.function if isinstance(f, systems.InSlowTime) else f
        assert callable(f)
        assert told.__doc__, f"the observable {key} does not say what it is"


SHAPES = {  # another shape, and what the message says of the system
    "henon_heiles": ((3,), r"in the plane"),
    "toda": ((2,), r"at least three particles.*shape \(n,\) .*n ≥ 3"),
    "fput": ((2, 4), r"row of particles"),
    "stiff_fput": ((3,), r"shape \(2, n\) .*n ≥ 1"),
    "perturbed_pendulum": ((2,), r"one angle"),
    "magnetic_mirror": ((2,), r"one particle in space"),
    "figure_eight": ((3,), r"shape \(bodies, 2\) or \(bodies, 3\)"),
    "polar_motion": ((2,), "the pole has one x"),
}


@pytest.mark.parametrize("name", NAMES)
def test_initial_conditions_of_another_shape_are_refused(name):
    made, other = problem(name), np.ones((7, 5, 3))
    made.check(made.q0, made.p0, made.args)
    with pytest.raises(ValueError, match="shape"):
        made.check(made.q0, other, made.args)
    if name != "oscillator":  # which takes any shape
        with pytest.raises(ValueError, match=r"shape.*\(7, 5, 3\)"):
            made.check(other, other, made.args)
    if name in SHAPES:
        shape, said = SHAPES[name]
        with pytest.raises(ValueError, match=f"{said}.*got.*{re.escape(str(shape))}"):
            made.check(np.ones(shape), np.ones(shape), made.args)


POSITIVE, NO_GYRATION = "must be a positive.*got ", "must not be zero, got "


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("pendulum", {"omega": 0.0}, POSITIVE + "0.0"),
        ("duffing", {"beta": -1.0}, POSITIVE),
        ("slow_oscillator", {"depth": 1.5}, r"must be between -1 and 1 \(both excluded\), got 1.5"),
        ("double_pendulum", {"m2": -1.0}, POSITIVE),
        ("relativistic_kepler", {"c": 0.5}, ""),
        ("oblate_kepler", {"R": 9000.0}, ""),
        ("two_centres", {"d": 0.0}, POSITIVE),
        ("restricted_three_body", {"mu": 0.7}, "must satisfy 0 < mu ≤ 1/2, got 0.7"),
        ("lotka_volterra", {"alpha": -0.1}, POSITIVE),
        ("uniform_field", {"B": 0.0}, NO_GYRATION),
        ("dipole_field", {"radius": -1.0}, POSITIVE),
        ("dipole_field", {"B0": 0.0}, NO_GYRATION),
        ("rigid_body", {"I3": 4.0}, ""),
        ("spinning_top", {"A": math.inf}, POSITIVE + "inf"),
        ("heavy_top", {"I": [1.0, 1.0, 2.1]}, "must be three positive moments.*at most the sum"),
        ("chain", {"l": 0.0}, POSITIVE + "0.0"),
        ("kepler", {"K": 0.0}, POSITIVE + "0.0"),
        ("magnetic_mirror", {"charge": 0.0}, NO_GYRATION),
        ("magnetic_mirror", {"B0": 0.0}, NO_GYRATION),
        ("magnetic_mirror", {"mass": -1.0}, POSITIVE + "-1.0"),
        ("magnetic_mirror", {"length": math.inf}, POSITIVE + "inf"),
        ("polar_motion", {"period": -433.0}, POSITIVE + "-433"),
        ("stiff_fput", {"omega": 0.0}, POSITIVE + "0.0"),
    ],
)
def test_parameters_out_of_range_are_refused(name, change, said):
    """What is not a number or of another shape: the next test."""
    made, ((key, _),) = problem(name), change.items()
    said = f"{key} {said}" if said else "falls into the centre|of the planet|at most the sum"
    with pytest.raises(ValueError, match=said):
        made.check(made.q0, made.p0, {**made.args, **change})


@pytest.mark.parametrize("name", NAMES)
def test_every_parameter_must_be_there_and_be_a_number(name):
    """By its name: where it is missing, not a number, of another shape, or None."""
    made = problem(name)
    for key, value in (made.args or {}).items():
        rest = {k: v for k, v in made.args.items() if k != key}
        if key != "G":  # which is 1 when it is left out
            for args, name_of_key in ((rest, key), (None, "")):
                with pytest.raises(ValueError, match=f"parameter {name_of_key}.*is missing"):
                    made.check(made.q0, made.p0, args)
        wrong = [np.nan * np.asarray(value, float), np.ones((2, 2))]
        for bad in wrong if np.ndim(value) else [*wrong, None, "1", True]:
            with pytest.raises(ValueError, match="mass of|masses" if key == "masses" else key):
                made.check(made.q0, made.p0, {**made.args, key: bad})
        made.check(made.q0, made.p0, {**rest, key: np.asarray(value)})  # an array of no axes is one


@pytest.mark.parametrize(
    ("make", "options", "said"),
    [
        ("stiff_fput", {"m": 0}, "m must be an integer of at least 1, got 0.*m springs"),
        ("fput", {"n": -1}, "n must be an integer of at least 1, got -1.*row of particles"),
        ("fput", {"alpha": math.nan}, "alpha must be a finite number, got nan"),
        ("toda", {"n": 2}, "n must be an integer of at least 3, got 2.*at least three particles"),
        ("nls_lattice", {"n": 2.5}, "got 2.5.*ring of at least three sites"),
        ("n_body", {"G": math.nan}, "G must be a finite"),
        ("magnetic_mirror", {"length": -1.0}, "length must be a positive.*got -1"),
        ("magnetic_mirror", {"distance": np.inf}, "distance must be a finite.*got inf"),
        ("dipole_field", {"radius": 0.0}, "radius must be a positive.*got 0"),
        ("chain", {"links": 0}, "links must be an integer of at least 1, got 0"),
        ("heavy_top", {"kind": "euler"}, "kind must be one of 'lagrange', 'kovalevskaya'"),
    ],
)
def test_invalid_arguments_of_systems_are_refused(make, options, said):
    with pytest.raises(ValueError, match=said):
        systems.LIBRARY[make](**options)


@pytest.mark.parametrize(
    ("name", "q0", "p0", "said"),
    [
        ("relativistic_kepler", [0.0, 0.0], [0.0, 1.0], "q0 must not be at the centre"),
        ("two_centres", [0.0, 0.0, -0.5], [0.0, 1.0, 0.0], r"second centre \[0.0, 0.0, -0.5"),
        ("hill", [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], "q0 must not be at the small body"),
        ("dipole_field", [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], "q0 must not be at the dipole"),
        ("rigid_body", [0.0, 0.0, 0.0], [1.0, 1.0, 0.5], r"\|L\| < G and"),
        ("spinning_top", [0.0, 0.0, 0.0], [1.0, 0.0, 1.0], "θ"),
    ],
)
def test_singular_starts_are_refused(name, q0, p0, said):
    with pytest.raises(ValueError, match=said):
        problem(name).check(q0, p0, problem(name).args)


def test_facts_and_observables_of_problems():
    """A `Problem` does not promise what it cannot show."""
    made = problem("kepler")
    parts = {"name": "x", "system": made.system, "q0": [0.0], "p0": [0.0], "h": 0.1}
    for facts, message in (
        ({"invariants": ("energy",)}, r"invariants of .* in observables, \[\], got 'energy'"),
        ({"args": {"K": 1.0}, "parameters": {"k": "strength [1]"}}, r"parameters .*'K'.*got 'k'"),
        ({"adiabatic": {"action": systems.Adiabatic("ε", 1)}}, "adiabatic of .* got 'action'"),
    ):
        with pytest.raises(ValueError, match=message):
            systems.Problem(**parts, **facts)
    action = problem("slow_oscillator").observables["action"]
    at = (0.0, 0.1, *(jnp.ones(1) for _ in range(4)), {"depth": 0.3})
    with pytest.raises(ValueError, match="needs the value of epsilon"):
        action(*at)
    tau = 0.1 * 0.5
    w = 1 + 0.3 * np.sin(tau)
    assert float(action.bind(None, 0.5)(*at)) == pytest.approx((1 + w**2) / 2 / w, rel=1e-14)


@slow
@pytest.mark.parametrize("name", NAMES)
def test_a_run_file_names_it(name, tmp_path):
    made = problem(name)
    path = tmp_path / "run.toml"
    method = "Yoshida(4, base=Rattle())" if name in CONSTRAINED else "TypeII"
    text = f'system = "{name}"\nmethod = "{method}"\nsteps = 5\n[output]\nplots = false\n'
    path.write_text(text + f'dir = "{(tmp_path / "out").as_posix()}"\n', encoding="utf-8")
    report = json.loads((run_file(path).folder / "report.json").read_text(encoding="utf-8"))
    assert report["status"]["result"] == "successful"
    assert set(report["results"]) >= set(made.observables)


@slow
def test_elliptic_integrals_and_functions_are_those_of_scipy():
    rng = np.random.default_rng(0)
    m = np.r_[0.0, rng.uniform(0, 1, 60), 1 - 1e-6]
    u, phi = rng.uniform(-20, 20, (2, m.size))
    ours = jax.jit(jacobi)
    np.testing.assert_allclose(jax.jit(complete)(m), [ellipk(m), ellipe(m)], rtol=2e-15)
    np.testing.assert_allclose(jax.jit(first_kind)(phi, m), ellipkinc(phi, m), rtol=3e-15)
    np.testing.assert_allclose(ours(u, m), ellipj(u, m), rtol=0, atol=5e-14)
    assert np.max(np.abs(ours(u, m**1.001)[0] - ellipj(u, m)[0])) > 1e-4
    np.testing.assert_allclose(swing(m), ellipe(m) - (1 - m) * ellipk(m), rtol=0, atol=1e-15)
    np.testing.assert_allclose(swing(1e-12) / 1e-12, np.pi / 4, rtol=1e-12)
    # Both signs of n, up to 1 − n = 1e-12 and n = −1e8; negative control: another n.
    rng = np.random.default_rng(1)
    m, phi = rng.uniform(0, 1, 100), rng.uniform(-20, 20, 100)
    large, small = 1 + 10 ** rng.uniform(-3, 8, 50), 10 ** rng.uniform(-12, 0, 50)
    complement = np.r_[large, (1 - m[50:]) * small]

    def by_scipy(s, c):
        x, y = c**2, c**2 + (1 - m) * s**2
        more = elliprj(x, y, 1.0, c**2 + complement * s**2)
        return s * elliprf(x, y, 1.0) + (1 - complement) / 3 * s**3 * more

    turns = np.round(phi / np.pi)
    rest = phi - np.pi * turns
    wanted = 2 * turns * by_scipy(1.0, 0.0) + by_scipy(np.sin(rest), np.cos(rest))
    found = jax.jit(third_kind)(phi, complement, m)
    assert np.max(np.abs(found - wanted) / (np.abs(phi) + np.abs(wanted))) < 4e-15
    other = third_kind(phi, complement * (1 + 1e-9), m)
    assert np.max(np.abs(other - wanted) / np.abs(wanted)) > 1e-10


def test_limits_of_elliptic_integrals_and_periods():
    m = jnp.array([1.0, 1.1, 1 - 1e-12])
    K, E = jax.jit(complete)(m)
    np.testing.assert_array_equal([K[:2], E[:2]], [[np.inf, np.nan], [1, np.nan]])
    np.testing.assert_array_equal(jax.jit(swing)(m)[:2], [1, np.nan])
    np.testing.assert_allclose([K[2], E[2]], [ellipk(1 - 1e-12), ellipe(1 - 1e-12)], rtol=1e-14)
    args, q = problem("pendulum").args, jnp.zeros(1)
    turn = jax.jit(lambda p: period(q, jnp.stack([p]), args))
    assert float(turn(2.0)) == math.inf
    for p in (2 - 1e-6, 2 + 1e-6):  # T = 2 (or 4) ln(4/√|1 − m|)
        expected = (4 if p < 2 else 2) * np.log(4 / np.sqrt(1e-6))
        assert float(turn(p)) == pytest.approx(expected, rel=1e-5)
    of = jax.jit(lambda p: action(0.0, 0.0, q, q, q, jnp.stack([p]), args))
    assert float(of(2.0)) == pytest.approx(8 / np.pi, rel=1e-15)
    assert np.isnan(of(2.01))


REGIMES = {  # all q0, all p0
    # librations, the fourth a turn away from the lowest point; rotations of both senses
    "pendulum": (np.c_[[1.5, -1.5, 0, 7, 0.5, -2]], np.c_[[1, -0.3, 1.99, 0.4, 2.5, -3]]),
    # in one well, three times; over the barrier
    "duffing": (np.c_[[-1.2, 0.7, 1.2, 0.3, -1.6]], np.c_[[0.2, -0.3, 0, 1, -0.9]]),
    # an ellipse; a circle; perihelion of e = 0.85, backwards
    "kepler": ([[0, 1.2], [1, 0], [0.1, 0], [1, 0]], [[-1, -0.6], [0, 1], [0, -4.3], [0, 1.5]]),
    # near the middle axis; about the third axis, twice; about the first, twice
    "rigid_body": (
        [[0.1, 0, 0.4], [0.4, 0.2, 0], [0.4, 0.2, 0], [1.4, -2, 0], [-1.4, -2, 0]],
        [[0.1, 1, 0.6], [0.9, 1, 0.6], [-0.9, 1, -0.6], [-0.1, 1, 0.6], [0.2, 1, 0.6]],
    ),
    # upright; hanging; at a turning point
    "spinning_top": (
        [[0, 0.6, 0], [1, 1.9, -3], [0, 0.9, 0]],
        [[2.4, 0.1, 2.5], [0.4, -0.7, -2], [1.8, 0, 1.5]],
    ),
}


@pytest.mark.parametrize("name", listed(REGIMES, {"pendulum", "duffing"}))
def test_exact_solutions_solve_the_equations_in_every_regime(name):
    """They have the initial conditions, and the derivative in time of the equations."""
    made, rates = problem(name), functions(name)
    ts = jnp.linspace(-7.0, 30.0, 11)

    @jax.jit
    @jax.vmap
    def seen(q0, p0):
        def at(t):
            return made.exact(t, q0, p0, made.args)

        states, slopes = jax.vmap(lambda t: jax.jvp(at, (t,), (jnp.ones_like(t),)))(ts)
        return at(jnp.zeros(())), states, slopes

    starts = [jnp.asarray(x, float) for x in REGIMES[name]]
    first, states, slopes = seen(*starts)
    np.testing.assert_allclose(np.stack(first), np.stack(starts), rtol=0, atol=5e-14)
    wanted = jax.vmap(jax.vmap(lambda q, p: rates(0.0, q, p, 0.0, made.args)))(*states)
    for a, b in zip(slopes, wanted, strict=True):
        assert np.max(np.abs(a - b)) < 5e-12 * np.max(np.abs(b))
    bent = jax.vmap(jax.vmap(lambda q, p: rates(0.0, q * 1.0001, p, 0.0, made.args)))(*states)
    assert max(np.max(np.abs(a - b)) for a, b in zip(slopes, bent, strict=True)) > 1e-6


@pytest.mark.parametrize(
    ("name", "q0", "p0"),
    [
        ("pendulum", [[0.0]], [[2.0]]),  # m = 1
        ("duffing", [[0.0]], [[0.0]]),  # E = 0
        ("kepler", [[0.0, 0.0]], [[0.0, 1.5]]),  # at the centre
        # Through the vertical, upright and hanging; about the middle axis.
        pytest.param("spinning_top", [[0.0, 0.6, 0.0], [0.0, 2.6, 0.0]],
                     [[2.5, 0.1, 2.5], [-0.5, 0.1, 0.5]], marks=slow),
        pytest.param("rigid_body", [[0.0] * 3], [[0.0, 1.0, 0.6]], marks=slow),
    ],
)  # fmt: skip
def test_an_exact_solution_that_does_not_hold_is_not_a_number(name, q0, p0):
    exact = jax.jit(jax.vmap(functools.partial(problem(name).exact, 1.0), (0, 0, None)))
    assert np.all(np.isnan(exact(jnp.array(q0), jnp.array(p0), problem(name).args)))


LONG = [  # name, q0, p0, time, largest difference from DOP853, whose own error it is
    ("spinning_top", [0.0, 0.6, 0.0], [2.4, 0.1, 2.5], 400.0, 1e-8),  # 108 nutations
    ("spinning_top", [0.0, 0.6, 0.0], [2.49, 0.1, 2.5], 20.0, 1e-9),  # cos θ to 0.9998
    ("spinning_top", [0.0, 0.6, 0.0], [2.499, 0.1, 2.5], 20.0, 1e-8),  # to 1 − 2e-6
    ("spinning_top", [0.0, 2.5, 0.0], [0.0, 0.5, 0.01], 20.0, 1e-9),  # it hangs
    ("rigid_body", [0.1, 0.0, 0.4], [0.1, 1.0, 0.6], 2000.0, 1e-7),  # 39 periods
    ("rigid_body", [0.1, 0.0, 0.4], [0.1, 1.0, 0.6], 800.0, 1e-8),  # 15 periods
    ("rigid_body", [1.4, -2.0, 0.0], [-0.1, 1.0, 0.6], 300.0, 1e-9),
]


@pytest.mark.parametrize(("name", "q0", "p0", "time", "most"), LONG)
@slow
def test_exact_solutions_hold_at_long_times_and_near_singularities(name, q0, p0, time, most):
    """A quadrature with few nodes for the whole time would lose φ, ψ and g."""
    made, rates, ts = problem(name), functions(name), time * np.array([0.11, 0.5, 1.0])

    def field(t, z):
        return np.concatenate(rates(t, z[:3], z[3:], 0.0, made.args))

    run = solve_ivp(field, (0, time), [*q0, *p0], "DOP853", ts, rtol=1e-13, atol=1e-14)
    exact, at = jax.jit(made.exact), (jnp.array(q0), jnp.array(p0), made.args)
    off, late = (
        np.max(np.abs(np.concatenate(exact(t, *at), axis=1) - run.y.T))
        for t in (ts, ts * (1 + 1e-6))
    )
    assert off < most < 0.1 * late


@slow
def test_the_pendulum_and_duffing_at_rest():
    """Those of the linear oscillator. So do action, integrals and Van der Pol's amplitude."""
    at_rest, made, t = jnp.zeros(1), problem("pendulum"), 1.7
    of = jax.jit(jax.jacrev(lambda q, p: made.exact(t, q, p, made.args), (0, 1)))
    wanted = [[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]
    np.testing.assert_allclose(np.reshape(of(at_rest, at_rest), (2, 2)), wanted, rtol=1e-14)

    def swung(q, p):
        return action(0.0, 0.0, q, p, q, p, made.args)

    assert jax.jit(jax.grad(swung))(at_rest, at_rest)[0] == 0
    slope = jax.jit(jax.grad(swung))(jnp.array([1e-3]), at_rest)  # J = q²/2 + …
    assert float(slope[0]) == pytest.approx(1e-3, rel=1e-6)
    slopes = [jax.jit(jax.grad(lambda m, i=i: complete(m)[i]))(0.0) for i in (0, 1)]
    np.testing.assert_allclose(slopes, [np.pi / 8, -np.pi / 8], rtol=1e-14)
    of_amplitude = jax.grad(lambda q, p: amplitude(0, 0, q, p, q, p, None))
    assert of_amplitude(at_rest, at_rest)[0] == 0
    assert float(of_amplitude(jnp.ones(1), 2 * jnp.ones(1))[0]) == pytest.approx(5**-0.5)
    # q = −1 − δ cos √2 t + O(δ²) from a distance δ, and rest at the bottom itself.
    made, ts = problem("duffing"), np.array([0.0, 1.0, 2.0, 5.0])
    w = np.sqrt(2)
    for size in (1e-5, 1e-7, 1e-8, 1e-9, 0.0):
        q, p = made.exact(ts, [-1.0 - size], [0.0], made.args)
        off = np.hypot(q[:, 0] + 1 + size * np.cos(w * ts), p[:, 0] - size * w * np.sin(w * ts))
        assert np.max(off) < 20 * size**2 + 1e-15
    assert np.max(np.abs(p[:, 0] - 1e-9 * np.sin(ts))) > 1e-10  # another frequency


@slow
def test_kepler_carries_gradients_on_a_circle():
    """They agree with central differences of the fourth order, and the map is symplectic."""
    made, circle = problem("kepler"), jnp.array([1.0, 0.0, 0.0, 1.0])

    @jax.jit
    def end(z):
        return jnp.concatenate(made.exact(1.7, z[:2], z[2:], made.args))

    found = np.asarray(jax.jit(jax.jacrev(end))(circle))

    def central(h):
        return np.stack([(end(circle + d) - end(circle - d)) / (2 * h) for d in h * np.eye(4)], 1)

    wanted = (4 * central(5e-4) - central(1e-3)) / 3
    np.testing.assert_allclose(found, wanted, rtol=0, atol=2e-9)
    flip = np.kron([[0, 1], [-1, 0]], np.eye(2))
    np.testing.assert_allclose(found.T @ flip @ found, flip, rtol=0, atol=1e-13)
    assert np.max(np.abs(found[:2, :2] - np.eye(2))) > 1


@pytest.mark.parametrize("name", listed(EXACT, set(EXACT) - ELLIPTIC))
def test_exact_solutions_keep_the_dtype_and_refuse_other_shapes(name):
    made, ts = problem(name), np.array([[1.0, 2.0]])
    q0, p0 = start(name)
    many, momenta = jnp.stack([q0] * 3), jnp.stack([p0] * 3)
    single = jax.eval_shape(made.exact, ts, *map(np.float32, (q0, p0)), made.args)
    lanes = jax.vmap(made.exact, (None, 0, 0, None))
    double = jax.eval_shape(lanes, ts, many, momenta, made.args)
    for x, y in zip(single, double, strict=True):
        assert (x.shape, x.dtype) == ((1, 2, *q0.shape), jnp.float32)
        assert (y.shape, y.dtype) == ((3, 1, 2, *q0.shape), jnp.float64)
    if name not in ("oscillator", "van_der_pol", "slow_oscillator", "klein_gordon"):  # of any shape
        with pytest.raises(ValueError, match=r"one initial condition.*got q0 of shape \(3, "):
            made.exact(1.0, many, many, made.args)
    with pytest.raises(ValueError, match="shape"):
        made.exact(1.0, many, q0, made.args)


@pytest.mark.parametrize("name", NAMES)
def test_the_table_in_the_documentation_says_the_same(name):
    made = problem(name)
    text = (Path(__file__).parents[1] / "docs" / "systems.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith(f"| `{name}` |")]
    assert len(rows) == 2, f"docs/systems.md has {len(rows)} rows for {name}"
    _, _, _, exact, kept, symmetries, _ = rows[0].split("|")
    _, _, source, _ = rows[1].split("|")
    kept, _, nearly = kept.partition("adiabatic")
    assert set(re.findall(r"`(\w+)`", kept)) == set(made.invariants)
    powers = {key: int(power) for key, power in re.findall(r"`(\w+)` \((\d)\)", nearly)}
    assert powers == {key: fact.power for key, fact in made.adiabatic.items()}
    found = dict(re.findall(r"`(\w+)`( \(flow\))?", symmetries))
    assert {key for key, flow in found.items() if not flow} == set(made.symmetries)
    assert {key for key, flow in found.items() if flow} == set(made.flow_symmetries)
    holds = {None: "–", 0.0: "yes", 1.0: "ε = 1"}
    assert exact.strip() == holds[made.exact_epsilon if made.exact else None]
    assert source.strip() == made.source


@pytest.mark.parametrize("name", NAMES)
def test_a_problem_can_be_pickled_and_copied(name):
    try:
        problem = systems.LIBRARY[name]()
    except EphemerisMissing:
        pytest.skip("there is no ephemeris")
    for again in (pickle.loads(pickle.dumps(problem)), copy.deepcopy(problem)):
        assert type(again) is systems.Problem
        assert repr(again) == repr(problem)
        assert np.array_equal(again.q0, problem.q0)
        assert again.observables.keys() == problem.observables.keys()
        for kind in ("observables", "adiabatic", "symmetries", "flow_symmetries", "parameters"):
            assert getattr(again, kind).keys() == getattr(problem, kind).keys()
        if again.check is not None:  # the checks have their limits
            again.check(again.q0, again.p0, again.args)
            with pytest.raises((ValueError, TypeError)):
                again.check(np.full_like(np.asarray(again.q0), np.nan)[None], again.p0, again.args)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n == "duffing" else pytest.mark.slow) for n in NAMES]
)
def test_a_pickled_problem_integrates_to_the_same_bits(name):
    try:
        problem = systems.LIBRARY[name]()
    except EphemerisMissing:
        pytest.skip("there is no ephemeris")
    again = pickle.loads(pickle.dumps(problem))
    method = dvi.Rattle() if problem.system.constraint is not None else dvi.Strang()
    runs = [
        dvi.integrate(p, num_steps=5, method=method, observe=p.observables, throw=False)
        for p in (problem, again)
    ]
    for first, second in zip(*map(jax.tree.leaves, runs), strict=True):
        assert np.array_equal(first, second, equal_nan=True)
    for kind in ("symmetries", "flow_symmetries"):
        for key, generator in getattr(problem, kind).items():
            for part in ("xi", "eta"):
                f, g = (getattr(x, part, None) for x in (generator, getattr(again, kind)[key]))
                if callable(f):
                    point = (0.3, problem.q0 + 0.1, problem.p0 + 0.2, problem.args)
                    assert np.array_equal(f(*point), g(*point))
    for key, invariant in problem.adiabatic.items():
        if invariant.smaller is not None:
            other = again.adiabatic[key].smaller(2.0)
            assert repr(other) == repr(invariant.smaller(2.0))
