"""Who is told how far a long call is."""

import warnings
from contextlib import contextmanager

import pytest

from dvi_jax import _progress


@contextmanager
def bar(console):
    yield ("bar", console)


def test_the_users_function_is_taken():
    with _progress.told(print, bar) as show:
        assert show is print


def test_nobody_is_told_where_nobody_looks():
    """Standard error of the tests is no terminal; True asks for a bar all the same."""
    with _progress.told(None, bar) as show:
        assert show is None
    with _progress.told(False, bar) as show:
        assert show is None
    with _progress.told(True, bar) as show:
        assert show[0] == "bar"


@pytest.mark.parametrize("wrong", [3, "yes"])
def test_what_is_no_answer_is_refused(wrong):
    with pytest.raises(TypeError, match="progress must be True, False, None or a function"):
        _progress.told(wrong, bar)


@pytest.mark.parametrize(
    ("widgets", "by_itself", "asked"), [(None, None, False), (object(), True, True)]
)
def test_a_notebook_without_widgets_is_spared_their_warnings(
    monkeypatch, widgets, by_itself, asked
):
    """Rich has a bar for notebooks with ipywidgets, and warns of their absence with a path."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # as Jupyter does
    monkeypatch.setattr(_progress, "find_spec", lambda name: widgets)
    for progress, expected in ((None, by_itself), (True, asked)):
        with _progress.told(progress, bar) as show:
            assert (show and show[1].is_jupyter) is expected


def test_rich_does_warn_without_widgets():
    """The control: what is spared is there."""
    from rich.console import Console
    from rich.progress import Progress

    if _progress.find_spec("ipywidgets") is not None:
        pytest.skip("ipywidgets is installed")
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        with Progress(console=Console(force_jupyter=True)) as shown:
            shown.add_task("x")
    assert any("ipywidgets" in str(w.message) for w in seen)
