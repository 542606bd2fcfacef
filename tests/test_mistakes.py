"""After a typical mistake: the right answer, a warning, or an error that helps.

Each row is one mistake. An error names what was seen and what to do.
"""

import math
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, plot, systems


def H_D(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


def H(t, q, p, args):
    return (p @ p + q @ q) / 2


def W(t0, t1, q0, p1, args):
    return -(q0**3)


def energy(q, p):
    return (p @ p + q @ q) / 2


FREE, FORCED = dvi.System(H_D), dvi.System(H_D, force=W)
STEPS = {"h": 0.1, "num_steps": 3}
Q, P = [1.0], [0.0]


def run(system=FREE, q0=Q, p0=P, **how):
    return dvi.integrate(system, q0, p0, **({**STEPS, **how}))


def hamiltonian(f, q0=Q, p0=P, **how):
    return run(dvi.System(f), q0, p0, **how)


SAMPLES = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))


def discover(system=FORCED, basis=dvi.Polynomials(2), **how):
    return dvi.discover_invariants(system, basis, **({"h": 0.1, "samples": SAMPLES, **how}))


def drift(invariant=energy, **how):
    return dvi.drift_order(
        FORCED, invariant, Q, P, **({"epsilons": [0.1, 0.2, 0.4], **STEPS, **how})
    )


TS = np.array([0.1, 0.2, 0.3])
MODEL = dvi.Model(FORCED, h=0.1, q0=Q, p0=P)


def observed(ts=TS, values=np.ones((3, 1)), **how):
    return dvi.Observations(ts, values, **({"sigma": 0.1, "t0": 0.0, **how}))


def fit(data=None, params=None, model=MODEL, **how):
    return dvi.fit(model, data or observed(), params or {"epsilon": 0.1}, progress=False, **how)


def sweep(**how):
    return dvi.sweep(FORCED, Q, P, **({**STEPS, "epsilon": [0.1, 0.2], "progress": False, **how}))


def section(**how):
    start = {"q0": [[1.0]], "p0": [[0.0]], "num_steps": 100, "h": 0.1, "crossings": 1}
    return dvi.poincare_section(FREE, g=lambda t, q, p, args: q[0], **(start | how))


