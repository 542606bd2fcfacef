"""Angles: a rotor is confined, and what has no period is refused, by the search and the checker."""

import copy
import re
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import dvi_jax as dvi

pytest.importorskip("flint")
from dvi_jax.proof import checker as exact

H = 0.05
PENDULUM = dvi.System(
    lambda t0, t1, q, p, args: p @ p / 2 - jnp.sum(jnp.cos(q)),
    force=lambda t0, t1, q, p, args: -jnp.sin(2 * q) / 2,
)


def energy(q, p, epsilon):
    """What the map conserves up to O(h²)."""
    potential = jnp.sum(jnp.cos(q)) + epsilon * jnp.sum(jnp.cos(2 * q)) / 4
    return p @ p / 2 - potential - H / 2 * p @ jnp.sin(q)


def proved(function=energy, system=PENDULUM, **options):
    domain = np.array([np.pi]), np.array([3.0])
    given = {"h": H, "epsilon": 0.01, "domain": domain, "periodic": True, "change": 0.5}
    return dvi.bound_drift(function, system, **(given | {"ratio": 4.0} | options))


@pytest.fixture(scope="module")
def rotor():
    return proved()


@pytest.mark.slow
def test_a_rotor_is_confined(rotor):
    """Also above the separatrix, whose energy is 1; without `periodic` below it only."""
    _, level = rotor.level
    assert level > 2
    assert rotor.steps > 200
    assert "stay there for" in exact.check(rotor.certificate)
    assert "an angle q, |q| ≤" in str(rotor)
    assert proved(periodic=False).level[1] < 1
    # Trajectories that rotate: the energy of each is below its line, and all stay in the domain.
    p = np.linspace(2.2, 2.5, 8)[:, None]
    q = np.linspace(-0.5, 0.5, 8)[:, None]
    steps = rotor.steps
    run = jax.jit(jax.vmap(lambda q, p: dvi.integrate(
        PENDULUM, q, p, h=H, num_steps=steps, epsilon=0.01
    )))  # fmt: skip
    sol = run(q, p)
    starts = jax.vmap(lambda q, p: energy(q, p, 0.01))(q, p)
    assert float(jnp.min(starts)) > 1.1
    assert float(jnp.max(starts)) <= rotor.level[1]
    assert float(jnp.min(sol.qs[:, -1] - q)) > 2 * np.pi
    assert float(jnp.max(jnp.abs(sol.ps))) < 3.0
    values = jax.vmap(jax.vmap(lambda q, p: energy(q, p, 0.01)))(sol.qs, sol.ps)
    drift = np.abs(values - starts[:, None]) / np.maximum(np.arange(steps + 1), 1)
    assert float(np.max(drift)) <= rotor.per_step[0] + rotor.rounding[0]


def test_steps_from_a_start_after_turns(rotor):
    """A computed angle that is larger has less left until the largest one."""
    near, far = (rotor.steps_inside([q], [0.1], 0.0) for q in (0.3, 0.3 + 60 * np.pi))
    assert near > rotor.steps > 0
    assert 0 < far < near
    assert rotor.steps_inside([1e6], [0.1], 0.0) == 0


class Digits:
    """The arithmetic of mpmath for the `run` of the checker."""

    @staticmethod
    def constant(value):
        return mpmath.mpf(value.numerator) / value.denominator

    @staticmethod
    def sum(*terms):
        return sum(terms[1:], terms[0])

    @staticmethod
    def multiply(a, b):
        return a * b

    @staticmethod
    def apply(name, a):
        return 1 / a if name == "inverse" else getattr(mpmath, name)(a)


def test_the_rounding_of_large_angles_is_bounded(rotor):
    c = rotor.certificate
    largest = float.fromhex(c["angles"][0])
    rng = np.random.default_rng(0)
    q = rng.uniform(0.9 * largest, largest, (200, 1))
    p = rng.uniform(-3, 3, (200, 1))
    sol = jax.vmap(
        lambda q, p: dvi.integrate(PENDULUM, q, p, h=H, num_steps=1, epsilon=0.01)
    )(q, p)  # fmt: skip
    worst = 0.0
    with mpmath.workdps(40):
        for i in range(200):
            *x, h = (mpmath.mpf(float(v)) for v in (q[i, 0], p[i, 0], 0.0, 0.01, H))
            step = exact.run(c["step"], [*x, h], Digits)
            computed = [mpmath.mpf(float(v[i, 1, 0])) for v in (sol.qs, sol.ps)]
            values = [
                exact.run(c["invariants"][0], [*z, *x[2:], h], Digits)[0] for z in (step, computed)
            ]
            worst = max(worst, float(abs(values[0] - values[1])))
    assert rotor.rounding[0] / 30 < worst <= rotor.rounding[0]


