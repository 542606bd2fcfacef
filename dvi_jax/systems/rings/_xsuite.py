"""Elements of Xsuite: what is written for one of pyAT, and read where pyAT leaves something out."""

import math
import re
from typing import Any

import numpy as np

from ._elements import C, Element

_KINDS = {"Quadrupole": "Quadrupole", "Sextupole": "Sextupole", "Octupole": "Octupole"}
_SIDES = (("entry", "Entrance", 1), ("exit", "Exit", 2))
_LIMITS = {
    "LimitRect": ("RApertures", ("min_x", "max_x", "min_y", "max_y")),
    "LimitEllipse": ("EApertures", ("a", "b")),
}


def content_of(source: Any, element: Element, frames: list[str]) -> dict[str, dict[str, Any]] | str:
    """Names and contents for Xsuite, in order, from the element of pyAT; the reason if there is no
    counterpart."""
    kind, length, name = type(source).__name__, float(source.Length), source.FamName
    content: dict[str, Any] = {"length": length}
    method, is_exact = source.PassMethod, source.PassMethod.startswith("Exact")
    is_field = kind in ("ThinMultipole", "Multipole", "Dipole", *_KINDS)
    if method == "IdentityPass" and length == 0:
        content = {"__class__": "Marker"}
    elif kind == "Drift":
        content |= {"__class__": "Drift", "model": "exact" if is_exact else "expanded"}
    elif kind == "Aperture":
        keys = _LIMITS["LimitRect"][1]
        content = {"__class__": "LimitRect", **dict(zip(keys, source.Limits.tolist(), strict=True))}
    elif kind == "Corrector":
        x, y = source.KickAngle.tolist()
        content |= {"__class__": "Multipole", "isthick": True, "knl": [-x], "ksl": [y], "order": 0}
        content |= {"num_multipole_kicks": 1, "model": "drift-kick-drift-expanded"}
    elif method == "SolenoidLinearPass":
        content |= {"__class__": "UniformSolenoid", "ks": source.K}
    elif method == "CavityPass":
        lag = 180 - 360 * source.TimeLag * source.Frequency / C - math.degrees(source.PhaseLag)
        content |= {"__class__": "Cavity", "voltage": source.Voltage, "lag": lag}
        content |= {"frequency": source.Frequency}
    elif is_field and "E2" not in method:
        content |= _field(source, kind, is_exact)
    else:
        return f"{method} is not there"
    edges = _edges(source, is_exact) if kind == "Dipole" else {}
    if isinstance(edges, str):
        return edges
    content |= edges
    limits = {key: getattr(source, _LIMITS[key][0], None) for key in _LIMITS}
    limits = {key: values.tolist() for key, values in limits.items() if values is not None}
    if frames:
        keys = {"dx": "shift_x", "dy": "shift_y", "roll": "rot_s_rad_no_frame", "tilt": "rot_s_rad"}
        moves = {new: float(element.values.get(old, 0.0)) for old, new in keys.items()}
        moves = {key: value for key, value in moves.items() if value}
        has_both = "rot_s_rad" in moves and len(moves) > 1
        if has_both or "affine" in frames or limits or not is_field:
            return "only magnets are placed or tilted, not both, and without an aperture"
        content |= moves | {"rot_shift_anchor": 0.0}
    heads, tails = {}, {}
    for key, values in limits.items():
        limit = {"__class__": key, **dict(zip(_LIMITS[key][1], values, strict=True))}
        heads[f"{name}_{key}_entry"] = limit
        tails = {f"{name}_{key}_exit": limit, **tails}
    return {**heads, name: content, **tails}


