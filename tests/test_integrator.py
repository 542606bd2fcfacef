"""One object for how to integrate, in every function that runs trajectories."""

import inspect

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, systems

PENDULUM = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)))
CONTINUOUS = dvi.System(dvi.discretise(lambda t, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q))))
ACCURATE = dvi.Integrator(method=dvi.Strang(), arithmetic=dvi.Compensated())
STRANG = dvi.Integrator(method=dvi.Strang())
START = {"q0": [0.5], "p0": [0.1], "h": 0.1}
SAMPLES = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))


def crossing(t, q, p, args):
    return p[0]


def velocity(t0, t1, q0, p0, q1, p1, args):
    return p1 @ p1


def last(**how):
    return dvi.integrate(PENDULUM, **START, num_steps=20, **how).qs[-1]


CALLS = {
    "integrate": last,
    "sweep": lambda **how: dvi.sweep(
        PENDULUM, [dvi.Axis("angle", [0.3, 0.4])], [0.1], h=0.1, num_steps=20,
        save=dvi.Save(final=True), progress=False, **how,
    ).to_xarray().q,
    "poincare_section": lambda **how: dvi.poincare_section(
        PENDULUM, np.array([[0.5]]), np.array([[0.1]]), crossing, h=0.1, num_steps=200,
        crossings=2, direction=0, **how,
    ).qs,
    "ReturnMap": lambda **how: dvi.ReturnMap(PENDULUM, crossing, 0.1, 200, **how)(
        jnp.array([0.5]), jnp.array([0.0])
    ).q,
    "tangent_map": lambda **how: dvi.tangent_map(PENDULUM, **START, num_steps=20, **how),
    "drift_order": lambda **how: dvi.drift_order(
        dvi.System(PENDULUM.H_D, force=lambda t0, t1, q, p, args: -(q**3)), velocity, [0.4], [0.1],
        epsilons=[0.01, 0.02, 0.04], h=0.1, num_steps=50, **how,
    ).drifts,
    "discover_invariants": lambda **how: dvi.discover_invariants(
        systems.oscillator().system, dvi.Polynomials(2), h=0.1, samples=SAMPLES, **how
    ).coefficients,
    "Model": lambda **how: dvi.integrate(
        **dvi.Model(PENDULUM, **START, **how)({}), num_steps=20
    ).qs,
}  # fmt: skip


@pytest.mark.parametrize("name", CALLS)
def test_an_integrator_means_the_same_as_its_keywords(name):
    call = CALLS[name]
    found, expected, other = (
        np.asarray(call(**how))
        for how in ({"integrator": STRANG}, {"method": dvi.Strang()}, {"method": dvi.TypeII()})
    )
    np.testing.assert_array_equal(found, expected)
    assert np.max(np.abs(found - other)) > 1e-4


def test_all_fields_are_used():
    how = {"method": dvi.Strang(), "arithmetic": dvi.Compensated(), "newton": dvi.Newton()}
    one = dvi.Integrator(dvi.Strang(), dvi.Newton(), arithmetic=dvi.Compensated())
    assert last(integrator=one) == last(**how)
    ts = np.linspace(0, 1, 11)
    times = dvi.integrate(
        PENDULUM, [0.5], [0.1], integrator=dvi.Integrator(lattice=dvi.Given(ts))
    ).ts
    np.testing.assert_array_equal(times, ts)


def implicit(t0, t1, q, p, args):
    return p @ p / 2 - jnp.sum(jnp.cos(q)) + 0.1 * p @ q


def lagrangian(t0, t1, q0, v, args):
    return jnp.sum(jnp.cosh(v)) - q0 @ q0 / 2


def action(t0, t1, q0, q1, args):
    return (t1 - t0) * lagrangian(t0, t1, q0, (q1 - q0) / (t1 - t0), args)


def value_of(H_D):
    return H_D(0.0, 0.1, jnp.array([0.3]), jnp.array([0.2]), None)


