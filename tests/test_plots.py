"""Pictures of orbits, sections, spectra and costs: what is drawn, where, and what is rejected."""

import importlib.util
import inspect
import itertools
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.animation
import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import to_hex, to_rgb
from pictures import closed, legend, lies_within, lines, marked, refuses, texts  # noqa: F401
from PIL import Image

import dvi_jax as dvi
from dvi_jax import plot, systems
from dvi_jax.plot import films
from dvi_jax.plot.axes import envelope
from dvi_jax.plot.style import MARKERS, SHADES
from dvi_jax.systems import rings

ROOT = Path(__file__).parents[1]
RNG = np.random.default_rng(0)
same = np.testing.assert_array_equal
close = np.testing.assert_allclose


@pytest.fixture(scope="module")
def batch():
    """Three Kepler orbits, of which the last starts in the centre and fails at once."""
    kepler = systems.kepler()
    section = dvi.Section(lambda t, q, p, args: q[0], direction=1, max_crossings=3)
    largest = dvi.MaxDrift(kepler.observables["energy"])
    settings = {"h": 0.1, "num_steps": 60, "args": kepler.args, "method": dvi.Strang()}
    settings["observe"] = {**kepler.observables, "largest": largest, "section": section}

    def run(y):
        q = jnp.stack([0 * y, y])
        return dvi.integrate(kepler.system, q, kepler.p0, throw=False, **settings)

    return jax.vmap(run)(jnp.array([1.2, 0.7, 0.0]))


@pytest.fixture(scope="module")
def good(batch):
    return jax.tree.map(lambda x: x[:2], batch)


@pytest.fixture(scope="module")
def single(batch):
    return jax.tree.map(lambda x: x[0], batch)


def arrays(lanes=None, n=1, steps=50, shape=None):
    """(ts, qs, ps) of circles of radii 1, 2, …"""
    t = np.linspace(0, 6, steps)
    radii = np.arange(1, (lanes or 1) + 1)[:, None, None] * np.ones(n)
    q, p = radii * np.cos(t)[:, None], -radii * np.sin(t)[:, None]
    ts = np.broadcast_to(t, (lanes or 1, steps))
    orbits = ts, *(x.reshape(*ts.shape, *(shape or (n,))) for x in (q, p))
    return orbits if lanes else tuple(x[0] for x in orbits)


def drawn_lines(axis):
    return [line for line in axis.lines if line.get_linestyle() != "None"]


# Machado, Oliveira & Fernandes 2009, IEEE Trans. Vis. Comput. Graph. 15, 1291: severity 1, in
# linear RGB, row by row.
SIGHTS = {
    "normal": "1 0 0 0 1 0 0 0 1",
    "protanopia": ".152286 1.052583 -.204868 .114503 .786281 .099216 -.003882 -.048116 1.051998",
    "deuteranopia": ".367322 .860646 -.227968 .280085 .672501 .047413 -.01182 .04294 .968881",
    "tritanopia": "1.255528 -.076749 -.178779 -.078411 .930809 .147602 .004733 .691367 .3039",
}
SRGB = "0.4124564 0.3575761 0.1804375 0.2126729 0.7151522 0.072175 0.0193339 0.119192 0.9503041"
SRGB = np.array(SRGB.split(), float).reshape(3, 3)


def lab(colours, sight):
    """CIELAB coordinates of colours as eyes of a kind see them, shape (count, 3)."""
    c = np.array([to_rgb(x) for x in colours])
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    eye = np.array(SIGHTS[sight].split(), float).reshape(3, 3)
    xyz = np.clip(linear @ eye.T, 0, 1) @ SRGB.T / SRGB.sum(1)
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = f.T
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=1)


def nearest_two(points):
    """The smallest distance between two points."""
    return min(np.linalg.norm(a - b) for a, b in itertools.combinations(points, 2))


@pytest.mark.parametrize("sight", SIGHTS)
def test_colours_differ_and_shades_grow_lighter_for_all_eyes(sight):
    """A distance of 2.3 is just noticeable; matplotlib's own colours are within 8."""
    assert nearest_two(lab(plot.COLOURS, sight)) > 15
    if sight == "deuteranopia":
        assert nearest_two(lab(["#d62728", "#2ca02c", "#8c564b"], sight)) < 8
    lightness = lab(SHADES(np.linspace(0, 1, 64)), sight)[:, 0]
    assert (np.diff(lightness) > 0.5).all()
    assert lightness[-1] < 84
    assert lab(plt.get_cmap("viridis")([1.0]), sight)[0, 0] > 88


def test_lines_differ_in_a_black_and_white_print():
    """By dash and marker; dashes of orbits that retrace themselves overlap, and markers do not."""
    assert (np.diff(lab(plot.COLOURS, "normal")[:5, 0]) > 3).all()
    assert len(set(plot.DASHES)) == len(plot.DASHES) == len(plot.COLOURS) <= len(set(MARKERS))
    drawing = drawn_lines(plot.phase_portrait(arrays(5), labels=list("abcde")))
    bodies = drawn_lines(plot.orbit(arrays(n=6, shape=(3, 2))[:2]))
    for some in (drawing, bodies):
        for kind in ("color", "marker", "markevery"):
            assert len({str(getattr(line, f"get_{kind}")()) for line in some}) == len(some)


def test_marks_are_far_apart_where_an_orbit_retraces_itself():
    """Three turns in equal steps of time would put three marks at each of three places."""
    t = np.linspace(0, 6 * np.pi, 50_000)
    circle = np.stack([np.cos(t), np.sin(t)], 1)
    axis = plot.orbit([(t, circle), (t, 3 * circle)])
    pieces = [line for line in drawn_lines(axis) if line.get_marker() == "s"]
    marks = np.concatenate([line.get_xydata()[line.get_markevery()] for line in pieces])
    assert len(marks) >= 9  # a mark at the border of two pieces is in both
    assert nearest_two(np.unique(marks, axis=0)) > 0.8 * 2 * np.sin(np.pi / 16)


def test_pictures_have_the_style_and_leave_the_settings_of_the_user():
    """Interactive mode too, which in Jupyter the first figure turns on, perhaps in the style."""
    assert not plot.phase_portrait(arrays()).spines["top"].get_visible()
    assert plt.rcParams["axes.spines.top"]
    with plot.style(), mpl.rc_context({"axes.labelsize": 21}):
        assert plot.phase_portrait(arrays()).xaxis.label.get_size() == 21
    for value in (True, False):
        mpl.interactive(not value)
        with plot.style():
            mpl.interactive(value)
        assert mpl.is_interactive() is value


