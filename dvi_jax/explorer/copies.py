"""The code that makes a picture of the page without the page, and the run file of a trajectory."""

import textwrap
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np

from ..integration.integrator import default_method
from .model import (
    CROSSINGS,
    DIAGRAM_CROSSINGS,
    DIAGRAM_SKIP,
    DIAGRAM_STEPS,
    DRIFT_STARTS,
    DRIFT_STEPS,
    EPSILONS,
    RUNS,
    SECTION_STEPS,
    STROBE,
    Model,
)
from .orbits import SIGNAL
from .subject import METHODS

VIEWS = ("motion", "section", "diagram", "drift")
"""The pictures of the page."""

_HEAD = """\
import jax
import matplotlib.pyplot as plt
import numpy as np

import dvi_jax as dvi

jax.config.update("jax_enable_x64", True)  # before the first array is made

"""


def python(model: Model, view: str = "motion") -> str:
    """The code of a picture, one of `VIEWS`.

    It assigns `solution`, `section` and `colour`, `diagram`, or `discovery` and `orders`.
    """
    make = {"motion": _motion, "section": _section, "diagram": _diagram, "drift": _drift}[view]
    return _HEAD + _setting(model) + "\n" + make(model) + "plt.show()\n"


def _setting(model: Model) -> str:
    subject, settings = model.subject, model.settings
    lines = subject.lines or "# problem = the object that was given to dvi.explore"
    system = "problem.system" if subject.problem is not None else "problem"
    method, default = subject.method(settings), default_method(subject.system)
    if settings.method in METHODS:
        text = f'"{settings.method}"'
    else:
        is_default = repr(method) == repr(default)
        text = "None  # that of the system" if is_default else "method  # given to dvi.explore"
    return (
        f"{lines}\nsystem = {system}\n"
        f"q0 = {_array(settings.q0)}\np0 = {_array(settings.p0)}\n"
        f"args = {_code(settings.args)}\nmethod = {text}\n"
        f'run = {{"h": {settings.h!r}, "epsilon": {settings.epsilon!r}, "args": args}}\n'
    )


def _motion(model: Model) -> str:
    subject, settings = model.subject, model.settings
    names, text = list(subject.observables), ""
    library = subject.problem.observables if subject.problem is not None else {}
    if "energy" in names and "energy" not in library:
        text = (
            "\n\ndef energy(t0, t1, q0, p0, q1, p1, args):\n"
            f"    return system.hamiltonian(t1, t1, q1, p1, {settings.epsilon!r}, args)\n\n\n"
        )
    rows = [
        f'"{n}": problem.observables["{n}"]' if n in library else f'"{n}": energy' for n in names
    ]
    x, y = model.orbit_axes()
    name = settings.observable or model.series()[0]
    values = (
        _rows(subject.coordinates[name])
        if name in subject.coordinates
        else f'solution.observed["{name}"]'
    )
    return (
        f"{text}solution = dvi.integrate(\n"
        f"    system, q0, p0, num_steps={settings.steps}, method=method, **run, throw=False,\n"
        f"    observe={{{', '.join(rows)}}},\n)\n"
        "print(solution.status)\n"
        f"values = np.asarray({values})\n"
        "figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout='constrained')\n"
        f"left.plot({_rows(subject.coordinates[x])}, {_rows(subject.coordinates[y])}, '.', ms=1)\n"
        f"left.set(xlabel={subject.label(x)!r}, ylabel={subject.label(y)!r})\n"
        "right.plot(solution.ts[-len(values):], values)\n"
        f"right.set(xlabel='t', ylabel={name!r})\n"
    )


def _surface(model: Model) -> str:
    if model.surface == STROBE:
        return f"surface = dvi.dynamics.stroboscope({model.settings.period!r})\n"
    index = _subscript(model.subject.coordinates[model.surface][1])
    value = model.settings.value
    return f"\n\ndef surface(t, q, p, args):\n    return q[{index}] - {value!r}\n\n\n"


def _section(model: Model) -> str:
    q, p = model.section_states()
    is_state = np.isfinite(p.reshape(len(p), -1)).all(axis=1)
    x, y = model.section_axes()
    index = _subscript(model.subject.coordinates[x][1])
    steps = f"num_steps={SECTION_STEPS}, method=method, **run, throw=False"
    kind = model.settings.colour
    colour, option = "colour = None\n", ""
    if kind != "orbit":
        option = f", colour=colour, colour_label={kind!r}"
        save = "save=dvi.Save(final=True), observe=dvi.MEGNO()"
        if kind == "frequency":
            save = f"save=dvi.Save(every={SIGNAL})"
        colour = (
            "orbits = jax.vmap(lambda q, p: dvi.integrate(\n"
            f"    system, q, p, {save},\n    {steps}))(qs, ps)\n"
        )
        colour += "colour = orbits.observed\n" if kind == "MEGNO" else (
            f"signal = orbits.qs[:, :, {index}] - 1j * orbits.ps[:, :, {index}]\n"
            "lines = dvi.frequencies(orbits.ts[0], signal, count=1, refine=False, throw=False)\n"
            "colour = abs(lines.frequencies[:, 0])\n"
        )  # fmt: skip
    return (
        f"{_surface(model)}# The orbits: that of the sliders, then one for each click.\n"
        f"qs = {_array(q[is_state])}\nps = {_array(p[is_state])}\n"
        "section = dvi.poincare_section(\n"
        f"    system, qs, ps, surface, crossings={CROSSINGS},\n    {steps},\n)\n"
        f"{colour}dvi.plot.section(section, x={x!r}, y={y!r}{option})\n"
    )


