"""Identification of unknown forces: exactly the planted terms, and no term without a force."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import dvi_jax as dvi
from dvi_jax.fit.elimination import Elimination

H = 0.1


def H_D(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


FREE = dvi.System(H_D)
ONE = dvi.ForceLibrary.monomials(5, 1)
TWO = dvi.ForceLibrary.monomials(3, 2, "q") + dvi.ForceLibrary(
    {
        "friction": lambda t0, t1, q, p, args: -p,
        "magnetic": lambda t0, t1, q, p, args: jnp.stack([p[1], -p[0]]),
    }
)
DAMPED = {"p": -0.05, "q³": -0.3}
# The force of the potential q1²q2 − q2³/3 (Hénon and Heiles 1964), and friction.
COUPLED = {"q1 q2 e1": -2.0, "q1² e2": -1.0, "q2² e2": 1.0, "friction": 0.02}
CASES = {
    "damped": (ONE, DAMPED, [1.5], [0.0], 300, 1.0),
    "coupled": (TWO, COUPLED, [0.9, 0.7], [0.3, -0.8], 300, 0.3),
}


def observed(system, q0, p0, steps, seed, noise=0.01, epsilon=1.0, known=True):
    """The state at each step, with 1 % of its spread as noise."""
    epsilon = epsilon if system.force is not None else 0.0
    sol = dvi.integrate(system, q0, p0, h=H, num_steps=steps, epsilon=epsilon)
    values = np.concatenate([np.asarray(sol.qs), np.asarray(sol.ps)], axis=1)
    sigma = noise * values.std()
    values = values + sigma * np.random.default_rng(seed).normal(size=values.shape)
    return dvi.Observations(np.asarray(sol.ts), values, "state", sigma if known else None)


MODELS = {name: dvi.Model(FREE, h=H, epsilon=epsilon) for name, (*_, epsilon) in CASES.items()}


@functools.cache
def found(name, seed):
    library, planted, q0, p0, steps, epsilon = CASES[name]
    truth = dvi.System(H_D, force=library.with_coefficients(planted))
    data = observed(truth, q0, p0, steps, seed, epsilon=epsilon)
    off = np.random.default_rng(seed).normal(scale=0.03, size=(2, len(q0)))
    starts = {"q0": jnp.array(q0) + off[0], "p0": jnp.array(p0) + off[1]}
    return dvi.identify(MODELS[name], data, library, starts)


def is_exact(name, seed):
    planted, it = CASES[name][1], found(name, seed)
    assert set(it.terms) == set(planted)
    truth = np.array([planted[term] for term in it.terms])
    assert np.max(np.abs(it.coefficients - truth) / it.sigma) < 4
    assert np.max(it.sigma / np.abs(truth)) < 0.1
    assert it.is_unique
    assert it.undetermined == []
    assert it.fit.status == "converged"
    return it


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", CASES)
def test_finds_exactly_the_planted_terms_among_twenty(name, seed):
    it = is_exact(name, seed)
    assert len(CASES[name][0]) == 20
    if (name, seed) == ("damped", 0):
        assert len(it.path) == 20  # each removal, and the one too many
        assert it.path[-1].criterion > it.path[-2].criterion + 1000
        assert "2 of 20 candidates" in str(it)
        assert "\n  q³  -0." in str(it)


@pytest.mark.slow
def test_the_identified_system_is_ready_for_discovery():
    """Friction forbids what the cubic alone has: an invariant of first order."""
    samples = np.random.default_rng(0).uniform(-1, 1, (2, 120, 1))
    it = found("damped", 0)
    d = dvi.discover_invariants(it.system, dvi.Polynomials(4), 1, h=H, samples=samples)
    assert d.count == 0
    assert d.obstructions[0].kind == "dissipation"
    cubic = ONE.only(["q³"]).with_coefficients(it.coefficients[list(it.terms).index("q³")][None])
    options = {"h": H, "samples": samples, "representative": "simplest"}
    system = dvi.System(H_D, force=cubic)
    d = dvi.discover_invariants(system, dvi.Polynomials(4), 1, **options)
    assert d.count == 1
    names = list(d.basis.names)
    assert d.coefficients[0, 1, names.index("q⁴")] == pytest.approx(0.3 / 4, abs=2e-3)


RESTING = dvi.Model(FREE, h=H, q0=[1.0], p0=[0.2])


def nothing(seed, known=True):
    data = observed(FREE, [1.0], [0.2], 150, seed, noise=0.1, known=known)
    return dvi.identify(RESTING, data, ONE)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("known", [True, False])
def test_noise_gives_no_term_whether_or_not_its_size_is_known(seed, known):
    it = nothing(seed, known)
    assert it.terms == ()
    assert it.coefficients.shape == (0,)
    assert it.fit is None
    assert it.system.force is None
    assert "no term was detected" in str(it)
    assert not known or len(it.path) == 21


SMALL = dvi.ForceLibrary(
    {
        "spring": lambda t0, t1, q, p, args: -q,
        "double spring": lambda t0, t1, q, p, args: -2 * q,
        "friction": lambda t0, t1, q, p, args: -p,
        "cubic": lambda t0, t1, q, p, args: -(q**3),
    }
)


@pytest.mark.slow
def test_candidates_that_are_the_same_are_reported():
    truth = dvi.System(H_D, force=SMALL.with_coefficients({"spring": 0.2, "cubic": 0.1}))
    data = observed(truth, [1.2], [0.0], 150, 0, known=False)
    it = dvi.identify(dvi.Model(FREE, h=H, q0=[1.2], p0=[0.0]), data, SMALL)
    springs = {"spring", "double spring"}
    assert len(it.terms) == 2
    assert "cubic" in it.terms
    (chosen,) = springs & set(it.terms)
    assert set(it.alternatives) == {chosen}
    ((other, rise),) = it.alternatives[chosen]
    assert {chosen, other} == springs
    assert abs(rise) < 1e-6
    assert not it.is_unique
    assert len(it.undetermined) == 1
    assert all(name in it.undetermined[0] for name in springs)
    assert f"not unique: in place of {chosen} the data allow {other}" in str(it)


def test_exact_data_of_an_unperturbed_system_give_no_term():
    """Rounding is not identified as a force."""
    data = observed(FREE, [1.0], [0.2], 100, 0, noise=0.0, known=False)
    it = dvi.identify(dvi.Model(FREE, h=H, q0=[1.0], p0=[0.2]), data, SMALL.only(["cubic"]))
    assert it.terms == ()


@pytest.mark.slow
def test_a_known_force_and_parameters_are_kept_next_to_the_library():
    """A model as a function: a mass to be fitted, a known spring, ε and args of its own."""

    def spring(t0, t1, q, p, args):
        return -args["k"] * q

    def moving(t0, t1, q, p, args):
        return p @ p / (2 * args["m"])

    def both(t0, t1, q, p, args):
        return spring(t0, t1, q, p, args) - 0.4 * q**3

    known = {"q0": [1.2], "p0": [0.0], "h": H, "epsilon": 0.5}
    truth = dvi.System(moving, force=both)
    sol = dvi.integrate(system=truth, num_steps=150, args={"k": 2.0, "m": 1.3}, **known)
    noise = 0.01 * np.random.default_rng(0).normal(size=sol.qs.shape)
    data = dvi.Observations(np.asarray(sol.ts), np.asarray(sol.qs) + noise, sigma=0.01)

    def model(params):
        system = dvi.System(moving, force=spring)
        return {"system": system, "args": {"k": 2.0, "m": params["m"]}, **known}

    it = dvi.identify(model, data, SMALL.only(["friction", "cubic"]), {"m": 1.2})
    assert it.terms == ("cubic",)
    assert it.coefficients[0] == pytest.approx(0.4, abs=4 * it.sigma[0])
    assert it.fit.params["m"] == pytest.approx(1.3, abs=0.02)
    assert it.epsilon == 0.5
    q, p = jnp.array([0.7]), jnp.array([0.1])
    force = it.system.disturbing_force(0.0, H, q, p, 0.5, {"k": 2.0})
    np.testing.assert_allclose(force, 0.5 * (-2.0 * q - it.coefficients[0] * q**3), rtol=1e-12)


@pytest.mark.slow
def test_a_library_is_the_sum_of_its_candidates():
    q, p = jnp.array([0.7, -0.4]), jnp.array([0.2, 0.5])
    c = {"q1 q2 e1": 2.0, "p2² e2": -3.0}
    library = dvi.ForceLibrary.monomials(2, 2)
    assert len(library) == 28
    assert len(dvi.ForceLibrary.monomials(2, 2, constant=True)) == 30
    assert dvi.ForceLibrary.monomials(3, 1, "p").names == ("p", "p²", "p³")
    bound = library.with_coefficients(c)
    expected = [2.0 * 0.7 * -0.4, -3.0 * 0.25]
    np.testing.assert_allclose(bound(0.0, H, q, p, None), expected, rtol=1e-14)
    args = {"coefficients": bound.coefficients}
    np.testing.assert_allclose(library(0.0, H, q, p, args), expected, rtol=1e-14)
    np.testing.assert_allclose(bound.only(c)(0.0, H, q, p, None), expected, rtol=1e-14)
    slope = jax.jacobian(lambda c: library(0.0, H, q, p, {"coefficients": c}))(bound.coefficients)
    np.testing.assert_allclose(slope @ bound.coefficients, expected, rtol=1e-14)
    assert TWO.names[-2:] == ("friction", "magnetic")


Q, P = jnp.array([0.7]), jnp.array([0.1])
AT = (0.0, H, Q, P)
SCALAR = dvi.ForceLibrary({"f": lambda *a: 1.0}, [1.0])


def free_flight(t0, t1, q0, p1, args):
    return p1 @ p1 / 2


def hyperbolic(t0, t1, q0, p1, args):
    return (p1 @ p1 - q0 @ q0) / 2


def van_der_pol(x):
    return [x[1], -x[0] - (1 - x[0] ** 2) * x[1]]


def duffing(x):
    return [x[1], -x[0] - 0.3 * x[0] ** 3 - 0.1 * x[1]]


def two_coupled(x):
    return [x[2], x[3], -x[0] - 2 * x[0] * x[1], -2 * x[1] - x[0] ** 2]


CUBICS, QUADRATICS = dvi.ForceLibrary.monomials(3, 1), dvi.ForceLibrary.monomials(2, 2, "q")
COUPLINGS = {"q1 e1": -1, "q2 e2": -2, "q1 q2 e1": -2, "q1² e2": -1}
# H_D without a force leaves the region of the data: (H_D, truth, library, terms, start, noise).
LEAVING = {
    "exact": (free_flight, van_der_pol, CUBICS, {"q": -1, "p": -1, "q² p": 1}, [1, -2], 0.0),
    "at rest": (free_flight, duffing, CUBICS, {"q": -1, "q³": -0.3, "p": -0.1}, [1.5, 0], 0.01),
    "two": (free_flight, two_coupled, QUADRATICS, COUPLINGS, [0.4, 0.2, 0, 0.1], 0.01),
    "hyperbolic": (
        *(hyperbolic, lambda x: [x[1], -x[0] - 0.2 * x[1]], CUBICS, {"q": -2, "p": -0.2}),
        *([1, 0.3], 0.01),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LEAVING)
def test_a_model_whose_trajectory_leaves_the_data(name):
    """The prior of a coefficient follows from effects near the data, not from those far away."""
    hamiltonian, field, library, planted, start, noise = LEAVING[name]
    ts, n = np.arange(0, 15, 0.1), len(start) // 2
    exact = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11, "t_eval": ts}
    values = solve_ivp(lambda t, x: field(x), (0, 15), start, **exact).y.T
    sigma = noise * values.std() or None
    values += (sigma or 0.0) * np.random.default_rng(0).normal(size=values.shape)
    system = dvi.System(dvi.discretise(lambda t, q, p, args: hamiltonian(t, t, q, p, args)))
    model = dvi.Model(system, h=0.05, method=dvi.GaussLegendre(3))
    data = dvi.Observations(ts, values, "state", sigma, t0=0.0)
    params = {"q0": np.array(start[:n], float), "p0": np.array(start[n:], float)}
    it = dvi.identify(model, data, library, params, check_units=False)
    assert set(it.terms) == set(planted)
    error = np.abs(it.coefficients - [planted[term] for term in it.terms])
    assert (error < (4 * it.sigma if noise else 1e-6)).all()
    assert it.is_unique
    assert "contradict" not in str(it)


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "noise"), [(1000, 0.02), (300, 0.05)])
def test_terms_are_not_held_by_a_prior_of_a_particle_at_rest(steps, noise):
    """Without the force it stays where it is, so that the force acts ever longer: the priors of the
    beginning bring the first fit near the data (1000 steps), and those of that fit are the last."""
    library, start = SMALL.only(["spring", "friction", "cubic"]), {"q0": [1.5], "p0": [0.0]}
    force = library.with_coefficients({"spring": 1.0, "friction": 0.02})
    system, save = dvi.System(free_flight, force=force), dvi.Save(every=4)
    sol = dvi.integrate(system, **start, h=H, num_steps=steps, epsilon=1.0, save=save)
    values = np.concatenate([sol.qs, sol.ps], axis=1)
    values += noise * np.random.default_rng(0).normal(size=values.shape)
    data = dvi.Observations(np.asarray(sol.ts), values, "state", noise)
    it = dvi.identify(dvi.Model(dvi.System(free_flight), h=H, **start), data, library)
    assert (it.full.status, set(it.terms)) == ("converged", {"spring", "friction"})
    assert it.full.explained > 0.99
    # The criterion of the chosen terms is that of their fit without any prior.
    k, (stage, *_) = len(it.terms), (step for step in it.path if step.terms == it.terms)
    chi2 = it.fit.reduced_chi2 * (it.fit.num_observed - k)
    assert stage.criterion == pytest.approx(chi2 + k * it.penalty, abs=1e-3)


@pytest.mark.slow
def test_the_effect_of_a_term_outside_of_the_data_does_not_count():
    """Alone, H_D leaves the data exponentially: there q⁹ is ten orders of magnitude larger."""

    def top(t0, t1, q0, p1, args):
        return (p1 @ p1 - 4 * q0 @ q0) / 2

    library = dvi.ForceLibrary({"ninth": lambda t0, t1, q, p, args: -(q**9)})
    truth, start = (
        dvi.System(top, force=library.with_coefficients([4.0])),
        {"q0": [0.1], "p0": [0.0]},
    )
    sol = dvi.integrate(truth, **start, h=H, num_steps=40, epsilon=1.0)
    values = np.concatenate([sol.qs, sol.ps], axis=1)
    values += 0.02 * np.random.default_rng(0).normal(size=values.shape)
    data = dvi.Observations(np.asarray(sol.ts), values, "state", 0.02)
    it = dvi.identify(dvi.Model(dvi.System(top), h=H, **start), data, library)
    assert it.terms == ("ninth",)
    assert abs(it.coefficients[0] - 4) < 4 * it.sigma[0] < 1


@pytest.mark.parametrize("first", ["cubic", pytest.param("friction", marks=pytest.mark.slow)])
def test_a_term_that_was_removed_by_mistake_returns(first, monkeypatch):
    """The removal of the weakest term is a guess: an exchange or an addition corrects it."""
    library, weakest = SMALL.only(["spring", "friction", "cubic"]), Elimination._weakest

    def mistaken(self, u, J, keep, spectrum):
        return (
            self.library.names.index(first)
            if len(self.path) == 1
            else weakest(self, u, J, keep, spectrum)
        )

    planted = {"friction": 0.05, "cubic": 0.3}
    truth = dvi.System(H_D, force=library.with_coefficients(planted))
    data = observed(truth, [1.2], [0.0], 100, 0)
    monkeypatch.setattr(Elimination, "_weakest", mistaken)
    it = dvi.identify(dvi.Model(FREE, h=H, q0=[1.2], p0=[0.0]), data, library)
    assert it.path[1].removed == first
    assert set(it.terms) == set(planted)
    best = min(it.path, key=lambda step: step.criterion)
    assert best.terms == it.terms
    assert not any(rise < 0 for pairs in it.alternatives.values() for _, rise in pairs)


@pytest.mark.slow
def test_an_identification_says_that_residuals_contradict_sigma():
    data = observed(
        dvi.System(H_D, force=SMALL.with_coefficients({"cubic": 0.3})), [1.2], [0.0], 100, 0
    )
    incomplete = SMALL.only(["friction"])
    it = dvi.identify(dvi.Model(FREE, h=H, q0=[1.2], p0=[0.0]), data, incomplete, {"q0": [1.2]})
    assert it.fit.status == "converged"
    assert "the residuals contradict sigma: reduced chi² must be 1 ± 0.1 and is" in str(it)


@pytest.mark.slow
def test_an_identification_says_that_a_prior_contradicts_the_data():
    data = observed(
        dvi.System(H_D, force=SMALL.with_coefficients({"cubic": 0.3})), [1.2], [0.0], 100, 0
    )
    for start, is_wrong in ((1.5, True), (1.2, False)):
        it = dvi.identify(
            dvi.Model(FREE, h=H, p0=[0.0]), data, SMALL, {"q0": np.array([1.2])},
            priors={"q0": dvi.Prior(start, 0.03)},
        )  # fmt: skip
        assert ("priors contradict the data" in str(it)) == is_wrong


INVALID_LIBRARIES = [
    (lambda: dvi.ForceLibrary([Q]), TypeError, "must be a dict"),
    (lambda: dvi.ForceLibrary({}), ValueError, "at least one"),
    (lambda: dvi.ForceLibrary({1: H_D}), TypeError, "must be a string"),
    (lambda: dvi.ForceLibrary({"f": lambda q: q}), TypeError, "'f' must take the arguments"),
    (lambda: dvi.ForceLibrary({"f": H_D}, [1.0, 2.0]), ValueError, r"shape \(1,\)"),
    (lambda: ONE.only(["x"]), ValueError, "unknown candidate 'x'"),
    (lambda: ONE.with_coefficients({"x": 1.0}), ValueError, "unknown candidate 'x'"),
    (lambda: ONE + ONE, ValueError, "both libraries"),
    (lambda: ONE(*AT, None), ValueError, r"args\[.coefficients.\]"),
    (lambda: ONE(*AT, {"coefficients": Q}), ValueError, r"shape \(20,\)"),
    (lambda: TWO(*AT, {"coefficients": jnp.ones(20)}), ValueError, r"shape \(2,\), got shape"),
    (lambda: SCALAR(*AT, None), ValueError, r"'f'.* shape \(1,\), got shape \(\)"),
    (lambda: dvi.ForceLibrary.monomials(0, 1), ValueError, "degree must be"),
    (lambda: dvi.ForceLibrary.monomials(1, 1.0), ValueError, "n must be"),
    (lambda: dvi.ForceLibrary.monomials(1, 1, "pq"), ValueError, "variables"),
]


@pytest.mark.parametrize(("make", "error", "match"), INVALID_LIBRARIES)
def test_invalid_libraries(make, error, match):
    with pytest.raises(error, match=match):
        make()


MODEL = dvi.Model(FREE, h=H, q0=[1.0], p0=[0.0])
FORCED = dvi.System(H_D, force=lambda t0, t1, q, p, args: -q)
INVALID = [
    ({"library": {"q": H_D}}, TypeError, "must be a dvi.ForceLibrary"),
    ({"library": SMALL.with_coefficients({})}, ValueError, "no coefficients"),
    ({"params": {"coefficients": 0.0}}, ValueError, "adds the coefficients"),
    ({"params": [1.0]}, TypeError, "must be a dict"),
    ({"params": {"epsilon": 0.1}}, ValueError, "only their product"),
    ({"penalty": 0.0}, ValueError, "penalty must be a positive"),
    ({"loss": dvi.Likelihood(lambda *a: 0.0)}, TypeError, "by residuals"),
    ({"model": 3}, TypeError, "model must be"),
    ({"model": dvi.Model(FORCED, h=H, q0=[1.0], p0=[0.0])}, ValueError, "epsilon = 0"),
    ({"model": dvi.Model(FREE, h=H, q0=[1.0], p0=[0.0], args=2.0)}, TypeError, "args of the model"),
    ({"optimiser": None}, TypeError, "has no argument 'optimiser'"),
    ({"max_steps": 0}, ValueError, "max_steps must be"),
]


@pytest.mark.parametrize(("change", "error", "match"), INVALID)
def test_invalid_input_of_identify(change, error, match):
    data = dvi.Observations([0.0, 0.1, 0.2, 0.3], [[1.0], [0.9], [0.8], [0.7]], sigma=0.1)
    given = {"model": MODEL, "data": data, "library": SMALL, "params": None, **change}
    with pytest.raises(error, match=match):
        dvi.identify(**given)
