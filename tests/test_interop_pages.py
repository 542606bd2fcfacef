"""The pages on other packages run as printed, and their numbers are correct."""

import re
from pathlib import Path

import numpy as np
import pages
import pytest

DOCS = Path(__file__).parents[1] / "docs"


def run(page):
    """The names that the blocks of a page define, one after the other."""
    text = (DOCS / page).read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.S)
    names: dict = {}
    for i, block in enumerate(blocks):
        exec(compile(block, f"{page}, block {i + 1}", "exec"), names)
    assert pages.wrong_values("\n".join(blocks), names) == {}
    return names, len(blocks)


@pytest.mark.slow
def test_the_page_on_interoperability_runs(tmp_path, monkeypatch):
    for package in ("diffrax", "rebound", "astropy"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    names, count = run("interoperability.md")
    assert count == 8
    # Two programs of one map: the round-off of 160 steps, 2e-16 each.
    assert names["apart"] < 160 * 2.2e-16
    assert names["series"].sizes["time"] == 11
    assert abs(names["series"].e.sel(body="Saturn").max() - 0.06) < 0.02
    assert 1e-5 < names["error_of_the_map"] < 1e-1
    assert names["from_theirs"] < 1e-10
    np.testing.assert_allclose(*names["energies"], rtol=1e-12)
    assert names["energies"][0] == pytest.approx(names["energies"][1], rel=1e-12)
    u = names["u"]
    assert np.linalg.norm(names["position"]).to_value(u.au) == pytest.approx(1.0, abs=0.02)
    assert 500 < names["height"].to_value(u.km) < 2500
    assert names["found"].status == 1
    assert len(names["found"].t_events[0]) == 1
    assert names["x_at_the_end"].dims == ()
    assert (tmp_path / "orbits.nc").exists()
    assert names["depth"] == 2  # 3 leapfrog steps


@pytest.mark.slow
def test_the_page_on_migration_runs():
    for package in ("diffrax", "rebound"):
        pytest.importorskip(package)
    names, count = run("migration.md")
    assert count == 3
    assert names["same_steps"] < 1e-13
    assert names["leapfrog"] < 1e-11
    assert 0 < names["ours"].observed["energy"] < 1e-3
    assert names["one_map"] < 1e-12
    assert np.max(np.abs(names["gauss"].qs - names["implicit"].qs)) > 1e-4  # another method


@pytest.mark.parametrize("page", ["interoperability.md", "migration.md"])
def test_names_on_the_pages_exist(page):
    import dvi_jax
    from dvi_jax import interop, systems

    modules = {"dvi": dvi_jax, "interop": interop, "systems": systems}
    text = (DOCS / page).read_text(encoding="utf-8")
    names = set(re.findall(r"\b(dvi|interop|systems)\.(?!md\b)(\w+)", text))
    assert len(names) > 15
    assert [name for name in names if not hasattr(modules[name[0]], name[1])] == []
