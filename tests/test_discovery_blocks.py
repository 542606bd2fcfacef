"""Fast and slow motion together: nothing false is reported without a warning, nothing true lost.

Whether a quantity is conserved is computed here by iterating the map in NumPy.
"""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

SLOW = dvi.Polynomials(4, ["q2", "p2"])
PAIRS = dvi.Polynomials(1, ["q1", "p1"]) * dvi.Polynomials(1, ["q2", "p2"])
BASIS = dvi.Polynomials(2, ["q1", "p1"]) + SLOW + PAIRS
"""Both energies, and products of the coordinates."""


def with_slow(rate, slope, potential, coupling=0.0):
    """The oscillator p1²/2 + q1²/2 and a part that is slower by a rate; the force of the part, and
    the number of steps of both that a list of states takes."""

    def H(t0, t1, q, p, args):
        fast = (p[0] ** 2 + q[0] ** 2) / 2 + coupling * q[0] * q[1]
        return fast + rate * (p[1] ** 2 / 2 + potential(q[1]))

    def orbit(q, p, steps, h=0.1):
        """The map p − h ∂H/∂q, q + h ∂H/∂p, every hundredth state."""
        states = []
        for n in range(steps):
            if n % (steps // 100) == 0:
                states.append((q.copy(), p.copy()))
            p = p - h * np.array([q[0], rate * slope(q[1])])
            q = q + h * np.array([p[0], rate * p[1]])
        return states

    return dvi.System(H), orbit


CASES = {
    "quartic, 1e-3, box of 1000": (1e-3, lambda q: q**3, lambda q: q**4 / 4, 1e3),
    "quartic, 1e-3, box of 1": (1e-3, lambda q: q**3, lambda q: q**4 / 4, 1.0),
    "cubic and quartic, 1e-4, box of 30": (
        1e-4, lambda q: q**2 + q**3, lambda q: q**3 / 3 + q**4 / 4, 30.0),
    "hyperbolic cosine, 1e-6, box of 3": (1e-6, jnp.sinh, jnp.cosh, 3.0),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_an_expansion_of_slow_motion_is_not_taken_for_conserved(name):
    rate, slope, potential, size = CASES[name]
    samples = tuple(size * np.random.default_rng(11).uniform(-1, 1, (2, 60, 2)))
    system, orbit = with_slow(rate, slope, potential)
    found = dvi.discover_invariants(system, BASIS, 0, h=0.1, samples=samples)
    assert found.warnings or found.count == 1
    states = orbit(*(size * np.array([[0.6, 0.8], [0.5, 0.3]])), 2000)
    values = np.array([found.evaluate(q, p, 0.0) for q, p in states])
    ranges = np.ptp(values, axis=0) / np.max(np.abs(values), axis=0)
    assert np.min(ranges) < 1e-11  # that of the fast oscillator is there


@pytest.mark.parametrize("rate", [1e-2, 1e-5, 1e-8])
def test_a_slow_oscillator_is_found_without_a_warning(rate):
    samples = tuple(np.random.default_rng(12).uniform(-1, 1, (2, 60, 2)))
    system, orbit = with_slow(rate, lambda q: q, lambda q: q**2 / 2)
    found = dvi.discover_invariants(system, dvi.Polynomials(2), 0, h=0.1, samples=samples)
    assert (found.count, found.warnings) == (2, ())
    c = np.asarray(found.coefficients[:, 0])
    places = [found.basis.names.index(x) for x in ("q2²", "q2 p2", "p2²")]
    i = int(np.argmax(np.abs(c[:, places[0]])))
    np.testing.assert_allclose(c[i, places], [0.5, -0.05 * rate, 0.5], rtol=1e-6, atol=1e-9)
    states = orbit(np.array([0.6, 0.8]), np.array([0.5, 0.3]), 5000)
    values = np.array([found.evaluate(q, p, 0.0) for q, p in states])
    assert np.max(np.ptp(values, axis=0)) < 1e-9


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
