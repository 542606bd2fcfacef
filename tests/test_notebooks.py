"""The notebooks: in step with their sources, executed, small; what they print comes out again."""

import base64
import copy
import importlib.util
import io
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from compilation import flags_of_users

ROOT = Path(__file__).parents[1]

for needed in ("jupytext", "nbclient", "nbformat", "ipykernel"):
    pytest.importorskip(needed)

NAMES = [
    "alpha_particles", "breakdown_of_mu", "discovering_invariants", "events", "fitting",
    "general_relativity", "gpu", "how_long", "limits", "magnetic_moment", "planets",
    "polar_motion", "quick_start", "radiating_ring", "storage_ring", "sweeps", "the_paper",
    "your_own_system",
]  # fmt: skip
FROM_THE_EPHEMERIS = {"general_relativity", "polar_motion"}


@pytest.fixture(scope="module")
def make():
    """The script that makes them."""
    spec = importlib.util.spec_from_file_location("make_notebooks", ROOT / "notebooks/make.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_all_are_there(make):
    assert make.names() == NAMES
    assert sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb")) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_as_it_should_be(make, name):
    """In step with its source, below 1 MB, executed in order, without errors or warnings."""
    assert make.faults(name) == []
    assert make.LARGEST <= 1_000_000


@pytest.mark.parametrize("name", NAMES)
def test_it_links_to_what_is_there(make, name):
    """Other notebooks by relative links, files of the repository by their path."""
    words = "\n".join(c.source for c in make.committed(name).cells if c.cell_type == "markdown")
    for link in re.findall(r"\]\(([^)]+)\)", words):
        assert (ROOT / "notebooks" / link).exists(), link
    for path in re.findall(r"`(?:python )?((?:docs|examples|benchmarks)/[\w./-]+)", words):
        assert (ROOT / path).exists(), path


@pytest.fixture
def book(make):
    return copy.deepcopy(make.committed("quick_start"))


def printed(book, text):
    """The output that holds a text."""
    return next(
        output
        for cell in book.cells
        for output in cell.get("outputs", [])
        if output.output_type == "stream" and text in output.text
    )


def test_changed_numbers_and_missing_pictures_are_caught(make, book):
    original = make.committed("quick_start")
    assert make.differences(original, book) == []
    output = printed(book, "slope 1.998")
    output.text = output.text.replace("slope 1.998", "slope 1.889")
    (difference,) = make.differences(original, book)
    assert "slope 1.998" in difference
    assert "slope 1.889" in difference
    cell = next(c for c in book.cells if any(map(make._is_picture, c.get("outputs", []))))
    cell.outputs = []
    assert any("kinds of outputs" in text for text in make.differences(original, book))


def test_a_number_may_differ_in_its_last_digit(make):
    assert not make.unlike("slope 1.990", "slope 1.991")
    assert make.unlike("slope 1.990", "slope 1.998")
    assert not make.unlike("drift 3e-15, −1.234", "drift 9.1e-16, −1.235")  # round-off
    assert make.unlike("drift 3e-5", "drift 9e-5")
    assert make.unlike("drift 3e-15", "drift 3e-5")
    assert make.unlike("8 of 9 points", "9 of 9 points")
    assert make.unlike("q0[0] = 1.0", "q0[1] = 1.0")
    assert make.unlike("found", "found\nmore")
    assert make.unlike("slope 2.0", "slope nan")


def stream(name, text):
    from nbformat.v4 import new_output

    return {"outputs": [new_output("stream", name=name, text=text)]}


SPOIL = {
    "cell 1 is not that of the source": lambda cells: cells[1].update(source="pass"),
    "cells, the source has": lambda cells: cells.pop(),
    "in their order": lambda cells: cells[1].update(execution_count=7),
    "its id or metadata": lambda cells: cells[1].update(id="aa"),
    "no picture": lambda cells: [c.update(outputs=[]) for c in cells if "outputs" in c],
    "cell 1 warns: UserWarning: no": lambda cells: cells[1].update(
        stream("stderr", "UserWarning: no\n")
    ),
    "names a place on a machine": lambda cells: cells[1].update(
        stream("stdout", "see /some/where/file.py\n")
    ),
    "fewer or smaller pictures": lambda cells: cells[1].update(stream("stdout", "x" * 1_000_000)),
}
"""Fault that is reported → a change that makes it."""


@pytest.mark.parametrize("fault", SPOIL)
def test_what_else_is_caught(make, book, fault):
    SPOIL[fault](book.cells)
    assert any(fault in text for text in make.faults("quick_start", book))


def test_a_picture_keeps_its_width_and_no_other_metadata(make, book):
    """Pictures have twice the pixels of the width in which they are shown."""
    outputs = [output for cell in book.cells for output in cell.get("outputs", [])]
    picture = next(output for output in outputs if make._is_picture(output))
    for width, kept in ((715, {"image/png": {"width": 715}}), (None, {})):
        size = {"width": width, "height": 450} if width else {}
        picture.metadata = {"image/png": size, "needs_background": "light"}
        assert make._plain(picture).metadata == kept


@pytest.mark.parametrize(("colours", "mode"), [(64, "P"), (4096, "RGB")])
def test_a_palette_is_used_unless_it_changes_colours(make, colours, mode):
    """Neither the resolution nor the colours change; texts, which name versions, are removed."""
    image = pytest.importorskip("PIL.Image")
    info = pytest.importorskip("PIL.PngImagePlugin").PngInfo()
    info.add_text("Software", "a version")
    side = round(colours**0.5)
    pixels = np.zeros((side, side, 3), np.uint8)
    pixels[..., 0], pixels[..., 1] = np.mgrid[:side, :side] * (255 // (side - 1))
    pixels[..., 2] = 255 - pixels[..., 0]
    before, after = io.BytesIO(), io.BytesIO()
    image.fromarray(pixels).save(before, "PNG", dpi=(220, 220), pnginfo=info)
    after.write(base64.b64decode(make._pixels(base64.b64encode(before.getvalue()).decode())))
    found = image.open(after)
    assert found.mode == mode
    assert found.info["dpi"] == pytest.approx((220, 220), rel=1e-3)
    assert "Software" not in found.info
    change = np.asarray(found.convert("RGB")).astype(int) - pixels
    assert np.abs(change).max() <= (make.UNSEEN if mode == "P" else 0)


def test_an_unknown_notebook_is_refused():
    command = [sys.executable, ROOT / "notebooks/make.py", "--check", "no_such"]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 2
    assert "no source for no_such; there are alpha_particles" in run.stderr


def kernels():
    """Kernels that this process has started, and that still run."""
    psutil = pytest.importorskip("psutil")
    below = psutil.Process().children(recursive=True)
    return [x.pid for x in below if x.status() != "zombie" and "ipykernel" in str(x.cmdline())]


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", NAMES)
def test_it_comes_out_again(make, name, monkeypatch):
    if name in FROM_THE_EPHEMERIS:
        pytest.importorskip("jplephem")
        if importlib.util.find_spec("skyfield_data") is None:
            pytest.skip("the ephemeris is not installed")
    monkeypatch.setenv("XLA_FLAGS", flags_of_users())
    assert make.made(name, check=True) == []
    assert kernels() == []


@pytest.mark.slow
def test_a_cell_that_raises_is_told(make, tmp_path, monkeypatch):
    wrong = "# %%\nslope = 2.0\n\n# %%\nassert abs(slope - 3) < 0.02\n"
    (tmp_path / "quick_start.py").write_text(wrong, encoding="utf-8")
    monkeypatch.setattr(make, "HERE", tmp_path)
    (told,) = make.made("quick_start", check=False)
    assert "AssertionError" in told
    assert kernels() == []
    assert not (tmp_path / "quick_start.ipynb").exists()
