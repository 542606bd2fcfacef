"""The pictures of the explorer as numbers: what they show, what they compile, what is copied."""

import time
from dataclasses import replace

import cli
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import programs_of_xla

import dvi_jax as dvi
from dvi_jax import systems
from dvi_jax.explorer import copies
from dvi_jax.explorer.model import Model
from dvi_jax.explorer.subject import METHODS, Subject, with_leaf


def model(name="henon_heiles", **start):
    lines = f"problem = dvi.systems.{name}()"
    return Model(Subject(systems.LIBRARY[name](), start, lines, name))


def executed(page, view, **names):
    """The names that the copied code assigns."""
    code = copies.python(page, view).replace("plt.show()", "plt.close('all')")
    exec(compile(code, "copy.py", "exec"), names)
    return names


@pytest.fixture(scope="module")
def heiles():
    """With a short run, so that steps = 1000 compiles once for the file."""
    page = model(method="Strang")
    page.change(steps=1000)
    page.motion()
    return page


@pytest.fixture(autouse=True)
def initial(heiles):
    heiles.settings, heiles.orbits = replace(heiles.subject.start, steps=1000), []


def test_sliders_compile_nothing(heiles):
    with programs_of_xla() as programs:
        for key, value in (("h", 0.09), ("q0[1]", 0.12), ("p0[0]", 0.3)):
            heiles.move(key, value)
            assert heiles.motion().message == ""
    assert programs == []
    kepler = model("kepler")
    kepler.change(steps=1000)
    first = kepler.motion()
    with programs_of_xla() as programs:
        kepler.move("epsilon", 0.01)
        kepler.move("args.K", 1.01)
        moved = kepler.motion()
    assert programs == []
    assert not np.array_equal(first.paths[""][0], moved.paths[""][0])
    kepler.change(steps=999)  # the control: another number of steps is another program
    with programs_of_xla() as programs:
        kepler.motion()
    assert programs != []


@pytest.mark.slow
def test_motion_is_that_of_integrate(heiles):
    settings = heiles.settings
    sol = dvi.integrate(
        heiles.subject.problem, h=settings.h, num_steps=1000, epsilon=0.0, method="Strang"
    )
    picture = heiles.motion()
    assert picture.is_line
    np.testing.assert_array_equal(picture.paths[""][0], sol.qs[:, 0])
    H = [float(heiles.subject.system.hamiltonian(0, 0, q, p, 0.0, None))
         for q, p in zip(sol.qs[:3], sol.ps[:3], strict=True)]  # fmt: skip
    np.testing.assert_allclose(picture.series[1][:3], H, rtol=1e-14)
    assert 1e-6 < np.nanmax(picture.changes["energy"][1]) < 1e-2
    heiles.change(observable="p[1]", path=("q[0]", "p[0]"))
    other = heiles.motion()
    np.testing.assert_array_equal(other.paths[""][1], sol.ps[:, 0])
    np.testing.assert_array_equal(other.series[1], sol.ps[:, 1])
    assert other.labels == ("q[0]", "p[0]", "p[1]")


def test_few_points_are_drawn_with_all_extremes():
    from dvi_jax.explorer.model import BINS, _envelope, _largest

    ts = np.arange(100_001.0)
    values = np.sin(ts)
    values[77_777] = 5.0
    t, least_and_largest = _envelope(ts, values)
    assert len(t) == len(least_and_largest) <= 2 * BINS
    assert (least_and_largest.max(), least_and_largest.min()) == (5.0, values.min())
    _, largest = _largest(ts, np.abs(values))
    assert np.nanmax(largest) == 5.0
    assert np.isnan(_largest(ts, 0 * ts)[1]).all()
    assert _envelope(ts[:50], values[:50])[1] is not None
    np.testing.assert_array_equal(_envelope(ts[:50], values[:50])[1], values[:50])


def test_a_failure_and_bad_values_are_reported():
    page = model("kepler", method="GaussLegendre(2)")
    page.change(steps=1000)
    before = page.settings
    for key, value, text in (
        ("h", 0.0, "h must not be zero"),
        ("h", np.nan, "finite"),
        ("args.K", -1.0, "K must be"),
        ("period", -1.0, "period"),
    ):
        with pytest.raises(ValueError, match=text):
            page.move(key, value)
        assert page.settings is before
    page.move("q0[0]", 0.001)
    page.move("q0[1]", 0.0)
    page.move("p0[0]", 0.0)
    page.move("p0[1]", 1e-3)
    page.move("h", 0.5)
    message = page.motion().message
    assert "failed at step" in message
    assert "of 1000" in message
    with pytest.raises(ValueError, match="the centre"):
        page.move("q0[0]", 0.0)


