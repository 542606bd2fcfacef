"""Pictures of orbits, sections, spectra and costs: what is drawn, where, and what is refused."""

import importlib.util
import inspect
import itertools
import re
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.animation
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex, to_rgb
from PIL import Image

import dvi_jax as dvi
from dvi_jax import plot, systems
from dvi_jax.plot import films
from dvi_jax.plot.axes import envelope
from dvi_jax.plot.style import MARKERS, SHADES

mpl.use("Agg")

RNG = np.random.default_rng(0)


@pytest.fixture(autouse=True)
def closed():
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def batch():
    """Three Kepler orbits, of which the last starts in the centre and fails at once."""
    kepler = systems.kepler()
    section = dvi.Section(lambda t, q, p, args: q[0], direction=1, max_crossings=3)

    def run(y):
        return dvi.integrate(
            kepler.system, jnp.stack([0 * y, y]), kepler.p0, h=0.1, num_steps=60, args=kepler.args,
            method=dvi.Strang(), throw=False,
            observe={**kepler.observables, "largest": dvi.MaxDrift(kepler.observables["energy"]),
                     "section": section},
        )  # fmt: skip

    return jax.vmap(run)(jnp.array([1.2, 0.7, 0.0]))


@pytest.fixture(scope="module")
def single(batch):
    return jax.tree.map(lambda x: x[0], batch)


def arrays(lanes=None, n=1, steps=50, shape=None):
    """(ts, qs, ps) of circles of radii 1, 2, …"""
    t = np.linspace(0, 6, steps)
    radii = np.arange(1, (lanes or 1) + 1)[:, None, None] * np.ones(n)
    q, p = radii * np.cos(t)[:, None], -radii * np.sin(t)[:, None]
    ts = np.broadcast_to(t, (lanes or 1, steps))
    found = (ts, q, p) if shape is None else (ts, *(x.reshape(*ts.shape, *shape) for x in (q, p)))
    return found if lanes else tuple(x[0] for x in found)


def lines(axis, least=2):
    """Lines of at least so many points, as arrays of their coordinates."""
    found = [np.asarray(line.get_data()) for line in axis.lines]
    return [xy for xy in found if xy.shape[-1] >= least and len(np.unique(xy[0])) > 1]


def legend(axis):
    found = axis.get_legend() or next(iter(axis.figure.legends), None)
    return [] if found is None else [text.get_text() for text in found.get_texts()]


# --- the style ----------------------------------------------------------------------------------

# Machado, Oliveira & Fernandes 2009, IEEE Trans. Vis. Comput. Graph. 15, 1291: severity 1, in
# linear RGB.
SIGHTS = {
    "normal": np.eye(3),
    "protanopia": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                            [-0.003882, -0.048116, 1.051998]]),
    "deuteranopia": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                              [-0.011820, 0.042940, 0.968881]]),
    "tritanopia": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                            [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip
SRGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
     [0.0193339, 0.1191920, 0.9503041]]
)  # fmt: skip


