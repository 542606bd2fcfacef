"""The reproduction of the paper: its numbers, its verdicts, what it writes and refuses to."""

import csv
import dataclasses
import io
import json
import re
import time

import numpy as np
import pytest
from rich.console import Console

from dvi_jax.testing.paper import reproduce, values
from dvi_jax.testing.paper.claims import Claim, NumberCheck, Verdict, judge, pretty
from dvi_jax.testing.paper.equations import EQUATIONS, resolve
from dvi_jax.testing.paper.figures import FIGURES
from dvi_jax.testing.paper.numbers import crossing, relative_spread, slope

pytestmark = pytest.mark.slow  # all of the paper, once: a minute


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One reproduction for all tests, what it printed (not to a terminal), its CPU seconds."""
    out = tmp_path_factory.mktemp("paper") / "made" / "here"
    console = Console(file=io.StringIO(), width=100)
    began = time.process_time()
    result = reproduce(out, console=console)
    return result, console.file.getvalue(), time.process_time() - began


@pytest.fixture(scope="module")
def m(run):
    return run[0].measurements


def verdicts(measurements):
    return {claim.key: claim.verdict for claim in judge(measurements)}


# --- numbers


def test_oscillator(m):
    mesh, cross, small = m.fixed_mesh, m.crossover, m.small_step
    E = mesh.mixed_energy[0]
    assert np.ptp(E) == pytest.approx(9.52e-6, rel=0.01)
    assert np.ptp(E) / np.mean([E.min(), E.max()]) == pytest.approx(0.1, rel=0.01)
    assert mesh.energy == pytest.approx(1e-4)
    assert mesh.exact.shape == (5, 10_000)
    assert np.all(relative_spread(mesh.exact) < 4e-14)
    # The same form without h must fail by O(h), or the line above says nothing.
    assert np.all(relative_spread(mesh.printed) > 0.09)
    assert mesh.rk4[-1] - mesh.energy == pytest.approx(-1.39e-8, rel=0.01)
    assert cross.loss == pytest.approx(cross.hs[0] ** 6 / 72, rel=0.01)
    assert cross.steps[0] == pytest.approx(7.2e6, rel=0.02)
    np.testing.assert_allclose(cross.steps, cross.predicted, rtol=0.03)
    assert slope(small.epsilons, small.printed) == pytest.approx(1.0, abs=0.03)
    assert np.max(small.corrected) < 2e-9


def test_what_the_tools_find(m):
    found = m.discoveries
    assert found["oscillator"] == "0.5 q² − 0.05 q p + 0.5 p² + ε (0.5 q² − 0.05 q p)"
    assert found["kepler"].replace("−", "") in ("0.5 q1 p2  0.5 q2 p1", "0.5 q1 p2 + 0.5 q2 p1")
    assert found["gauge_34_left_0"] < 1e-13 < 1e-3 < found["gauge_34_left_1"]
    assert found["gauge_50_exponent"] == pytest.approx(1.0, abs=0.05)
    assert found["balance_gap_by_tool"] < 1e-12
    worse = found | {"oscillator_off": 1e-3, "kepler_count": 2.0}
    changed = verdicts(dataclasses.replace(m, discoveries=worse))
    assert changed["invariant-34"] is Verdict.FAILS
    assert changed["invariant-49"] is Verdict.FAILS


def test_kepler(m):
    sweep, small = m.mesh_sweep, m.small_step_sweep
    at = dict(zip(sweep.hs, sweep.spread_50[:, 0], strict=True))
    assert at[0.1] == pytest.approx(0.055, rel=0.01)
    assert at[0.01] == pytest.approx(0.0051, rel=0.01)
    assert slope(sweep.hs, sweep.spread_50[:, 0]) == pytest.approx(1.0, abs=0.1)
    assert np.max(sweep.relative_49) < 1e-13
    for drifts, order in ((small.attracting, 1.98), (small.repelling, 1.04)):
        assert small.exponent(small.beyond_zero(drifts)) == pytest.approx(order, abs=0.02)
    # ξ0 = 1, as (47) has it, gives an invariant that is exact as h → 0.
    assert np.all(np.abs(small.beyond_zero(small.literal)) < 0.1 * small.literal[0])
    rk4, variational = m.long_runs["RK4"], m.long_runs["variational (order 1)"]
    assert rk4.error_at(1.0) == pytest.approx(4.6e-3, rel=0.02)
    assert rk4.error_at(1.0) / rk4.error_at(0.5) == pytest.approx(2, rel=0.02)
    assert np.max(np.abs(rk4.momentum_errors)) == pytest.approx(3.4e-4, rel=0.02)
    assert variational.error_at(1.0) == pytest.approx(0.324, rel=0.01)
    assert np.max(np.abs(variational.momentum_errors)) < 1e-13
    assert variational.width > 100 * rk4.width
    steps, *ends = m.variational_mesh.values()
    assert steps == 77
    assert ends == pytest.approx([31.0, 20.1], abs=0.1)
    assert m.identities["balance_gap"] < 1e-12
    assert m.identities["law_31_smallest_gap"] > 1e-3


# --- verdicts


def test_every_verdict_is_as_on_record(run):
    claims = run[0].claims
    assert [claim.key for claim in claims if not claim.is_expected] == []
    assert len({claim.key for claim in claims}) == len(claims)
    assert {claim.verdict for claim in claims} == set(Verdict)


def replaced(m, field, **changes):
    return dataclasses.replace(m, **{field: dataclasses.replace(getattr(m, field), **changes)})


def test_verdicts_follow_the_measurements(m):
    before, mesh, small = verdicts(m), m.fixed_mesh, m.small_step_sweep
    first = mesh.mixed_energy[:1, :1] * (1 + 1e-9 * np.sin(mesh.ts))
    steady = np.repeat(first, len(mesh.mixed_energy), 0)
    holds, corrected, fails = Verdict
    changes = {
        "fixed_mesh": {"mixed_energy": steady},
        "mesh_sweep": {"relative_49": m.mesh_sweep.relative_49 + 1e-6},
        "small_step_sweep": {"attracting": small.repelling, "repelling": small.attracting},
        "crossover": {"steps": np.full_like(m.crossover.steps, np.nan)},
    }
    after = {field: judge(replaced(m, field, **change)) for field, change in changes.items()}
    for field, key, was, becomes in (
        ("fixed_mesh", "energy-fig1", fails, holds),
        ("fixed_mesh", "exact-oscillator", corrected, corrected),  # 1e-9 is not round-off
        ("mesh_sweep", "momentum", holds, fails),
        ("mesh_sweep", "invariant-49", holds, fails),
        ("small_step_sweep", "force-kepler", corrected, holds),
        ("small_step_sweep", "invariant-50", corrected, fails),
        ("crossover", "rk4-long", holds, fails),
    ):
        claim = next(c for c in after[field] if c.key == key)
        assert (before[key], claim.verdict) == (was, becomes)
        assert claim.is_expected == (was is becomes)
        assert ("Unexpected" in claim.reason) == (was is not becomes)


def test_every_number_has_one_name_and_every_claim_a_bound(m, run):
    parts = (*(part(m) for part in values.PARTS), m.limits, m.symmetries, m.identities)
    parts += (m.discoveries, m.repulsion, m.variational_mesh)
    assert len(values.numbers(m)) == sum(map(len, parts))
    assert all(check.decides for c in run[0].claims for check in (*c.printed, *c.corrected))
    assert not any(check.decides for c in run[0].claims for check in c.context)


def test_nan_passes_no_check():
    check = NumberCheck("a number", float("nan"))
    assert not check.passes
    claim = Claim("k", "w", "s", (check,), (check,), Verdict.FAILS, "why")
    assert claim.verdict is Verdict.FAILS


# --- equations


def test_all_fifty_equations_are_mapped_to_code():
    assert [e.number for e in EQUATIONS] == list(range(1, 51))
    for equation in EQUATIONS:
        assert equation.code, equation
        for name in equation.code:
            assert resolve(name) is not None, name


@pytest.mark.parametrize("name", ["dvi_jax.NoSuchThing", "dvi_jax.no.such", "no_such_package.x"])
def test_a_name_that_does_not_exist_is_not_resolved(name):
    with pytest.raises((AttributeError, ModuleNotFoundError)):
        resolve(name)


# --- files


def test_what_is_written(run):
    out = run[0].out
    document = json.loads((out / "verdicts.json").read_text("utf-8"))
    assert len(document["claims"]) == len(run[0].claims)
    assert all(row["checks_as_printed"] and row["why"] for row in document["claims"])
    markdown = (out / "verdicts.md").read_text("utf-8")
    assert all(claim.says.replace("|", "\\|") in markdown for claim in run[0].claims)
    for name in FIGURES:
        assert (out / "figures" / f"{name}.png").read_bytes()[:4] == b"\x89PNG"
    for path in (out / "tables").iterdir():
        header, *rows = csv.reader(path.open(encoding="utf-8"))
        assert rows
        assert all(len(row) == len(header) for row in rows)


def test_the_page_needs_nothing_beside_it(run):
    page = (run[0].out / "verdicts.html").read_text("utf-8")
    sources = re.findall(r"""(?:src|href)=["']([^"']*)""", page)
    assert all(source.startswith(("data:image/png;base64,", "#")) for source in sources)
    assert sum(source.startswith("data:") for source in sources) == len(FIGURES)
    assert not re.search(r"https?:|url\(|@import|<script|<link", page)


def test_what_is_printed_without_a_terminal(run):
    printed = run[1]
    assert "\x1b" not in printed
    assert printed.count("100 %") == 12
    assert "hold once corrected" in printed
    assert "verdicts.html" in printed
    # Of CPU time, mostly of one core: 50 s alone, more where the other half of the core is busy.
    assert run[2] < 90


# --- refusals


def test_files_and_folders_that_are_not_empty_are_refused_before_any_work(tmp_path):
    (tmp_path / "mine.txt").write_text("keep")
    began = time.perf_counter()
    with pytest.raises(FileExistsError, match="not empty"):
        reproduce(tmp_path)
    with pytest.raises(NotADirectoryError, match="is a file"):
        reproduce(tmp_path / "mine.txt", force=True)
    assert time.perf_counter() - began < 1
    assert [p.name for p in tmp_path.iterdir()] == ["mine.txt"]


def test_force_overwrites_its_own_files_only(run, m, tmp_path, monkeypatch):
    monkeypatch.setattr("dvi_jax.testing.paper._reproduce.measure", lambda console: m)
    (tmp_path / "mine.txt").write_text("keep")
    (tmp_path / "verdicts.md").write_text("old")
    reproduce(tmp_path, force=True, console=Console(file=io.StringIO()))
    assert (tmp_path / "mine.txt").read_text() == "keep"
    assert (tmp_path / "verdicts.md").read_text("utf-8").startswith("# The paper's claims")


# --- the statistics


@pytest.mark.parametrize(
    ("value", "text"),
    [(-1.39e-8, "−1.39×10⁻⁸"), (7.2e6, "7.2×10⁶"), (0.055, "0.055"), (0, "0")],
)
def test_numbers_as_text(value, text):
    assert pretty(value) == text


def test_statistics():
    rows = np.array([[2.0, 5.0, 1.0], [4.0, 4.0, 4.0]])
    np.testing.assert_array_equal(relative_spread(rows), [2, 0])
    x = np.array([1.0, 2.0, 4.0])
    assert slope(x, 3 * x**1.7) == pytest.approx(1.7)
    assert np.isnan(slope(x, np.array([1.0, 0.0, 1.0])))
    assert np.isnan(slope(x, np.array([1.0, np.nan, 1.0])))
    assert crossing(x, x**2, 10.0) == pytest.approx(3.0)
    assert np.isnan(crossing(x, x, 5.0))