def coupled(q, p, epsilon):
    return p @ p / 2 - jnp.cos(q[0] - 2 * q[1]) + jnp.exp(jnp.sin(q[0]))


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"function": lambda q, p, e: energy(q, p, e) + 1e-9 * q[0]}, "more than q1|not periodic"),
        ({"function": lambda q, p, e: jnp.cos(q[0] / 2)}, "cos is not periodic"),
        ({"function": lambda q, p, e: jnp.cos(q[0]) * q[0]}, "not periodic"),
        ({"function": lambda q, p, e: jnp.exp(q[0])}, "exp is not periodic"),
        ({"inside": lambda q, p: 10 - q @ q}, "not periodic"),
        ({"system": dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)}, "more than q1"),
        ({"system": dvi.System(lambda t0, t1, q, p, args: p @ p / 2 + q @ p)}, "not periodic|more"),
        ({"domain": np.array([2.0])}, "domain of the angle q1 must be a whole turn"),
        ({"periodic": [True, False]}, r"periodic must be True or a boolean array like q, .*\(1,\)"),
        ({"periodic": 2 * np.pi}, "periodic must be True or a boolean"),
    ],
)
def test_what_is_no_angle(how, message):
    with pytest.raises(ValueError, match=message):
        proved(**how)


@pytest.mark.slow
def test_two_coupled_angles_and_one_that_is_not():
    """Differences of angles, times integers, have the period as well."""
    system = dvi.System(lambda t0, t1, q, p, args: coupled(q, p, 0.0))
    domain = np.full(2, np.pi), np.full(2, 1.0)
    given = {"function": coupled, "system": system, "domain": domain, "max_boxes": 2, "ratio": 50.0}
    bound = proved(**given)
    assert [float.fromhex(x) > 3 for x in bound.certificate["angles"]] == [True, True]
    exact.check(bound.certificate)
    assert proved(**given, periodic=np.array([True, False])).certificate["angles"][1] == "0x0.0p+0"


def changed(certificate, **entries):
    new = copy.deepcopy(certificate) | entries
    return new | {"hash": exact.digest(new)}


@pytest.mark.slow
def test_a_forged_angle_is_refused(rotor):
    c = rotor.certificate
    (lower, upper), (largest,) = c["domain"], (float.fromhex(x) for x in c["angles"])
    rational = [*map(Fraction, (float.fromhex(lower[0]), float.fromhex(upper[0])))]
    assert rational[1] - rational[0] > 2 * Fraction(np.pi)
    forgeries = {
        "a smaller largest angle": ({"angles": [(largest / 10).hex()]}, "an angle may be larger"),
        "a larger one": ({"angles": [(1e6 * largest).hex()]}, "a rounding"),
        "less than a turn": (
            {"domain": [[(-np.pi).hex(), lower[1]], [np.pi.hex(), upper[1]]]},
            "less than a turn",
        ),
        "no angle": ({"angles": [(0.0).hex()]}, "shown|outside"),
        "more steps": ({"steps": 100 * c["steps"]}, "an angle may be larger|not shown"),
        "two angles": ({"angles": c["angles"] * 2}, "not 1 numbers"),
        "a negative angle": ({"angles": [(-largest).hex()]}, "out of range"),
    }
    for name, (entries, message) in forgeries.items():
        with pytest.raises(exact.Failure) as refusal:
            exact.check(changed(c, **entries))
        assert re.search(message, str(refusal.value)), (name, refusal.value)
    # Operations: each function of 2q becomes one of 1.9999 q.
    for name in ("step", "invariants"):
        new = copy.deepcopy(c)
        program = new[name] if name == "step" else new[name][0]
        for operation in program["operations"]:
            if operation == ["constant", (2.0).hex()]:
                operation[1] = (1.9999).hex()
        if new[name] != c[name]:
            with pytest.raises(exact.Failure, match=r"not periodic|a turn changes"):
                exact.check(changed(new))


def test_another_checker_without_the_check_accepts_a_forgery(rotor, monkeypatch):
    """The negative control: what refuses a forged invariant is the check of its period alone."""
    c = copy.deepcopy(rotor.certificate)
    program = c["invariants"][0]
    program["operations"] += [
        ["input", 0], ["constant", (1e-12).hex()],
        ["multiply", len(program["operations"]), len(program["operations"]) + 1],
    ]  # fmt: skip
    size = len(program["operations"])
    program["operations"].append(["sum", size - 1, program["outputs"][0]])
    program["outputs"] = [size]
    with pytest.raises(exact.Failure, match="a turn changes more than q1"):
        exact.check(changed(c))
    monkeypatch.setattr(exact.Checker, "require_angle", lambda self, i: None)
    wider = {"per_step": [(1.01 * rotor.per_step[0]).hex()], "rounding": [(1e-9).hex()]}
    assert "a step changes I" in exact.check(changed(c, **wider, level=None))