ERRORS = {
    # --- the state ---
    "q0 and p0 of different shapes": (lambda: run(p0=[0.0, 1.0]), "same shape.*\\(1,\\).*\\(2,\\)"),
    "no momenta": (lambda: dvi.integrate(FREE, Q, **STEPS), "p0"),
    "no state at all": (lambda: dvi.integrate(FREE, **STEPS), "q0"),
    "an empty state": (lambda: run(q0=[], p0=[]), "empty"),
    "a complex state": (lambda: run(q0=[1j], p0=[0j]), "Re ψ"),
    "NaN in the state": (lambda: run(q0=[np.nan]), "finite, got nan at index \\[0\\]"),
    "text in the state": (lambda: run(q0=["a"]), "real numbers|must be a real array"),
    "None in the state": (lambda: run(q0=[None]), "real"),
    "half precision": (lambda: run(q0=np.float16([1]), p0=np.float16([0])), "float32 or float64"),
    "a scalar state where H_D has p1 @ p1": (lambda: run(q0=1.0, p0=0.0), "shape \\(\\)"),
    "a batch of states": (lambda: run(q0=np.ones((4, 1)), p0=np.ones((4, 1))), "jax.vmap"),
    "q0 and p0 as one array": (lambda: dvi.integrate(FREE, [1.0, 0.0], **STEPS), "p0"),
    "float64 while x64 is off": (
        lambda: without_x64(lambda: run(q0=np.ones(1), p0=np.ones(1))),
        "jax_enable_x64",
    ),
    # --- the system ---
    "H(t, q, p, args) as H_D": (lambda: dvi.System(H), "dvi.discretise"),
    "H_D to discretise": (lambda: dvi.discretise(H_D), "\\(t, q, p, args\\)"),
    "a function in place of a system": (lambda: run(H_D), "dvi.System"),
    "a discretised H in place of a system": (lambda: run(dvi.discretise(H)), "dvi.System"),
    "the class System": (lambda: run(dvi.System), "dvi.System"),
    "no function": (lambda: dvi.System(3.0), "function"),
    "H_D with a vector for a value": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: p1**2),
        "scalar",
    ),
    "H_D without return": (lambda: hamiltonian(lambda t0, t1, q0, p1, args: None), "scalar|None"),
    "H_D with a tuple for a value": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: (p1 @ p1, 0)),
        "scalar|tuple",
    ),
    "an index outside of q0": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: p1 @ p1 + q0[2] ** 2),
        "out of bounds",
    ),
    "an index outside of p1 in the force": (
        lambda: run(dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1[1:2]), epsilon=0.1),
        "shape|out of bounds",
    ),
    "NumPy in H_D": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: np.cos(q0[0]) + p1 @ p1),
        "jnp",
    ),
    "math in H_D": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: math.cos(q0[0]) + p1 @ p1),
        "jnp",
    ),
    "float() in H_D": (lambda: hamiltonian(lambda t0, t1, q0, p1, args: float(q0[0])), "jnp"),
    "if in H_D": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: p1 @ p1 if q0[0] > 0 else p1 @ p1 / 2),
        "jnp.where",
    ),
    "while in H_D": (lambda: hamiltonian(loop), "jnp.where|traced by JAX"),
    "if in the force": (
        lambda: run(
            dvi.System(H_D, force=lambda t0, t1, q0, p1, args: q0 if q0[0] > 0 else -q0),
            epsilon=0.1,
        ),
        "jnp.where",
    ),
    "args left out": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: args["k"] * (p1 @ p1)),
        "args=None|args =",
    ),
    "a name that args does not have": (
        lambda: hamiltonian(lambda t0, t1, q0, p1, args: args["k"] * (p1 @ p1), args={"m": 1.0}),
        "args|'k'",
    ),
    "an object in args": (lambda: run(args={"a": [bytearray(3)]}), "args"),
    "dates in args": (lambda: run(args=np.array(["2020-01-01"], "M8[D]")), "args"),
    "a force with four arguments": (
        lambda: dvi.System(H_D, force=lambda t, q, p, args: -q),
        "t0, t1, q0, p1, args",
    ),
    "a force of another shape": (
        lambda: run(dvi.System(H_D, force=lambda t0, t1, q0, p1, args: jnp.ones(2)), epsilon=0.1),
        "shape",
    ),
    "a perturbation with a vector for a value": (
        lambda: run(dvi.System(H_D, perturbation=lambda t0, t1, q0, p1, args: q0), epsilon=0.1),
        "scalar",
    ),
    "an order of discretise that does not exist": (lambda: dvi.discretise(H, order=5), "order"),
    # --- the perturbation ---
    "a force without epsilon": (lambda: run(FORCED), "epsilon="),
    "a perturbation without epsilon": (
        lambda: run(dvi.System(H_D, perturbation=lambda t0, t1, q0, p1, args: q0 @ q0)),
        "epsilon=",
    ),
    "several epsilons": (lambda: run(FORCED, epsilon=[0.1, 0.2]), "jax.vmap"),
    "epsilon NaN": (lambda: run(FORCED, epsilon=np.nan), "epsilon.*finite"),
    "epsilon as text": (lambda: run(FORCED, epsilon="0.1"), "epsilon"),
    # --- steps ---
    "no h": (lambda: dvi.integrate(FREE, Q, P, num_steps=3), "h"),
    "no num_steps": (lambda: dvi.integrate(FREE, Q, P, h=0.1), "num_steps"),
    "h = 0": (lambda: run(h=0.0), "h must not be zero"),
    "h = 0 and t1": (lambda: dvi.integrate(FREE, Q, P, h=0.0, t1=1.0), "h must not be zero"),
    "h NaN": (lambda: run(h=np.nan), "h must be a finite"),
    "h as text": (lambda: run(h="0.1"), "h "),
    "an array of h": (lambda: run(h=[0.1, 0.2]), "dvi.Given"),
    "half a step": (lambda: run(num_steps=2.5), "num_steps"),
    "a negative number of steps": (lambda: run(num_steps=-1), "num_steps"),
    "num_steps under jit": (lambda: jax.jit(lambda n: run(num_steps=n).qs[-1])(3), "num_steps"),
    "n_steps": (lambda: run(n_steps=3), "num_steps"),
    "steps": (lambda: run(steps=3), "num_steps"),
    "dt": (lambda: run(dt=0.1), "h"),
    "dt0": (lambda: run(dt0=0.1), "h"),
    "eps": (lambda: run(FORCED, eps=0.1), "epsilon"),
    "solver": (lambda: run(solver=dvi.Strang()), "method"),
    "saveat": (lambda: run(saveat=dvi.Save()), "save"),
    "tolerance": (lambda: run(rtol=1e-9), "rtol"),
    "both t1 and num_steps": (lambda: run(t1=1.0), "num_steps"),
    "t1 that h does not divide": (
        lambda: dvi.integrate(FREE, Q, P, h=0.1, t1=0.25),
        "multiple|whole number",
    ),
    "t1 before t0": (lambda: dvi.integrate(FREE, Q, P, h=0.1, t1=-1.0), "t1|negative h"),
    "a negative duration": (lambda: dvi.integrate(FREE, Q, P, h=0.1, duration=-1.0), "duration|h"),
    # --- how ---
    "a method that does not exist": (lambda: run(method="leapfrgo"), "Leapfrog"),
    "the class of a method": (lambda: run(method=dvi.Strang), "parentheses"),
    "a solver as a method": (lambda: run(method=dvi.Newton()), "method must be"),
    "a composition of odd order": (lambda: dvi.Yoshida(5), "order"),
    "a composition of an order that is not published": (lambda: dvi.KahanLi(4), "order|6.*8"),
    "no stages": (lambda: dvi.GaussLegendre(0), "stages"),
    "a method as an integrator": (lambda: run(integrator=dvi.Strang()), "dvi.Integrator"),
    "integrator and method": (
        lambda: run(integrator=dvi.Integrator(), method=dvi.Strang()),
        "method and integrator",
    ),
    "newton and root_finder": (
        lambda: run(newton=dvi.Newton(), root_finder=dvi.Newton()),
        "only one of newton and root_finder",
    ),
    "a root finder as text": (lambda: run(root_finder="newton"), "root_finder|newton"),
    "the class of a root finder": (lambda: run(root_finder=dvi.Newton), "parentheses|dvi.Newton"),
    "no Newton steps": (lambda: dvi.Newton(max_steps=0), "max_steps"),
    "the class of a lattice": (lambda: run(lattice=dvi.Uniform), "parentheses|lattice"),
    "given times and h": (lambda: run(lattice=dvi.Given([0.0, 0.1, 0.2])), "Given"),
    "given times in no order": (lambda: dvi.Given([0.0, 0.2, 0.1]), "order|ascending|monoton"),
    "arithmetic as text": (lambda: run(arithmetic="compensated"), "arithmetic"),
    "the class of an adjoint": (lambda: run(adjoint=dvi.Reversible), "parentheses|adjoint"),
    "fixed point for an implicit step": (
        lambda: hamiltonian(
            lambda t0, t1, q0, p1, args: (p1 @ p1) * (q0 @ q0), arithmetic=dvi.FixedPoint(2.0**-40)
        ),
        "explicit|solve|separable",
    ),
    "layout as text": (lambda: run(layout="arrays"), "layout|Layout"),
    # --- output ---
    "save as a number": (lambda: run(save=10), "dvi.Save\\(every=10\\)"),
    "save as text": (lambda: run(save="final"), "dvi.Save\\(final=True\\)"),
    "Save(every=0)": (lambda: dvi.Save(every=0), "every"),
    "save times in no order": (lambda: dvi.Save(ts=[0.2, 0.1, 0.3]), "order"),
    "an observable with three arguments": (
        lambda: run(observe=lambda t, q, p: q @ q),
        "\\(q, p\\).*\\(t, q, p, args\\)",
    ),
    "the class of a reduction": (lambda: run(observe=dvi.MaxDrift), "dvi.MaxDrift\\(function\\)"),
    "a number in a reduction": (lambda: run(observe=dvi.MaxDrift(5)), "function"),
    "text as an observable": (lambda: run(observe="energy"), "function"),
    "an observable with a tuple for a value": (
        lambda: run(observe=lambda q, p: (q, p)),
        "one array",
    ),
    "an observable that has if": (
        lambda: run(observe=lambda q, p: q[0] if q[0] > 0 else p[0]),
        "jnp.where",
    ),
    "a function as a stop": (lambda: run(stop=energy), "dvi.Stop"),
    "a stop of two arguments": (lambda: dvi.Stop(lambda q, p: q[0]), "\\(t, q, p, args\\)"),
    "progress as a number": (lambda: run(progress=5), "progress"),
    "progress under jit": (
        lambda: jax.jit(lambda q: run(q0=q, p0=q, progress=True).qs[-1])(jnp.ones(1)),
        "progress",
    ),
    "a run that overflows": (
        lambda: hamiltonian(
            lambda t0, t1, q0, p1, args: jnp.exp(q0 @ q0) + p1 @ p1,
            q0=[9.0],
            p0=[9.0],
            h=1.0,
            num_steps=20,
        ),
        "step",
    ),
    # --- names ---
    "plots": (lambda: dvi.plots, "plot"),
    "discretize": (lambda: dvi.discretize, "discretise"),
    "solve": (lambda: dvi.solve, "no attribute"),
    "Verlet": (lambda: dvi.Verlet, "StormerVerlet"),
    "sol.q": (lambda: run().q, "qs"),
    "sol.t": (lambda: run().t, "ts"),
    "sol.ys": (lambda: run().ys, "qs"),
    # --- discovery ---
    "one array of samples": (lambda: discover(samples=np.ones((60, 2))), "samples"),
    "samples of different counts": (
        lambda: discover(samples=(np.ones((5, 1)), np.ones((6, 1)))),
        "samples|shape",
    ),
    "few samples": (lambda: discover(samples=SAMPLES[:, :4]), "samples"),
    "NaN in the samples": (lambda: discover(samples=SAMPLES * np.nan), "finite"),
    "no samples": (lambda: dvi.discover_invariants(FORCED, dvi.Polynomials(2), h=0.1), "samples"),
    "the class of a basis": (lambda: discover(basis=dvi.Polynomials), "basis|Polynomials"),
    "a degree as a basis": (lambda: discover(basis=2), "basis|Polynomials"),
    "a degree of zero": (lambda: discover(basis=dvi.Polynomials(0)), "degree"),
    "a negative order": (lambda: discover(order=-1), "order"),
    "no step for a search": (lambda: discover(h=None), "h"),
    "negative epsilons": (lambda: drift(epsilons=[-0.1, 0.1, 0.2]), "positive"),
    "the same epsilon twice": (lambda: drift(epsilons=[0.1, 0.1, 0.2]), "epsilons"),
    "one epsilon": (lambda: drift(epsilons=0.1), "epsilons"),
    # --- sweeps ---
    "epsilons in a plane": (lambda: sweep(epsilon=np.ones((2, 2))), "one-dimensional|epsilon"),
    "an empty axis": (lambda: sweep(epsilon=[]), "empty|epsilon"),
    "axes of one name and two lengths": (
        lambda: sweep(epsilon=dvi.Axis("a", [0.1, 0.2]), h=dvi.Axis("a", [0.1, 0.2, 0.3])),
        "'?a'?",
    ),
    "an axis of text": (
        lambda: sweep(epsilon=dvi.Axis("a", ["x"]), observe=dvi.Last(energy)),
        "real numbers|axis 'a'",
    ),
    "a sweep that observes nothing": (sweep, "observe|save"),
    # --- fits ---
    "a parameter that the model does not have": (lambda: fit(params={"gamma": 1.0}), "gamma"),
    "no observations": (lambda: observed(ts=[], values=np.ones((0, 1))), "observ|times|empty"),
    "values of another length": (lambda: observed(values=np.ones((4, 1))), "4"),
    "negative sigma": (lambda: observed(sigma=-1.0), "sigma"),
    "all values missing": (
        lambda: fit(observed(values=np.full((3, 1), np.nan))),
        "NaN|missing|observ",
    ),
    "bounds the wrong way round": (lambda: dvi.Bounds(1.0, 0.0), "Bounds|lower|upper"),
    # --- other functions ---
    "one orbit to a section": (lambda: section(q0=[1.0], p0=[0.0]), "orbits|axis|shape"),
    "no crossings": (lambda: section(crossings=0), "crossings"),
    "a plot of numbers": (lambda: plot.orbit(3.0), "Solution|orbit|ts"),
    "a plot of a column that is not there": (lambda: plot.phase_portrait(run(), dof=3), "dof|3"),
    "a unit in a plain run": (lambda: run(q0=[1.0] * unit()), "unit|interop"),
    "solve_ivp with a tolerance": (
        lambda: interop.solve_ivp(FREE, (0.0, 1.0), [1.0, 0.0], h=0.1, rtol=1e-6),
        "rtol",
    ),
    "a system of the library that does not exist": (lambda: systems.keppler, "keppler"),
}
"""Mistake → (call, what the message contains)."""