def test_save_takes_what_the_pictures_return(tmp_path):
    one, several = plot.phase_portrait(arrays()), plot.phase_portrait(arrays(n=2))
    inside = plt.figure().subfigures(1, 2)[0].subplots()
    for drawing in (several, one.figure, inside):
        assert Image.open(plot.save(drawing, tmp_path / "a.png")).size[0] > 500
    assert not plt.fignum_exists(inside.figure.figure.number)
    refuses(
        plot.save,
        (([one, several[0]], tmp_path / "b.png"), {}, "2 figures"),
        (("picture", tmp_path / "b.png"), {}, "a figure", TypeError),
    )
    assert not (tmp_path / "b.png").exists()


def test_an_envelope_keeps_the_extremes_and_the_gaps():
    x = np.arange(100_000.0)
    y = np.sin(x)
    y[54_321], y[77_777], y[3_000] = 9.0, np.nan, -7.0
    a, b = envelope(x, y, 4000)
    assert len(a) < 4000
    assert (np.nanmax(b), np.nanmin(b), a[np.nanargmax(b)]) == (9.0, -7.0, 54_321)
    assert np.isnan(b).sum() == 1
    same(envelope(x[:50], y[:50])[1], y[:50])


def pictures(single):
    """Every function that draws, by name, with the number of its axes."""
    t = np.arange(1.0, 6.0)
    order = SimpleNamespace(
        epsilons=t, drifts=t, used=t > 0, slope=1.0, interval=(0.9, 1.1), floor=0.5, resolved=True
    )
    proved = SimpleNamespace(per_step=(0.2,), rounding=(0.0,), level=None, steps=0)
    flags = {"flag_values": [0, 1, 2, 3, 4, 5], "flag_meanings": "successful a b c d e"}
    data = xr.DataArray(t, dims="x", coords={"x": t}, name="drift", attrs=flags)
    orbits = dvi.elements.Keplerian(t, t, t, t, t, t)
    history = {"stage": 0 * t, "loss": t, "accepted": t > 0, "horizon": t}
    fit = SimpleNamespace(
        whitened=[t[:, None]], ts=[t], chi2=1.0, degrees_of_freedom=3, has_errors=True,
        observed=[t], predicted=[t], errors=[t], names=["a"], x=[1.0], covariance=[[1.0]],
        history=history,
    )  # fmt: skip
    surface = SimpleNamespace(
        epsilons=t, hs=t, drifts=np.ones((5, 5)), used=np.ones((5, 5), bool), slopes=t,
        intervals=np.stack([t, t], 1), orders=[order] * 5,
    )  # fmt: skip
    magnets = [rings.quadrupole(f"Q{i}", 1.0, 0.5) for i in range(4)]
    ring, tunes = rings.Ring(magnets), SimpleNamespace(diffusion=-t, tune=np.stack([t, t], 1) / 9)
    optics = SimpleNamespace(
        s=t, beta=np.ones((5, 2)), alpha=np.zeros((5, 2)), orbit=np.zeros((5, 6)),
        dispersion=np.ones((5, 4)),
    )  # fmt: skip
    planets = RNG.normal(size=(4, 9, 3)), list("abcdefghi")
    errors = t, RNG.uniform(1, 2, (5, 9)), list("abcdefghi"), t, 1.0, 0.0
    return {
        "phase_portrait": (2, lambda ax: plot.phase_portrait(single, ax=ax)),
        "orbit": (1, lambda ax: plot.orbit(single, ax=ax)),
        "trajectory": (1, lambda ax: plot.trajectory(single, ax=ax)),
        "invariants": (1, lambda ax: plot.invariants(t, {"E": t}, ax=ax)),
        "conserved": (1, lambda ax: plot.conserved(t, {"E": t}, "t", "", ax=ax)),
        "changes": (3, lambda ax: plot.changes(t, dict.fromkeys("abc", t), "t", "", ax=ax)),
        "balance": (2, lambda ax: plot.balance(t, t, {"a": t}, ax=ax)),
        "indicator": (1, lambda ax: plot.indicator(t, t, "megno", ax=ax)),
        "section": (1, lambda ax: plot.section(single, ax=ax)),
        "bifurcation": (1, lambda ax: plot.bifurcation(t, np.ones((5, 3)), ax=ax)),
        "work_precision": (1, lambda ax: plot.work_precision({"a": (t, 1 / t)}, ax=ax)),
        "spectrum": (1, lambda ax: plot.spectrum(t, t, ax=ax)),
        "frequency_map": (1, lambda ax: plot.frequency_map(t, t, ax=ax)),
        "twiss": (2, lambda ax: plot.twiss(ring, optics, ax=ax)),
        "tune_map": (2, lambda ax: plot.tune_map(t, t, tunes, ax=ax)),
        "drift_bound": (1, lambda ax: plot.drift_bound(proved, [0, 1, 2], [1, 1.1, 1.2], ax=ax)),
        "drift_orders": (1, lambda ax: plot.drift_orders([order], ax=ax)),
        "drift_surface": (2, lambda ax: plot.drift_surface(surface, ax=ax)),
        "sweep_map": (1, lambda ax: plot.sweep_map(data, ax=ax)),
        "slope_map": (1, lambda ax: plot.slope_map(data, "x", x="x", ax=ax)),
        "failure_map": (1, lambda ax: plot.failure_map(data.astype(int), ax=ax)),
        "fit_residuals": (2, lambda ax: plot.fit_residuals(fit, axes=ax)),
        "fit_corner": (1, lambda ax: plot.fit_corner(fit, axes=ax)),
        "fit_against_data": (1, lambda ax: plot.fit_against_data(fit, ax=ax)),
        "learning_curve": (1, lambda ax: plot.learning_curve(fit, ax=ax)),
        "planet_orbits": (2, lambda ax: plot.planet_orbits(*planets, ax=ax)),
        "elements": (2, lambda ax: plot.elements(t, orbits, ("a", "e"), ax=ax)),
        "ephemeris_comparison": (3, lambda ax: plot.ephemeris_comparison(*errors, ax=ax)),
    }


def test_every_picture_draws_on_the_axes_it_is_given_and_on_nothing_else(single):
    """Anything but axes is a `TypeError` before a figure is made; their number is checked."""
    drawing = pictures(single)
    functions = {name for name, f in vars(plot).items() if inspect.isfunction(f)}
    assert set(drawing) == functions - {"save", "style", "animate"}
    for name, (count, draw) in drawing.items():
        with pytest.raises(TypeError, match="must be the matplotlib Axes"):
            draw([3])
        assert plt.get_fignums() == [], name
        figure, (*mine, other) = plt.subplots(1, count + 1, figsize=(4 * count + 4, 4))
        canvas = mine if count > 1 or name == "fit_corner" else mine[0]
        assert np.ravel(draw(canvas)).tolist() == mine, name
        assert plt.get_fignums() == [figure.number], name
        assert all(axis.has_data() for axis in mine), name
        assert not other.has_data(), name
        if count > 1:
            with pytest.raises(ValueError, match=f"needs {count} Axes"):
                draw(mine[:-1])
        plt.close(figure)
        several = "orbit", "balance", "sweep_map", "fit_residuals", "elements"
        if name in (*several, "ephemeris_comparison"):
            assert np.size(draw(None)) == count, name
            plt.close("all")


