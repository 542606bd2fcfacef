"""The code gets no larger, and imports have no circles."""

import inspect
import re
import types

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
        ("def f():\n    found = 1\n", "names that are participles"),
        ("def f():\n    x = 1\n", "names of one letter"),
        ("def f(x):\n    return x + 1\n", None),
        ("raise ValueError('no')\n", "raise statements"),
        ("from .other import f\n", "circles of imports"),
        ("def f():\n    from . import other\n", "circles of imports"),
        ("import dvi_jax.engine.other\n", "circles of imports"),
        ("import dvi_jax_cli\n", None),
    ],
)
def test_a_planted_violation_is_seen(small, text, exceeded):
    """A file of the core, and a second one that imports it."""
    before = measures.measure(small, signatures=False).values
    planted = small / "dvi_jax" / "engine" / "planted.py"
    other = small / "dvi_jax" / "engine" / "other.py"
    try:
        planted.write_text(text)
        other.write_text("from .planted import f\n")
        after = measures.measure(small, signatures=False).values
    finally:
        planted.unlink()
        other.unlink()
    worse = [name for name, value in after.items() if value > before[name]]
    usual = ("lines of the core", "layers of imports", measures.COMMENTS)
    others = [name for name in worse if name not in usual]
    assert "lines of the core" in worse
    assert bool(others) == (exceeded is not None)
    assert not others or others[0].startswith(exceeded)


def test_long_signatures_are_counted():
    """Also those that a decorator has given."""

    def long(a, b, c, d, e, f, g, *, h, i, j): ...

    def short(**settings): ...

    def decorated(**settings): ...

    decorated.__signature__ = inspect.signature(long)  # pyright: ignore[reportFunctionMemberAccess]
    module = types.SimpleNamespace(__name__=__name__, long=long, short=short, decorated=decorated)
    counts = [text.split(": ")[1] for text in measures.long_signatures_of(module)]
    assert counts == ["10 parameters"] * 2


def test_limits_are_compared_with_their_numbers():
    values = {**measures.LIMITS, measures.COMMENTS: 4.9, "raise statements": 10**4}
    text = measures.exceeded(measures.Measures(values))
    assert [line.split(":")[0] for line in text] == ["raise statements", measures.COMMENTS]


def test_the_picture_of_the_layers_is_that_of_the_imports():
    """Names in the order of their height; `python tests/measures.py --picture` draws it again."""
    text = (measures.ROOT / "docs" / "pictures" / "layers.svg").read_text()
    drawn = re.findall(r"<text[^>]*>([^<]*)</text>", text)
    layers = measures.layers()
    assert drawn == [name for y, row in enumerate(layers) for name in (str(y), *row)]
    assert layers[0][-1] == "lanewise"
    heights = {name: y for y, row in enumerate(layers) for name in row}
    assert heights["methods"] < heights["integration"] < heights["fit"] < heights["interop"]
