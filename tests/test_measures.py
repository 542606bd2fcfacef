"""The code gets no larger, and imports have no circles."""

import re

import measures
import pytest


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """Packages of the same names with nothing in them."""
    root = tmp_path_factory.mktemp("root")
    for package in (*measures.PACKAGES, "dvi_jax/engine"):
        (root / package).mkdir()
        (root / package / "__init__.py").write_text("# Nothing.\n")
    return root


def test_the_code_is_within_its_limits():
    assert measures.exceeded(measures.measure()) == []


@pytest.mark.parametrize(
    ("text", "exceeded"),
    [
        ("x = 1\n" * 451, "files of more than 450 lines"),
        ("def f(a, b, c, d, e, f, g, *, h, i, j):\n    pass\n", "functions with more than 9"),
        ("def f():\n" + "    raise ValueError\n" * 40, "raise statements"),
        ("from .other import f\n", "circles of imports"),
        ("def f():\n    from . import other\n", "circles of imports"),
        ("import dvi_jax.engine.other\n", "circles of imports"),
        ("import dvi_jax_cli\n", None),
    ],
)
def test_a_planted_violation_is_seen(small, text, exceeded):
    """A file of the core, and a second one that imports it."""
    before = measures.measure(small)
    planted = small / "dvi_jax" / "engine" / "planted.py"
    other = small / "dvi_jax" / "engine" / "other.py"
    try:
        planted.write_text(text)
        other.write_text("from .planted import f\n")
        after = measures.measure(small)
    finally:
        planted.unlink()
        other.unlink()
    worse = [name for name, value in after.values().items() if value > before.values()[name]]
    found = [name for name in worse if name not in ("lines", measures.COMMENTS)]
    assert "lines" in worse
    assert bool(found) == (exceeded is not None)
    assert not found or found[0].startswith(exceeded)


def test_limits_are_compared_with_their_numbers():
    found = measures.measure()
    spoiled = measures.Measures(
        lines=10**6, raises=found.raises, comments=0.0, long_files=found.long_files,
        long_signatures=found.long_signatures, circles=["a → b"],
    )  # fmt: skip
    assert [text.split(":")[0] for text in measures.exceeded(spoiled)] == [
        "lines", measures.COMMENTS, "circles of imports"
    ]  # fmt: skip


def test_the_picture_of_the_layers_is_that_of_the_imports():
    """Names in the order of their height; `python tests/measures.py --picture` draws it again."""
    text = (measures.ROOT / "docs" / "pictures" / "layers.svg").read_text()
    drawn = re.findall(r"<text[^>]*>([^<]*)</text>", text)
    layers = measures.layers()
    assert drawn == [name for y, row in enumerate(layers) for name in (str(y), *row)]
    assert layers[0][-1] == "lanewise"
    heights = {name: y for y, row in enumerate(layers) for name in row}
    assert heights["methods"] < heights["integration"] < heights["fit"] < heights["interop"]