def test_a_click_is_completed_onto_the_energy_surface(heiles):
    heiles.click(0.1, 0.05)
    heiles.click(-0.2, 0.0)
    q, p = heiles.section_states()
    H = jax.vmap(lambda q, p: heiles.subject.system.hamiltonian(0.0, 0.0, q, p, 0.0, None))
    np.testing.assert_allclose(H(jnp.asarray(q), jnp.asarray(p)), 1 / 12, rtol=1e-14)
    np.testing.assert_array_equal(q[1:, 0], 0.0)
    np.testing.assert_array_equal(q[1:, 1], [0.1, -0.2])
    assert (p[1:, 0] > 0).all()  # so that the orbit crosses in the direction of the section
    with pytest.raises(ValueError, match="no state at"):
        heiles.click(2.0, 2.0)
    assert len(heiles.orbits) == 2


def test_completion_with_a_momentum_that_is_not_quadratic():
    """H = p⁴ + p + q², whose minimum over p is not at p = 0."""
    from dvi_jax.explorer.orbits import onto_energy

    system = dvi.System(lambda t0, t1, q0, p1, args: jnp.sum(p1**4) + p1[0] + jnp.sum(q0**2))
    q, p = np.zeros((2, 2)), np.array([[0.3, 0.1], [0.3, 0.7]])
    energy = jnp.asarray(0.2)
    found = np.asarray(onto_energy(system, (0,), q, p, energy, jnp.asarray(0.0), None))
    values = found[:, 0] ** 4 + found[:, 0] + found[:, 1] ** 4
    np.testing.assert_allclose(values, 0.2, rtol=1e-12)
    assert (4 * found[:, 0] ** 3 + 1 > 0).all()


@pytest.mark.slow
def test_section_and_its_copy(heiles):
    heiles.click(0.1, 0.05)
    heiles.click(-0.2, 0.0)
    picture = heiles.section()
    assert picture.message == ""
    assert picture.x.shape == (3, 400)
    with programs_of_xla() as programs:
        heiles.move("h", 0.09)
        heiles.move("value", 0.01)
        for k in range(8):  # more orbits than one batch has
            heiles.click(0.02 * k, 0.0)
        many = heiles.section()
    assert many.x.shape == (11, 400)
    assert programs == []
    for colour in ("orbit", "MEGNO", "frequency"):
        heiles.change(colour=colour)
        drawn = heiles.section()
        names = executed(heiles, "section")
        np.testing.assert_allclose(drawn.x, names["section"].qs[..., 1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(drawn.y, names["section"].ps[..., 1], rtol=0, atol=1e-9)
        if colour == "orbit":
            assert drawn.colour is None
        else:
            np.testing.assert_allclose(drawn.colour, names["colour"], rtol=1e-7)
    assert (np.abs(drawn.colour - 0.95) < 0.1).all()  # frequencies of Hénon and Heiles are near 1


@pytest.mark.slow
def test_diagram_and_its_copy():
    page = model("duffing", method="Strang")
    assert 'run["epsilon"] = values' in copies.python(page, "diagram")
    page.change(parameter="args.gamma", ends=(0.0, 0.4))
    drawn = page.diagram()
    names = executed(page, "diagram")
    assert drawn.parameter[-1] == 0.4
    assert np.isfinite(drawn.y).any()
    np.testing.assert_allclose(drawn.y, names["diagram"].qs[..., 0], rtol=0, atol=1e-8)
    with programs_of_xla() as programs:
        page.change(ends=(0.0, 0.2))
        page.move("h", page.settings.h * 0.9)
        page.diagram()
    assert programs == []
    page.change(ends=(1.0, 0.0))
    with pytest.raises(ValueError, match="must increase"):
        page.diagram()


@pytest.mark.slow
def test_drifts_their_progress_and_their_copy():
    cubic = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2,
                       force=lambda t0, t1, q0, p1, args: -q0**3)  # fmt: skip
    start = {"q0": [0.4], "p0": [0.3], "h": 0.1}
    page, reports = Model(Subject(cubic, start)), []
    drifts = page.drifts(lambda done, total: reports.append((done, total)))
    assert reports[0] == (0, 1)
    assert reports[-1] == (1 + len(drifts.orders), 1 + len(drifts.orders))
    assert len(drifts.orders) >= 1
    names = executed(page, "drift", problem=cubic)
    assert [str(series) for series in names["discovery"].invariants] == drifts.formulas
    for ours, theirs in zip(drifts.orders, names["orders"], strict=True):
        np.testing.assert_allclose(ours.drifts, theirs.drifts, rtol=1e-6)
    assert drifts.orders[0].slope == pytest.approx(2, abs=0.3)
    page.change(degree=40)
    with pytest.raises(ValueError, match="lower the degree"):
        page.drifts()
    with pytest.raises(ValueError, match="no perturbation"):
        model().drifts()


def test_python_of_a_motion(heiles):
    heiles.move("h", 0.08)
    picture = heiles.motion()
    names = executed(heiles, "motion")
    np.testing.assert_array_equal(picture.paths[""][0], names["solution"].qs[:, 0])
    np.testing.assert_array_equal(picture.series[1], names["values"])


@pytest.mark.slow
def test_toml_is_a_run_file(tmp_path):
    page = model("kepler", method="Strang")
    page.change(steps=1000)
    page.move("epsilon", 0.02)
    page.move("args.K", 1.1)
    file = cli.write(tmp_path, copies.toml(page))
    result = cli.found("run", file, "--out", tmp_path / "out")
    assert result["status"]["result"] == "successful"
    with np.load(tmp_path / "out" / "trajectory.npz") as saved:
        np.testing.assert_allclose(saved["qs"][-1, 0], page.motion().paths[""][0][-1], rtol=1e-12)


def test_objects_of_a_session_have_no_run_file():
    system = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + args * (q0 @ q0)) / 2)
    page = Model(Subject(system, {"q0": [1.0], "p0": [0.0], "h": 0.1, "args": 2.0}))
    with pytest.raises(ValueError, match="object of a Python session"):
        copies.toml(page)
    page.change(steps=1000)
    page.move("args", 3.0)
    picture = page.motion()
    names = executed(page, "motion", problem=system)
    np.testing.assert_array_equal(picture.paths[""][0], names["solution"].qs[:, 0])
    np.testing.assert_array_equal(picture.series[1][1:], names["solution"].observed["energy"])