def test_unknown_keywords_are_rejected_with_those_that_there_are():
    t = np.arange(3.0)
    for draw, args, wrong, known in (
        (plot.phase_portrait, (arrays(),), "color", "'color'. Allowed are labels, colour"),
        (plot.invariants, (t, {"a": 1 + t}), "label", "'label'. Allowed are labels"),
        (plot.bifurcation, (t, np.ones((3, 2))), "labels", "Allowed are units"),
        (plot.animate, (arrays(), "a.gif"), "colour", "Allowed are labels"),
        (plot.sweep_map, (xr.DataArray(t),), "facets", "Did you mean 'facet'"),
        (plot.failure_map, (xr.DataArray(t),), "limits", "'limits'"),
    ):
        refuses(draw, (args, {wrong: 1}, known, TypeError))


def test_a_phase_portrait_draws_the_states_as_they_are(single):
    axes = plot.phase_portrait(single, units={"q": "au", "p": "au/d"})
    assert axes.shape == (2,)
    for i, axis in enumerate(axes):
        same(lines(axis)[0], [single.qs[:, i], single.ps[:, i]])
    assert axes[1].get_ylabel() == "p$_{2}$ [au/d]"
    same(marked(axes[0], "o")[0], [[single.qs[0, 0], single.ps[0, 0]]])
    ts, q, p = arrays()
    (line,) = lines(plot.phase_portrait((ts, q[:, 0], p[:, 0])))  # a state that is one number
    same(line, [q[:, 0], p[:, 0]])
    assert not drawn_lines(plot.phase_portrait((ts, q, p), dots=True))
    assert plot.phase_portrait(arrays(n=2), dof=[1]).shape == (1,)


def test_orbits_that_failed_end_with_a_cross_and_are_counted(batch, good):
    orbit, portrait = plot.orbit(batch), plot.phase_portrait(batch, dof=0)
    for axis in (orbit, portrait, plot.invariants(batch, {"size": lambda q, p: q @ q})):
        assert "1 of 3 orbits failed: not finite" in legend(axis)
    same(marked(orbit, "x"), [[[0.0, 0.0]]])
    assert not any("failed" in text for text in legend(plot.orbit(good)))
    ts, q, p = arrays(2)
    q = q.copy()
    q[1, 30:] = np.nan  # seen from the numbers, without a status
    same(marked(plot.phase_portrait((ts, q, p)), "x"), [[[q[1, 29, 0], p[1, 29, 0]]]])


def test_a_batch_has_an_orbit_for_each_trajectory_whatever_its_axes():
    orbits = arrays(6)
    axis = plot.phase_portrait(orbits, labels=list("abcdef"))
    assert legend(axis)[:6] == list("abcdef")
    again = plot.phase_portrait(tuple(x.reshape(2, 3, *x.shape[1:]) for x in orbits))
    same(lines(axis), lines(again))
    pair = plot.phase_portrait([arrays(steps=20), arrays(steps=30)])
    assert [xy.shape[1] for xy in lines(pair)] == [20, 30]


def test_orbits_are_coloured_by_a_value_and_the_unknown_is_grey():
    axis = plot.phase_portrait(arrays(3), colour=[1.0, np.nan, 3.0], colour_label="MEGNO")
    shown = [to_hex(line.get_color()) for line in drawn_lines(axis)]
    assert shown == [to_hex(SHADES(0.0)), "#b8b8b8", to_hex(SHADES(1.0))]
    assert "1 of 3 orbits have no value" in legend(axis)


def test_an_angle_is_folded_with_a_gap_where_it_goes_round():
    t = np.linspace(0, 10, 101)
    q, _ = lines(plot.phase_portrait((t, t[:, None], 0 * t[:, None]), period=2 * np.pi))[0]
    assert np.nanmax(np.abs(q)) <= np.pi
    assert np.isnan(q).sum() == 2  # at π and at 3π
    close(np.exp(1j * q[~np.isnan(q)]), np.exp(1j * t), atol=1e-12)


def test_level_lines_are_those_of_the_hamiltonian_at_the_first_initial_condition():
    def H(q, p):
        return (q @ q + p @ p) / 2

    axis = plot.phase_portrait(arrays(n=2), dof=0, hamiltonian=H, levels=[0.7, 0.9])
    (contours,) = axis.collections
    same(contours.levels, [0.7, 0.9])
    for level, path in zip([0.7, 0.9], contours.get_paths(), strict=True):
        # The other degree of freedom is at (1, 0), its energy ½.
        close(np.hypot(*path.vertices.T), np.sqrt(2 * (level - 0.5)), rtol=2e-3)


def test_orbits_have_one_scale_in_the_plane_and_in_space(single):
    axis = plot.orbit(single, centre=[0.5, 0.0])
    same(lines(axis)[0], single.qs.T)
    assert axis.get_aspect() == 1
    t = np.linspace(0, 20, 200)
    qs = np.stack([np.cos(t), np.sin(t), t], 1)
    space = plot.orbit((t, qs))
    same(space.lines[0].get_data_3d(), qs.T)
    sides = [np.ptp(getattr(space, f"get_{letter}lim")()) for letter in "xyz"]
    assert min(sides) > 0.4 * max(sides)
    plane = plot.orbit((t, qs), coordinates=(2, 0))
    same(lines(plane)[0], qs[:, [2, 0]].T)
    refuses(
        plot.orbit,
        (((t, qs),), {"ax": plane}, 'projection="3d"'),
        (((t, qs), (0, 1)), {"ax": space}, "projection"),
    )


def test_bodies_are_drawn_by_name_about_one_of_them():
    ts, q, _ = arrays(n=6, shape=(3, 2))
    ts, q = np.ravel(ts), q.reshape(50, 3, 2) + RNG.normal(size=(50, 3, 2))
    assert legend(plot.orbit((ts, q), names=["A", "B", "C"])) == ["A", "B", "C", "start"]
    relative = plot.orbit((ts, q), centre=1)
    same(lines(relative), [(q[:, 0] - q[:, 1]).T, (q[:, 2] - q[:, 1]).T])
    assert relative.get_xlabel() == "x − x$_{2}$"
    assert len(lines(plot.orbit((ts, q), bodies=[2]))) == 1


def states(*shapes, dtype=float):
    return tuple(np.ones(shape, dtype) for shape in shapes)


ENERGY = systems.kepler().observables["energy"]  # of (t, q, p, args)