def _diagram(model: Model) -> str:
    name, low, high = model.diagram_range()
    label = name.removeprefix("args.")
    change = 'run["epsilon"] = values\n'
    if name != "epsilon":
        keys = "".join(f"[{_key(part)}]" for part in label.split("."))
        change = f'args{keys} = dvi.Axis("parameter", values)\n'
    x, _ = model.section_axes()
    symbol = "ε" if name == "epsilon" else label
    return (
        f"{_surface(model)}values = np.linspace({low!r}, {high!r}, {RUNS})\n{change}"
        "diagram = dvi.bifurcation(\n"
        f"    system, q0, p0, surface, crossings={DIAGRAM_CROSSINGS}, skip={DIAGRAM_SKIP},\n"
        f"    num_steps={DIAGRAM_STEPS}, method=method, **run, throw=False,\n)\n"
        f"dvi.plot.bifurcation(values, diagram, y={x!r}, name={symbol!r})\n"
    )


def _drift(model: Model) -> str:
    corners = (_array(x) for x in model.box())
    q_low, p_low, q_high, p_high = corners
    degree, shape = model.settings.degree, tuple(model.subject.shape)
    span = 1.0 if model.subject.system.slow_time else DRIFT_STEPS * abs(model.settings.h)
    return (
        "# A box around the trajectory, from which samples are drawn.\n"
        f"q_box = {q_low}, {q_high}\np_box = {p_low}, {p_high}\n"
        f"basis = dvi.Polynomials({degree})\n"
        f"count = max(64, 4 * basis.for_shape({shape}).size)\n"
        "random = np.random.default_rng(0)\n"
        f"samples = [random.uniform(*box, (count, *{shape})) for box in (q_box, p_box)]\n"
        f"samples.append(random.uniform(0.0, {span!r}, count))  # times\n"
        f"starts = [random.uniform(*box, ({DRIFT_STARTS}, *{shape})) for box in (q_box, p_box)]\n"
        'options = {"h": run["h"], "args": args, "method": method}\n'
        "discovery = dvi.discover_invariants(\n"
        "    system, basis, 1, samples=samples,\n"
        '    representative="simplest", **options,\n)\n'
        "print(discovery)\n"
        "orders = [\n"
        f"    dvi.drift_order(system, series, *starts, epsilons={list(EPSILONS)},\n"
        f"                    num_steps={DRIFT_STEPS}, batched=True, **options)\n"
        "    for series in discovery.invariants\n]\n"
        "dvi.plot.drift_orders(orders)\n"
    )


def toml(model: Model) -> str:
    """The file with which `dvi-jax run` computes the trajectory.

    **Raises** `ValueError` for a system without a name in a file, and for parameters or a method
    that a file cannot have.
    """
    subject, settings = model.subject, model.settings
    if not subject.name:
        raise ValueError(
            "a run file needs the name of the system, in the library or as file.py:name; this "
            "page shows an object of a Python session. Copy as Python has no such limit."
        )
    args = settings.args
    if args is not None and not isinstance(args, Mapping):
        raise ValueError("a run file needs parameters in a dict; copy as Python instead.")
    lines = [
        "# dvi-jax run FILE.toml", f"system = {_text(subject.name)}",
        f"method = {_text(settings.method)}", f"h = {settings.h!r}", f"steps = {settings.steps}",
    ]  # fmt: skip
    if ":" in subject.name:
        lines.insert(1, "# This file belongs into the folder of the Python file.")
    if subject.has_perturbation:
        lines.append(f"epsilon = {settings.epsilon!r}")
    lines += ["", "[state]", f"q0 = {_toml(settings.q0)}", f"p0 = {_toml(settings.p0)}"]
    if args:
        lines += ["", "[args]", *(f"{_text(k)} = {_toml(v)}" for k, v in args.items())]
    # As many saved states as the page draws.
    lines += ["", "[output]", f"every = {max(1, settings.steps // 1000)}"]
    return "\n".join(lines) + "\n"


def _rows(coordinate: tuple[str, tuple[int, ...]]) -> str:
    kind, index = coordinate
    return f"solution.{kind}s[{', '.join([':', *map(str, index)])}]"


def _subscript(index: tuple[int, ...]) -> str:
    return ", ".join(map(str, index))


def _key(part: str) -> str:
    return part if part.isdigit() else repr(part)


def _array(x: Any) -> str:
    text = repr(np.asarray(x).tolist())
    return f"np.array({text})" if len(text) < 80 else _lines_of("np.array(", text)


def _lines_of(head: str, text: str) -> str:
    lines = textwrap.wrap(text, 92, break_long_words=False, break_on_hyphens=False)
    return head + "\n    " + "\n    ".join(lines) + "\n)"


def _code(tree: Any) -> str:
    """A pytree of numbers and arrays as Python code."""
    if isinstance(tree, Mapping):
        return "{" + ", ".join(f"{k!r}: {_code(v)}" for k, v in tree.items()) + "}"
    if isinstance(tree, list | tuple):
        inner = ", ".join(map(_code, tree)) + ("," if isinstance(tree, tuple) else "")
        return f"[{inner}]" if isinstance(tree, list) else f"({inner})"
    if isinstance(tree, np.ndarray | jax.Array):
        return f"np.array({np.asarray(tree).tolist()!r})"
    return repr(tree.item() if isinstance(tree, np.generic) else tree)


def _toml(value: Any) -> str:
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_text(k)} = {_toml(v)}" for k, v in value.items()) + "}"
    if isinstance(value, np.ndarray | jax.Array | np.generic):
        value = np.asarray(value).tolist()
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int | float):
        return repr(value)
    raise ValueError(f"a run file cannot have the parameter {value!r:.80}; copy as Python instead.")


def _text(text: str) -> str:
    return '"' + str(text).replace("\\", "\\\\").replace('"', '\\"') + '"'
