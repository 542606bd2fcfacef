"""Fast and slow motion together: nothing false is reported without a warning, nothing true lost.

Whether a quantity is conserved is computed here by iterating the map in NumPy.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

SLOW = dvi.Polynomials(4, ["q2", "p2"])
PAIRS = dvi.Polynomials(1, ["q1", "p1"]) * dvi.Polynomials(1, ["q2", "p2"])
BASIS = dvi.Polynomials(2, ["q1", "p1"]) + SLOW + PAIRS
"""Both energies, and products of the coordinates."""


def potential(q, a):
    powers = a["square"] * q**2 / 2 + a["cube"] * q**3 / 3 + a["fourth"] * q**4 / 4
    return powers + a["root"] * jnp.sqrt(1 + q**2)


def H(t0, t1, q, p, a):
    fast = (p[0] ** 2 + q[0] ** 2) / 2 + a["coupling"] * q[0] * q[1]
    return fast + a["rate"] * (p[1] ** 2 / 2 + potential(q[1], a))


SYSTEM = dvi.System(H)
"""The oscillator p1²/2 + q1²/2 and a part that is slower by a rate. The searches of a test take one
compiled program, so that cases are in loops."""


def arguments(rate, coupling=0.0, **parts):
    names = "square", "cube", "fourth", "root"
    values = {"rate": rate, "coupling": coupling} | {x: parts.get(x, 0.0) for x in names}
    return {name: jnp.asarray(value, float) for name, value in values.items()}


def slope(q, a):
    powers = a["square"] * q + a["cube"] * q**2 + a["fourth"] * q**3
    return powers + a["root"] * q / np.sqrt(1 + q**2)


def orbit(q, p, steps, a, h=0.1):
    """The map p − h ∂H/∂q, q + h ∂H/∂p, every hundredth state."""
    states, a = [], {name: float(value) for name, value in a.items()}
    for n in range(steps):
        if n % (steps // 100) == 0:
            states.append((q.copy(), p.copy()))
        c = a["coupling"]
        p = p - h * np.array([q[0] + c * q[1], a["rate"] * slope(q[1], a) + c * q[0]])
        q = q + h * np.array([p[0], a["rate"] * p[1]])
    return jnp.asarray(states).swapaxes(0, 1)


def found_in(basis, size, a, seed):
    samples = tuple(size * np.random.default_rng(seed).uniform(-1, 1, (2, 60, 2)))
    return dvi.discover_invariants(SYSTEM, basis, 0, h=0.1, samples=samples, args=a)


# Rate, parts of the potential, coupling, size of the box.
CASES = {
    "quartic, 1e-3, box of 1000": (1e-3, {"fourth": 1.0}, 0.0, 1e3),
    "quartic, 1e-3, box of 1": (1e-3, {"fourth": 1.0}, 0.0, 1.0),
    "cubic and quartic, 1e-4, box of 30": (1e-4, {"cube": 1.0, "fourth": 1.0}, 0.0, 30.0),
    "square root, 1e-6, box of 3": (1e-6, {"root": 1.0}, 0.0, 3.0),
    "quartic, 1e-3, coupled by 1e-12": (1e-3, {"fourth": 1.0}, 1e-12, 1.0),
    "quartic, 1e-6, coupled by 1e-8": (1e-6, {"fourth": 1.0}, 1e-8, 1.0),
    "quartic, 1e-6, coupled more than it moves": (1e-6, {"fourth": 1.0}, 1e-5, 1.0),
    "cubic and quartic, 1e-4, coupled by 1e-14": (1e-4, {"cube": 1.0, "fourth": 1.0}, 1e-14, 3.0),
    "quartic, 1e-5, coupled by 1e-12, box of 30": (1e-5, {"fourth": 1.0}, 1e-12, 30.0),
}


@pytest.mark.slow
def test_an_expansion_of_slow_motion_is_not_taken_for_conserved():
    for name, (rate, parts, coupling, size) in CASES.items():
        a = arguments(rate, coupling, **parts)
        found = found_in(BASIS, size, a, 11)
        assert found.warnings or (found.count == 1 and not coupling), name
        states = orbit(*(size * np.array([[0.6, 0.8], [0.5, 0.3]])), 2000, a)
        values = np.asarray(jax.vmap(found.evaluate, (0, 0, None))(*states, 0.0))
        ranges = np.ptp(values, axis=0) / np.max(np.abs(values), axis=0)
        assert np.min(ranges) < max(1e-11, coupling), name  # that of the fast oscillator is there


# Rate and coupling.
LINEAR = ((1e-2, 0), (1e-5, 0), (1e-8, 0), (1e-3, 1e-14), (1e-6, 1e-12), (1e-4, 1e-8), (1e-6, 1e-4))


def test_a_slow_oscillator_is_found_without_a_warning():
    for rate, coupling in LINEAR:
        a = arguments(rate, coupling, square=1.0)
        found = found_in(dvi.Polynomials(2), 1.0, a, 12)
        assert (found.count, found.warnings) == (2, ())
        c = np.asarray(found.coefficients[:, 0])
        places = [found.basis.names.index(x) for x in ("q2²", "q2 p2", "p2²")]
        i = int(np.argmax(np.abs(c[:, places[0]])))
        if not coupling:
            slow = [0.5, -0.05 * rate, 0.5]
            np.testing.assert_allclose(c[i, places], slow, rtol=1e-6, atol=1e-9)
        states = orbit(np.array([0.6, 0.8]), np.array([0.5, 0.3]), 5000, a)
        values = np.asarray(jax.vmap(found.evaluate, (0, 0, None))(*states, 0.0))
        assert np.max(np.ptp(values, axis=0)) < 1e-9


FIELDS = dvi.Polynomials(1, ["q1", "p1"]) + dvi.Polynomials(3, ["q2", "p2"], constant=True)
# Rate, parts, coupling, size of the box, whether the symmetries are exact.
OF_FIELDS = {
    "quartic, 1e-3": (1e-3, {"fourth": 1.0}, 0.0, 1.0, False),
    "quartic, 1e-4": (1e-4, {"fourth": 1.0}, 0.0, 1.0, False),
    "quartic, 1e-6, box of 100": (1e-6, {"fourth": 1.0}, 0.0, 100.0, False),
    "quartic, 1e-4, coupled by 1e-12": (1e-4, {"fourth": 1.0}, 1e-12, 1.0, False),
    "quartic, 1e-6, coupled by 1e-9": (1e-6, {"fourth": 1.0}, 1e-9, 1.0, False),
    "oscillator, 1e-2": (1e-2, {"square": 1.0}, 0.0, 1.0, True),
    "oscillator, 1e-4": (1e-4, {"square": 1.0}, 0.0, 1.0, True),
    "oscillator, 1e-3, coupled by 1e-4": (1e-3, {"square": 1.0}, 1e-4, 1.0, True),
}


@pytest.mark.slow
def test_a_field_along_slow_motion_is_not_taken_for_a_symmetry():
    """Of the slow oscillator the field of its energy is one, of the quartic one an expansion."""
    for name, (rate, parts, coupling, size, is_exact) in OF_FIELDS.items():
        samples = tuple(size * np.random.default_rng(5).uniform(-1, 1, (2, 120, 2)))
        how = {"h": 0.1, "samples": samples, "time": False}
        found = dvi.find_symmetries(SYSTEM, FIELDS, args=arguments(rate, coupling, **parts), **how)
        if is_exact:
            assert (found.warnings, found.count > 3) == ((), True), name
        else:  # rotation and dilation of the fast oscillator
            assert found.warnings or found.count == 2, name


@pytest.mark.parametrize(("rate", "size"), [(1e-4, 1000.0), (1e-6, 100.0)])
def test_unequal_steps_of_positions_and_momenta(rate, size):
    """One slow oscillator alone: its samples lie near turning points, where a step is large for p
    and small for q. What the map conserves there to rounding is an expansion."""
    samples = tuple(size * np.random.default_rng(13).uniform(-1, 1, (2, 60, 1)))

    def quartic(t0, t1, q, p, args):
        return rate * (p @ p / 2 + jnp.sum(q**4) / 4)

    found = dvi.discover_invariants(dvi.System(quartic), dvi.Polynomials(4), h=0.1, samples=samples)
    assert any("samples of p lie close" in x or "the step is small" in x for x in found.warnings)
    assert [x.kind for x in found.larger] == ["p", "step"]


def test_blocks_are_degrees_of_freedom_that_the_map_does_not_couple(tmp_path):
    """A slow pair (2, 4) among two oscillators: its total momentum and both energies."""
    samples = tuple(np.random.default_rng(14).uniform(-1, 1, (2, 120, 4)))

    def H(t0, t1, q, p, args):
        pair = p[1] ** 2 / 2 + p[3] ** 2 / 2 + jnp.cosh(q[1] - q[3])
        return (p[0] ** 2 + q[0] ** 2) / 2 + 0.3 * (p[2] ** 2 + q[2] ** 2) + 1e-4 * pair

    found = dvi.discover_invariants(dvi.System(H), dvi.Polynomials(2), h=0.1, samples=samples)
    assert {x.coordinates for x in found.larger if x.coordinates} == {"q2, p2, q4, p4"}
    assert {i.formula(2) for i in found.invariants} >= {"0.5 p2 + 0.5 p4"}
    assert (found.count, found.warnings) == (3, ())
    found.save(tmp_path / "found.npz")
    assert dvi.Discovery.load(tmp_path / "found.npz", dvi.Polynomials(2)).larger == found.larger
