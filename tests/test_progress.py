"""Which progress of a long call is shown, and where."""

from contextlib import contextmanager
from importlib.util import find_spec

import pytest
from rich.console import Console
from rich.progress import Progress

from dvi_jax.base import progress as _progress


@contextmanager
def bar(console):
    yield ("bar", console)


def shown(progress):
    with _progress.reporter(progress, bar) as show:
        return show


def test_who_takes_the_progress():
    """The user's function; without a terminal, as in these tests, a bar only for True."""
    assert shown(print) is print
    assert shown(None) is None
    assert shown(False) is None
    assert shown(True)[0] == "bar"
    for wrong in (3, "yes"):
        with pytest.raises(TypeError, match="progress must be True, False, None or a function"):
            shown(wrong)


@pytest.mark.parametrize(
    ("widgets", "by_itself", "with_true"), [(None, None, False), (object(), True, True)]
)
def test_a_notebook_without_widgets(monkeypatch, widgets, by_itself, with_true):
    """Rich has a bar for notebooks with ipywidgets, and would warn of their absence."""
    monkeypatch.setattr("rich.console._is_jupyter", lambda: True)
    monkeypatch.setenv("FORCE_COLOR", "1")  # as Jupyter does
    monkeypatch.setattr(_progress, "find_spec", lambda name: widgets)
    for progress, expected in ((None, by_itself), (True, with_true)):
        show = shown(progress)
        assert (show and show[1].is_jupyter) is expected


@pytest.mark.skipif(find_spec("ipywidgets") is not None, reason="ipywidgets is installed")
def test_rich_does_warn_without_widgets():
    """The control of the test above."""
    shown = Progress(console=Console(force_jupyter=True))
    with pytest.warns(UserWarning, match="ipywidgets"), shown:
        shown.add_task("x")
