"""The work-precision benchmark: its counts, its reference, and the slopes that it measures."""

import csv
import importlib.util
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq

import dvi_jax as dvi

pytest.importorskip("matplotlib")
FILE = Path(__file__).parent.parent / "benchmarks" / "work_precision.py"


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("work_precision", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.plt.switch_backend("agg")
    return module


def counting(system, made):
    """The system, which appends to `made` at run time for each half of a gradient of H_D."""

    # The derivatives pass through the host: those that the compiler drops are not counted. The
    # times are arguments, so that the compiler does not merge two evaluations at one point.

    @jax.custom_jvp
    def seen(x, t0, t1):
        def note(x, t0, t1):
            made.append(1)
            return x

        shape = jax.ShapeDtypeStruct(x.shape, x.dtype)
        return jax.pure_callback(note, shape, x, t0, t1, vmap_method="sequential")

    seen.defjvp(lambda x, dx: (seen(*x), dx[0]))  # columns of a Jacobian are not counted

    @jax.custom_jvp
    def H_D(t0, t1, q0, p1, args):
        return system.H_D(t0, t1, q0, p1, args)

    @H_D.defjvp
    def _(at, changes):
        of_q, of_p = (seen(jax.grad(system.H_D, argnums=i)(*at), *at[:2]) for i in (2, 3))
        return H_D(*at), jnp.vdot(of_q, changes[2]) + jnp.vdot(of_p, changes[3])

    return dvi.System(H_D, system.force)


def problems(bench):
    """Separable, neither, and one in which q enters no rate of q but p a rate of p."""
    separable = bench.henon_heiles()
    friction = dvi.System(separable.system.H_D, force=lambda t0, t1, q0, p1, args: -p1)
    return {
        "henon_heiles": separable,
        "double_pendulum": bench.driven_pendulum(),
        "damped": separable._replace(system=friction, epsilon=0.1),
    }


OF_EACH = ("Adjoint", "BlanesMoan4", "KahanLi6", "GaussLegendre2", "RungeKutta4")
OF_EACH = (*OF_EACH, *(f"LobattoIIIAIIIB{stages}" for stages in (2, 3, 5)))
COUNTED = [
    ("henon_heiles", "Strang"),
    ("double_pendulum", "TypeII"),
    *((problem, method) for problem in ("henon_heiles", "double_pendulum") for method in OF_EACH),
    ("damped", "LobattoIIIAIIIB2"),
    ("damped", "LobattoIIIAIIIB3"),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("problem", "method"),
    [pytest.param(*pair, marks=[pytest.mark.slow] * (i > 1)) for i, pair in enumerate(COUNTED)],
)
def test_evaluations_are_counted_as_they_are_made(bench, problem, method):
    """Against derivatives of H_D at run time, each half an evaluation; columns are not counted."""
    problem, halves = problems(bench)[problem], []
    watched = problem._replace(system=counting(problem.system, halves))
    price, num_steps = bench.cost(bench.METHODS[method], problem), 16
    run = bench.compiled(bench.METHODS[method], watched)
    _, _, iterations, good = jax.block_until_ready(run.function(0.1, num_steps // bench.PIECE))
    assert bool(good)
    made = len(halves) / 2
    # Of the three residuals of an iteration the last is evaluated where it is needed.
    least, most = (int(iterations) * price.of_iteration * part for part in (2 / 3, 1))
    assert least <= made - num_steps * price.of_step <= most
    if int(iterations) == 0:
        assert made == num_steps * price.of_step
    assert made >= num_steps


def test_a_derivative_that_is_not_used_is_not_counted(bench):
    """And a method of unknown cost is rejected."""
    problem, halves = bench.henon_heiles(), []
    slopes = jax.grad(counting(problem.system, halves).H_D, argnums=(2, 3))
    q, p, now = jnp.array([0.1, 0.2]), jnp.array([0.3, 0.1]), 0.0
    for used, made in ((lambda of: of[0], 1), (lambda of: of, 3)):
        jax.block_until_ready(jax.jit(lambda q, p, u=used: u(slopes(now, now, q, p, None)))(q, p))
        assert len(halves) == made
    with pytest.raises(TypeError, match=r"what does a step of Strang.* cost"):
        bench.cost(dvi.Strang(base=dvi.Strang()), problem)


def test_the_reference_is_as_good_as_its_floor(bench):
    """Against Kepler's equation, solved to the last digit."""
    e, t = 0.6, bench.kepler().t_end
    u = brentq(lambda u: u - e * math.sin(u) - t, t - 1, t + 1, xtol=1e-15, rtol=1e-15)
    root, r = math.sqrt(1 - e * e), 1 - e * math.cos(u)
    q = np.array([math.cos(u) - e, root * math.sin(u)])
    p = np.array([-math.sin(u), root * math.cos(u)]) / r
    truth = bench.reference(bench.kepler(e))
    assert 1e-14 <= truth.floor < 5e-12
    assert truth.error(q, p) < 2 * truth.floor
    assert truth.error(q * (1 + 3e-11), p) > 4 * truth.floor


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "is_wrong"), [("Strang", False), ("BlanesMoan6", False), ("BlanesMoan6", True)]
)
def test_slopes_are_the_orders(bench, monkeypatch, method, is_wrong):
    """Two third digits changed, symmetric still: order 2."""
    if is_wrong:
        c = list(bench.METHODS[method].fractions())
        for i, sign in ((0, 1), (2, -1), (-1, 1), (-3, -1)):
            c[i] += sign * 1e-3
        monkeypatch.setitem(bench.METHODS, method, dvi.Composition(c, order=2))
    run = bench.compiled(bench.METHODS[method], bench.PROBLEMS["henon_heiles"]())
    truth, budgets = bench.reference(run.problem), bench.budgets(2**8, 2**15, 2)
    points = bench.sweep("henon_heiles", method, run, truth, budgets)
    assert abs(bench.slope(points, truth.floor) - bench.METHODS[method].order) < 0.4


@pytest.mark.slow
def test_quick_run(bench, tmp_path, capsys):
    """Every method has its order; tables and pictures are written, and progress goes apart."""
    points, floors = bench.main(["--quick", "--out", str(tmp_path)])
    floor = floors["henon_heiles"]
    for name, method in bench.METHODS.items():
        mine = [p for p in points if p.method == name]
        assert abs(bench.slope(mine, floor, "num_steps") - method.order) < 0.4, name
        if not any(p.newton_iterations for p in mine):
            assert abs(bench.slope(mine, floor) - method.order) < 0.4, name
        assert all(p.time > 0 for p in mine)
    out, err = capsys.readouterr()
    assert out.count("| KahanLi8 | 8 |") == 1
    assert "timing, round 1 of 1" in err
    with (tmp_path / "work_precision.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(points)
    assert {row["method"] for row in rows} == set(bench.METHODS)
    for kind, most in (("png", 200_000), ("svg", 1_000_000)):
        assert 10_000 < (tmp_path / f"work_precision_henon_heiles.{kind}").stat().st_size < most


def test_pictures_are_drawn_again_from_the_numbers(bench, tmp_path, monkeypatch):
    """Nothing is measured; the caption is a legend, and the title names the problem."""
    steps = [64, 128, 256, 512]
    points = [
        bench.Point("henon_heiles", name, order, n, 40 / n, 0, float(n), n**-order, n / 8192)
        for name, order in (("Strang", 2), ("KahanLi6", 6))
        for n in steps
    ]
    bench.write_csv(tmp_path / "work_precision.csv", points)
    drawn = []
    monkeypatch.setattr(bench, "measure", None)
    monkeypatch.setattr(bench, "reference", lambda problem: bench.Reference(0, 0, 1e-13))
    monkeypatch.setattr(bench, "save", lambda figure, path: drawn.append((figure, path.name)))
    again, floors = bench.main(["--out", str(tmp_path), "--redraw"])
    assert again == points
    assert floors == {"henon_heiles": 1e-13}
    ((figure, name),) = drawn
    assert name == "work_precision_henon_heiles"
    assert figure.get_suptitle() == "Error against work: Hénon–Heiles, E = 1/12"
    assert len(figure.legends[0].get_texts()) == 3
    assert figure.axes[4].get_xlabel() == "time [8192 steps of Strang]"


def test_where_an_error_is_reached(bench):
    """By hand: error N⁻² crosses 1e-3 at 31.6; never 1e-9; a temporary dip does not count."""
    points = [
        bench.Point("p", "m", 2, n, 1 / n, 0, float(n), e)
        for n, e in ((1, 1.0), (2, 1e-5), (10, 1e-2), (100, 1e-4))
    ]
    assert bench.at_error(points, 1e-3, "evaluations") == pytest.approx(10**1.5)
    assert math.isnan(bench.at_error(points, 1e-9, "evaluations"))
    assert math.isnan(bench.slope(points, 1e-4))
    work, error = bench.envelope(points, "evaluations")
    np.testing.assert_array_equal(work, [1, 2])
    np.testing.assert_array_equal(error, [1.0, 1e-5])
