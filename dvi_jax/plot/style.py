"""Style of the pictures: colours, dashes, markers, common keywords, writing to a file.

The settings of matplotlib are in ``dvi.mplstyle``, next to this file.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec, TypeVar

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib import colormaps
from matplotlib.colors import ListedColormap

from ..base.files import writable_path

P = ParamSpec("P")
R = TypeVar("R")

_FILE = Path(__file__).with_name("dvi.mplstyle")
_SETTINGS = mpl.rc_params_from_file(_FILE, use_default_template=False)

COLOURS: tuple[str, ...] = tuple(_SETTINGS["axes.prop_cycle"].by_key()["color"])
"""The palette of Okabe and Ito (2008), dark first. Lines differ by marker or dash as well."""

DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")
MARKS = ("s", "^", "D", "v", "P", "<", ">")
"""Markers on lines that may overlap. The circle marks a start and the cross an early end."""

SHADES = ListedColormap(colormaps["viridis"](np.linspace(0, 0.88, 256)), "shades")
"""Colours of numbers: viridis without its light yellow, which is invisible on white paper."""

GREY, PALE = "#777777", "#b8b8b8"
"""Colours of reference lines and of missing values."""

NO_NUMBER, ZERO = "#d0d0d0", "#000000"
"""Colours of cells without a number (hatched as well) and of exact zeros on a logarithmic scale."""

HATCH: dict[str, Any] = {"facecolor": NO_NUMBER, "edgecolor": "#8c8c8c", "hatch": "/////"}
HATCH["lw"] = 0
CROSS: dict[str, Any] = {"marker": "x", "color": "#000000", "ms": 7, "mew": 1.5}
START: dict[str, Any] = {"marker": "o", "mfc": "white", "ls": "none"}
STAR: dict[str, Any] = {"marker": "*", "color": "#E69F00", "ms": 11, "ls": "none"}
STAR["mec"] = "black"
GUIDE: dict[str, Any] = {"color": GREY, "lw": 1, "ls": "--"}
SMALL: dict[str, Any] = {"fontsize": 8, "color": "#555555"}

_in_use: ContextVar[bool] = ContextVar("in_use", default=False)


@contextmanager
def style() -> Iterator[None]:
    """The style of this package for figures made inside the block; no global setting changes.

    The functions of `dvi_jax.plot` use it anyway. A block serves figures of your own and changes
    of the style: settings made inside it by ``matplotlib.rc_context`` take effect.
    """
    token = _in_use.set(True)
    try:
        with mpl.rc_context(_SETTINGS):
            try:
                yield
            finally:
                interactive = mpl.is_interactive()
    finally:
        _in_use.reset(token)
    # The first figure of a notebook selects an interactive backend. That choice must survive.
    mpl.interactive(interactive)


def in_style(function: Callable[P, R]) -> Callable[P, R]:
    """The function, drawing in this style unless its caller is inside a `style()` block."""

    @wraps(function)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        with nullcontext() if _in_use.get() else style():
            return function(*args, **kwargs)

    return wrapper


class Look(NamedTuple):
    """Keywords that several pictures share; `dvi_jax.plot` describes them."""

    labels: Sequence[str] | None = None
    colour: Any = None
    colour_label: str = ""
    units: Mapping[str, str] = {}
    title: str = ""
    ax: Any = None


def look_of(options: Mapping[str, Any], *exceptions: str) -> Look:
    """The options that were given, with defaults for the others, without `exceptions`."""
    check_keywords(options, *(name for name in Look._fields if name not in exceptions))
    return Look(**{name: x for name, x in options.items() if x is not None})


def check_keywords(keywords: Mapping[str, Any], *names: str) -> None:
    """**Raises** `TypeError` for a keyword that is not one of `names`."""
    if excess := [name for name in keywords if name not in names]:
        raise TypeError(
            f"unknown keyword {excess[0]!r}. Allowed are {', '.join(names)}, and those in the "
            "signature."
        )


@in_style
def save(drawn: Any, path: str | Path) -> Path:
    """Write the figure (type from the suffix) and close it; returns the path.

    `drawn`: a figure, or axes of one, as every function of `dvi_jax.plot` returns them. **Raises**
    `TypeError` for anything else, `ValueError` for axes of several figures.
    """
    path = writable_path(path)
    axes = np.ravel(np.asarray(drawn, object)).tolist()
    if not axes or not all(hasattr(axis, "figure") for axis in axes):
        raise TypeError(f"drawn must be a figure, or the Axes of one, got {drawn!r:.200}.")
    figures = {figure_of(axis) for axis in axes}  # a figure's own `figure` is itself
    if len(figures) > 1:
        raise ValueError(f"drawn must be of one figure, got Axes of {len(figures)} figures.")
    figure = figures.pop()
    figure.savefig(path)
    plt.close(figure)
    return path


def figure_of(axis: Any) -> Any:
    """The figure that contains the axes, the outermost one for axes of a subfigure."""
    figure = axis.figure
    while figure.figure is not figure:
        figure = figure.figure
    return figure


def sign_text(value: float, form: str = "g") -> str:
    """A number with a minus sign as wide as a plus sign."""
    return f"{value:{form}}".replace("-", "−")


def with_unit(name: str, unit: str | None) -> str:
    """A label with its unit, if it has one."""
    return name if unit in (None, "", "1") else f"{name} [{unit}]"
