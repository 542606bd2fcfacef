"""Multipoles about a displaced orbit against derivatives of the kick."""

import jax
import numpy as np
import pytest

from dvi_jax.systems import rings

FIELD = {"b": (1e-3, 0.7, 8.0, 50.0), "a": (2e-3, 0.3, 3.0)}
ORBIT = np.array([1e-3, 2e-3, -2e-3, 1e-3, 0.0, 1e-3])
THIN = rings.multipole("M", 0.0, **FIELD)
CASES = {
    "orbit": THIN,
    "shifted and rolled": THIN.placed(3e-3, -1e-3, 0.4),
    "design": THIN.placed(1e-3, 0.0, 0.1, tilt=0.5),
    "inclined": THIN.placed(1e-3, 0.0, 0.3, ds=1e-3, pitch=1e-4),
}


@pytest.mark.parametrize("name", CASES)
def test_derivatives_of_a_thin_kick(name):
    """−Δpx + iΔpy and its derivatives in the complex direction, in the axes of the design; for a
    magnet that is inclined to the order of its angle."""
    ring = rings.Ring([CASES[name]])
    b, a = rings.feed_down(ring, ORBIT[None])

    x = np.array([-1.5, -0.5, 0.5, 1.5]) * 1e-2
    z = ORBIT + x[:, None] * np.eye(6)[0]
    change = np.asarray(rings.track(ring, z).z) - z
    # The kick is a polynomial of order 3.
    for found, values in ((b, -change[:, 1]), (a, change[:, 3])):
        wanted = np.linalg.solve(x[:, None] ** np.arange(4), values)
        scale = 1e-3 if name == "inclined" else 1e-11
        pair = found[0] * 1e-2 ** np.arange(4), wanted * 1e-2 ** np.arange(4)
        np.testing.assert_allclose(*pair, rtol=scale, atol=1e-3 * scale)


def test_the_mean_along_an_orbit_that_crosses_at_an_angle():
    """A weak magnet, in which the orbit is a line, behind a drift: ⟨x²⟩ is not ⟨x⟩²."""
    weak = rings.multipole("M", 0.8, (0, 0, 1e-6), slices=1).placed(dx=1e-3)
    ring = rings.Ring([rings.drift("D", 1.0), weak, rings.drift("D", 1.0)])
    start = np.array([0.0, 5e-3, 0.0, 0.0, 0.0, 0.0])
    orbit = np.stack([start, start + 5e-3 * np.eye(6)[0], start])
    b, a = rings.feed_down(ring, orbit)
    middle = 5e-3 + 0.4 * 5e-3 - 1e-3
    np.testing.assert_allclose(b[1, 2::-1], 1e-6 * np.array([1, 2 * middle, middle**2 + 4e-6 / 3]))
    assert not np.asarray(b)[[0, 2]].any()
    assert not np.asarray(a).any()


@pytest.mark.slow
def test_the_closed_orbit_of_a_ring_and_derivatives():
    """A displaced quadrupole is a corrector: its dipole, by differences of a strength."""
    ring = rings.Ring([
        rings.quadrupole("QF", 0.5, 0.6, slices=3).placed(dx=1e-4), rings.drift("D", 2.0),
        rings.sextupole("S", 0.1, 5.0, slices=1), rings.quadrupole("QD", 0.5, -0.6, slices=3),
        rings.drift("D", 2.0),
    ])  # fmt: skip
    optics = rings.optics(ring, chromatic=False)
    b, _ = rings.feed_down(ring)
    middle = optics.orbit[2, 0] + 0.05 * optics.orbit[2, 1]
    assert b[2, 1] == pytest.approx(float(10.0 * middle), rel=1e-3)
    slope = jax.jacfwd(lambda k: rings.feed_down(ring.set("S", b2=k), optics.orbit)[0][2, 1])(5.0)
    assert slope == pytest.approx(float(b[2, 1]) / 5, rel=1e-4)
    with pytest.raises(ValueError, match=r"orbit must be a real array of shape \(5, 6\) or"):
        rings.feed_down(ring, np.zeros((3, 6)))