def test_what_cannot_be_explored_is_refused():
    with pytest.raises(ValueError, match="noise"):
        Subject(systems.LIBRARY["double_well"](temperature=1.0), {})
    system = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2)
    with pytest.raises(TypeError, match="q0"):
        Subject(system, {})
    with pytest.raises(ValueError, match="step size"):
        Subject(system, {"q0": [1.0], "p0": [0.0]})


def test_every_system_of_the_library_has_sliders():
    for name, make in systems.LIBRARY.items():
        subject = Subject(make(), {})
        for control in subject.controls():
            value = subject.read(subject.start, control.key)
            assert control.low <= value <= control.high, (name, control)
            moved = subject.write(subject.start, control.key, value)
            assert subject.read(moved, control.key) == value
        subject.check(subject.start)
    assert set(METHODS) <= set(Subject(systems.kepler(), {}).methods)


def test_a_leaf_of_nested_parameters():
    args = {"a": {"k": 1.0}, "b": np.array([1.0, 2.0]), "n": 3, "list": [4.0, 5.0]}
    subject = Subject(
        dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2),
        {"q0": [1.0], "p0": [0.0], "h": 0.1, "args": args},
    )
    numbers = subject.parameters(args)
    assert numbers == {
        "args.a.k": 1.0, "args.b[0]": 1.0, "args.b[1]": 2.0, "args.list.0": 4.0, "args.list.1": 5.0
    }  # fmt: skip
    for key in numbers:
        changed = with_leaf(args, key, 9.0)
        assert [k for k, v in subject.parameters(changed).items() if v == 9.0] == [key]
    assert copies._code(args) == (
        "{'a': {'k': 1.0}, 'b': np.array([1.0, 2.0]), 'n': 3, 'list': [4.0, 5.0]}"
    )
    assert copies._toml(args["a"]) == '{"k" = 1.0}'


def test_a_redraw_takes_little_time(heiles):
    """The least of some, because other processes may run; `benchmarks/explore.py` measures it."""
    heiles.change(steps=100_000)
    heiles.motion()
    seconds = []
    for k in range(8):
        heiles.move("h", 0.1 - 0.001 * k)
        began = time.process_time()
        heiles.motion()
        seconds.append(time.process_time() - began)
    assert min(seconds) < 0.2  # processor time, of two threads
