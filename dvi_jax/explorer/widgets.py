"""Widgets in the style of the page: sliders, choices, numbers, buttons, rows."""

import html
from collections.abc import Callable
from typing import Any

import numpy as np
import panel as pn

from . import style

_FORMAT = "0[.][000000]"
WIDGET = {"stylesheets": [style.WIDGET], "sizing_mode": "stretch_width", "margin": (3, 4)}
BLOCK = {"stylesheets": [style.TEXT], "sizing_mode": "stretch_width", "margin": (0, 4)}


class Slider:
    """A slider with a field for its number, which may lie outside of the slider."""

    def __init__(self, control: Any, value: float):
        step = 10.0 ** np.floor(np.log10((control.high - control.low) / 200))
        self.bar = pn.widgets.FloatSlider(
            value=value, start=control.low, end=control.high, step=step, show_value=False,
            css_classes=["slider"], stylesheets=[style.WIDGET], sizing_mode="stretch_width",
            margin=(2, 14, 8, 10),
        )  # fmt: skip
        self.number = pn.widgets.FloatInput(
            value=value,
            step=step,
            format=_FORMAT,
            width=104,
            stylesheets=[style.WIDGET],
            margin=(0, 4),
        )
        text = f"<span class='label'>{html.escape(control.label)}</span>"
        label = pn.pane.HTML(text, **{**BLOCK, "margin": (4, 4, 0, 4)})
        head = pn.Row(label, self.number, sizing_mode="stretch_width")
        self.view = pn.Column(head, self.bar, sizing_mode="stretch_width")

    def show(self, value: float) -> None:
        """Show a number; the slider itself ends at its ends."""
        self.number.value = value
        self.bar.value = min(max(value, self.bar.start), self.bar.end)


def select(name: str, options: Any, value: Any) -> Any:
    """A choice among options; with two numbers it fills a row of a phone."""
    return pn.widgets.Select(name=name, options=options, value=value, width=134,
                             stylesheets=[style.WIDGET], margin=(3, 4))  # fmt: skip


def number(name: str, value: float) -> Any:
    """A field for a number."""
    return pn.widgets.FloatInput(name=name, value=value, width=94, format=_FORMAT,
                                 stylesheets=[style.WIDGET], margin=(3, 4))  # fmt: skip


def button(name: str, action: Callable[[], Any], kind: str = "default") -> Any:
    """A button that calls a function."""
    button = pn.widgets.Button(name=name, button_type=kind, stylesheets=[style.WIDGET],
                               margin=(3, 4), align="end")  # fmt: skip
    button.on_click(lambda _: action())
    return button


def row(*widgets: Any) -> Any:
    """Widgets next to one another, in several rows on a narrow screen."""
    return pn.FlexBox(*widgets, flex_wrap="wrap", align_items="flex-end", gap="4px",
                      sizing_mode="stretch_width")  # fmt: skip
