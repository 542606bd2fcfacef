"""`holds_for`: whether a certificate is about a system."""

import json
import os
from typing import Any, NamedTuple, TypedDict, Unpack

import jax
import jax.numpy as jnp

from lanewise import Layout

from ..base.files import user_file
from ..base.keywords import checked_keywords
from ..base.precision import refuse_double_without_x64
from ..integration.arithmetic import Arithmetic
from ..integration.integrator import Integrator
from ..methods import Method
from ..problem.system import System, check_system, of_problem
from .programs import Region, functions_of, programs_of
from .result import DriftBound, tools
from .ways import XLA, integrator_of, way_of_running

_PARTS = {
    "step": "the list of operations of the step",
    "invariants": "the lists of operations of the invariants",
    "inside": "the list of operations of inside",
    "implicit": "whether the step is implicit",
    "slow": "slow_time",
    "quantum": "the quantum of FixedPoint",
    "arithmetic": "the arithmetic",
}


class Binding(NamedTuple):
    """Whether a certificate is about a program. `bool(...)` is `holds`.

    - `differences`: what is not the same, so that the proof says nothing about the program.
    - `remarks`: what was not compared, and differences that the lists of operations do not show,
      such as another version of JAX.
    """

    holds: bool
    differences: tuple[str, ...]
    remarks: tuple[str, ...]

    def __bool__(self) -> bool:
        return self.holds

    def __str__(self) -> str:
        first = (
            "the proof is about this program" if self.holds else "the proof is about another one"
        )
        rows = [*(f"differs: {text}" for text in self.differences), *self.remarks]
        return "\n".join([first, *rows])


class BindingSettings(TypedDict, total=False):
    """Keywords of `holds_for` that describe the map as `bound_drift` received it."""

    inside: Any
    args: Any
    method: Method | str | None
    arithmetic: Arithmetic | None
    integrator: Integrator | None
    layout: Layout | None


@checked_keywords
def holds_for(
    system: Any,
    certificate: DriftBound | dict[str, Any] | str | os.PathLike[str],
    found: Any = None,
    **settings: Unpack[BindingSettings],
) -> Binding:
    """Check whether a certificate of `bound_drift` is about a system, by reading its map again.

    The step of the system is traced, read as a list of operations, compared with the traced
    function at random points of the domain, and then with the list of the certificate. The
    certificate itself is not checked: ``dvi-jax verify`` does that.

    **Arguments** `system`: a `System` or a problem of the library. `certificate`: a `DriftBound`,
    or the path or contents of the file that its `save` wrote. `found`: the invariants, if these
    shall be compared as well. `inside`, `args`, `method`, `arithmetic`, `layout`, `integrator`: as
    in the call of `bound_drift`. A proof about the rounding of machine code does not hold where
    XLA computes, as with ``layout=dvi.Layout(form="arrays")``, and vice versa.

    **Returns** a `Binding`, which is true if nothing differs; ``print`` shows what differs.

    **Raises** `ValueError` for a changed file, and for a system that has no list of operations.

    **Example**

    ```python
    spring = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + args * q0 @ q0) / 2)
    energy = lambda q, p, epsilon: (p @ p + q @ q - 0.1 * q @ p) / 2
    bound = dvi.bound_drift(energy, spring, args=1.0, h=0.1, epsilon=0.1, domain=np.array([0.5]))
    print(bool(dvi.holds_for(spring, bound, energy, args=1.0)))
    print(bool(dvi.holds_for(spring, bound, energy, args=1.1)))
    # True
    # False
    ```
    """
    exact, _ = tools()
    refuse_double_without_x64("the certificate", float)
    c = _contents(certificate)
    if c.get("format") != exact.FORMAT or exact.digest(c) != c["hash"]:
        raise ValueError(
            f"certificate must be a file that DriftBound.save wrote, of the format {exact.FORMAT!r}"
            f" and unchanged, got the format {c.get('format')!r}."
        )
    system, *_, args = of_problem(system, None, None, None, settings.get("args"), has_start=True)
    check_system(system, "holds_for")
    integrator = integrator_of(settings, "holds_for")
    low, high = ([float.fromhex(x) for x in side] for side in c["domain"])
    (begin, end), (least, largest) = ([float.fromhex(x) for x in c[k]] for k in ("time", "epsilon"))
    h, shape = float.fromhex(c["h"]), tuple(c["shape"])
    region = Region(shape, (low, high), (begin, end), (least, largest), h, c["timed"])
    functions = [] if found is None else functions_of(found, system, region.is_timed)
    inside = settings.get("inside")
    misfit = _misfit(system, args, functions, inside, shape)
    if misfit:
        return Binding(False, (misfit,), ())
    points = region.points(inside)
    _, programs = programs_of(system, integrator, args, functions, inside, region, points, c["way"])
    parts = [part for part in _PARTS if found is not None or part != "invariants"]
    differences = [_PARTS[part] for part in parts if programs[part] != c[part]]
    way, reason = way_of_running(system, integrator, shape, h, args)
    if way != c["way"]:
        text = f"the way of running: the proof is about {c['way']}, and integrate uses {way} here"
        differences.append(f"{text}{f' ({reason})' * bool(reason)}")
    remarks = [] if found is not None else ["the invariants were not compared: give found=..."]
    mine, its = programs["program"], c["program"]
    if mine["elementary functions"] != its["elementary functions"]:
        differences.append("the elementary functions, whose errors the rounding contains")
    for name in mine["versions"]:
        pair = its["versions"][name], mine["versions"][name]
        if pair[0] != pair[1]:
            # The errors of XLA's functions are measured, and another version may have others.
            has_effect = c["way"] == XLA and name == "jaxlib"
            rows = differences if has_effect else remarks
            rows.append(f"{name} was {pair[0]} when the proof was made and is {pair[1]}")
    names = ["step"] if found is None else ["step", "invariants"]
    remarks += [
        f"the program of the {name} is another one, with the same list of operations"
        for name in names
        if mine[name] != its[name] and programs[name] == c[name]
    ]
    return Binding(not differences, tuple(differences), tuple(remarks))


def _misfit(system: System, args: Any, functions: list, inside: Any, shape: tuple) -> str:
    """Why a system cannot have states of this shape; empty if it can."""
    state, number = jnp.zeros(shape), jnp.zeros(())
    try:
        system.check_shapes(number, state, state, number, args)
        for function, _ in functions:
            jax.eval_shape(function, state, state, number, number, number)
        if inside is not None:
            jax.eval_shape(inside, state, state)
    except Exception as error:  # of the user's functions: any
        return (
            f"the number of coordinates: q and p of the certificate have the shape {shape}, for "
            f"which the functions of this system raise {type(error).__name__}: {error}"
        )
    return ""


def _contents(certificate: Any) -> dict[str, Any]:
    if isinstance(certificate, DriftBound):
        return certificate.certificate
    contents = certificate
    if isinstance(certificate, str | os.PathLike):
        try:
            text = user_file("certificate", certificate).read_text(encoding="utf-8")
            contents = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(
                f"certificate {str(certificate)!r} is no JSON file: {error}."
            ) from None
    if not isinstance(contents, dict):
        raise TypeError(
            "certificate must be a DriftBound, or a file that its save wrote, got "
            f"{certificate!r:.100}."
        )
    return contents