def lab(colours, sight):
    """CIELAB coordinates of colours as eyes of a kind see them, shape (count, 3)."""
    c = np.array([to_rgb(x) for x in colours])
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(linear @ SIGHTS[sight].T, 0, 1) @ SRGB.T / SRGB.sum(1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack(
        [116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1
    )


def nearest(colours, sight):
    x = lab(colours, sight)
    distances = np.linalg.norm(x[:, None] - x[None], axis=-1)
    return distances[np.triu_indices(len(x), 1)].min()


@pytest.mark.parametrize("sight", SIGHTS)
def test_colours_differ_for_all_eyes(sight):
    """2.3 is just noticeable side by side; matplotlib's own are within 8 of one another."""
    assert nearest(plot.COLOURS, sight) > 15
    if sight == "deuteranopia":
        assert nearest(["#d62728", "#2ca02c", "#8c564b"], sight) < 8


@pytest.mark.parametrize("sight", SIGHTS)
def test_shades_grow_lighter_evenly_and_stay_visible_on_paper(sight):
    lightness = lab(SHADES(np.linspace(0, 1, 64)), sight)[:, 0]
    assert (np.diff(lightness) > 0.5).all()
    assert lightness[-1] < 84
    assert lab(plt.get_cmap("viridis")([1.0]), sight)[0, 0] > 88


def test_lines_differ_in_a_black_and_white_print():
    lightness = lab(plot.COLOURS, "normal")[:, 0]
    assert (np.diff(lightness[:5]) > 3).all()
    assert len(set(plot.DASHES)) == len(plot.DASHES) == len(plot.COLOURS)
    assert len(set(MARKERS)) >= len(plot.COLOURS)
    axis = plot.phase_portrait(arrays(5))
    drawn = [line for line in axis.lines if line.get_linestyle() != "None"]
    assert len({str(line._dash_pattern) for line in drawn}) == 5
    assert len({line.get_marker() for line in drawn}) == 5
    assert [line.get_color() for line in drawn] == list(plot.COLOURS[:5])


def test_orbits_that_retrace_themselves_are_told_apart_by_marks():
    """Dashes of many turns fill one another up; marks at different places do not."""
    t = np.linspace(0, 80 * np.pi, 4001)
    q = np.stack([k * np.cos(t) for k in (1, 2, 3)])[..., None]
    p = np.stack([-k * np.sin(t) for k in (1, 2, 3)])[..., None]
    axis = plot.phase_portrait((np.broadcast_to(t, (3, 4001)), q, p), labels=["a", "b", "c"])
    drawn = [line for line in axis.lines if line.get_linestyle() != "None"]
    marks = [line.get_marker() for line in drawn]
    assert len(set(marks)) == 3
    assert not {"None", "o", "x"} & set(marks)
    handles = axis.figure.legends[0].legend_handles[:3]
    assert [handle.get_marker() for handle in handles] == marks
    for line in drawn:
        first, step = line.get_markevery()
        assert 8 <= len(range(first, 4001, step)) <= 10
    eight = np.stack([np.cos(t), np.sin(2 * t)] * 3, 1).reshape(-1, 3, 2)
    bodies = plot.orbit((t, eight), names=["A", "B", "C"])
    drawn = [line for line in bodies.lines if line.get_linestyle() != "None"]
    assert len({line.get_marker() for line in drawn}) == 3
    assert len({line.get_markevery() for line in drawn}) == 3
    for plain in (plot.phase_portrait(arrays()), plot.phase_portrait(arrays(9))):
        assert {x.get_marker() for x in plain.lines if x.get_linestyle() != "None"} == {"None"}


def test_pictures_have_the_style_and_leave_the_user_his_own():
    axis = plot.phase_portrait(arrays())
    assert not axis.spines["top"].get_visible()
    assert plt.rcParams["axes.spines.top"]  # nothing global is changed
    with plot.style(), mpl.rc_context({"axes.labelsize": 21}):
        assert plot.phase_portrait(arrays()).xaxis.label.get_size() == 21
    assert plot.phase_portrait(arrays()).xaxis.label.get_size() == 10


def test_a_backend_that_a_first_figure_makes_interactive_stays_so():
    """In Jupyter the first figure turns interactive mode on, perhaps inside of the style."""
    before = mpl.is_interactive()
    try:
        for value in (True, False):
            mpl.interactive(not value)
            with plot.style():
                mpl.interactive(value)
            assert mpl.is_interactive() is value
    finally:
        mpl.interactive(before)


def test_save_takes_what_the_pictures_return(tmp_path):
    one, several = plot.phase_portrait(arrays()), plot.phase_portrait(arrays(n=2))
    inside = plt.figure().subfigures(1, 2)[0].subplots()
    for drawn in (one, several, one.figure, inside):
        file = plot.save(drawn, tmp_path / "a.png")
        assert Image.open(file).size[0] > 500
    assert not plt.fignum_exists(inside.figure.figure.number)
    with pytest.raises(ValueError, match="2 figures"):
        plot.save([one, several[0]], tmp_path / "b.png")
    with pytest.raises(TypeError, match="a figure or axes"):
        plot.save("picture", tmp_path / "b.png")
    assert not (tmp_path / "b.png").exists()


def test_an_envelope_keeps_the_extremes_and_the_gaps():
    x = np.arange(100_000.0)
    y = np.sin(x)
    y[54_321], y[77_777], y[3_000] = 9.0, np.nan, -7.0
    a, b = envelope(x, y, 4000)
    assert len(a) < 4000
    assert np.nanmax(b) == 9.0
    assert a[np.nanargmax(b)] == 54_321
    assert np.nanmin(b) == -7.0
    assert np.isnan(b).sum() == 1
    assert a[0] == 0
    assert a[-1] == x[-1]
    assert envelope(x[:50], y[:50])[0] is not None
    np.testing.assert_array_equal(envelope(x[:50], y[:50])[1], y[:50])


def single_pictures(single):
    """Every function that draws on one `Axes`, by name."""
    t = np.arange(1.0, 9.0)
    order = types.SimpleNamespace(
        epsilons=t, drifts=t, used=t > 0, slope=1.0, interval=(0.9, 1.1), floor=0.5, resolved=True
    )
    return {
        "phase_portrait": lambda ax: plot.phase_portrait(single, dof=0, ax=ax),
        "orbit": lambda ax: plot.orbit(single, ax=ax),
        "trajectory": lambda ax: plot.trajectory(single, ax=ax),
        "invariants": lambda ax: plot.invariants(t, {"E": t}, ax=ax),
        "conserved": lambda ax: plot.conserved(t, {"E": t}, "t", "", ax=ax),
        "indicator": lambda ax: plot.indicator(t, t, "megno", ax=ax),
        "section": lambda ax: plot.section(single, ax=ax),
        "bifurcation": lambda ax: plot.bifurcation(t, np.ones((8, 3)), ax=ax),
        "work_precision": lambda ax: plot.work_precision({"a": (t, 1 / t)}, ax=ax),
        "spectrum": lambda ax: plot.spectrum(t, t, ax=ax),
        "frequency_map": lambda ax: plot.frequency_map(t, t, ax=ax),
        "drift_orders": lambda ax: plot.drift_orders([order], ax=ax),
    }


@pytest.mark.slow
def test_every_picture_draws_on_the_axes_it_is_given_and_returns_them(single):
    for name, draw in single_pictures(single).items():
        figure, (mine, other) = plt.subplots(1, 2)
        before = plt.get_fignums()
        assert draw(mine) is mine, name
        assert plt.get_fignums() == before, name
        assert mine.has_data(), name
        assert not other.has_data(), name
        assert figure.legends == [], name
        with pytest.raises(TypeError, match="must be the matplotlib Axes"):
            draw(3)
        assert isinstance(draw(None), plt.Axes), name
        plt.close("all")


def public_pictures():
    """Names of the functions that draw on axes."""
    return {
        name for name, f in vars(plot).items()
        if inspect.isfunction(f) and name not in ("save", "style", "animate")
    }  # fmt: skip


def test_every_public_picture_takes_axes():
    assert len(public_pictures()) == 24
    for name in public_pictures():
        assert {"ax", "axes"} & set(inspect.signature(getattr(plot, name)).parameters), name


@pytest.mark.slow
def test_every_public_picture_refuses_what_are_no_axes(single):
    """A `TypeError` before anything is drawn, from all of them."""
    t = np.arange(1.0, 6.0)
    data = xr.DataArray(t, dims="x", coords={"x": t}, name="drift", attrs={
        "flag_values": [0, 1, 2, 3, 4, 5], "flag_meanings": "successful a b c d e"
    })  # fmt: skip
    fit = types.SimpleNamespace(
        whitened=[t[:, None]], ts=[t], chi2=1.0, degrees_of_freedom=3, has_errors=True,
        observed=[t], predicted=[t], errors=[t], names=["a"], x=[1.0], covariance=[[1.0]],
        history={"stage": 0 * t, "loss": t, "accepted": t > 0, "horizon": t},
    )  # fmt: skip
    order = types.SimpleNamespace(resolved=True)
    surface = types.SimpleNamespace(
        epsilons=t, hs=t, drifts=np.ones((5, 5)), used=np.ones((5, 5), bool), slopes=t,
        intervals=np.stack([t, t], 1), orders=[order] * 5,
    )  # fmt: skip
    pictures = single_pictures(single) | {
        "balance": lambda ax: plot.balance(t, t, {"a": t}, ax=ax),
        "changes": lambda ax: plot.changes(t, {"a": t}, "t", "", ax=ax),
        "drift_surface": lambda ax: plot.drift_surface(surface, ax=ax),
        "sweep_map": lambda ax: plot.sweep_map(data, ax=ax),
        "slope_map": lambda ax: plot.slope_map(data, "x", x="x", ax=ax),
        "failure_map": lambda ax: plot.failure_map(data.astype(int), ax=ax),
        "fit_residuals": lambda ax: plot.fit_residuals(fit, axes=ax),
        "fit_corner": lambda ax: plot.fit_corner(fit, axes=ax),
        "fit_against_data": lambda ax: plot.fit_against_data(fit, ax=ax),
        "learning_curve": lambda ax: plot.learning_curve(fit, ax=ax),
        "planet_orbits": lambda ax: plot.planet_orbits(np.ones((4, 5, 3)), list("abcde"), ax=ax),
        "ephemeris_comparison": lambda ax: plot.ephemeris_comparison(
            t, np.ones((5, 1)), ["a"], t, 1.0, 0.0, ax=ax
        ),
    }
    assert set(pictures) == public_pictures()
    for name, draw in pictures.items():
        before = plt.get_fignums()
        for nothing in (3, "axes", [3]):
            with pytest.raises(TypeError, match="must be the matplotlib Axes"):
                draw(nothing)
        assert plt.get_fignums() == before, name
        draw(None)  # what it is given else is right
        plt.close("all")


def test_pictures_of_several_panels_take_as_many_axes():
    t = np.arange(5.0)
    drawn = {
        2: lambda ax: plot.phase_portrait(arrays(n=2), ax=ax),
        3: lambda ax: plot.changes(t, {"a": t, "b": t, "c": t}, "t", "", ax=ax),
    }
    drawn_2 = {
        "balance": lambda ax: plot.balance(t, t, {"a": t}, ax=ax),
        "planets": lambda ax: plot.planet_orbits(RNG.normal(size=(4, 5, 3)), list("abcde"), ax=ax),
    }
    for count, draw in [*drawn.items(), *((2, d) for d in drawn_2.values())]:
        figure, mine = plt.subplots(1, count)
        assert list(draw(mine)) == list(mine)
        assert [a.has_data() for a in figure.axes] == [True] * count
        assert draw(None).shape == (count,)
        assert figure.legends == []
        with pytest.raises(ValueError, match=f"axes must be {count}"):
            draw(list(mine)[:-1])
    errors = RNG.uniform(1, 2, (40, 9))
    mine = plt.subplots(1, 3)[1]
    given = (np.arange(40), errors, list("abcdefghi"), np.arange(40.0), 1.0, 0.0)
    assert list(plot.ephemeris_comparison(*given, ax=mine)) == list(mine)
    planets = plt.subplots(1, 2, figsize=(9, 5))[1]
    plot.planet_orbits(RNG.normal(size=(4, 5, 3)), list("abcde"), ax=planets)
    for axis in (mine[0], *planets):
        axis.figure.canvas.draw()
        assert axis.get_legend().get_window_extent().y0 >= axis.get_window_extent().y0


# --- orbits -------------------------------------------------------------------------------------


def test_a_phase_portrait_draws_the_states_as_they_are(single):
    axes = plot.phase_portrait(single, units={"q": "au", "p": "au/d"})
    assert axes.shape == (2,)
    for i, axis in enumerate(axes):
        np.testing.assert_array_equal(lines(axis)[0], [single.qs[:, i], single.ps[:, i]])
        assert axis.get_xlabel() == f"q$_{{{i + 1}}}$ [au]"
        assert axis.get_ylabel() == f"p$_{{{i + 1}}}$ [au/d]"
    start = [line for line in axes[0].lines if line.get_marker() == "o"]
    np.testing.assert_array_equal(start[0].get_xydata(), [[single.qs[0, 0], single.ps[0, 0]]])
    ts, q, p = arrays()
    (line,) = lines(plot.phase_portrait((ts, q[:, 0], p[:, 0])))  # a state that is one number
    np.testing.assert_array_equal(line, [q[:, 0], p[:, 0]])
    dots = plot.phase_portrait((ts, q, p), dots=True).lines[0]
    assert (dots.get_linestyle(), dots.get_marker()) == ("None", "o")
    assert plot.phase_portrait(arrays(n=2), dof=[1]).shape == (1,)


def test_orbits_that_failed_end_with_a_cross_and_are_counted(batch):
    assert list(np.asarray(batch.status)) == ["successful", "successful", "not_finite"]
    for axis in (plot.phase_portrait(batch, dof=0), plot.orbit(batch), plot.invariants(
        batch, {"size": lambda q, p: q @ q}
    )):  # fmt: skip
        assert "1 of 3 orbits failed: not finite" in legend(axis)
    crosses = [line for line in plot.orbit(batch).lines if line.get_marker() == "x"]
    assert len(crosses) == 1
    np.testing.assert_array_equal(crosses[0].get_xydata(), [[0.0, 0.0]])
    good = plot.orbit(jax.tree.map(lambda x: x[:2], batch))
    assert not any("failed" in text for text in legend(good))
    ts, q, p = arrays(2)
    q = q.copy()
    q[1, 30:] = np.nan  # no status tells it, the numbers do
    axis = plot.phase_portrait((ts, q, p))
    assert "1 of 2 orbits failed: not finite" in legend(axis)
    (cross,) = [line for line in axis.lines if line.get_marker() == "x"]
    np.testing.assert_array_equal(cross.get_xydata(), [[q[1, 29, 0], p[1, 29, 0]]])


def test_a_batch_draws_an_orbit_for_each_lane_whatever_its_axes():
    ts, q, p = arrays(6)
    axis = plot.phase_portrait((ts, q, p), labels=list("abcdef"))
    assert len(lines(axis)) == 6
    assert legend(axis)[:6] == list("abcdef")
    again = plot.phase_portrait(tuple(x.reshape(2, 3, *x.shape[1:]) for x in (ts, q, p)))
    for a, b in zip(lines(axis), lines(again), strict=True):
        np.testing.assert_array_equal(a, b)
    listed = plot.phase_portrait([arrays(steps=20), arrays(steps=30)])
    assert [xy.shape[1] for xy in lines(listed)] == [20, 30]


def test_orbits_are_coloured_by_a_value_and_the_unknown_is_grey():
    values = [1.0, np.nan, 3.0]
    axis = plot.phase_portrait(arrays(3), colour=values, colour_label="MEGNO")
    shown = [to_hex(line.get_color()) for line in axis.lines if line.get_marker() == "None"]
    assert shown == [to_hex(SHADES(0.0)), "#b8b8b8", to_hex(SHADES(1.0))]
    (bar,) = [a for a in axis.figure.axes if a is not axis]
    assert bar.get_ylabel() == "MEGNO"
    assert bar.get_ylim() == (1.0, 3.0)
    assert "1 of 3 orbits have no value" in legend(axis)
    with pytest.raises(ValueError, match="2 values for 3 orbits"):
        plot.phase_portrait(arrays(3), colour=[1, 2])


def test_an_angle_is_folded_with_a_gap_where_it_goes_round():
    t = np.linspace(0, 10, 101)
    axis = plot.phase_portrait((t, t[:, None], 0 * t[:, None]), period=2 * np.pi)
    q, _ = lines(axis)[0]
    assert np.nanmax(np.abs(q)) <= np.pi
    assert np.isnan(q).sum() == 2  # at π and at 3π
    np.testing.assert_allclose(np.exp(1j * q[~np.isnan(q)]), np.exp(1j * t), atol=1e-12)
    assert np.nanmax(lines(plot.phase_portrait((t, t[:, None], 0 * t[:, None])))[0][0]) == 10
    with pytest.raises(ValueError, match="period must be a positive"):
        plot.phase_portrait(arrays(), period=0)


def test_level_lines_are_those_of_the_hamiltonian_at_the_first_start():
    def H(q, p):
        return (q @ q + p @ p) / 2

    axis = plot.phase_portrait(arrays(n=2), dof=0, hamiltonian=H, levels=[0.7, 0.9])
    (contours,) = axis.collections
    np.testing.assert_array_equal(contours.levels, [0.7, 0.9])
    assert contours.get_zorder() < min(line.get_zorder() for line in axis.lines)
    for level, path in zip([0.7, 0.9], contours.get_paths(), strict=True):
        radii = np.hypot(*path.vertices.T)
        # The other degree of freedom is at (1, 0), its energy ½.
        np.testing.assert_allclose(radii, np.sqrt(2 * (level - 0.5)), rtol=2e-3)
    assert "levels of H" in legend(axis)
    assert not list(plot.phase_portrait(arrays(n=2), dof=0).collections)
    with pytest.raises(ValueError, match=r"one state, it returned shape \(2,\)"):
        plot.phase_portrait(arrays(n=2), dof=0, hamiltonian=lambda q, p: q)


def test_orbits_have_one_scale_in_the_plane_and_in_space(single):
    axis = plot.orbit(single, centre=[0.5, 0.0], units={"q": "au"})
    np.testing.assert_array_equal(lines(axis)[0], single.qs.T)
    assert axis.get_aspect() == 1
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("q$_{1}$ [au]", "q$_{2}$ [au]")
    (star,) = [line for line in axis.lines if line.get_marker() == "*"]
    np.testing.assert_array_equal(star.get_xydata(), [[0.5, 0.0]])
    t = np.linspace(0, 20, 200)
    qs = np.stack([np.cos(t), np.sin(t), t], 1)
    space = plot.orbit((t, qs))
    np.testing.assert_array_equal(space.lines[0].get_data_3d(), qs.T)
    sides = [np.ptp(getattr(space, f"get_{which}lim")()) for which in "xyz"]
    box = space.get_box_aspect() if hasattr(space, "get_box_aspect") else None
    box = space._box_aspect if box is None else box
    np.testing.assert_allclose(box / np.max(box), sides / np.max(sides), rtol=1e-6)
    assert min(sides) > 0.4 * max(sides)
    assert lines(plot.orbit((t, qs), coordinates=(2, 0)))[0][0, -1] == 20
    with pytest.raises(ValueError, match='projection="3d"'):
        plot.orbit((t, qs), ax=plt.subplots()[1])
    with pytest.raises(ValueError, match="axes in space"):
        plot.orbit((t, qs), (0, 1), ax=plt.figure().add_subplot(projection="3d"))


def test_bodies_are_drawn_by_name_about_one_of_them():
    ts, q, _ = arrays(n=6, shape=(3, 2))
    q = q + np.arange(3)[:, None] + 0.1 * RNG.normal(size=q.shape)
    axis = plot.orbit((ts[0] if ts.ndim > 1 else ts, q.reshape(50, 3, 2)), names=["A", "B", "C"])
    assert legend(axis) == ["A", "B", "C", "start"]
    about = plot.orbit((np.ravel(ts), q.reshape(50, 3, 2)), centre=1)
    q = q.reshape(50, 3, 2)
    np.testing.assert_array_equal(lines(about)[0], (q[:, 0] - q[:, 1]).T)
    np.testing.assert_array_equal(lines(about)[1], (q[:, 2] - q[:, 1]).T)
    assert about.get_xlabel() == "x − x$_{2}$"
    assert len(lines(plot.orbit((np.ravel(ts), q), bodies=[2]))) == 1


@pytest.mark.parametrize(
    ("given", "error", "match"),
    [
        (
            (np.arange(5.0), np.ones((4, 2)), np.ones((4, 2))),
            ValueError,
            r"ts of shape \(5,\), qs of shape \(4, 2\)",
        ),
        (
            (np.arange(5.0), np.ones((5, 2)), np.ones((5, 3))),
            ValueError,
            r"qs of shape \(5, 2\), ps of shape \(5, 3\)",
        ),
        ((np.arange(4.0), np.ones((2, 4, 1)), None), ValueError, "broadcast_to"),
        ((1.0, np.ones(2), np.ones(2)), ValueError, r"ts of shape \(\), qs of shape \(2,\)"),
        ((np.arange(3.0), np.ones((3, 1)) * 1j, np.ones((3, 1))), TypeError, "complex"),
        ((np.arange(3.0), np.ones((3, 1))), TypeError, "needs momenta"),
        (np.ones((3, 1)), TypeError, "must be a Solution"),
        ([], ValueError, "no orbit"),
        ([arrays(n=1), arrays(n=2)], ValueError, r"shapes \[\(1,\), \(2,\)\]"),
        (arrays(n=7), ValueError, "7 degrees of freedom and room for 6"),
    ],
)
def test_states_that_do_not_fit_are_named(given, error, match):
    with pytest.raises(error, match=match):
        plot.phase_portrait(given)


def test_choices_that_are_not_there_are_named():
    two, bodies = arrays(n=2), arrays(n=6, shape=(3, 2))
    for kwargs, match in [
        ({"dof": 2}, r"has no component 2; take one number from 0 to 1"),
        ({"dof": "q"}, "has no component 'q'"),
        ({"dof": []}, "dof is empty"),
        ({"labels": ["a", "b"]}, "2 names for 1 orbits"),
        ({"labels": "ab"}, "1 names for 1 orbits"),
    ]:
        with pytest.raises(ValueError, match=match):
            plot.phase_portrait(two, **kwargs)
    with pytest.raises(ValueError, match="a tuple of 2 numbers"):
        plot.phase_portrait(bodies, dof=0)
    for orbits, kwargs, match in [
        (arrays(n=1), {}, "phase_portrait draws a single one"),
        (arrays(n=4), {}, r"coordinates=\(0, 1\)"),
        (two, {"coordinates": (0, 2)}, "from 0 to 1"),
        (two, {"coordinates": (0,)}, "two or three"),
        (two, {"centre": 0}, "there are none"),
        (two, {"centre": [1.0]}, r"shape \(2,\)"),
        (two, {"colour": [1.0]}, "one orbit"),
        (bodies, {"bodies": [3]}, "from 0 to 2"),
        (bodies, {"names": ["A"]}, "1 names for 3 bodies"),
        (arrays(2, n=2), {"names": ["A", "B"]}, r"2 orbits.*labels="),
    ]:
        with pytest.raises(ValueError, match=match):
            plot.orbit(orbits, **kwargs)


def test_a_trajectory_is_drawn_as_its_shape_suggests(single):
    assert plot.trajectory(arrays()).get_xlabel() == "q"
    np.testing.assert_array_equal(lines(plot.trajectory(single))[0], single.qs.T)
    ts, q, p = arrays(n=4)
    axis = plot.trajectory(ts, q, p, time="t [s]", position="m")
    assert len(lines(axis)) == 4
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("t [s]", "q [m]")
    with pytest.raises(ValueError, match="one orbit, got 2"):
        plot.trajectory(arrays(2))


def test_a_long_line_is_drawn_whole_in_pieces():
    ts, q, p = arrays(steps=50_001)
    drawn = lines(plot.phase_portrait((ts, q, p)))
    assert [xy.shape[1] for xy in drawn] == [20_001, 20_001, 10_001]
    np.testing.assert_array_equal(drawn[1][:, 0], drawn[0][:, -1])
    assert sum(xy.shape[1] - 1 for xy in drawn) == 50_000


# --- along time ---------------------------------------------------------------------------------


def test_invariants_are_changes_since_the_first_value(single):
    axes = plot.invariants(single, units={"t": "d"})
    names = ["energy", "mixed energy", "angular momentum"]
    found = sorted(axis.get_ylabel().splitlines()[0] for axis in axes)
    assert found[:1] == ["angular momentum"]
    assert set(names) <= set(found)  # "largest" and "section" have no value per step
    (axis,) = [a for a in axes if a.get_ylabel() == "energy\nrelative change"]
    E = np.asarray(single.observed["energy"])
    t, drawn = lines(axis)[0]
    np.testing.assert_array_equal(t, single.ts[1:])
    np.testing.assert_allclose(drawn, (E - E[0]) / abs(E[0]), atol=1e-15)
    assert axes[-1].get_xlabel() == "time t [d]"


def test_functions_of_the_state_begin_with_the_start(batch):
    good = jax.tree.map(lambda x: x[:2], batch)
    axis = plot.invariants(
        good, {"L": lambda q, p: q[0] * p[1] - q[1] * p[0]}, change="absolute", units={"L": "J s"}
    )
    assert axis.get_ylabel() == "L\nchange [J s]"
    for k, (t, drawn) in enumerate(lines(axis)):
        L = good.qs[k, :, 0] * good.ps[k, :, 1] - good.qs[k, :, 1] * good.ps[k, :, 0]
        np.testing.assert_array_equal(t, good.ts[k])
        np.testing.assert_allclose(drawn, L - L[0], atol=1e-14)
    value = plot.invariants(good, {"r": lambda q, p: jnp.linalg.norm(q)}, change="value")
    assert lines(value)[0][1][0] == pytest.approx(1.2)
    assert value.get_ylabel() == "r"


def test_solutions_of_several_runs_share_a_panel_for_what_all_of_them_watched(single, batch):
    short = types.SimpleNamespace(
        ts=single.ts[:21], qs=single.qs[:21], observed={"energy": single.observed["energy"][:20]}
    )
    good = jax.tree.map(lambda x: x[:2], batch)
    axis = plot.invariants([good, short], labels=["a", "b", "c"])
    assert axis.get_ylabel() == "energy\nrelative change"
    assert [len(xy[0]) for xy in lines(axis)] == [60, 60, 20]
    np.testing.assert_array_equal(lines(axis)[0][1][:20], lines(axis)[2][1])
    assert legend(axis) == ["a", "b", "c"]
    mine = {"E": [np.ones(61), np.ones(61), np.r_[1, 2 * np.ones(20)]]}
    assert lines(plot.invariants([good, short], mine))[2][1].max() == 1
    with pytest.raises(ValueError, match="one array for each"):
        plot.invariants([good, short], {"E": np.ones(61)})


def test_vectors_change_by_the_length_of_their_difference():
    t = np.arange(4.0)
    v = np.array([[3.0, 4], [3, 4], [3, 5], [0, 0]])
    axis = plot.invariants(t, {"L": v})
    np.testing.assert_allclose(lines(axis)[0][1], [0, 0, 0.2, 1.0])
    assert axis.get_ylabel() == "L\nsize of relative change"


def test_a_logarithmic_axis_has_all_quantities_of_one_orbit_and_counts_zeros():
    t = np.arange(1.0, 7.0)
    v = 1 + np.array([0, 1e-15, 0, 3e-15, -2e-14, 0])
    axis = plot.invariants(t, {"E": v, "L": 2 + 1e-3 * t}, log=True)
    assert axis.get_yscale() == "log"
    assert legend(axis) == ["E", "L", "2 values exactly 0"]
    E = lines(axis)[0][1]
    np.testing.assert_array_equal(np.isnan(E), [True, False, True, False, False, True])
    assert any(text.get_text().startswith("rounding") for text in axis.texts)
    far = plot.invariants(t, {"L": 2 + 1e-3 * t}, log=True)
    assert not list(far.texts)
    assert plot.invariants(t, {"E": v, "L": 2 + t}).shape == (2,)


def test_invariants_that_cannot_be_drawn_are_named(single):
    t = np.arange(4.0)
    two = np.stack([t, 1 + t])
    axis = plot.invariants(np.stack([t, t]), {"L": two})  # a batch keeps its good ones
    np.testing.assert_array_equal([xy[1] for xy in lines(axis)], [[np.nan] * 4, t])
    assert "L: 1 of 2 orbits start at 0" in legend(axis)
    for args, error, match in [
        ((t, {"L": t}), ValueError, "every orbit starts at 0"),
        ((t, {"E": np.ones(6)}), ValueError, r"shape \(4,\).*of shape \(6,\)"),
        ((t, {"E": 1j * t}), TypeError, "complex"),
        ((t, {"E": lambda q, p: q}), TypeError, "function"),
        ((t,), TypeError, "there is neither"),
        (("orbit", {"E": t}), TypeError, "takes a Solution, or times"),
        ((t, {}), ValueError, "nothing to draw"),
    ]:
        with pytest.raises(error, match=match):
            plot.invariants(*args)
    with pytest.raises(ValueError, match="change must be one of 'relative', 'absolute', 'value'"):
        plot.invariants(single, change="log")
    with pytest.raises(ValueError, match="one for each quantity, got 1"):
        plot.invariants(single, ax=plt.subplots()[1])
    with pytest.raises(ValueError, match="'E' must have one number for each time"):
        plot.conserved(t, {"E": np.ones(3)}, "t", "")


def test_conserved_quantities_differ_by_dash_as_well():
    t = np.arange(1.0, 9.0)
    axis = plot.conserved(t, {"a": t, "b": 2 * t}, "t", "")
    drawn = [line for line in axis.lines if len(line.get_xdata()) == 7]
    assert [line.get_linestyle() for line in drawn] == ["-", "--"]
    np.testing.assert_array_equal(drawn[1].get_ydata(), 2 * t[1:])


def test_the_balance_is_a_stack_whose_ends_add_up_to_the_drift():
    t = np.linspace(0, 1, 40, endpoint=False)
    causes = {"a": np.sin(7 * t), "b": -0.5 + t, "c": 0.3 * np.cos(20 * t)}
    drift = sum(causes.values()) + 1e-3
    top, bottom = plot.balance(t, drift, causes, unit="J/s")
    edges = np.zeros((2, 40))
    for k, values in enumerate(causes.values()):
        up, down = (c.get_paths()[0].vertices for c in top.collections[2 * k : 2 * k + 2])
        assert up[:, 1].max() == pytest.approx((edges[0] + np.maximum(values, 0)).max())
        assert down[:, 1].min() == pytest.approx((edges[1] + np.minimum(values, 0)).min())
        edges += [np.maximum(values, 0), np.minimum(values, 0)]
    np.testing.assert_allclose(edges.sum(0), drift - 1e-3)
    np.testing.assert_array_equal(top.lines[0].get_ydata(), drift)
    np.testing.assert_allclose(bottom.lines[0].get_ydata(), 1e-3, atol=1e-15)
    assert len({c.get_hatch() for c in top.collections}) == 3
    assert top.get_ylabel() == "rate of change [J/s]"
    whole, _ = plot.balance(t, drift, causes, cumulative=True)
    np.testing.assert_allclose(whole.lines[0].get_ydata()[-1], drift[:-1].sum() / 40)
    found = types.SimpleNamespace(
        ts=t, drift=drift, symmetry=causes["a"], work=causes["b"], lattice=causes["c"]
    )
    top, _ = plot.balance(found)
    assert legend(top) == ["symmetry", "work", "lattice", "drift"]
    with pytest.raises(ValueError, match=r"a of shape \(3,\)"):
        plot.balance(t, drift, {"a": np.ones(3)})
    with pytest.raises(TypeError, match="noether_balance"):
        plot.balance(t, drift)


def test_what_has_come_together_begins_at_0_and_knows_uneven_steps():
    """A rate that is the slope of t² over each step brings t² itself, whatever the mesh."""
    one = plot.balance(np.arange(5.0), np.ones(5), {"a": np.ones(5)}, cumulative=True)[0]
    np.testing.assert_array_equal(one.lines[0].get_ydata(), np.arange(5.0))
    t = np.array([0.0, 0.1, 0.4, 1.0, 1.1, 3.0])
    rate = np.append(np.diff(t**2) / np.diff(t), 1e9)  # of a last step without an end
    top, bottom = plot.balance(t, rate, {"a": rate}, cumulative=True)
    np.testing.assert_allclose(top.lines[0].get_ydata(), t**2, atol=1e-15)
    np.testing.assert_array_equal(bottom.lines[0].get_ydata(), 0)
    upper = top.collections[0].get_paths()[0].vertices
    np.testing.assert_allclose(upper[:, 1].max(), 9)


def test_indicators_of_runs_backward_stand_at_the_time_since_the_start():
    t = -np.geomspace(1, 1e3, 40)
    axis = plot.indicator(np.r_[0, t], 3 / np.abs(t), "lyapunov")
    np.testing.assert_allclose(lines(axis)[0], [-t, -3 / t])
    assert legend(axis) == ["slope −1"]
    assert axis.get_xlabel() == "time since the start |t − t$_0$|"
    megno = plot.indicator(t, 2 + 0 * t, "megno")
    np.testing.assert_array_equal(lines(megno)[0], [-t, 2 + 0 * t])
    megno.figure.canvas.draw()
    later = plot.indicator(np.r_[5, 5 + t], 2 + 0 * t, "megno")
    np.testing.assert_allclose(lines(later)[0][0], -t)
    given = plot.indicator(5 + t, 2 + 0 * t, "megno", t0=5.0)
    np.testing.assert_allclose(lines(given)[0][0], -t)
    assert plot.indicator(-t, 2 + 0 * t, "megno").get_xlabel() == "time t"


def test_indicators_count_what_has_no_place_each_by_its_reason():
    t = np.arange(6.0)
    axis = plot.indicator(t, np.array([1.0, 2, np.nan, 0, -1, 3]), "lyapunov")
    assert legend(axis)[-3:] == [
        "1 values are no numbers",
        "1 values at the start, t = t$_0$",
        "2 values are not positive",
    ]
    linear = plot.indicator(t, np.array([1.0, 2, np.nan, 0, -1, 3]))
    assert legend(linear) == ["1 values are no numbers"]


def test_what_has_no_place_on_a_logarithmic_axis_is_counted():
    t = np.arange(9.0)
    part = np.where(t > 5, np.nan, 1e-9)
    axis = plot.conserved(t, {"a": 0 * t, "b": part, "c": 0 * t + 1e-8}, "t", "")
    assert legend(axis) == [
        "a", "b", "c", "a: 8 of 8 are exactly 0", "b: 3 of 8 are no numbers"
    ]  # fmt: skip
    axes = plot.changes(t, {"a": np.nan * t, "b": part, "c": t}, "t", "")
    said = [[text.get_text() for text in axis.texts] for axis in axes]
    assert said == [["9 of 9 are no numbers"], ["3 of 9 are no numbers"], []]
    order = types.SimpleNamespace(
        epsilons=np.array([0.1, 0.2, 0.4, 0.8]), drifts=np.array([0.0, 0.1, np.nan, 0.3]),
        used=np.array([False, True, False, True]), slope=1.0, interval=(0.9, 1.1), floor=0.0,
        resolved=True,
    )  # fmt: skip
    axis = plot.drift_orders({"a": order})
    marks = {x.get_marker(): list(x.get_xdata()) for x in axis.lines if x.get_marker() in "xv"}
    assert marks == {"x": [0.4], "v": [0.1, pytest.approx(0.07)]}
    assert legend(axis)[-2:] == ["1 of 5 drifts failed", "2 of 5 drifts are exactly 0"]
    order.drifts, order.floor = np.array([0.05, 0.1, 0.2, 0.3]), 1e-3
    assert not any("drifts" in text for text in legend(plot.drift_orders({"a": order})))


def test_indicators_stand_beside_what_regular_motion_shows():
    t = np.geomspace(1, 1e4, 60)
    megno = plot.indicator(t, np.stack([2 - 1 / t, 0.1 * t]), "megno", labels=["regular", "wild"])
    assert (megno.get_xscale(), megno.get_yscale()) == ("log", "linear")
    np.testing.assert_array_equal(lines(megno)[0], [t, 2 - 1 / t])
    assert legend(megno) == ["regular", "wild", "regular: 2"]
    assert 2.0 in {line.get_ydata()[0] for line in megno.lines if len(line.get_xdata()) == 2}
    exponents = plot.indicator(np.r_[0, t], {"e": np.stack([3 / t, 0.1 + 0 * t])}, "lyapunov")
    assert exponents.get_yscale() == "log"
    x, y = lines(exponents)[-1]
    assert np.diff(np.log(y))[0] / np.diff(np.log(x))[0] == pytest.approx(-1)
    assert (x[0], y[0]) == (1.0, 3.0)
    assert legend(exponents) == ["e 1", "e 2", "slope −1"]
    falls = plot.indicator(t, np.where(t > 100, 0.0, 1 / t**2), "sali")
    assert legend(falls)[-1] == f"{np.sum(t > 100)} values are not positive"
    assert "slope" not in " ".join(legend(falls))
    assert plot.indicator(t, -t).get_yscale() == "linear"
    gali = plot.indicator(t, t**-2, "gali", slope=-2)
    np.testing.assert_allclose(lines(gali)[0][1][-1], lines(gali)[1][1][-1])
    with pytest.raises(ValueError, match="'megno', 'lyapunov', 'sali', 'gali'"):
        plot.indicator(t, t, "fli")
    with pytest.raises(ValueError, match=r"\(..., 60\) or \(..., 59\)"):
        plot.indicator(t, np.ones(7))


# --- sections -----------------------------------------------------------------------------------


def crossings(counts, room=5, n=2):
    """`Crossings` of orbits that crossed so often."""
    rows = np.arange(room) < np.minimum(np.asarray(counts), room)[:, None]
    q = np.where(rows[..., None], RNG.normal(size=(len(counts), room, n)), np.nan)
    p = np.where(rows[..., None], RNG.normal(size=q.shape), np.nan)
    return types.SimpleNamespace(ts=q[..., 0], qs=q, ps=p, count=np.asarray(counts, float))


def test_a_section_draws_every_crossing_once(batch):
    found = batch.observed["section"]
    axis = plot.section(batch, x="p[0]", y="q[1]")
    drawn = np.concatenate([c.get_offsets() for c in axis.collections])
    there = np.isfinite(np.asarray(found.ts))
    assert there.sum() > 0
    np.testing.assert_array_equal(drawn, np.stack(
        [np.asarray(found.ps)[there][:, 0], np.asarray(found.qs)[there][:, 1]], 1
    ))  # fmt: skip
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("p$_{1}$", "q$_{2}$")


def test_a_section_tells_what_is_not_there():
    made = crossings([7, 0, 3])
    axis = plot.section(made)
    assert [len(c.get_offsets()) for c in axis.collections] == [5, 0, 3]
    assert legend(axis) == [
        "1 of 3 orbits crossed more often than the 5 times kept",
        "1 of 3 orbits did not cross",
    ]
    empty = plot.section(crossings([0, 0]))
    assert [text.get_text() for text in empty.texts] == ["no orbit crossed the section"]
    assert not list(empty.collections)
    assert not list(plot.section(made).texts)


def statuses(made, *names):
    """The same as a `PoincareSection` whose orbits came through so."""
    made.status = np.asarray(names)
    return made


def test_a_section_names_how_orbits_ended_and_failed_ones_do_not_set_its_limits():
    made = statuses(crossings([5, 2, 0, 4, 3]), "successful", "too_few_crossings", "never_crossed",
                    "stopped", "failed")  # fmt: skip
    calm = plot.section(made).axis()
    made.qs[4, 2], made.ps[4, 2] = 1e9, 1e12
    for kwargs in ({}, {"colour": np.arange(5.0)}):
        axis = plot.section(made, **kwargs)
        assert legend(axis) == [
            "1 of 5 orbits crossed less often than the 5 times asked for",
            "1 of 5 orbits stopped",
            "1 of 5 orbits failed",
            "1 of 5 orbits did not cross",
            "1 of 3 crossings of failed orbits lie outside the picture",
        ]
        assert np.abs(axis.axis()).max() < 10
        assert sum(len(c.get_offsets()) for c in axis.collections) == 14  # drawn all the same
        made.status[4] = "successful"
        assert np.abs(plot.section(made, **kwargs).axis()).max() > 1e12
        made.status[4] = "failed"
    assert np.abs(calm).max() < 10
    alone = plot.section(statuses(crossings([3]), "failed"))
    assert legend(alone) == ["1 of 1 orbits failed"]
    assert len(alone.collections[0].get_offsets()) == 3


def test_a_bifurcation_names_how_runs_ended():
    made = statuses(crossings([5, 3, 4], n=1), "successful", "failed", "too_few_crossings")
    made.qs[1, 2] = -1e9
    axis = plot.bifurcation([1.0, 2.0, 3.0], made, y="q")
    assert legend(axis) == [
        "1 of 3 orbits crossed less often than the 5 times asked for",
        "1 of 3 orbits failed",
        "1 of 3 crossings of failed orbits lie outside the picture",
    ]
    assert axis.get_ylim()[0] > -10
    made.status[1] = "successful"
    assert plot.bifurcation([1.0, 2.0, 3.0], made, y="q").get_ylim()[0] < -1e8


@pytest.mark.slow
def test_a_section_of_runs_that_failed_says_why(batch):
    assert "1 of 3 orbits failed: not finite" in legend(plot.section(batch))
    kepler = systems.kepler()
    q = jnp.array([[1.2, 0.0], [0.0, 0.0]])
    found = dvi.poincare_section(
        kepler.system, q, jnp.broadcast_to(jnp.asarray(kepler.p0), (2, 2)),
        lambda t, q, p, args: q[0], h=0.1, num_steps=100, crossings=40, args=kepler.args,
        throw=False,
    )  # fmt: skip
    assert list(found.status) == ["too_few_crossings", "failed"]
    assert legend(plot.section(found)) == [
        "1 of 2 orbits crossed less often than the 40 times asked for",
        "1 of 2 orbits failed: not finite",
    ]


def test_sections_are_coloured_by_orbit_or_by_value():
    axis = plot.section(crossings([5, 5, 5]), labels=["a", "b", "c"])
    assert [to_hex(c.get_facecolor()[0]).upper() for c in axis.collections] == list(
        plot.COLOURS[:3]
    )
    assert legend(axis) == ["a", "b", "c"]
    made = crossings([5, 2, 4])
    axis = plot.section(made, colour=[2.0, np.nan, 9.0], colour_label="MEGNO", limits=(2, 4))
    (cloud,) = axis.collections
    shades = [to_hex(c) for c in cloud.get_facecolors()]
    assert shades == [to_hex(SHADES(0.0))] * 5 + ["#b8b8b8"] * 2 + [to_hex(SHADES(1.0))] * 4
    assert axis.figure.axes[1].get_ylim() == (2, 4)
    assert "1 of 3 orbits have no value" in legend(axis)
    assert len(plot.section(crossings([5] * 40)).collections) == 1


def test_a_million_crossings_are_one_collection_of_pixels():
    made = crossings([1000] * 1000, room=1000, n=1)
    axis = plot.section(made, x="q", y="p")
    (cloud,) = axis.collections
    assert len(cloud.get_offsets()) == 10**6
    assert cloud.get_rasterized()
    assert not plot.section(crossings([5])).collections[0].get_rasterized()


def test_sections_take_functions_of_the_state():
    made = crossings([3, 4])

    def action(q, p):
        return (q @ q + p @ p) / 2

    axis = plot.section(made, x=action, y=lambda q, p: jnp.arctan2(p[0], q[0]), units={"q": "m"})
    drawn = np.concatenate([c.get_offsets() for c in axis.collections])
    there = np.isfinite(made.ts)
    q, p = made.qs[there], made.ps[there]
    np.testing.assert_allclose(drawn[:, 0], (np.sum(q**2, 1) + np.sum(p**2, 1)) / 2)
    np.testing.assert_allclose(drawn[:, 1], np.arctan2(p[:, 0], q[:, 0]))
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("action", "")
    for kwargs, match in [
        ({"x": "q[2]"}, "has no component"),
        ({"x": "r[0]"}, 'such as "q\\[0\\]"'),
        ({"x": "q"}, r'such as "q\[0\]"'),
        ({"colour": [1.0]}, "1 values for 2 orbits"),
        ({"labels": ["a"]}, "1 names for 2 orbits"),
    ]:
        with pytest.raises(ValueError, match=match):
            plot.section(made, **kwargs)
    for wrong in (
        np.ones((3, 2)),
        types.SimpleNamespace(ts=1, qs=1, ps=1, observed={}),
        [made] * 2,
    ):
        with pytest.raises(TypeError, match=r"Crossings of a dvi\.Section"):
            plot.section(wrong)


def test_a_bifurcation_has_a_column_of_points_for_each_parameter():
    made = crossings([5, 0, 3], n=1)
    axis = plot.bifurcation([0.1, 0.2, 0.3], made, y="q", skip=1, name="ε [1]", units={"q": "m"})
    drawn = axis.collections[0].get_offsets()
    np.testing.assert_allclose(drawn[:, 0], [0.1] * 4 + [0.3] * 2)
    np.testing.assert_array_equal(drawn[:4, 1], made.qs[0, 1:, 0])
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("ε [1]", "q [m]")
    assert legend(axis) == ["1 of 3 runs have no crossing after the first 1"]
    assert plot.bifurcation([1, 10], np.ones((2, 4)), log=True).get_xscale() == "log"
    none = plot.bifurcation([1, 2], np.full((2, 4), np.nan))
    assert [text.get_text() for text in none.texts] == ["no orbit crossed the section"]
    for args, kwargs, match in [
        (([1, 2], np.ones((3, 4))), {}, r"of shape \(2,\), crossings of shape \(3, 4\)"),
        (([1, 2], np.ones((2, 4))), {"skip": -1}, "from 0 on, got -1"),
        (([0, 2], np.ones((2, 4))), {"log": True}, "positive parameters"),
    ]:
        with pytest.raises(ValueError, match=match):
            plot.bifurcation(*args, **kwargs)


# --- cost, frequencies --------------------------------------------------------------------------


def test_work_precision_measures_slopes_and_finds_the_front():
    cost = 10.0 ** np.arange(1, 6)
    errors = {"two": cost**-2, "four": np.maximum(1e4 * cost**-4, 1e-14)}
    axis = plot.work_precision(
        {name: (cost[::-1], e[::-1]) for name, e in errors.items()}, "evaluations", "error [m]"
    )
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    np.testing.assert_array_equal(lines(axis)[0], [cost, errors["two"]])
    assert legend(axis) == ["two: slope −2.0", "four: slope −4.0", "front"]
    front = lines(axis)[2]
    np.testing.assert_array_equal(front, [cost, [1e-2, 1e-4, 1e-8, 1e-12, 1e-14]])
    flat = {"late": (cost, [1e-3, 1e-5, 1e-7, 1.1e-7, 1.3e-7]), "first": (cost, 1 / cost)}
    assert legend(plot.work_precision(flat))[:2] == ["late: slope −2.0", "first: slope −1.0"]
    early = {"early": (cost, [1.0, 9.0, 1.0, 1e-3, 1e-6])}  # steps that are too long at first
    assert legend(plot.work_precision(early))[0] == "early: slope −3.0"
    late = {"bent": (cost[:4], [1.0, 1e-1, 1e-3, 1e-6]), "two": (cost[:2], [1, 1e-2])}
    assert legend(plot.work_precision(late))[:2] == [
        "bent: slope −2.5, not settled", "two: slope −2.0 of two runs"
    ]  # fmt: skip
    # Two runs of one cost, as 1e-2 and 1e-4: together 1e-3.
    twice = {"a": ([1, 10, 10, 100], [1.0, 1e-2, 1e-4, 1e-6])}
    assert legend(plot.work_precision(twice))[0] == "a: slope −3.0"
    swapped = {"a": ([1, 10, 10, 100], [1.0, 1e-4, 1e-2, 1e-6])}
    assert legend(plot.work_precision(swapped))[0] == "a: slope −3.0"
    looks = {(line.get_marker(), line.get_color()) for line in axis.lines[:2]}
    assert looks == {("o", plot.COLOURS[0]), ("s", plot.COLOURS[1])}
    assert "front" not in legend(plot.work_precision(errors_of("a"), front=False))
    assert legend(plot.work_precision({"a": ([1, 2], [1e-16, 1e-16])}))[0] == "a: no slope"


def errors_of(name):
    return {name: ([1.0, 2, 4, 8], [np.nan, 0.0, 0.1, np.inf])}


def test_runs_that_failed_or_have_no_error_keep_their_place():
    axis = plot.work_precision(errors_of("a"))
    marks = {line.get_marker(): list(line.get_xdata()) for line in axis.lines if line.get_color()}
    assert marks["x"] == [1.0, 8.0]
    assert marks["v"] == [2.0]
    assert "2 of 4 runs failed" in legend(axis)
    assert "1 of 4 runs without error" in legend(axis)
    for results, match in [
        ({}, "no method"),
        ({"a": ([1, 2], [1])}, r"got \(2,\) and \(1,\)"),
        ({"a": ([0, 2], [1, 1])}, "must be positive"),
        ({"a": 3}, r"must be \(costs, errors\)"),
    ]:
        with pytest.raises(ValueError, match=match):
            plot.work_precision(results)


def test_a_spectrum_draws_sizes_at_their_frequencies():
    w = np.array([[1.0, 2.5, np.nan], [1.0, -0.5, 3.0]])
    A = np.array([[1, 0.1j, 0.3], [0.5, 0.2, 0.0]])
    axis = plot.spectrum(
        types.SimpleNamespace(frequencies=w, amplitudes=A), labels=["x", "y"],
        fundamental={"ω": 1.0}, units={"frequency": "rad/d", "amplitude": "au"},
    )  # fmt: skip
    assert axis.get_yscale() == "log"
    np.testing.assert_allclose(axis.lines[0].get_xydata(), [[1.0, 1.0], [2.5, 0.1]])
    stems = axis.collections[1].get_segments()
    np.testing.assert_allclose([s[1] for s in stems], [[1.0, 0.5], [-0.5, 0.2]])
    assert axis.get_ylim()[0] == pytest.approx(0.1 / 3)
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("frequency [rad/d]", "amplitude [au]")
    assert legend(axis) == ["x", "y", "ω", "2 of 6 lines have no frequency or amplitude"]
    linear = plot.spectrum(w[1], A[1], log=False)
    assert linear.get_ylim()[0] == 0
    assert len(linear.lines[0].get_xdata()) == 3
    with pytest.raises(ValueError, match=r"float64.*of shape \(2, 3\), amplitudes of shape \(3,\)"):
        plot.spectrum(w, A[0])
    with pytest.raises(TypeError, match="frequencies and amplitudes"):
        plot.spectrum(w)


def test_frequencies_stand_against_each_other_with_their_resonances():
    x, y = np.array([1.0, 2.0, np.nan]), np.array([0.5, 1.0, 1.0])
    axis = plot.frequency_map(x, y, [-9.0, np.nan, -1.0], resonances=[(1, -2)])
    np.testing.assert_array_equal(axis.collections[0].get_offsets(), [[1.0, 0.5]])
    np.testing.assert_array_equal(axis.collections[1].get_offsets(), [[2.0, 1.0]])
    assert legend(axis) == [
        "1 orbits without a diffusion",
        "1 of 3 orbits have no frequencies",
    ]
    assert [text.get_text() for text in axis.texts] == ["(1, −2)"]
    line = axis.lines[0]
    assert line.get_xy1() == (0, 0)
    assert line.get_xy2() == (-2, -1)
    with pytest.raises(ValueError, match="not both 0"):
        plot.frequency_map(x, y, resonances=[(0, 0)])
    with pytest.raises(ValueError, match=r"y of shape \(2,\)"):
        plot.frequency_map(x, y[:2])


def test_a_plane_of_starts_is_coloured_by_diffusion():
    x, y = np.linspace(0, 1, 4), np.linspace(2, 4, 3)
    D = RNG.uniform(-9, -1, (4, 3))
    D[1, 2] = np.nan
    axis = plot.frequency_map(x, y, D, limits=(-8, -2), names=("a [au]", "e"))
    mesh = axis.collections[0]
    np.testing.assert_array_equal(mesh.get_array().filled(np.nan), D.T)
    assert (mesh.norm.vmin, mesh.norm.vmax) == (-8, -2)
    assert axis.get_xlabel() == "a [au]"
    assert legend(axis) == ["1 of 12 starts without a value"]
    with pytest.raises(ValueError, match="must rise"):
        plot.frequency_map(x[::-1], y, D)
    plain = plot.frequency_map(x, y, D)
    assert (plain.get_xlabel(), plain.get_ylabel()) == ("x", "y")
    with pytest.raises(ValueError, match=r"line among frequencies.*x and y of shape \(4, 3\)"):
        plot.frequency_map(x, y, D, resonances=[(1, -1)])
    X, Y = np.meshgrid(x, y, indexing="ij")
    assert plot.frequency_map(X, Y, D, resonances=[(1, -1)]).get_xlabel() == "ω$_1$"


@pytest.mark.parametrize(
    ("x", "y", "k", "edge"),
    [
        ((1, 3), (0.5, 2), (1, -1), "top"),
        ((1, 2), (0.5, 3), (1, -1), "right"),
        ((-2, 0), (1, 3), (1, 1), "left"),  # and at the bottom
    ],
)
def test_a_resonance_has_its_name_where_its_line_leaves_the_picture(x, y, k, edge):
    axis = plot.frequency_map(np.asarray(x), np.asarray(y), resonances=[k])
    (name,) = axis.texts
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    at_x, at_y = name.xy
    assert k[0] * at_x + k[1] * at_y == pytest.approx(0, abs=1e-12)
    found, wanted = {"top": (at_y, high), "right": (at_x, right), "left": (at_x, left)}[edge]
    assert found == pytest.approx(wanted)
    assert left <= at_x <= right
    assert low <= at_y <= high


# --- films --------------------------------------------------------------------------------------


def frames(path):
    """Pictures and delays [ms] of a GIF."""
    image = Image.open(path)
    found, delays = [], []
    for k in range(image.n_frames):
        image.seek(k)
        found.append(np.asarray(image.convert("RGB")).astype(int))
        delays.append(image.info["duration"])
    return found, delays


def test_a_film_has_the_frames_and_the_length_asked_for(tmp_path, batch):
    calls = []
    path = plot.animate(
        batch, tmp_path / "film.gif", seconds=0.7, fps=10, size=(3, 2.5), dpi=60,
        labels=list("abc"), progress=lambda done, total: calls.append((done, total)),
    )  # fmt: skip
    found, delays = frames(path)
    assert path == tmp_path / "film.gif"
    assert len(found) == 7
    assert found[0].shape == (150, 180, 3)
    assert sum(delays) == 700
    assert calls == [(k, 7) for k in range(1, 8)]
    assert [file.name for file in tmp_path.iterdir()] == ["film.gif"]
    for a, b in itertools.pairwise(found):
        assert (np.abs(a - b).max(-1) > 60).sum() > 10
    assert (found[0][0, :5] == 255).all()  # white paper


def test_a_film_names_all_its_orbits_and_tells_of_those_that_failed(tmp_path, monkeypatch):
    """Eight long names in a narrow film: each of them lies within it."""
    ts, q, p = arrays(8)
    q = q.copy()
    q[3, 20:] = np.nan
    figures = []
    monkeypatch.setattr(
        films, "write", lambda writer, scene, part, progress: (
            figures.append(scene.axis.figure), part.write_bytes(b"")
        ),
    )  # fmt: skip
    names = [f"orbit with a long name {k}" for k in range(8)]
    plot.animate((ts, q, p), tmp_path / "a.gif", labels=names, size=(5, 5), dpi=60)
    (figure,) = figures
    (drawn,) = figure.legends
    said = [text.get_text() for text in drawn.get_texts()]
    assert said == [*names, "1 of 8 orbits failed: not finite"]
    figure.canvas.draw()
    for text in drawn.get_texts():
        box = text.get_window_extent()
        assert 0 <= box.x0 < box.x1 <= 300
        assert 0 <= box.y0 < box.y1 <= 300
    plot.animate(arrays(), tmp_path / "b.gif", dpi=30)
    assert not figures[1].legends


def test_a_film_shows_each_moment_evenly_in_time(tmp_path):
    """Steps that grow: the head is where the orbit is, not at every so many states."""
    t = np.linspace(0, 3, 400) ** 2
    qs = np.stack([t, 0 * t], 1)
    path = plot.animate(
        (t, qs), tmp_path / "line.gif", seconds=1, fps=5, size=(4, 2), dpi=60, tail=0
    )
    found, _ = frames(path)
    blue = np.array([int(plot.COLOURS[0][i : i + 2], 16) for i in (1, 3, 5)])
    heads = [np.argwhere(np.abs(f - blue).max(-1) < 40)[:, 1].mean() for f in found]
    np.testing.assert_allclose(np.diff(heads), np.diff(heads).mean(), atol=2.5)
    assert np.diff(heads).mean() > 20


def test_films_beside_phase_portraits_and_invariants_and_in_space(tmp_path, single, batch):
    look = {"seconds": 0.2, "fps": 10, "size": (5, 2.5), "dpi": 50}
    plain, _ = frames(plot.animate(single, tmp_path / "0.gif", **look))
    names = {k: single.observed[k] for k in ("energy", "angular_momentum")}
    for i, kwargs in enumerate(
        [{"beside": "phase_portrait", "dof": 1}, {"beside": "invariants", "values": names}]
    ):
        found, _ = frames(plot.animate(single, tmp_path / f"{i + 1}.gif", **look, **kwargs))
        right = np.s_[:, 140:]
        assert np.abs(found[0][right] - found[-1][right]).sum() > 3000
        assert np.abs(found[0] - plain[0]).sum() > 10_000
    t = np.linspace(0, 20, 30)
    qs = np.stack([np.cos(t), np.sin(t), t], 1)
    qs[20:] = np.nan
    found, _ = frames(plot.animate((t, qs), tmp_path / "space.gif", **look))
    assert np.abs(found[0] - found[-1]).sum() > 1000
    one = arrays()
    found, _ = frames(plot.animate(one, tmp_path / "one.gif", **look))  # in (q, p)
    assert np.abs(found[0] - found[-1]).sum() > 1000


def test_a_film_of_few_states_shows_each_for_longer(tmp_path):
    path = plot.animate(arrays(steps=4), tmp_path / "few.gif", seconds=1, size=(3, 3), dpi=40)
    found, delays = frames(path)
    assert len(found) == 4
    assert delays == [250] * 4


def test_films_that_cannot_be_made_leave_nothing_behind(tmp_path, monkeypatch):
    orbit = arrays(n=2)
    for name, kwargs, match in [
        ("a.avi", {}, "a .gif or an .mp4, got 'a.avi'"),
        ("a.gif", {"fps": 60}, "at most 50"),
        ("a.gif", {"seconds": 0}, "seconds must be a positive and finite number, got 0"),
        ("a.gif", {"fps": float("nan")}, "fps must be"),
        ("a.gif", {"tail": 2}, "a share from 0 to 1, got 2"),
        ("a.gif", {"beside": "energy"}, "one of None, 'phase_portrait', 'invariants'"),
        ("none/a.gif", {}, "folder of the film is not there"),
        ("a.gif", {"size": (40, 40), "dpi": 600}, "too large"),
    ]:
        with pytest.raises(ValueError, match=match):
            plot.animate(orbit, tmp_path / name, **kwargs)
    nowhere = (np.arange(3.0), np.full((3, 2), np.nan))
    for orbits, match in [(arrays(2, n=2), "2 orbits"), (arrays(), r"states of shape \(1,\)")]:
        with pytest.raises(ValueError, match=match):
            plot.animate(orbits, tmp_path / "a.gif", names=["A", "B"])
    with pytest.raises(ValueError, match="no orbit has a state"):
        plot.animate(nowhere, tmp_path / "a.gif")
    with pytest.raises(TypeError, match="needs momenta"):
        plot.animate(arrays()[:2], tmp_path / "a.gif")
    monkeypatch.setattr(
        type(matplotlib.animation.writers), "is_available", lambda self, name: False
    )
    with pytest.raises(RuntimeError, match=r"ffmpeg.*install.*or write a \.gif"):
        plot.animate(orbit, tmp_path / "a.mp4")

    def interrupt(done, total):
        raise KeyboardInterrupt

    (tmp_path / "old.gif").write_bytes(b"what was there")
    with pytest.raises(KeyboardInterrupt):
        plot.animate(orbit, tmp_path / "old.gif", seconds=0.2, dpi=30, progress=interrupt)
    assert [(f.name, f.read_bytes()) for f in tmp_path.iterdir()] == [
        ("old.gif", b"what was there")
    ]


@pytest.mark.skipif(
    not matplotlib.animation.writers.is_available("ffmpeg"), reason="ffmpeg is not installed"
)
def test_an_mp4_is_written_where_there_is_ffmpeg(tmp_path):
    path = plot.animate(arrays(n=2), tmp_path / "a.mp4", seconds=0.5, fps=10, size=(3, 3), dpi=50)
    start = path.read_bytes()[:12]
    assert start[4:8] == b"ftyp"
    assert path.stat().st_size > 2000


def test_the_gallery_refuses_an_unknown_picture_before_it_draws(tmp_path, monkeypatch, capsys):
    file = Path(__file__).parents[1] / "examples" / "gallery.py"
    spec = importlib.util.spec_from_file_location("gallery", file)
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    drawn = []

    def picture(out):
        drawn.append(out)
        return out / "a.png"

    monkeypatch.setattr(gallery, "PICTURES", [picture])
    monkeypatch.setattr(sys, "argv", ["gallery.py", str(tmp_path / "g"), "picture", "no"])
    with pytest.raises(SystemExit):
        gallery.main()
    assert "no picture is called no: there are picture" in capsys.readouterr().err
    assert not drawn
    assert not (tmp_path / "g").exists()
    monkeypatch.setattr(sys, "argv", ["gallery.py", str(tmp_path / "g"), "picture"])
    gallery.main()
    assert drawn == [tmp_path / "g"]


@pytest.mark.slow
def test_the_documentation_runs_as_printed(tmp_path, monkeypatch):
    page = (Path(__file__).parents[1] / "docs" / "plots.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"```python\n(.*?)```", page, re.S)
    monkeypatch.chdir(tmp_path)
    exec(block, {})
    sizes = {file.name: file.stat().st_size for file in tmp_path.iterdir()}
    assert set(sizes) == {"orbits.png", "invariants.png", "orbits.gif"}
    assert min(sizes.values()) > 20_000
