"""Orbital elements along time."""

import numpy as np
import pytest

from dvi_jax import elements, plot

TS = np.linspace(0, 10, 41)
ANGLE = np.angle(np.exp(1j * TS))
ONE = 1.0 + 0 * TS
KEPLER = elements.Keplerian(ONE, 0.1 * ONE, 0.2 * ONE, 0.3 * ONE, ANGLE, ANGLE)


def lines(axis):
    return [line.get_ydata() for line in axis.lines if len(line.get_ydata()) == len(TS)]


def test_labels_and_values():
    """Angles in degrees and without jumps; symbols and units."""
    axes = plot.elements(TS, KEPLER, units={"t": "year", "a": "au"}, title="one")
    assert [axis.get_ylabel() for axis in axes] == ["a [au]", "e", "i [°]", "Ω [°]", "ω [°]"]
    assert (axes[-1].get_xlabel(), axes[0].get_title("left")) == ("time t [year]", "one")
    np.testing.assert_allclose(lines(axes[4])[0], np.degrees(TS), atol=1e-12)
    np.testing.assert_allclose(lines(axes[2])[0], np.degrees(0.2), atol=1e-13)
    kinds = elements.Poincare(*(ONE,) * 6), elements.Equinoctial(*(ONE,) * 6)
    labels = [[axis.get_ylabel() for axis in plot.elements(TS, kind)] for kind in kinds]
    assert labels[0] == ["λ [°]", "η", "q", "Λ", "ξ", "p"]
    assert labels[1][1:] == ["e cos ϖ", "e sin ϖ", "tan(i/2) cos Ω", "tan(i/2) sin Ω"]


def test_many_bodies_and_values_that_are_not_finite():
    a = np.stack([ONE, 2 * ONE], 1)
    omega = np.stack([ANGLE, ANGLE], 1)
    omega[7, 1] = np.nan
    both = elements.Keplerian(a, a, a, a, omega, a)
    axes = plot.elements(TS, both, ("a", "omega"), labels=["b", "c"])
    assert [text.get_text() for text in axes[1].texts] == ["1 of 82 are not finite"]
    assert not axes[0].texts
    first, second = lines(axes[1])
    np.testing.assert_allclose(first, np.degrees(TS), atol=1e-12)
    assert np.isnan(second[7])
    np.testing.assert_allclose(np.delete(second, 7), np.degrees(np.delete(TS, 7)), atol=1e-12)


@pytest.mark.parametrize(("kind", "text", "wrong"), [
    (TypeError, "orbits must be elements", lambda: plot.elements(TS, TS)),
    (ValueError, "each of names must be one of 'a'", lambda: plot.elements(TS, KEPLER, ["inclin"])),
    (ValueError, "must have shape .S,. or", lambda: plot.elements(TS[:3], KEPLER)),
    (ValueError, "names of bodies", lambda: plot.elements(TS, KEPLER, labels=["a", "b"])),
    (TypeError, "unknown keyword 'colour'", lambda: plot.elements(TS, KEPLER, colour=[1.0])),
])  # fmt: skip
def test_bad_input(kind, text, wrong):
    with pytest.raises(kind, match=text):
        wrong()