def test_orbits_and_choices_that_do_not_fit_are_named():
    two, bodies = arrays(n=2), arrays(n=6, shape=(3, 2))
    refuses(
        plot.phase_portrait,
        ((states(5, (4, 2), (4, 2)),), {}, r"ts of shape \(5,\), qs of shape \(4, 2\)"),
        ((states(5, (5, 2), (5, 3)),), {}, r"qs of .*\(5, 2\), ps of .*\(5, 3\)"),
        ((states(3, (3, 1), (3, 1), dtype=complex),), {}, "complex", TypeError),
        ((states(3, (3, 1)),), {}, "needs momenta", TypeError),
        (states((3, 1)), {}, "must be a Solution", TypeError),
        ((3.0,), {}, "must be a Solution", TypeError),
        (([],), {}, "orbits is empty"),
        (([arrays(n=1), two],), {}, r"shapes \[\(1,\), \(2,\)\]"),
        ((arrays(n=7),), {}, r"7 degrees of freedom are too many.*dof=\[0, 1\]"),
        ((two,), {"dof": 2}, "dof must be a number from 0 to 1 .*, got 2"),
        ((two,), {"dof": []}, "dof is empty"),
        ((two,), {"labels": ["a", "b"]}, r"1 names .* got \['a', 'b'\]"),
        ((bodies,), {"dof": 0}, "a tuple of 2 numbers"),
        ((two,), {"period": 0}, "period must be a positive"),
        ((arrays(3),), {"colour": [1, 2]}, r"shape \(3,\); got colour of shape \(2,\)"),
        ((two, 0, lambda q, p: q), {}, r"must return one number; .*shape \(2,\)"),
        ((two, 0, ENERGY), {}, r"hamiltonian must take.*\(q, p\), got energy", TypeError),
    )
    refuses(
        plot.orbit,
        ((arrays(n=1),), {}, "use phase_portrait"),
        ((arrays(n=4),), {}, r"coordinates=\(0, 1\)"),
        ((two,), {"coordinates": (0,)}, "two or three"),
        ((two,), {"centre": [1.0]}, r"shape \(2,\)"),
        ((two,), {"colour": [1.0]}, "several orbits"),
        ((bodies,), {"bodies": [3]}, "from 0 to 2"),
        ((bodies,), {"names": ["A"]}, "3 names of bodies"),
        ((arrays(2, n=2),), {"names": ["A", "B"]}, "2 orbits.*labels="),
    )


def test_a_trajectory_is_drawn_as_its_shape_suggests(single):
    assert plot.trajectory(arrays()).get_xlabel() == "q"
    same(lines(plot.trajectory(single))[0], single.qs.T)
    assert len(lines(plot.trajectory(*arrays(n=4), time="t [s]", position="m"))) == 4
    refuses(plot.trajectory, ((arrays(2),), {}, "a single orbit, got 2"))


def test_a_long_line_is_drawn_whole_in_pieces():
    orbit = arrays(steps=50_001)
    first, *rest = lines(plot.phase_portrait(orbit))
    whole = np.concatenate([first, *(piece[:, 1:] for piece in rest)], axis=1)
    same(whole, [orbit[1][:, 0], orbit[2][:, 0]])


def test_invariants_are_changes_since_the_first_value(single):
    axes = plot.invariants(single, units={"t": "d"})
    # "largest" and "section" have no value per step.
    assert not {"largest", "section"} & {axis.get_ylabel().splitlines()[0] for axis in axes}
    (axis,) = [a for a in axes if a.get_ylabel() == "energy\nrelative change"]
    E = np.asarray(single.observed["energy"])
    t, change = lines(axis)[0]
    same(t, single.ts)
    close(change, (E - E[0]) / abs(E[0]), atol=1e-15)


def test_functions_of_the_state_begin_at_the_initial_condition(good):
    def L(q, p):
        return q[0] * p[1] - q[1] * p[0]

    axis = plot.invariants(good, {"L": L}, change="absolute", units={"L": "J s"})
    for k, (t, change) in enumerate(lines(axis)):
        values = L(good.qs[k].T, good.ps[k].T)
        same(t, good.ts[k])
        close(change, values - values[0], atol=1e-14)
    value = plot.invariants(good, {"r": lambda q, p: jnp.linalg.norm(q)}, change="value")
    assert lines(value)[0][1][0] == pytest.approx(1.2)


def test_solutions_of_several_runs_share_a_panel_for_observables_of_all(single, good):
    observed = {"energy": single.observed["energy"][:21]}
    short = SimpleNamespace(ts=single.ts[:21], qs=single.qs[:21], observed=observed)
    axis = plot.invariants([good, short], labels=["a", "b", "c"])
    assert [len(xy[0]) for xy in lines(axis)] == [61, 61, 21]
    same(lines(axis)[0][1][:21], lines(axis)[2][1])
    mine = {"E": [np.ones(61), np.ones(61), np.r_[1, 2 * np.ones(20)]]}
    assert lines(plot.invariants([good, short], mine))[2][1].max() == 1
    refuses(plot.invariants, (([good, short], {"E": np.ones(61)}), {}, "a list of 3 arrays"))


def test_vectors_change_by_the_length_of_their_difference():
    v = np.array([[3.0, 4], [3, 4], [3, 5], [0, 0]])
    close(lines(plot.invariants(np.arange(4.0), {"L": v}))[0][1], [0, 0, 0.2, 1.0])


def test_a_logarithmic_axis_has_all_quantities_of_one_orbit_and_counts_zeros():
    t = np.arange(1.0, 7.0)
    v = 1 + np.array([0, 1e-15, 0, 3e-15, -2e-14, 0])
    axis = plot.invariants(t, {"E": v, "L": 2 + 1e-3 * t}, log=True)
    assert legend(axis) == ["E", "L", "2 values exactly 0"]
    same(np.isnan(lines(axis)[0][1]), [True, False, True, False, False, True])
    assert texts(axis) == ["machine epsilon"]
    assert not texts(plot.invariants(t, {"L": 2 + 1e-3 * t}, log=True))
    assert plot.invariants(t, {"E": v, "L": 2 + t}).shape == (2,)


def test_invariants_that_cannot_be_drawn_are_named(single):
    t = np.arange(4.0)
    two = np.stack([t, 1 + t])
    axis = plot.invariants(np.stack([t, t]), {"L": two})  # a batch keeps its good ones
    same([xy[1] for xy in lines(axis)], [[np.nan] * 4, t])
    assert "L: 1 of 2 orbits start at 0" in legend(axis)
    refuses(
        plot.invariants,
        ((t, {"L": t}), {}, "is 0 at the start of every orbit"),
        ((t, {"E": np.ones(6)}), {}, r"shape \(4,\).*of shape \(6,\)"),
        ((t, {"E": 1j * t}), {}, "complex", TypeError),
        ((t, {"E": lambda q, p: q}), {}, "momenta", TypeError),
        ((t,), {}, "a dict of observables, got type NoneType", TypeError),
        (("orbit", {"E": t}), {}, "or times, got 'orbit'", TypeError),
        ((t, {}), {}, "values is empty: give"),
        ((t, dict.fromkeys("abcdefghijklm", 1 + t)), {}, "13 quantities are too"),
        ((single,), {"change": "log"}, "change must be one of 'relative', 'absolute', 'value'"),
        ((single, {"E": ENERGY}), {}, r"values\['E'\] must.*\(q, p\).*observe=", TypeError),
        ((single, {"E": lambda t, q, p, args: t}), {}, r"\(q, p\).*observe=", TypeError),
    )
    refuses(plot.conserved, ((t, {"E": np.ones(3)}, "t", ""), {}, "'E' must have one number"))