def loop(t0, t1, q0, p1, args):
    while q0[0] > 1:
        q0 = q0 / 2
    return p1 @ p1 + q0 @ q0


def unit():
    return pytest.importorskip("astropy.units").m


def without_x64(call):
    jax.config.update("jax_enable_x64", False)
    try:
        return call()
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.parametrize("mistake", ERRORS)
def test_an_error_helps(mistake):
    call, words = ERRORS[mistake]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = message_of(call)
    assert re.search(words, text, re.S), text


def message_of(call):
    """The message of the error that the call raises, with its notes."""
    try:
        call()
    except Exception as error:
        return "\n".join([str(error), *getattr(error, "__notes__", [])])
    raise AssertionError("no error")


WARNINGS = {
    "epsilon without a force": (lambda: run(epsilon=0.1), "epsilon.*no effect"),
    "observations without t0": (
        lambda: fit(dvi.Observations(TS, np.ones(3), sigma=0.1)),
        "t0 is not given.*t=?",
    ),
    "p and q of H_D in the other order": (
        lambda: dvi.System(lambda t0, t1, p1, q0, args: p1 @ p1 / 2 + jnp.cos(q0[0])),
        "exchange them",
    ),
    "p and q of H in the other order": (
        lambda: dvi.discretise(lambda t, p, q, args: p @ p),
        "exchange them",
    ),
    "p and q of the force in the other order": (
        lambda: dvi.System(H_D, force=lambda t0, t1, p, q, args: -q),
        "exchange them",
    ),
}
"""Mistake → (call, what the warning contains)."""