LEFT = jnp.array([[0.5], [0.2]]), jnp.array([[0.1], [0.3]])
NAMED = {
    **CALLS,
    "Integrator": lambda **how: last(integrator=dvi.Integrator(**how)),
    "bifurcation": lambda **how: dvi.bifurcation(
        PENDULUM, np.array([0.5]), np.array([0.1]), crossing, h=0.1, num_steps=200, crossings=2,
        direction=0, skip=0, epsilon=dvi.Axis("strength", [0.0]), **how,
    ).qs,
    "drift_surface": lambda **how: dvi.drift_surface(
        dvi.System(PENDULUM.H_D, force=lambda t0, t1, q, p, args: -(q**3)), velocity, [0.4], [0.1],
        epsilons=[0.01, 0.02, 0.04], hs=[0.05, 0.1], duration=2.0, **how,
    ).drifts,
    "find_symmetries": lambda **how: dvi.find_symmetries(
        PENDULUM, dvi.Polynomials(1), h=0.1, samples=SAMPLES, time=False, **how
    ).singular_values,
    "solution_pairs": lambda **how: dvi.solution_pairs(
        dvi.System(implicit), h=0.1, samples=LEFT, **how
    )[1].q,
    "legendre": lambda **how: value_of(dvi.legendre(lagrangian, **how)),
    "from_lagrangian": lambda **how: value_of(dvi.from_lagrangian(action, **how)),
    "from_type_iii": lambda **how: value_of(dvi.from_type_iii(
        lambda t0, t1, q1, p0, args: p0 @ p0 / 2 - jnp.sum(jnp.cos(q1)), **how
    )),
    "solve_ivp": lambda **how: interop.solve_ivp(
        dvi.System(implicit), (0.0, 1.0), [0.5, 0.1], h=0.1, **how
    ).y,
}  # fmt: skip
"""Every public function with the keyword `newton`; `diffrax_solver` needs diffrax."""


@pytest.mark.parametrize("name", NAMED)
def test_root_finder_and_newton_are_one_keyword(name):
    call, solver = NAMED[name], dvi.Newton(max_steps=30)
    one, other = (np.asarray(call(**{key: solver})) for key in ("root_finder", "newton"))
    np.testing.assert_array_equal(one, other)
    with pytest.raises(TypeError, match="are one keyword: give one"):
        call(root_finder=solver, newton=solver)
    with pytest.raises((TypeError, AttributeError)):
        call(root_finder="a word")


def test_diffrax_solver_takes_both_names():
    pytest.importorskip("diffrax")
    solver = dvi.Newton(max_steps=30)
    assert interop.diffrax_solver(root_finder=solver) == interop.diffrax_solver(newton=solver)


def test_no_function_with_newton_is_left_out():
    public = [getattr(dvi, name) for name in dir(dvi) if not name.startswith("_")]
    public += [interop.solve_ivp, interop.diffrax_solver]
    excepted = (dvi.Equations, dvi.PicardThenNewton, dvi.sweep_cost)  # the last as `sweep`
    found = {f.__name__ for f in public if callable(f) and _has_newton(f) and f not in excepted}
    assert found | {"Integrator", "Model", "diffrax_solver"} == {*NAMED, "diffrax_solver"}


def _has_newton(f) -> bool:
    try:
        return "newton" in inspect.signature(f).parameters
    except (TypeError, ValueError):
        return False


@pytest.mark.parametrize(
    ("how", "error", "message"),
    [
        ({"integrator": dvi.Strang()}, TypeError, r"must be a dvi.Integrator\(...\)"),
        ({"integrator": STRANG, "newton": dvi.Newton()}, ValueError, "newton and integrator are"),
        ({"method": dvi.Strang}, TypeError, "a pair of parentheses missing"),
    ],
)
def test_wrong_integrators_are_refused(how, error, message):
    with pytest.raises(error, match=message):
        last(**how)


def test_fields_without_effect_are_refused():
    with pytest.raises(ValueError, match="discover_invariants does not use arithmetic"):
        CALLS["discover_invariants"](integrator=ACCURATE)
    with pytest.raises(ValueError, match="find_symmetries does not use method"):
        dvi.find_symmetries(
            PENDULUM, dvi.Polynomials(1), h=0.1, samples=SAMPLES, integrator=STRANG, time=False
        )


def test_one_default_for_every_function():
    """The map of H_D as it is written; Strang's of one that `discretise` made with order 1."""
    for system, method in ((PENDULUM, dvi.TypeII()), (CONTINUOUS, dvi.Strang())):
        runs = [
            dvi.integrate(system, **START, num_steps=200, observe=section, **how).observed
            for section in (dvi.Section(crossing, 0, 2),)
            for how in ({}, {"method": method})
        ]
        np.testing.assert_array_equal(runs[0].qs, runs[1].qs)
        found = dvi.poincare_section(
            system, np.array([[0.5]]), np.array([[0.1]]), crossing, h=0.1, num_steps=200,
            crossings=2, direction=0,
        )  # fmt: skip
        np.testing.assert_array_equal(found.qs[0], runs[0].qs)
    assert last() == last(method=dvi.TypeII())