def test_numbers_without_a_place_on_the_axis_are_counted():
    t = np.arange(9.0)
    part = np.where(t > 5, np.nan, 1e-9)
    axis = plot.conserved(t, {"a": 0 * t, "b": part, "c": 1 + t}, "t", "")
    assert legend(axis)[:3] == ["a", "b", "c"]
    assert legend(axis)[3:] == ["a: 8 of 8 are exactly 0", "b: 3 of 8 are not finite"]
    same(axis.lines[2].get_ydata(), 1 + t[1:])
    axes = plot.changes(t, {"a": np.nan * t, "b": part, "c": t}, "t", "")
    assert [texts(a) for a in axes] == [["9 of 9 are not finite"], ["3 of 9 are not finite"], []]


def test_the_balance_is_a_stack_whose_ends_add_up_to_the_drift():
    t = np.linspace(0, 1, 40, endpoint=False)
    causes = {"a": np.sin(7 * t), "b": -0.5 + t, "c": 0.3 * np.cos(20 * t)}
    drift = sum(causes.values()) + 1e-3
    top, bottom = plot.balance(t, drift, causes, unit="J/s")
    edges = np.zeros((2, 40))
    for k, values in enumerate(causes.values()):
        edges += [np.maximum(values, 0), np.minimum(values, 0)]
        up, down = (c.get_paths()[0].vertices for c in top.collections[2 * k : 2 * k + 2])
        assert up[:, 1].max() == pytest.approx(edges[0].max())
        assert down[:, 1].min() == pytest.approx(edges[1].min())
    close(edges.sum(0), drift - 1e-3)
    same(top.lines[0].get_ydata(), drift)
    close(bottom.lines[0].get_ydata(), 1e-3, atol=1e-15)
    assert len({c.get_hatch() for c in top.collections}) == 3  # seen without colours
    parts = dict(zip(("symmetry", "work", "lattice"), causes.values(), strict=True))
    top, _ = plot.balance(SimpleNamespace(ts=t, drift=drift, **parts))
    same(top.lines[0].get_ydata(), drift)
    assert legend(top) == ["symmetry", "work", "time grid", "drift"]
    refuses(
        plot.balance,
        ((t, drift, {"a": np.ones(3)}), {}, r"a of shape \(3,\)"),
        ((t, drift), {}, "got causes=None", TypeError),
    )


def test_a_cumulative_balance_begins_at_0_and_has_uneven_steps():
    """A rate that is the slope of t² over each step brings t² itself."""
    t = np.array([0.0, 0.1, 0.4, 1.0, 1.1, 3.0])
    rate = np.append(np.diff(t**2) / np.diff(t), 1e9)  # of a last step without an end
    top, bottom = plot.balance(t, rate, {"a": rate}, cumulative=True)
    close(top.lines[0].get_ydata(), t**2, atol=1e-15)
    same(bottom.lines[0].get_ydata(), 0)
    close(top.collections[0].get_paths()[0].vertices[:, 1].max(), 9)


def test_indicators_are_drawn_with_their_value_for_regular_motion():
    t = np.geomspace(1, 1e4, 60)
    megno = plot.indicator(t, np.stack([2 - 1 / t, 0.1 * t]), "megno", labels=["regular", "wild"])
    same(lines(megno)[0], [t, 2 - 1 / t])
    assert legend(megno) == ["regular", "wild", "regular: 2"]
    assert 2.0 in {line.get_ydata()[0] for line in megno.lines if len(line.get_xdata()) == 2}
    exponents = plot.indicator(np.r_[0, t], {"e": np.stack([3 / t, 0.1 + 0 * t])}, "lyapunov")
    x, y = lines(exponents)[-1]
    assert np.diff(np.log(y))[0] / np.diff(np.log(x))[0] == pytest.approx(-1)
    assert (x[0], y[0]) == (1.0, 3.0)
    gali = lines(plot.indicator(t, t**-2, "gali", slope=-2))
    close(gali[0][1][-1], gali[1][1][-1])
    refuses(
        plot.indicator,
        ((t, t, "fli"), {}, "'megno', 'lyapunov', 'sali', 'gali'"),
        ((t, np.ones(7)), {}, r"\(..., 60\) or \(..., 59\)"),
    )


def test_indicators_of_runs_backward_are_drawn_at_the_time_since_the_start():
    t = -np.geomspace(1, 1e3, 40)
    for ts, options in ((t, {}), (np.r_[5, 5 + t], {}), (5 + t, {"t0": 5.0})):
        close(lines(plot.indicator(ts, 2 + 0 * t, "megno", **options))[0][0], -t)


def test_indicators_count_values_without_a_place_each_by_its_reason():
    t, v = np.arange(6.0), np.array([1.0, 2, np.nan, 0, -1, 3])
    at_start = "1 values at the start, t = t$_0$"
    notes = ["1 values are not finite", at_start, "2 values are not positive"]
    assert legend(plot.indicator(t, v, "lyapunov"))[-3:] == notes
    assert legend(plot.indicator(t, v)) == notes[:1]
    lost = plot.indicator(t[1:], np.where(t[1:] > 2, 0.0, 1.0), "sali")
    assert legend(lost) == ["3 values are not positive"]


def crossings(counts, *statuses, room=5, n=2):
    """`Crossings` of orbits that crossed so often, or a `PoincareSection` with these statuses."""
    rows = np.arange(room) < np.minimum(np.asarray(counts), room)[:, None]
    q = np.where(rows[..., None], RNG.normal(size=(len(counts), room, n)), np.nan)
    p = np.where(rows[..., None], RNG.normal(size=q.shape), np.nan)
    orbits = SimpleNamespace(ts=q[..., 0], qs=q, ps=p, count=np.asarray(counts, float))
    if statuses:
        orbits.status = np.asarray(statuses)
    return orbits


def offsets(axis):
    return np.concatenate([c.get_offsets() for c in axis.collections])


def test_a_section_draws_every_crossing_once(batch):
    section = batch.observed["section"]
    axis = plot.section(batch, x="p[0]", y="q[1]")
    finite = np.isfinite(np.asarray(section.ts))
    assert finite.sum() > 0
    same(offsets(axis), np.stack([section.ps[finite][:, 0], section.qs[finite][:, 1]], 1))
    assert "1 of 3 orbits failed: not finite" in legend(axis)


