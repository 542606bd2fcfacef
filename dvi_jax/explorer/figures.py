"""The figures of the page: bokeh models, and how the numbers of the model fill them."""

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource
from bokeh.palettes import Viridis256
from bokeh.plotting import figure

from .model import Diagram, Drifts, Motion, SectionPicture
from .style import COLOURS, PALETTE

SHADES = Viridis256[60:222]
"""Colours of numbers, without the ends of viridis, which vanish on black or on white."""


def _figure(height: int, **options: Any) -> Any:
    plot = figure(
        height=height, sizing_mode="stretch_width", min_width=240, stylesheets=[COLOURS],
        tools="pan,wheel_zoom,box_zoom,reset,save", active_drag=None, **options,
    )  # fmt: skip
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    for axis in (plot.xaxis[0], plot.yaxis[0]):
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_font_size = "13px"
        axis.major_label_text_font_size = "12px"
    return plot


def _source(name: str, *columns: str) -> ColumnDataSource:
    return ColumnDataSource({column: [] for column in ("x", "y", *columns)}, name=name)


class MotionFigures:
    """Trajectory, observable over time, and changes of the invariants."""

    def __init__(self, invariants: list[str]):
        self.lines, self.dots = _source("lines", "colour"), _source("dots", "colour")
        self.path, self.series, self.changes = _figure(420), _figure(200), _figure(220,
            y_axis_type="log")  # fmt: skip
        self.path.multi_line("x", "y", color="colour", line_width=0.9, source=self.lines)
        self.path.scatter("x", "y", color="colour", size=2, line_color=None, source=self.dots)
        self.values = ColumnDataSource({"t": [], "y": []}, name="series")
        self.series.line("t", "y", color=PALETTE[0], line_width=1.2, source=self.values)
        self.sources = {name: ColumnDataSource({"t": [], "y": []}) for name in invariants}
        for source, colour in zip(self.sources.values(), PALETTE, strict=False):
            self.changes.line("t", "y", color=colour, line_width=1.4, source=source)
        for plot in (self.series, self.changes):
            plot.xaxis[0].axis_label = "t"
        self.changes.x_range = self.series.x_range
        self.changes.yaxis[0].axis_label = "relative change"

    def draw(self, motion: Motion, time: str) -> None:
        """Show a motion; `time`: the label of its axis."""
        names = list(motion.paths)
        columns: dict[str, Any] = {
            "x": [x for x, _ in motion.paths.values()],
            "y": [y for _, y in motion.paths.values()],
            "colour": [PALETTE[i % len(PALETTE)] for i in range(len(names))],
        }
        empty: dict[str, Any] = {name: [] for name in columns}
        self.lines.data = columns if motion.is_line else empty
        self.dots.data = empty if motion.is_line else _points_of(columns)
        self.path.xaxis[0].axis_label, self.path.yaxis[0].axis_label, label = motion.labels
        self.series.yaxis[0].axis_label = label.replace("_", " ")
        self.series.xaxis[0].axis_label = self.changes.xaxis[0].axis_label = time
        self.values.data = dict(zip("ty", motion.series, strict=True))
        for name, source in self.sources.items():
            source.data = dict(zip("ty", motion.changes[name], strict=True))


def _points_of(columns: dict[str, Any]) -> dict[str, Any]:
    lengths = [len(x) for x in columns["x"]]
    return {
        "x": np.concatenate(columns["x"]), "y": np.concatenate(columns["y"]),
        "colour": np.repeat(columns["colour"], lengths),
    }  # fmt: skip


class SectionFigure:
    """Points of a Poincaré section, a colour for each orbit or for a number of each orbit."""

    def __init__(self) -> None:
        self.points, self.starts = _source("section", "colour"), _source("starts")
        self.plot = _figure(560)
        self.plot.scatter("x", "y", color="colour", size=3, line_color=None, source=self.points)
        self.plot.scatter(
            "x", "y", size=9, fill_color=None, line_color=PALETTE[5], line_width=1.6,
            source=self.starts,
        )  # fmt: skip

    def draw(self, picture: SectionPicture) -> tuple[float, float] | None:
        """Show a section. Returns the ends of the scale of the colours, if they are numbers."""
        good = np.isfinite(picture.x) & np.isfinite(picture.y)
        colours, ends = [PALETTE[i % len(PALETTE)] for i in range(len(picture.x))], None
        if picture.colour is not None:
            finite = picture.colour[np.isfinite(picture.colour)]
            low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
            # Equal numbers, up to rounding, get one colour.
            size = high - low if high - low > 1e-9 * abs(high) else 1.0
            places = (np.nan_to_num(picture.colour, nan=low) - low) / size * (len(SHADES) - 1)
            is_number = np.isfinite(picture.colour)
            shades = [SHADES[int(x)] for x in places]
            colours = [c if ok else PALETTE[8] for c, ok in zip(shades, is_number, strict=True)]
            ends = float(low), float(high)
        self.points.data = {
            "x": picture.x[good], "y": picture.y[good],
            "colour": np.repeat(colours, good.sum(axis=1)),
        }  # fmt: skip
        self.starts.data = dict(zip("xy", picture.starts.T, strict=True))
        self.plot.xaxis[0].axis_label, self.plot.yaxis[0].axis_label = picture.labels
        return ends


class DiagramFigure:
    """Orbit diagram."""

    def __init__(self) -> None:
        self.points = _source("diagram")
        self.plot = _figure(520)
        self.plot.scatter("x", "y", size=2.2, color=PALETTE[0], line_color=None, source=self.points)

    def draw(self, diagram: Diagram) -> None:
        """Show a diagram."""
        x = np.broadcast_to(diagram.parameter[:, None], diagram.y.shape)
        good = np.isfinite(diagram.y)
        self.points.data = {"x": x[good], "y": diagram.y[good]}
        self.plot.xaxis[0].axis_label, self.plot.yaxis[0].axis_label = diagram.labels


class DriftFigure:
    """Drifts of invariants against ε."""

    def __init__(self) -> None:
        self.points, self.lines = (
            _source(f"drift {name}", "colour") for name in ("points", "lines")
        )
        self.plot = _figure(380, x_axis_type="log", y_axis_type="log")
        self.plot.multi_line("x", "y", color="colour", line_width=1.6, source=self.lines)
        self.plot.scatter("x", "y", color="colour", size=8, source=self.points)
        self.plot.xaxis[0].axis_label = "ε"
        self.plot.yaxis[0].axis_label = "largest change of the invariant"

    def draw(self, drifts: Drifts) -> None:
        """Show measured drifts."""
        colours = [PALETTE[i % len(PALETTE)] for i in range(len(drifts.orders))]
        pairs = [(o.epsilons, np.where(o.drifts > 0, o.drifts, np.nan)) for o in drifts.orders]
        columns: dict[str, Any] = {
            "x": [x for x, _ in pairs],
            "y": [y for _, y in pairs],
            "colour": colours,
        }
        self.lines.data = columns
        self.points.data = _points_of(columns) if pairs else {"x": [], "y": [], "colour": []}
