"""What tests of pictures read from them."""

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

mpl.use("Agg")


@pytest.fixture(autouse=True)
def closed():
    """No figure stays open after a test; import it to use it."""
    yield
    plt.close("all")


def legend(axis):
    """Texts of the legend, of the axes or of their figure."""
    found = axis.get_legend() or next(iter(axis.figure.legends), None)
    return [] if found is None else [text.get_text() for text in found.get_texts()]


def texts(axis):
    """Texts on the axes."""
    return [text.get_text() for text in axis.texts]


def lies_within(inner, outer, tolerance=0.0):
    """Whether what is drawn lies within the extent of something else."""
    a, b = inner.get_window_extent(), outer.get_window_extent()
    return (
        b.x0 - tolerance <= a.x0 < a.x1 <= b.x1 + tolerance
        and b.y0 - tolerance <= a.y0 < a.y1 <= b.y1 + tolerance
    )


def lines(axis):
    """Lines of two points or more, as arrays of their coordinates."""
    found = [np.asarray(line.get_data()) for line in axis.lines]
    return [xy for xy in found if xy.shape[-1] >= 2 and len(np.unique(xy[0])) > 1]


def marked(axis, marker):
    """Points that are drawn with a marker, one array (count, 2) for each line."""
    return [x.get_xydata() for x in axis.lines if x.get_marker() == marker and len(x.get_xdata())]


def refuses(draw, *cases):
    """Check that a function rejects (arguments, keywords) with a message, by a `ValueError`."""
    for args, kwargs, match, *error in cases:
        with pytest.raises(*error or (ValueError,), match=match):
            draw(*args, **kwargs)