def test_a_section_reports_missing_crossings():
    axis = plot.section(crossings([7, 0, 3]))
    assert len(offsets(axis)) == 8
    assert legend(axis) == [
        "1 of 3 orbits crossed more than the 5 times stored",
        "1 of 3 orbits did not cross",
    ]
    assert texts(plot.section(crossings([0, 0]))) == ["no orbit crossed the section"]


ENDED = [
    "1 of 5 orbits crossed less than the required 5 times",
    "1 of 5 orbits stopped",
    "1 of 5 orbits failed",
    "1 of 5 orbits did not cross",
    "1 of 3 crossings of failed orbits lie outside the picture",
]


def test_a_section_names_how_orbits_ended_and_failed_ones_do_not_set_its_limits():
    names = "successful", "too_few_crossings", "never_crossed", "stopped", "failed"
    made = crossings([5, 2, 0, 4, 3], *names)
    made.qs[4, :2], made.ps[4, :2] = made.qs[0, 0], made.ps[0, 0]
    made.qs[4, 2], made.ps[4, 2] = 1e9, 1e12
    for_bifurcation = [*ENDED[:3], ENDED[4], "1 of 5 runs have no crossing"]
    for draw, notes in (
        (lambda: plot.section(made), ENDED),
        (lambda: plot.section(made, colour=np.arange(5.0)), ENDED),
        (lambda: plot.bifurcation([0, 1, 3, 4, 2], made), for_bifurcation),
    ):
        axis = draw()
        assert legend(axis) == notes
        assert np.abs(axis.axis()).max() < 10
        assert len(offsets(axis)) == 14  # drawn nevertheless
        made.status[4] = "successful"
        assert np.abs(draw().axis()).max() > 1e8
        made.status[4] = "failed"
    assert len(offsets(plot.section(crossings([3], "failed")))) == 3


@pytest.mark.slow
def test_a_poincare_section_of_runs_that_failed_says_why():
    kepler = systems.kepler()
    q, p = jnp.array([[1.2, 0.0], [0.0, 0.0]]), jnp.broadcast_to(jnp.asarray(kepler.p0), (2, 2))
    found = dvi.poincare_section(
        kepler.system, q, p, lambda t, q, p, args: q[0], h=0.1, num_steps=100, crossings=40,
        args=kepler.args, method=dvi.Strang(), throw=False,
    )  # fmt: skip
    assert list(found.status) == ["too_few_crossings", "failed"]
    assert legend(plot.section(found)) == [
        "1 of 2 orbits crossed less than the required 40 times",
        "1 of 2 orbits failed: not finite",
    ]


def test_sections_are_coloured_by_orbit_or_by_value():
    axis = plot.section(crossings([5, 5, 5]), labels=["a", "b", "c"])
    shown = [to_hex(c.get_facecolor()[0]).upper() for c in axis.collections]
    assert shown == list(plot.COLOURS[:3])
    made = crossings([5, 2, 4])
    axis = plot.section(made, colour=[2.0, np.nan, 9.0], colour_label="MEGNO", limits=(2, 4))
    (cloud,) = axis.collections
    shades = [to_hex(c) for c in cloud.get_facecolors()]
    assert shades == [to_hex(SHADES(0.0))] * 5 + ["#b8b8b8"] * 2 + [to_hex(SHADES(1.0))] * 4
    assert "1 of 3 orbits have no value" in legend(axis)


def test_sections_take_functions_of_the_state():
    made = crossings([3, 4])

    def action(q, p):
        return (q @ q + p @ p) / 2

    axis = plot.section(made, x=action, y=lambda q, p: jnp.arctan2(p[0], q[0]), units={"q": "m"})
    q, p = (x[np.isfinite(made.ts)] for x in (made.qs, made.ps))
    angle = np.arctan2(p[:, 0], q[:, 0])
    close(offsets(axis), np.stack([(np.sum(q**2, 1) + np.sum(p**2, 1)) / 2, angle], 1))
    nothing, several = SimpleNamespace(ts=1, qs=1, ps=1, observed={}), [made] * 2
    refuses(
        plot.section,
        ((made,), {"x": "q[2]"}, "the index in 'q.2.' must be a number from 0 to 1"),
        ((made,), {"x": "r[0]"}, r'such as "q\[0\]"'),
        ((made,), {"colour": [1.0]}, r"colour of shape \(1,\)"),
        ((made,), {"labels": ["a"]}, "2 names of orbits"),
        *(((x,), {}, "one dvi.Section", TypeError) for x in (np.ones((3, 2)), nothing, several)),
    )


def test_a_bifurcation_has_a_column_of_points_for_each_parameter():
    made = crossings([5, 0, 3], n=1)
    axis = plot.bifurcation([0.1, 0.2, 0.3], made, y="q", skip=1, name="ε [1]", units={"q": "m"})
    drawn = offsets(axis)
    close(drawn[:, 0], [0.1] * 4 + [0.3] * 2)
    same(drawn[:4, 1], made.qs[0, 1:, 0])
    assert legend(axis) == ["1 of 3 runs have no crossing after the first 1"]
    numbers = plot.bifurcation([1, 10], np.ones((2, 4)), log=True, y="x [m]")
    assert (numbers.get_xscale(), legend(numbers)) == ("log", [])
    refuses(
        plot.bifurcation,
        (([1, 2], np.ones((3, 4))), {}, r"of shape \(2,\), crossings of shape \(3, 4\)"),
        (([1, 2], np.ones((2, 4))), {"skip": -1}, "of at least 0, got -1"),
        (([0, 2], np.ones((2, 4))), {"log": True}, "positive parameter, got 0"),
    )


COST = 10.0 ** np.arange(1, 6)
FLAT = [1e-3, 1e-5, 1e-7, 1.1e-7, 1.3e-7]  # round-off after three runs


@pytest.mark.parametrize(
    ("runs", "slope"),
    [
        ((COST[::-1], COST[::-1] ** -2), "slope −2.0"),
        ((COST, np.maximum(1e4 * COST**-4, 1e-14)), "slope −4.0"),
        ((COST, FLAT), "slope −2.0"),
        ((COST, [1.0, 9.0, 1.0, 1e-3, 1e-6]), "slope −3.0"),  # steps that are too long at first
        ((COST[:4], [1.0, 1e-1, 1e-3, 1e-6]), "slope −2.5, not settled"),
        ((COST[:2], [1, 1e-2]), "slope −2.0 of two runs"),
        (([1, 10, 10, 100], [1.0, 1e-2, 1e-4, 1e-6]), "slope −3.0"),  # equal costs: together 1e-3
        (([1, 10, 10, 100], [1.0, 1e-4, 1e-2, 1e-6]), "slope −3.0"),
        (([1, 2], [1e-16, 1e-16]), "no slope"),
    ],
)
def test_work_precision_measures_slopes_before_round_off(runs, slope):
    axis = plot.work_precision({"a": runs}, front=False)
    assert legend(axis) == [f"a: {slope}"]
    order = np.argsort(runs[0], kind="stable")
    same(axis.lines[0].get_data(), np.asarray(runs, float)[:, order])


