"""`Integrator`, the options of a run as one object, in every function that runs trajectories."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import _namespaces, interop, systems
from dvi_jax.base.checks import argument_names

PENDULUM = dvi.System(lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)))
CONTINUOUS = dvi.System(dvi.discretise(lambda t, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q))))
ACCURATE = dvi.Integrator(method=dvi.Strang(), arithmetic=dvi.Compensated())
STRANG = dvi.Integrator(method=dvi.Strang())
START = {"q0": [0.5], "p0": [0.1], "h": 0.1}
SAMPLES = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))


FORCED = dvi.System(PENDULUM.H_D, force=lambda t0, t1, q, p, args: -(q**3))


def crossing(t, q, p, args):
    return p[0]


def velocity(t0, t1, q0, p0, q1, p1, args):
    return p1 @ p1


def last(**how):
    return dvi.integrate(PENDULUM, **START, num_steps=20, **how).qs[-1]


def sweep(**how):
    axis, run = dvi.Axis("angle", [0.3, 0.4]), {"h": 0.1, "num_steps": 20, "progress": False}
    save = dvi.Save(final=True)
    return dvi.sweep(PENDULUM, [axis], [0.1], save=save, **run, **how).to_xarray().q


SECTION = {"h": 0.1, "num_steps": 200, "crossings": 2, "direction": 0}
START_OF_SECTION = np.array([[0.5]]), np.array([[0.1]])
DRIFT = {"epsilons": [0.01, 0.02, 0.04]}
SAMPLED = {"h": 0.1, "samples": SAMPLES}


def poincare(system=PENDULUM, **how):
    return dvi.poincare_section(system, *START_OF_SECTION, crossing, **SECTION, **how).qs


def drift_order(**how):
    run = {"h": 0.1, "num_steps": 50, **DRIFT}
    return dvi.drift_order(FORCED, velocity, [0.4], [0.1], **run, **how).drifts


def invariants(**how):
    system = systems.oscillator().system
    return dvi.discover_invariants(system, dvi.Polynomials(2), **SAMPLED, **how).coefficients


CALLS = {
    "integrate": last,
    "sweep": sweep,
    "poincare_section": poincare,
    "ReturnMap": lambda **how: (
        dvi.ReturnMap(PENDULUM, crossing, 0.1, 200, **how)(jnp.array([0.5]), jnp.array([0.0])).q
    ),
    "tangent_map": lambda **how: dvi.tangent_map(PENDULUM, **START, num_steps=20, **how),
    "drift_order": drift_order,
    "discover_invariants": invariants,
    "Model": lambda **how: (
        dvi.integrate(**dvi.Model(PENDULUM, **START, **how)({}), num_steps=20).qs
    ),
}


QUICK = ("integrate", "Integrator", "Model", "drift_order", "tangent_map", "from_lagrangian")


def each(calls):
    """Names of calls, marked slow if they take seconds to compile."""
    return [pytest.param(n, marks=() if n in QUICK else pytest.mark.slow) for n in calls]


@pytest.mark.parametrize("name", each(CALLS))
def test_an_integrator_means_the_same_as_its_keywords(name):
    call = CALLS[name]
    found, expected, other = (
        np.asarray(call(**how))
        for how in ({"integrator": STRANG}, {"method": dvi.Strang()}, {"method": dvi.TypeII()})
    )
    np.testing.assert_array_equal(found, expected)
    assert np.max(np.abs(found - other)) > 1e-4


def test_all_fields_are_used_or_rejected():
    how = {"method": dvi.Strang(), "arithmetic": dvi.Compensated(), "newton": dvi.Newton()}
    one = dvi.Integrator(dvi.Strang(), dvi.Newton(), arithmetic=dvi.Compensated())
    assert last(integrator=one) == last(**how)
    ts = np.linspace(0, 1, 11)
    given = dvi.Integrator(lattice=dvi.Given(ts))
    np.testing.assert_array_equal(dvi.integrate(PENDULUM, [0.5], [0.1], integrator=given).ts, ts)
    with pytest.raises(ValueError, match="arithmetic of discover_invariants must be"):
        invariants(integrator=ACCURATE)
    with pytest.raises(ValueError, match="find_symmetries does not use method"):
        symmetries(integrator=STRANG)


def implicit(t0, t1, q, p, args):
    return p @ p / 2 - jnp.sum(jnp.cos(q)) + 0.1 * p @ q


def diffusion(**how):
    noisy = dvi.System(implicit, noise=lambda t, q, p, args: 0.1 * jnp.ones(1))
    run = {"h": 0.1, "num_steps": 5, "num_paths": 3, "method": dvi.StochasticEuler()}
    return dvi.invariant_diffusion(
        noisy, [0.5], [0.1], invariant=lambda q, p: q @ q, **run, **how
    ).changes


def lagrangian(t0, t1, q0, v, args):
    return jnp.sum(jnp.cosh(v)) - q0 @ q0 / 2


def action(t0, t1, q0, q1, args):
    return (t1 - t0) * lagrangian(t0, t1, q0, (q1 - q0) / (t1 - t0), args)


def value_of(H_D):
    return H_D(0.0, 0.1, jnp.array([0.3]), jnp.array([0.2]), None)


LEFT = jnp.array([[0.5], [0.2]]), jnp.array([[0.1], [0.3]])


def bifurcation(**how):
    run = {"skip": 0, "epsilon": dvi.Axis("strength", [0.0]), **SECTION}
    return dvi.bifurcation(PENDULUM, *map(np.array, ([0.5], [0.1])), crossing, **run, **how).qs


def drift_surface(**how):
    run = {"hs": [0.05, 0.1], "duration": 2.0, **DRIFT}
    return dvi.drift_surface(FORCED, velocity, [0.4], [0.1], **run, **how).drifts


def symmetries(**how):
    basis = dvi.Polynomials(1)
    return dvi.find_symmetries(PENDULUM, basis, **SAMPLED, time=False, **how).singular_values


IMPLICIT = dvi.System(implicit)
ROOT_FINDERS = {
    **CALLS,
    "invariant_diffusion": diffusion,
    "Integrator": lambda **how: last(integrator=dvi.Integrator(**how)),
    "bifurcation": bifurcation,
    "drift_surface": drift_surface,
    "find_symmetries": symmetries,
    "solution_pairs": lambda **how: dvi.solution_pairs(IMPLICIT, h=0.1, samples=LEFT, **how)[1].q,
    "legendre": lambda **how: value_of(dvi.legendre(lagrangian, **how)),
    "from_lagrangian": lambda **how: value_of(dvi.from_lagrangian(action, **how)),
    "from_type_iii": lambda **how: value_of(
        dvi.from_type_iii(lambda t0, t1, q1, p0, args: p0 @ p0 / 2 - jnp.sum(jnp.cos(q1)), **how)
    ),
    "solve_ivp": lambda **how: interop.solve_ivp(IMPLICIT, (0, 1.0), [0.5, 0.1], h=0.1, **how).y,
}
"""Public functions with the keyword `root_finder`; three of them also take `newton`."""


@pytest.mark.parametrize("name", each(ROOT_FINDERS))
def test_a_root_finder_is_used(name):
    """`newton` is another name of it for `integrate` and `Integrator` only."""
    call, solver = ROOT_FINDERS[name], dvi.Newton(max_steps=30)
    expected = np.asarray(call(root_finder=solver))
    assert np.isfinite(expected).all()
    if name in ("integrate", "Integrator", "Model"):
        np.testing.assert_array_equal(call(newton=solver), expected)
        with pytest.raises(TypeError, match="only one of newton and root_finder"):
            call(root_finder=solver, newton=solver)
    else:
        with pytest.raises(TypeError, match="argument 'newton'"):
            call(newton=solver)
    with pytest.raises((TypeError, AttributeError)):
        call(root_finder="a word")


def test_no_function_with_a_root_finder_is_missing_here():
    public = [getattr(dvi, name) for name in _namespaces.names()] + [interop.solve_ivp]
    excepted = (dvi.Implicit, dvi.sweep_cost)  # the last as `sweep`
    found = {
        f.__name__ for f in public if callable(f) and _has_root_finder(f) and f not in excepted
    }
    assert found | {"Model"} == {*ROOT_FINDERS}


def _has_root_finder(f) -> bool:
    try:
        return "root_finder" in argument_names(f)
    except (TypeError, ValueError):
        return False


OF_A_RUN = {"t0", "args", "root_finder", "integrator"}
SEARCHES = {
    dvi.discover_invariants: {"method"},
    dvi.drift_order: {"method"},
    dvi.drift_surface: {"method"},
    dvi.find_symmetries: set(),
    dvi.solution_pairs: set(),
}


@pytest.mark.parametrize("search", SEARCHES, ids=lambda f: f.__name__)
def test_searches_list_their_keywords_and_name_the_one_that_is_unknown(search):
    assert set(argument_names(search)) >= OF_A_RUN | SEARCHES[search]
    with pytest.raises(TypeError, match=f"{search.__name__} has no argument 'integratr'. Did you "):
        search(PENDULUM, integratr=None)
    name, hint = ("methd", "Did you mean 'method'") if SEARCHES[search] else ("method", "Its argu")
    with pytest.raises(TypeError, match=f"{search.__name__} has no argument '{name}'. {hint}"):
        search(PENDULUM, **{name: dvi.Strang()})


@pytest.mark.slow
def test_one_default_for_every_function():
    """The map of H_D as it is written; Strang's of one that `discretise` made with order 1."""
    for system, method in ((PENDULUM, dvi.TypeII()), (CONTINUOUS, dvi.Strang())):
        run = {"num_steps": 200, "observe": dvi.Section(crossing, 0, 2), **START}
        default = dvi.integrate(system, **run).observed.qs
        np.testing.assert_array_equal(
            dvi.integrate(system, method=method, **run).observed.qs, default
        )
        np.testing.assert_array_equal(poincare(system)[0], default)
    assert last() == last(method=dvi.TypeII())