def _field(source: Any, kind: str, is_exact: bool) -> dict[str, Any]:
    """Strengths k_n = n! b_n of the main field, and the others integrated over the length."""
    factors = np.array([math.factorial(n) for n in range(len(source.PolynomB))])
    knl, ksl = factors * source.PolynomB, factors * source.PolynomA
    if kind == "ThinMultipole":
        return {"__class__": "Multipole", "knl": knl.tolist(), "ksl": ksl.tolist(),
                "order": source.MaxOrder}  # fmt: skip
    has_fringe = any(getattr(source, f"FringeQuad{end}", 0) for _, end, _ in _SIDES)
    label = "Bend" if kind == "Dipole" else _KINDS.get(kind, "Multipole")
    if has_fringe and label in ("Multipole", "Sextupole", "Octupole"):
        label = "Quadrupole"
    content: dict[str, Any] = {"__class__": label, "order": source.MaxOrder}
    content |= {"num_multipole_kicks": source.NumIntSteps, "integrator": "yoshida4"}
    content["model"] = f"drift-kick-drift-{'exact' if is_exact else 'expanded'}"
    if label == "Bend" and is_exact:
        content["model"] = "bend-kick-bend"
    if label == "Multipole":
        content["isthick"] = True
    if label == "Quadrupole":
        content |= {f"edge_{side}_active": getattr(source, f"FringeQuad{end}", 0)
                    for side, end, _ in _SIDES}  # fmt: skip
    return content | {
        "knl": (source.Length * knl).tolist(), "ksl": (source.Length * ksl).tolist(),
    }  # fmt: skip


def _edges(source: Any, is_exact: bool) -> dict[str, Any] | str:
    content = {"angle": source.BendingAngle, "k0_from_h": True}
    for side, end, i in _SIDES:
        method, fringe = (getattr(source, f"Fringe{k}{end}", 0) for k in ("Bend", "Quad"))
        if method == 2 or (is_exact and not method):
            return f"its edge, FringeBend{end} = {method}, is not there"
        model = (
            ("full" if fringe else "dipole-only") if is_exact else "full" if fringe else "linear"
        )
        content |= {
            f"edge_{side}_angle": getattr(source, f"{end}Angle"),
            f"edge_{side}_fint": getattr(source, f"FringeInt{i}") if method else 0.0,
            f"edge_{side}_hgap": source.FullGap / 2,
            f"edge_{side}_model": model,
        }
    return content


def counterpart(source: Any, content: dict[str, Any], toolbox: Any) -> Any:
    """The element that pyAT makes of one of Xsuite, with what it leaves out or misreads."""
    kind = content.get("__class__")
    element, names = source, ()
    if kind in _LIMITS:
        key, names = _LIMITS[kind]
        ends = {"min_x": -1e10, "min_y": -1e10}
        values = np.array([content.get(k, ends.get(k, 1e10)) for k in names])
        element = toolbox.Marker(source.FamName, **{key: values})
        if kind == "LimitRect":
            element = toolbox.Aperture(source.FamName, values)
    elif kind == "UniformSolenoid" and content["length"]:
        names = "length", "ks", "order", "num_multipole_kicks"
        values = {"Length": content["length"], "K": content.get("ks", 0.0)}
        element = toolbox.Element(source.FamName, PassMethod="SolenoidLinearPass", **values)
    if element is not source:
        element.unread = {key: value for key, value in content.items() if key not in names}
        return element
    if kind == "Cavity" and source.Voltage and source.Frequency > 0:
        source.TimeLag = (180 - content.get("lag", 0.0)) / 360 * C / source.Frequency
        source.PassMethod = "CavityPass"
    if kind in ("Bend", "RBend"):
        for side, end, _ in _SIDES:
            # Linear edges, the default, have no fringe field of the quadrupole.
            setattr(source, f"FringeQuad{end}", int(content.get(f"edge_{side}_model") == "full"))
        if source.PassMethod.startswith("Exact"):
            source.gK = getattr(source, "FullGap", 0.0) * getattr(source, "FringeInt1", 0.0)
    return source


def fold_limits(names: list[str], elements: list[Any]) -> list[Any]:
    """Elements with the apertures that `save` has written before and after them."""
    result = list(zip(names, elements, strict=True))
    for key, (attribute, _) in reversed(_LIMITS.items()):  # the order of `content_of`, from inside
        i = 0
        while i < len(result) - 2:
            first, (name, element), last = result[i : i + 3]
            ends = [re.sub(r"\.\d+$", "", x) for x in (first[0], name, last[0])]
            if ends == [f"{ends[1]}_{key}_entry", ends[1], f"{ends[1]}_{key}_exit"]:
                values = getattr(first[1], "Limits" if key == "LimitRect" else attribute)
                setattr(element, attribute, values)
                result[i : i + 3] = [(name, element)]
            i += 1
    return [element for _, element in result]
