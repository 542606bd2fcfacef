"""The house style: colours, dashes, markers, and how a figure is written."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from cycler import cycler

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe & Ito's palette (2008), dark ones first; tell lines apart by marker or dash as well."""

DASHES = ("-", "--", "-.", ":", (0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)))

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">")

_STYLE: Any = {
    "figure.figsize": (6.4, 4.0),
    "figure.dpi": 110,
    "savefig.dpi": 160,
    "figure.constrained_layout.use": True,
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 10,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#d9d9d9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "lines.linewidth": 1.5,
    "lines.markersize": 4.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "axes.prop_cycle": cycler(color=COLOURS),
    "axes.formatter.limits": (-3, 4),
    "axes.formatter.use_mathtext": True,
}


@contextmanager
def style() -> Iterator[None]:
    """The house style, for the figures made inside the block; nothing global is changed."""
    with mpl.rc_context(_STYLE):
        yield


def save(figure: Any, path: str | Path) -> Path:
    """Write the figure (type from the suffix) and close it."""
    path = Path(path)
    figure.savefig(path)
    plt.close(figure)
    return path


def cell_edges(centres: np.ndarray) -> np.ndarray:
    """Edges of cells about `centres`, half way between them on a logarithmic axis."""
    x = np.log(centres)
    middle = (x[1:] + x[:-1]) / 2
    first, last = (x[0] - middle[0], middle[-1] - x[-1]) if len(x) > 1 else (-0.3, -0.3)
    return np.exp(np.concatenate([[x[0] + first], middle, [x[-1] - last]]))
