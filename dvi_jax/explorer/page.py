"""The page: widgets that change the model, and figures that show it."""

import html
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import panel as pn
from bokeh.events import Tap

from . import copies, style
from .figures import SHADES, DiagramFigure, DriftFigure, MotionFigures, SectionFigure
from .model import STEPS, Drifts, Model
from .subject import Subject
from .widgets import BLOCK, WIDGET, Slider, button, number, row, select

_TABS = ("Motion", "Section", "Orbit diagram", "Drift")
COLOURINGS = ("orbit", "MEGNO", "frequency")
SEARCH = "search for invariants"
"""Name of the thread that computes it."""
_DELAY = 15  # milliseconds in which further moves of a slider join the same picture


class Page:
    """The widgets and figures of one browser window, with a `Model` of its own.

    - `view`: the object for panel.
    """

    def __init__(self, subject: Subject):
        self.model = Model(subject)
        self.message = pn.pane.HTML("", css_classes=["message"], visible=False, **BLOCK)
        self.state = pn.pane.HTML("", css_classes=["state"], **BLOCK)
        self._is_pending = self._is_quiet = False
        self._document: Any = None
        self._controls = {c.key: Slider(c, self._value(c.key)) for c in subject.controls()}
        for key, slider in self._controls.items():
            for widget in (slider.bar, slider.number):
                self._watch(widget, lambda value, key=key: self._slide(key, value))
        self.motion = MotionFigures(subject.invariants)
        self.section, self.diagram, self.drift = SectionFigure(), DiagramFigure(), DriftFigure()
        figures = [self.motion.path, self.motion.series, self.motion.changes]
        figures += [figure.plot for figure in (self.section, self.diagram, self.drift)]
        self._panes = [pn.pane.Bokeh(figure) for figure in figures]
        self.section.plot.on_event(Tap, lambda event: self.click(event.x, event.y))
        self.diagram.plot.on_event(Tap, lambda event: self._open_section(event.x))
        self.tabs = pn.widgets.RadioButtonGroup(
            name="Picture",
            options=dict(zip(_TABS, copies.VIEWS, strict=True)),
            value="motion",
            stylesheets=[style.TABS],
            sizing_mode="stretch_width",
            margin=(0, 0, 6, 0),
        )
        parts = self._motion_tab, self._section_tab, self._diagram_tab, self._drift_tab
        self._parts = {name: part() for name, part in zip(copies.VIEWS, parts, strict=True)}
        self._watch(self.tabs, self._open)
        self._open("motion", draws=False)
        self.view = self._layout()

    def _open(self, view: str, draws: bool = True) -> None:
        for name, part in self._parts.items():
            part.visible = name == view
        if draws:
            self._schedule()

    # The parts of the page

    def _layout(self) -> Any:
        subject, problem = self.model.subject, self.model.subject.problem
        source = f"<p>{html.escape(problem.source)}</p>" if problem and problem.source else ""
        title = html.escape(subject.title.replace("_", " "))
        head = pn.pane.HTML(f"<h1>{title}</h1>{source}", **BLOCK)
        method = select("Method", list(subject.methods), self.model.settings.method)
        self._watch(method, lambda value: self._choose(method=value))
        reset = button("Reset the sliders", self.reset)
        groups = {"Perturbation and step": ("epsilon", "h"), "Parameters": ("args",),
                  "Initial condition": ("q0", "p0")}  # fmt: skip
        side: list[Any] = [method]
        for name, starts in groups.items():
            sliders = [s.view for key, s in self._controls.items() if key.startswith(starts)]
            heading = [pn.pane.HTML(f"<h2>{name}</h2>", **BLOCK)] if sliders else []
            side += [*heading, *sliders]
        if not any(key[0] in "qp" for key in self._controls):
            text = "The initial condition has too many coordinates for sliders."
            side.append(pn.pane.HTML(f"<p class='note'>{text}</p>", **BLOCK))
        side.append(reset)
        return pn.Column(
            head, self.message,
            pn.FlexBox(
                pn.Column(*side, stylesheets=[style.SIDE]),
                pn.Column(
                    self.tabs, *self._parts.values(), self.state, self._copies(),
                    stylesheets=[style.MAIN],
                ),
                flex_wrap="wrap", gap="14px", align_items="flex-start",
                sizing_mode="stretch_width",
            ),
            stylesheets=[style.COLOURS + style.ROOT], sizing_mode="stretch_width",
        )  # fmt: skip

    def _motion_tab(self) -> Any:
        model, names = self.model, list(self.model.subject.coordinates)
        x, y = model.orbit_axes()
        steps = select("Steps", {f"{n:,}".replace(",", " "): n for n in STEPS}, STEPS[1])
        observable = select("Over time", model.series(), model.series()[0])
        axes = select("Horizontal", names, x), select("Vertical", names, y)
        self._watch(steps, lambda value: self._choose(steps=value))
        self._watch(observable, lambda value: self._choose(observable=value))
        for axis in axes:
            self._watch(axis, lambda _: self._choose(path=tuple(a.value for a in axes)))
        swatches = "".join(
            f"{_swatch(i)}{html.escape(name.replace('_', ' '))} "
            for i, name in enumerate(model.subject.invariants)
        )
        return pn.Column(
            row(steps, observable, *axes), self._panes[0], self._panes[1],
            pn.pane.HTML(f"<p class='note names'>{swatches}</p>", **BLOCK), self._panes[2],
            sizing_mode="stretch_width",
        )  # fmt: skip

    def _section_tab(self) -> Any:
        model = self.model
        surface = select("Surface", model.surfaces(), model.surface)
        colour = select("Colour", list(COLOURINGS), model.settings.colour)
        value = number("at the value", model.settings.value)
        period = number("Period", model.settings.period)
        value.visible, period.visible = (surface.value != "stroboscope",
                                         surface.value == "stroboscope")  # fmt: skip

        def choose(name: str) -> None:
            value.visible, period.visible = name != "stroboscope", name == "stroboscope"
            model.orbits.clear()
            self._choose(surface=name, axes=None)

        self._watch(surface, choose)
        self._watch(colour, lambda kind: self._choose(colour=kind))
        self._watch(value, lambda x: self._move("value", x))
        self._watch(period, lambda x: self._move("period", x))
        hint = (
            "Click in the picture: an orbit begins there. On a surface q[i] = value it has the "
            "energy of the initial condition."
        )
        self.scale = pn.pane.HTML("", css_classes=["scale"], **BLOCK)
        return pn.Column(
            row(surface, value, period, colour, button("Clear the orbits", self.clear)),
            pn.pane.HTML(f"<p class='note'>{hint}</p>", **BLOCK), self.scale, self._panes[3],
            sizing_mode="stretch_width",
        )  # fmt: skip

    def _diagram_tab(self) -> Any:
        names = self.model.diagram_parameters()
        if not names:
            text = "The system has neither a perturbation nor parameters to vary."
            return pn.pane.HTML(f"<p>{text}</p>", **BLOCK)
        name, low, high = self.model.diagram_range()
        labels = {"ε" if n == "epsilon" else n.removeprefix("args."): n for n in names}
        parameter = select("Parameter", labels, name)
        ends = number("from", low), number("to", high)

        def choose(name: str) -> None:
            self.model.change(parameter=name, ends=None)
            self._is_quiet = True
            for box, value in zip(ends, self.model.diagram_range()[1:], strict=True):
                box.value = value
            self._is_quiet = False
            self._schedule()

        self._watch(parameter, choose)
        for end in ends:
            self._watch(end, lambda _: self._choose(ends=tuple(e.value for e in ends)))
        hint = "Click at a value of the parameter to open its section."
        return pn.Column(
            row(parameter, *ends), pn.pane.HTML(f"<p class='note'>{hint}</p>", **BLOCK),
            self._panes[4], sizing_mode="stretch_width",
        )  # fmt: skip

    def _drift_tab(self) -> Any:
        degree = select("Polynomials of degree", [2, 3, 4, 5, 6, 8], self.model.settings.degree)
        self._watch(degree, lambda value: self.model.change(degree=value))
        self.search = button("Discover invariants", self.discover, "primary")
        self.progress = pn.pane.HTML("", css_classes=["progress"], **BLOCK)
        self.formulas = pn.pane.HTML("", css_classes=["formulas"], **BLOCK)
        hint = (
            "Searches the map for adiabatic invariants of order 1 in a box around the trajectory, "
            "and measures how much they change in 1000 steps at six values of ε."
        )
        return pn.Column(
            pn.pane.HTML(f"<p class='note'>{hint}</p>", **BLOCK), row(degree, self.search),
            self.progress, self._panes[5], self.formulas, sizing_mode="stretch_width",
        )  # fmt: skip

    def _copies(self) -> Any:
        self.code = pn.widgets.TextAreaInput(
            value="", rows=12, visible=False, disabled=False, css_classes=["code"], **WIDGET
        )
        # The browser copies only after a click, and the text comes a moment after it.
        self.code.jscallback(value="navigator.clipboard?.writeText(cb_obj.value).catch(() => {})")
        files = [
            pn.widgets.FileDownload(
                callback=lambda kind=kind: self._file(kind), filename=f"explore.{suffix}",
                label=f"Download {suffix}", button_type="default", stylesheets=[style.WIDGET],
                margin=(3, 4), embed=False,
            )
            for kind, suffix in (("python", "py"), ("toml", "toml"))
        ]  # fmt: skip
        buttons = [
            button("Copy as Python", lambda: self.copy("python")),
            button("Copy as TOML", lambda: self.copy("toml")),
        ]
        return pn.Column(row(*buttons, *files), self.code, sizing_mode="stretch_width")

    # What the user does

    def reset(self) -> None:
        """The sliders as at the beginning."""
        start = self.model.subject.start
        numbers = ("epsilon", "h", "args", "q0", "p0")
        self.model.change(**{name: getattr(start, name) for name in numbers})
        self._show_values()
        self._schedule()

    def clear(self) -> None:
        """Remove the orbits of the section that were clicked."""
        self.model.orbits.clear()
        self._schedule()

    def click(self, x: float, y: float) -> None:
        """Begin an orbit at a point of the section."""
        if self._attempt(lambda: self.model.click(x, y)):
            self._schedule()

    def _open_section(self, value: float) -> None:
        name = self.model.diagram_range()[0]
        if self._attempt(lambda: self.model.move(name, float(value))):
            self._show_values()
            self.tabs.value = "section"

    def copy(self, kind: str) -> None:
        """Show the code of the picture, or the run file, and copy it."""
        texts: list[str] = []
        if self._attempt(lambda: texts.append(self._text(kind))):
            self.code.visible = True
            self.code.value = texts[0]

    def discover(self) -> None:
        """Search for invariants in a thread of its own, and show how far it is."""
        self.search.disabled = True
        self._show("")
        model = Model(self.model.subject)
        model.settings = self.model.settings

        def report(count: int, total: int) -> None:
            text = f"<progress value='{count}' max='{total}'></progress><p class='note'>"
            text += "searching the map" if not count else f"{count} of {total} parts"
            self._later(lambda: setattr(self.progress, "object", text + "</p>"))

        def work() -> None:
            try:
                drifts = model.drifts(report)
            except Exception as error:
                self._later(lambda text=_line(error): self._finish(None, text))
            else:
                self._later(lambda: self._finish(drifts, drifts.message))

        # No daemon: the interpreter cannot end while XLA computes in a thread.
        threading.Thread(target=work, name=SEARCH).start()

    def _finish(self, drifts: Drifts | None, message: str) -> None:
        self.search.disabled, self.progress.object = False, ""
        self._show(message)
        if drifts is not None:
            self.drift.draw(drifts)
            self.formulas.object = _table(drifts)

    # Redrawing

    def draw(self) -> None:
        """Draw the picture that is in view. An error leaves the last one, and is shown."""
        self._is_pending = False
        self._draw()
        if self._document is None:  # a notebook receives changes of figures when they are sent
            pn.io.push_notebook(*self._panes)

    def _draw(self) -> None:
        view = self.tabs.value
        result: list[Any] = []
        if view == "drift":
            self.state.object = ""
            return
        if not self._attempt(lambda: result.append(getattr(self.model, view)())):
            self.state.object = ""
            return
        picture = result[0]
        if view == "motion":
            unit = self.model.subject.units.get("t", "1")
            self.motion.draw(picture, "t" if unit in ("", "1") else f"t [{unit}]")
        elif view == "section":
            self._show_scale(self.section.draw(picture))
        else:
            self.diagram.draw(picture)
        self._show(picture.message)
        text = f"computed in {1000 * picture.seconds:.0f} ms"
        self.state.object = f"<p class='note'>{text}</p>"

    def _show_scale(self, ends: tuple[float, float] | None) -> None:
        """The scale of the colours of a section."""
        self.scale.object = ""
        if ends is not None:
            colours = ", ".join(SHADES[:: len(SHADES) // 8])
            low, high = (f"{x:.4g}" for x in ends)
            bar = f"<span class='scale' style='background: linear-gradient(90deg, {colours})'>"
            kind = self.model.settings.colour
            self.scale.object = f"<p class='note'>{kind} {low}{bar}</span>{high}</p>"

    def _schedule(self) -> None:
        """Draw soon, once for all changes that arrive until then."""
        if self._is_pending or self._is_quiet:
            return
        self._is_pending = True
        document = pn.state.curdoc
        if document is None or document.session_context is None:
            self.draw()  # in a notebook
            return
        self.state.object = "<p class='note'>computing …</p>"
        document.add_timeout_callback(self.draw, _DELAY)

    def _later(self, function: Callable[[], Any]) -> None:
        """Call a function in the thread of the page."""
        if self._document is None:
            function()
        else:
            self._document.add_next_tick_callback(function)

    def load(self) -> None:
        """Draw for the first time, when the browser shows the page."""
        self._document = pn.state.curdoc
        self._schedule()

    def _attempt(self, action: Callable[[], Any]) -> bool:
        """Whether an action succeeds; the page shows why not."""
        try:
            action()
        except Exception as error:
            self._show(_line(error))
            return False
        self._show("")
        return True

    def _show(self, text: str) -> None:
        box = f"<div class='alarm' role='alert'>{html.escape(text)}</div>" if text else ""
        self.message.object, self.message.visible = box, bool(text)

    def _move(self, key: str, value: Any) -> None:
        if value is None:
            self._show(f"{key} needs a number.")
        elif self._attempt(lambda: self.model.move(key, float(value))):
            self._schedule()

    def _slide(self, key: str, value: Any) -> None:
        self._move(key, value)
        # After a refused value the number stays, for the user to correct it.
        if value is not None and self._value(key) == value:
            self._is_quiet = True
            self._controls[key].show(value)
            self._is_quiet = False

    def _choose(self, **choices: Any) -> None:
        self.model.change(**choices)
        self._schedule()

    def _watch(self, widget: Any, function: Callable[[Any], Any], name: str = "value") -> None:
        def handle(event: Any) -> None:
            if not self._is_quiet:
                function(event.new)

        widget.param.watch(handle, name)

    def _value(self, key: str) -> float:
        return self.model.subject.read(self.model.settings, key)

    def _show_values(self) -> None:
        self._is_quiet = True
        for key, slider in self._controls.items():
            slider.show(self._value(key))
        self._is_quiet = False

    def _text(self, kind: str) -> str:
        view = self.tabs.value
        return copies.python(self.model, view) if kind == "python" else copies.toml(self.model)

    def _file(self, kind: str) -> Any:
        import io

        texts: list[str] = []
        self._attempt(lambda: texts.append(self._text(kind)))
        return io.BytesIO("".join(texts).encode())


def _line(error: BaseException) -> str:
    """An exception for the reader: the message of invalid input, of others with the type."""
    text = str(error).strip() or type(error).__name__
    return text if isinstance(error, ValueError) else f"{type(error).__name__}: {text}"


def _swatch(i: int) -> str:
    colour = style.PALETTE[i % len(style.PALETTE)]
    return f"<span class='swatch' style='background: {colour}'></span>"


def _table(drifts: Drifts) -> str:
    rows = []
    for i, (formula, order) in enumerate(zip(drifts.formulas, drifts.orders, strict=True)):
        slope = f"ε^{order.slope:.2f}" if np.isfinite(order.slope) else "at the floor"
        rows.append(
            f"<tr><td>{_swatch(i)}</td><td>{html.escape(formula)}</td><td>{slope}</td></tr>"
        )
    head = "<tr><th></th><th>Invariant</th><th>Drift scales as</th></tr>"
    return f"<table>{head}{''.join(rows)}</table>" if rows else ""
