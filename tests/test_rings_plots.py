"""Pictures of storage rings: what is drawn, by numbers."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from pictures import closed, legend, refuses, texts  # noqa: F401

from dvi_jax import plot
from dvi_jax.systems import rings

close = np.testing.assert_allclose


def cell(pieces=1):
    """A FODO cell with bends, a sextupole and a thin octupole, its elements in pieces."""

    def parts(make, name, length, *args, **how):
        return [make(f"{name}{i}", length / pieces, *args, **how) for i in range(pieces)]

    return rings.Ring(
        [
            *parts(rings.quadrupole, "QF", 0.5, 0.6),
            *parts(rings.drift, "D", 1.0),
            *parts(rings.bend, "B", 1.5, 0.2 / pieces),
            *parts(rings.quadrupole, "QD", 0.5, -0.6),
            *parts(rings.sextupole, "SD", 0.1, -2.0),
            rings.octupole("O", 0.0, 5.0),
            *parts(rings.drift, "D", 2.4),
        ]
    )


@pytest.fixture(scope="module")
def optics():
    return rings.optics(cell(), chromatic=False)


def test_twiss_draws_the_functions_inside_of_the_elements(optics):
    axes = plot.twiss(cell(), optics)
    fine = rings.optics(cell(2), chromatic=False)
    right = axes[0].figure.axes[2]
    curves = [*axes[0].lines, *right.lines]
    assert len(curves) == 3  # no vertical dispersion
    for line, values in zip(curves, (*fine.beta.T, fine.dispersion[:, 0]), strict=True):
        s, curve = line.get_data()
        inside = np.interp(fine.s, s, curve)
        close(inside, values, atol=1e-3 * np.max(values))
        # The polygon through the ends of the elements would be wrong.
        ends = np.interp(fine.s, optics.s, np.interp(optics.s, s, curve))
        assert np.max(np.abs(ends - values)) > 1e-2 * np.max(values)
    assert legend(axes[0])[3:] == ["bend", "quadrupole", "sextupole", "other multipole"]


def test_magnets_are_where_they_are_and_their_signs_are_seen(optics):
    boxes = [
        (b.get_x(), b.get_width(), b.get_y(), b.get_y() + b.get_height())
        for b in plot.twiss(cell(), optics)[1].patches
    ]
    wanted = [
        (0.0, 0.5, 0.0, 1.0),  # focusing in x
        (1.5, 1.5, -0.45, 0.45),
        (3.0, 0.5, -1.0, 0.0),
        (3.5, 0.1, -0.75, 0.0),
        (3.6, 0.0, 0.0, 0.55),
    ]
    close(boxes, wanted, atol=1e-12)
    refuses(plot.twiss, ((cell(2), optics), {}, r"must be those of this ring; got s of shape"))


def frequencies():
    """Tunes near (0.3, 0.4) on a grid of 4 × 3 initial conditions, one of them lost."""
    x, y = np.meshgrid(np.linspace(1e-3, 4e-3, 4), np.linspace(0, 2e-3, 3))
    D = np.arange(-12.0, 0.0).reshape(3, 4)
    D[1, 2] = np.nan
    tune = np.stack([0.295 + x**2 * 1e3, 0.4 + y], -1)
    tune[1, 2] = np.nan
    return x, y, SimpleNamespace(diffusion=D, tune=tune)


def test_a_tune_map_draws_both_planes():
    x, y, result = frequencies()
    axes = plot.tune_map(x, y, result, order=3)
    mesh = axes[0].collections[0]
    close(mesh.get_array().filled(np.nan), result.diffusion)
    close(mesh.get_coordinates()[0, :, 0], [0.5, 1.5, 2.5, 3.5, 4.5])  # mm
    close(axes[1].collections[0].get_offsets(), result.tune[np.isfinite(result.diffusion)])
    assert texts(axes[1]) == ["(2, 1, 1)"]
    (line,) = axes[1].lines
    for a, b in (line.get_xy1(), line.get_xy2()):
        assert 2 * a + b == pytest.approx(1)
    # Without a grid each initial condition is a point.
    one = plot.tune_map(x.ravel(), y.ravel(), rings.FrequencyMap(
        result.tune.reshape(-1, 2), None, result.diffusion.ravel()))  # fmt: skip
    close(one[0].collections[0].get_offsets()[0], [1.0, 0.0])
    refuses(plot.tune_map, ((x[:2], y[:2], result), {}, r"diffusion of shape \(3, 4\)"))


def test_resonances_are_those_that_cross_the_tunes_each_once():
    Q = np.array([[0.30, 0.40], [0.35, 0.52]])
    result = SimpleNamespace(diffusion=np.array([-9.0, -3.0]), tune=Q)
    names = texts(plot.tune_map(np.ones(2), np.ones(2), result)[1])
    shown = {tuple(map(int, name.replace("−", "-").strip("()").split(","))) for name in names}
    assert len(shown) == len(names)
    assert {(0, 2, 1), (3, 0, 1), (2, 1, 1)} <= shown
    grid = np.stack(np.meshgrid(*(np.linspace(*q, 301) for q in Q.T)), -1)
    for m, n, k in itertools.product(range(-4, 5), repeat=3):
        if 0 < abs(m) + abs(n) <= 4 and np.gcd.reduce([m, n, k]) == 1:
            distance = grid @ [m, n] - k
            crosses = distance.min() <= 0 <= distance.max()
            assert crosses == bool({(m, n, k), (-m, -n, -k)} & shown)
    assert (0, 4, 2) not in shown  # it is (0, 2, 1)


def test_a_resonance_of_tunes_is_a_line_with_its_integer_on_the_right():
    axis = plot.frequency_map(np.array([0.2, 0.4]), np.array([0.1, 0.5]), resonances=[(1, 2, 1)])
    (label,) = axis.texts
    assert label.get_text() == "(1, 2, 1)"
    assert label.xy[0] + 2 * label.xy[1] == pytest.approx(1)
    refuses(
        plot.frequency_map,
        ((np.ones(2), np.ones(2)), {"resonances": [(0, 0, 1)]}, "not both 0"),
    )