@pytest.mark.parametrize("mistake", WARNINGS)
def test_a_warning_helps(mistake):
    call, words = WARNINGS[mistake]
    with pytest.warns(UserWarning, match=words):
        call()


def final(**how):
    return float(run(FORCED, epsilon=0.1, **how).q_final[0])


ANSWERS = {
    "epsilon = 0 for a forced system": lambda: (run(FORCED, epsilon=0.0).qs, run().qs),
    "integers in the state": lambda: (run(q0=[1], p0=[0]).qs, run().qs),
    "a tuple for a state": lambda: (run(q0=(1.0,)).qs, run().qs),
    "num_steps as a float without a fraction": lambda: (run(num_steps=3.0).qs, run().qs),
    "a method by its name": lambda: (final(method="strang"), final(method=dvi.Strang())),
    "a method by its name, capital": lambda: (
        final(method="KahanLi8"),
        final(method=dvi.KahanLi(8)),
    ),
    "a method by the field's name": lambda: (final(method="leapfrog"), final(method=dvi.Strang())),
    "a method with its order": lambda: (final(method="yoshida(4)"), final(method=dvi.Yoshida(4))),
    "t1": lambda: (dvi.integrate(FREE, Q, P, h=0.1, t1=0.3).qs, run().qs),
    "t1 and t0": lambda: (dvi.integrate(FREE, Q, P, h=0.1, t0=1.0, t1=1.3).ts, run(t0=1.0).ts),
    "duration": lambda: (dvi.integrate(FREE, Q, P, h=0.1, duration=0.3).qs, run().qs),
    "backwards to t1": lambda: (dvi.integrate(FREE, Q, P, h=-0.1, t1=-0.3).qs, run(h=-0.1).qs),
    "a problem of the library": lambda: (
        dvi.integrate(systems.kepler(), h=0.1, num_steps=3).qs,
        kepler_by_hand(),
    ),
    "an observable of (q, p)": lambda: (
        run(observe=energy).observed,
        jax.vmap(energy)(run().qs, run().ps),
    ),
    "an observable of (t, q, p, args)": lambda: (
        run(observe=lambda t, q, p, args: t).observed,
        run().ts,
    ),
    "a reduction of (q, p)": lambda: (
        run(observe=dvi.MaxDrift(lambda q, p: q[0])).observed,
        abs(run().qs[:, 0] - 1.0).max(),
    ),
    "a relative drift": lambda: (
        run(q0=[2.0], observe=dvi.MaxDrift(lambda q, p: q[0], relative=True)).observed,
        abs(run(q0=[2.0]).qs[:, 0] / 2.0 - 1.0).max(),
    ),
    "progress=True": lambda: (run(progress=True).qs, run().qs),
    "values of shape (N,) in a fit": lambda: (
        fit(observed(values=np.ones(3))).x,
        fit(observed()).x,
    ),
    "Leapfrog": lambda: (final(method=dvi.Leapfrog()), final(method=dvi.Strang())),
    "the last state": lambda: (run().p_final, run().ps[-1]),
}
"""What people write → (result, what it must equal)."""


def kepler_by_hand():
    k = systems.kepler()
    return dvi.integrate(k.system, k.q0, k.p0, args=k.args, h=0.1, num_steps=3, epsilon=0.0).qs


@pytest.mark.parametrize("habit", ANSWERS)
def test_a_habit_gives_the_right_answer(habit):
    found, expected = ANSWERS[habit]()
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=1e-14, atol=1e-15)


def test_there_are_enough_rows():
    assert len(ERRORS) + len(WARNINGS) + len(ANSWERS) >= 150


def test_states_of_the_library_are_arrays():
    for make in (systems.kepler, systems.henon_heiles, systems.oscillator):
        assert isinstance(make().q0, np.ndarray)
        assert isinstance(make().p0 @ make().p0, float)
