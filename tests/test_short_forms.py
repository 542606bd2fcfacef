"""Functions of the state may have the arguments (q, p), wherever one is accepted."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.observe import OfState, of_steps

T, Q, P = jnp.asarray(0.3), jnp.array([1.0, 2.0]), jnp.array([0.5, -1.0])
POINT, STEP = (T, Q, P, None), (T, T + 0.1, Q, P, None)


def H_D(t0, t1, q0, p1, args):
    return p1 @ p1 / 2


def number(q, p):
    return q @ p + q[0]


def vector(q, p):
    return q * p


def adiabatic(gauge):
    step = (*STEP[:2], Q, P, Q, P, None)
    return dvi.AdiabaticInvariant([dvi.generators.rotation()], [gauge]).bind(dvi.System(H_D), 0.0)(
        *step
    )


def observed(f):
    return dvi.Observations([0.1], [[1.0]], f, sigma=0.1, t0=0.0).function(*POINT)


PLACES = {
    "Stop": (number, lambda f: dvi.Stop(f).g(*POINT)),
    "Section": (number, lambda f: dvi.Section(f).g(*POINT)),
    "Save": (number, lambda f: dvi.Save(ts=[1.0], clock=f).clock(*POINT)),
    "AdaptiveReversible": (number, lambda f: dvi.AdaptiveReversible(f).speed(*POINT)),
    "TimeTransformed": (number, lambda f: dvi.TimeTransformed(f).speed(*POINT)),
    "discretise": (number, lambda f: dvi.discretise(f)(*STEP)),
    "legendre": (lambda q, v: v @ v - q @ q, lambda f: dvi.legendre(f)(*POINT)),
    "Implicit": (
        number,
        lambda f: dvi.Implicit(*[lambda t, q, p, y, args: y] * 2, f).guess(*POINT),
    ),
    "noise": (vector, lambda f: dvi.System(H_D, noise=f).noise.functions[0](*POINT)),
    "NoiseHamiltonians": (vector, lambda f: dvi.NoiseHamiltonians(f).h(*POINT)),
    "Observations": (vector, observed),
    "EnergyShell": (number, lambda f: dvi.starts.EnergyShell(1, f, 1.0, [0.0], [1.0]).H(*POINT)),
    "Generator": (vector, lambda f: dvi.Generator(xi=f)(dvi.LatticePoint(T, Q, P)).q),
    "hamiltonian_flow": (
        number,
        lambda f: dvi.generators.hamiltonian_flow(f)(dvi.LatticePoint(T, Q, P)).q,
    ),
    "gauge": (number, adiabatic),
    "observe": (number, lambda f: of_steps(f)(T, T, Q, P, Q, P, None)),
    "reduction": (number, lambda f: of_steps(dvi.MaxDrift(f)).function(T, T, Q, P, Q, P, None)),
    "InSlowTime": (
        number,
        lambda f: systems.InSlowTime(f).bind(None, 0.1)(T, T, Q, P, Q, P, None),
    ),
}
FORCES = {
    "velocity_force": lambda f: dvi.velocity_force(H_D, f)(*STEP),
    "ForceLibrary": lambda f: dvi.ForceLibrary({"f": f}, [2.0])(*STEP),
}


@pytest.mark.parametrize("place", PLACES)
def test_a_function_of_the_state_has_a_short_form(place):
    function, value = PLACES[place]
    long = lambda t, q, p, args: function(q, p)  # noqa: E731
    np.testing.assert_array_equal(value(function), value(long))
    with pytest.raises(TypeError, match=r"\(q, p\)|\(q, v\)"):
        value(lambda q, p, third: function(q, p))


@pytest.mark.parametrize("place", FORCES)
def test_a_force_has_a_short_form(place):
    value = FORCES[place]
    np.testing.assert_array_equal(value(vector), value(lambda t0, t1, q, v, args: vector(q, v)))
    with pytest.raises(TypeError, match=r"\(q0, "):
        value(lambda q, p, third: vector(q, p))


@pytest.mark.parametrize("place", [*PLACES, *FORCES])
def test_arguments_in_another_order_give_a_warning(place):
    function, value = PLACES.get(place) or (vector, FORCES[place])
    with pytest.warns(UserWarning, match="exchange them"):
        value((lambda v, q: function(q, v)) if place in ("legendre", "velocity_force")
              else (lambda p, q: function(q, p)))  # fmt: skip


def test_an_observable_of_the_library_has_a_value_at_each_saved_state():
    problem = systems.kepler()
    observe = {name: problem.observables[name] for name in ("energy", "angular_momentum")}
    sol = dvi.integrate(problem, h=0.1, num_steps=4, save=dvi.Save(every=2), observe=observe)
    assert {values.shape for values in sol.observed.values()} == {sol.ts.shape}
    first = problem.observables["energy"](0.0, problem.q0, problem.p0, problem.args)
    np.testing.assert_allclose(sol.observed["energy"][0], first, rtol=1e-15)


STEPS_ONLY = {"mixed_energy", "map_invariant"}


@pytest.mark.parametrize("name", systems.LIBRARY)
def test_observables_of_the_library_are_functions_of_the_state(name):
    problem = systems.LIBRARY[name]()
    for label, function in problem.observables.items():
        is_of_state = isinstance(function, OfState | systems.InSlowTime)
        assert is_of_state == (label not in STEPS_ONLY), label
        if is_of_state and not problem.system.slow_time:
            state = tuple(map(jnp.asarray, (0.0, problem.q0, problem.p0)))
            values = [
                jax.eval_shape(function, *arguments, problem.args)
                for arguments in (state, (state[0], *state, *state[1:]))
            ]
            assert values[0].shape == values[1].shape
