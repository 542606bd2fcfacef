"""Perturbations from real data: relativity from an ephemeris, the wobble from measured poles."""

import importlib.util
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]

pytest.importorskip("jplephem")
if importlib.util.find_spec("skyfield_data") is None:
    pytest.skip("the ephemeris is not installed", allow_module_level=True)


def example(name):
    """A module of the examples."""
    spec = importlib.util.spec_from_file_location(f"example_{name}", ROOT / f"examples/{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def relativity():
    return example("general_relativity")


@pytest.fixture(scope="module")
def wobble():
    return example("polar_motion")


def test_components_and_waves_of_residuals(relativity):
    q, v = np.array([[2.0, 0.0, 0.0]]), np.array([[0.5, 3.0, 0.0]])
    off = np.array([[5.0, 7.0, 11.0]])
    np.testing.assert_allclose(relativity.components(off, q, v), [[7.0, 5.0, 11.0]], rtol=1e-15)
    t = 10.0 * np.arange(3652)
    period, amplitude = relativity.spectrum(3.0 * np.cos(2 * np.pi * t / 400) + 1e-4 * t)
    top = np.argmax(amplitude)
    assert abs(period[top] - 400) < 1
    assert abs(amplitude[top] - 3) < 0.05


YEARS = 12
"""Enough for the digits below; the century of docs/general-relativity.md takes minutes."""


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_decades_give_relativity_its_strength(relativity, tmp_path):
    newton, einstein, oblate = found = relativity.stages(YEARS)
    assert abs(einstein.epsilon - 1.0006) <= 1e-4
    assert abs(oblate.epsilon - 1) <= 1e-4
    assert einstein.rms < 200  # m
    assert oblate.rms < einstein.rms
    assert newton.rms > 100 * einstein.rms  # negative control
    assert abs(einstein.advance - newton.advance - relativity.TEXTBOOK) < 0.1
    text = relativity.table(found, YEARS)
    assert "much too small" in text
    mpl.use("Agg")
    relativity.draw(found).savefig(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


@pytest.mark.slow
def test_the_wobble_and_how_well_it_is_known(wobble):
    data = wobble.arcs()
    assert [len(arc.ts) for arc in data] == [293] * 4
    fit = wobble.fitted(data)
    (period, inverse_q), formal = wobble.shared(fit)
    assert abs(period - 432.82) < 0.02
    assert abs(inverse_q - 0.0078) < 1e-4
    assert abs(1e3 * fit.rms - 31.06) < 0.01
    knife = wobble.jackknife(data, fit.params["args"])
    assert 2 < knife.error[0] < 5
    assert knife.error[1] > inverse_q  # Q is not determined
    assert (knife.error / formal > 8).all()
    text = wobble.report(fit, knife)
    assert "433 ± 3 days" in text
    assert "Q is not determined" in text