@pytest.mark.parametrize(("ratio", "count"), [(1.3, 3), (4, 2), (12, 3), (200, 3)])
def test_labels_of_a_short_logarithmic_axis_do_not_touch(ratio, count):
    _, ax = plt.subplots(figsize=(4, 3))
    axis = plot.work_precision({"a": ([0.013, 0.013 * ratio], [0.1, 0.01])}, ax=ax)
    axis.figure.draw_without_rendering()
    left, right = axis.get_window_extent().intervalx
    labels = [x for x in axis.get_xticklabels(which="both") if x.get_text()]
    boxes = sorted((x.get_window_extent() for x in labels), key=lambda box: box.x0)
    boxes = [box for box in boxes if left < 0.5 * (box.x0 + box.x1) < right]
    assert len(boxes) == count
    assert all(a.x1 + 4 < b.x0 for a, b in itertools.pairwise(boxes))


def test_work_precision_finds_the_front_and_marks_runs_without_a_place():
    errors = {"two": COST**-2, "four": np.maximum(1e4 * COST**-4, 1e-14)}
    axis = plot.work_precision({name: (COST, e) for name, e in errors.items()})
    same(lines(axis)[2], [COST, [1e-2, 1e-4, 1e-8, 1e-12, 1e-14]])
    assert legend(axis)[-1] == "front"
    axis = plot.work_precision({"a": ([1.0, 2, 4, 8], [np.nan, 0.0, 0.1, np.inf])})
    same(marked(axis, "x")[0][:, 0], [1.0, 8.0])
    same(marked(axis, "v")[0][:, 0], [2.0])
    assert legend(axis)[-2:] == ["2 of 4 runs failed", "1 of 4 runs without error"]
    refuses(
        plot.work_precision,
        (({},), {}, "results is empty"),
        (({"a": ([1, 2], [1])},), {}, r"of one shape \(runs,\), got"),
        (({"a": ([0, 2], [1, 1])},), {}, "must be positive and finite, got 0.0"),
        (({"a": 3},), {}, r"must be \(costs, errors\).*got 3"),
    )


def test_drifts_that_failed_or_are_0_keep_their_place():
    order = SimpleNamespace(
        epsilons=np.array([0.1, 0.2, 0.4, 0.8]), drifts=np.array([0.0, 0.1, np.nan, 0.3]),
        used=np.array([False, True, False, True]), slope=1.0, interval=(0.9, 1.1), floor=0.0,
        resolved=True,
    )  # fmt: skip
    axis = plot.drift_orders({"a": order}, expected=[None])  # then there is no grey line
    assert "expected slope" not in legend(axis)
    same(marked(axis, "x")[0][:, 0], [0.4])
    close(marked(axis, "v")[0][:, 0], [0.1, 0.07])
    assert legend(axis)[-2:] == ["1 of 5 drifts failed", "2 of 5 drifts are exactly 0"]
    order.drifts, order.floor = np.array([0.05, 0.1, 0.2, 0.3]), 1e-3
    whole = legend(plot.drift_orders({"a": order}, expected=1))
    assert whole[0] == "a: slope 1.00 ± 0.10, expected 1"
    assert "expected slope" in whole
    assert not any("drifts" in text for text in whole)


def test_a_spectrum_draws_sizes_at_their_frequencies():
    w = np.array([[1.0, 2.5, np.nan], [1.0, -0.5, 3.0]])
    A = np.array([[1, 0.1j, 0.3], [0.5, 0.2, 0.0]])
    both = SimpleNamespace(frequencies=w, amplitudes=A)
    axis = plot.spectrum(both, labels=["x", "y"], fundamental={"ω": 1.0})
    close(axis.lines[0].get_xydata(), [[1.0, 1.0], [2.5, 0.1]])
    close([s[1] for s in axis.collections[1].get_segments()], [[1.0, 0.5], [-0.5, 0.2]])
    assert legend(axis) == ["x", "y", "ω", "2 of 6 lines have no frequency or amplitude"]
    assert len(plot.spectrum(w[1], A[1], log=False).lines[0].get_xdata()) == 3
    refuses(
        plot.spectrum,
        ((w, A[0]), {}, r"float64.*of shape \(2, 3\), amplitudes of shape \(3,\)"),
        ((w,), {}, "without attributes frequencies, amplitudes", TypeError),
    )


def test_frequencies_are_drawn_against_each_other_or_their_diffusion_over_a_grid():
    x, y = np.array([1.0, 2.0, np.nan]), np.array([0.5, 1.0, 1.0])
    axis = plot.frequency_map(x, y, [-9.0, np.nan, -1.0], resonances=[(1, -2)])
    same(offsets(axis), [[1.0, 0.5], [2.0, 1.0]])
    notes = ["1 orbits without a diffusion", "1 of 3 orbits have no frequencies"]
    assert legend(axis) == notes
    assert texts(axis) == ["(1, −2)"]
    a, b = np.linspace(0, 1, 4), np.linspace(2, 4, 3)
    D = RNG.uniform(-9, -1, (4, 3))
    D[1, 2] = np.nan
    grid = plot.frequency_map(a, b, D, limits=(-8, -2), names=("a [au]", "e"))
    mesh = grid.collections[0]
    same(mesh.get_array().filled(np.nan), D.T)
    assert (mesh.norm.vmin, mesh.norm.vmax) == (-8, -2)
    assert legend(grid) == ["1 of 12 orbits have no value"]
    refuses(
        plot.frequency_map,
        ((x, y), {"resonances": [(0, 0)]}, "not both 0"),
        ((x, y[:2]), {}, r"y of shape \(2,\)"),
        ((a[::-1], b, D), {}, r"must be increasing and finite, got x\[1\] ="),
        ((a, b, D), {"resonances": [(1, -1)]}, r"require frequencies.* of shape \(4, 3\)"),
    )


@pytest.mark.parametrize(
    ("x", "y", "k"), [((1, 3), (0.5, 2), (1, -1)), ((1, 2), (0.5, 3), (1, -1)),
                      ((-2, 0), (1, 3), (1, 1))],
)  # fmt: skip
def test_a_resonance_has_its_name_where_its_line_leaves_the_picture(x, y, k):
    axis = plot.frequency_map(np.asarray(x), np.asarray(y), resonances=[k])
    (name,) = axis.texts
    assert np.dot(k, name.xy) == pytest.approx(0, abs=1e-12)
    (left, right), (low, high) = axis.get_xlim(), axis.get_ylim()
    fractions = np.divide(np.subtract(name.xy, (left, low)), (right - left, high - low))
    assert (np.abs(fractions - 0.5) < 0.5 + 1e-9).all()
    assert np.max(np.abs(fractions - 0.5)) == pytest.approx(0.5)


def frames(path):
    """Pictures and delays [ms] of a GIF."""
    image = Image.open(path)
    pictures, delays = [], []
    for k in range(image.n_frames):
        image.seek(k)
        pictures.append(np.asarray(image.convert("RGB")).astype(int))
        delays.append(image.info["duration"])
    return pictures, delays


@pytest.mark.slow
def test_a_film_has_the_requested_frames_and_length(tmp_path, batch):
    calls = []
    path = plot.animate(
        batch, tmp_path / "film.gif", seconds=0.7, fps=10, size=(3, 2.5), dpi=40,
        progress=lambda done, total: calls.append((done, total)),
    )  # fmt: skip
    images, delays = frames(path)
    assert (len(images), sum(delays)) == (7, 700)
    assert images[0].shape == (100, 120, 3)
    assert calls == [(k, 7) for k in range(1, 8)]
    assert [file.name for file in tmp_path.iterdir()] == ["film.gif"]
    for a, b in itertools.pairwise(images):
        assert (np.abs(a - b).max(-1) > 60).sum() > 10
    assert (images[0][0, :5] == 255).all()  # white paper
    path = plot.animate(arrays(steps=4), tmp_path / "few.gif", seconds=1, size=(3, 3), dpi=30)
    images, delays = frames(path)  # few states are shown for longer
    assert (len(images), delays) == (4, [250] * 4)


def test_a_film_names_all_its_orbits_and_counts_those_that_failed(tmp_path, monkeypatch):
    """Eight long names in a narrow film: each of them lies within it."""
    ts, q, p = arrays(8)
    q = q.copy()
    q[3, 20:] = np.nan
    figures = []
    monkeypatch.setattr(films, "write_gif", lambda scene, part, *_: (
        figures.append(scene.axis.figure), part.write_bytes(b"")))  # fmt: skip
    names = [f"orbit with a long name {k}" for k in range(8)]
    plot.animate((ts, q, p), tmp_path / "a.gif", labels=names, size=(5, 5), dpi=60)
    (box,) = figures[0].legends
    assert legend(figures[0].axes[0]) == [*names, "1 of 8 orbits failed: not finite"]
    figures[0].canvas.draw()
    assert all(lies_within(text, figures[0]) for text in box.get_texts())


def test_a_film_shows_times_that_are_evenly_spaced(tmp_path):
    """Steps that grow: the head is where the orbit is, not at every so many states."""
    t = np.linspace(0, 3, 400) ** 2
    look = {"seconds": 1, "fps": 5, "size": (4, 2), "dpi": 60, "tail": 0}
    images, _ = frames(plot.animate((t, np.stack([t, 0 * t], 1)), tmp_path / "line.gif", **look))
    blue = 255 * np.array(to_rgb(plot.COLOURS[0]))
    heads = [np.argwhere(np.abs(f - blue).max(-1) < 40)[:, 1].mean() for f in images]
    close(np.diff(heads), np.diff(heads).mean(), atol=2.5)
    assert np.diff(heads).mean() > 20


@pytest.mark.slow
def test_films_beside_phase_portraits_and_invariants_and_in_space(tmp_path, single):
    t = np.linspace(0, 20, 30)
    qs = np.stack([np.cos(t), np.sin(t), t], 1)
    qs[20:] = np.nan
    energy = {"values": {"energy": single.observed["energy"]}}
    for orbits, options in (
        (single, {"beside": "phase_portrait", "dof": 1}),
        (single, {"beside": "invariants", **energy}),
        ((t, qs), {}),
        (arrays(), {}),  # in (q, p)
    ):
        look = {"seconds": 0.2, "fps": 10, "size": (5, 2.5), "dpi": 40} | options
        images, _ = frames(plot.animate(orbits, tmp_path / "film.gif", **look))
        change = np.abs(images[0] - images[-1])
        assert change.sum() > 1000
        assert not options or change[:, 112:].sum() > 2000  # the second picture moves


def test_films_that_cannot_be_made_leave_nothing_behind(tmp_path, monkeypatch):
    orbit = arrays(n=2)
    nowhere = (np.arange(3.0), np.full((3, 2), np.nan))
    names = {"names": ["A", "B"]}
    cases = [
        (orbit, "a.avi", {}, "one of '.gif', '.mp4', got '.avi'"),
        (orbit, "a.gif", {"fps": 60}, "at most 50"),
        (orbit, "a.gif", {"seconds": 0}, "seconds must be a positive and finite"),
        (orbit, "a.gif", {"tail": 2}, "a fraction from 0 to 1, got 2"),
        (orbit, "a.gif", {"beside": "energy"}, "one of None, 'phase_portrait', 'invariants'"),
        (orbit, "none/a.gif", {}, "there is no directory", FileNotFoundError),
        (orbit, "a.gif", {"size": (40, 40), "dpi": 600}, "pixels of all frames"),
        (arrays(2, n=2), "a.gif", names, "2 orbits"),
        (arrays(), "a.gif", names, r"states of shape \(1,\)"),
        (nowhere, "a.gif", {}, "finite states"),
        (arrays()[:2], "a.gif", {}, "needs momenta", TypeError),
        (orbit, "a.mp4", {}, r"ffmpeg.*install.*or write a \.gif", RuntimeError),
    ]
    kind = type(matplotlib.animation.writers)
    monkeypatch.setattr(kind, "is_available", lambda self, name: False)
    for orbits, name, options, *expected in cases:
        refuses(plot.animate, ((orbits, tmp_path / name), options, *expected))

    def interrupt(done, total):
        raise KeyboardInterrupt

    (tmp_path / "old.gif").write_bytes(b"what was there")
    with pytest.raises(KeyboardInterrupt):
        plot.animate(orbit, tmp_path / "old.gif", seconds=0.2, dpi=30, progress=interrupt)
    left = [(f.name, f.read_bytes()) for f in tmp_path.iterdir()]
    assert left == [("old.gif", b"what was there")]


@pytest.mark.skipif(
    not matplotlib.animation.writers.is_available("ffmpeg"), reason="ffmpeg is not installed"
)
def test_an_mp4_is_written_if_ffmpeg_is_installed(tmp_path):
    path = plot.animate(arrays(n=2), tmp_path / "a.mp4", seconds=0.5, fps=10, size=(3, 3), dpi=50)
    assert path.read_bytes()[4:8] == b"ftyp"
    assert path.stat().st_size > 2000


def test_the_gallery_rejects_an_unknown_picture_before_it_draws(tmp_path, monkeypatch, capsys):
    spec = importlib.util.spec_from_file_location("gallery", ROOT / "examples" / "gallery.py")
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    monkeypatch.setattr(sys, "argv", ["gallery.py", str(tmp_path / "g"), "drift_orders", "no"])
    with pytest.raises(SystemExit):
        gallery.main()
    assert "no picture is called no: there are" in capsys.readouterr().err
    assert not (tmp_path / "g").exists()
