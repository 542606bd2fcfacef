"""Rings from running MAD-X, and from LatticeJSON."""

import math
import warnings
from typing import Any, get_args

import numpy as np

from ...base.checks import instance, one_of
from ...base.keywords import user_level
from ._elements import (
    Element,
    Model,
    bend,
    cavity,
    corrector,
    drift,
    marker,
    multipole,
    solenoid,
)
from ._readers import convert_all, refuse
from ._ring import Ring

_FIELD_FREE = {
    "marker", "monitor", "hmonitor", "vmonitor", "instrument", "placeholder", "collimator",
    "rcollimator", "ecollimator", "drift",
}  # fmt: skip
_LATTICE_JSON = {
    "length": "l", "angle": "angle", "e1": "e1", "e2": "e2", "k1": "k1", "k2": "k2", "k3": "k3",
    "voltage": "volt", "frequency": "freq", "phase": "lag",
}  # fmt: skip


def from_madx(sequence: Any, *, model: Model = "exact") -> Ring:
    """The ring of a sequence of MAD-X that runs in cpymad, after all commands that change it.

    With apertures (circle, ellipse, rectangle, rectellipse, rectcircle), tilts, errors of EALIGN,
    K0 that is not ANGLE/L, and cavities with their LAG. The reference particle has v = c here.

    **Arguments** `sequence`: such as ``Madx().sequence.ring`` after USE; it is expanded. `model`:
    see `multipole`. **Raises** `ValueError` with the elements that have no counterpart.
    """
    one_of("model", model, get_args(Model))
    beam = sequence.beam
    if beam.beta < 0.9999:
        warnings.warn(
            f"the beam of MAD-X has v = {beam.beta:.6g} c, here it is c: motion along s is another "
            "one, and so are dispersion over PT and slippage.",
            stacklevel=user_level(),
        )
    elements = convert_all(
        list(sequence.expanded_elements),
        lambda source: _of_madx(source, beam, model),
        lambda source: f"{source.name} ({source.base_type.name})",
    )
    return Ring(elements, 1e9 * beam.energy)


def _of_madx(source: Any, beam: Any, model: Model) -> Element:
    kind, values = source.base_type.name, dict(source)
    field = getattr(source, "field_errors", None)
    if field is not None and any(np.any(getattr(field, name)) for name in ("dkn", "dks")):
        refuse("errors of EFCOMP are not supported")
    element = _plain(source.name, kind, source.length, values, 1e9 * beam.energy, beam.freq0, model)
    for name in ("h1", "h2", "ktap", "lagf", "dfreq"):
        if values.get(name):
            refuse(f"{name} = {values[name]} is not supported")
    sizes, shape = list(values.get("aperture", [0.0])), values.get("apertype", "circle")
    if any(sizes):
        if any(values.get("aper_offset", [0.0])):
            refuse("aper_offset is not supported")
        ellipse = {"circle": sizes[:1] * 2, "ellipse": sizes, "rectellipse": sizes[2:]}.get(shape)
        box = sizes[:2] if shape in ("rectangle", "rectellipse", "rectcircle") else None
        ellipse = sizes[2:] * 2 if shape in ("rectcircle", "lhcscreen") else ellipse
        box = sizes[:2] if shape == "lhcscreen" else box
        if ellipse is None and box is None:
            refuse(f"apertype {shape} is not supported")
        rectangle = None if box is None else (-box[0], box[0], -box[1], box[1])
        element = element.inside(ellipse=ellipse, rectangle=rectangle)
    errors = getattr(source, "align_errors", None)
    moves = {"dx": "dx", "dy": "dy", "ds": "ds", "roll": "dpsi", "pitch": "dphi", "yaw": "dtheta"}
    moves = {key: float(getattr(errors, name, 0.0)) for key, name in moves.items()}
    moves["tilt"] = float(values.get("tilt", 0.0))
    return element.placed(**moves) if any(moves.values()) else element  # pyright: ignore[reportArgumentType]


def _plain(
    name: str, kind: str, length: float, values: Any, energy: float, revolution: float, model: Model
) -> Element:
    """An element from the attributes of MAD-X. **Raises** `ValueError` for others."""
    get = values.get
    if kind in _FIELD_FREE:
        return drift(name, length, model) if length else marker(name, kind)
    if kind in ("hkicker", "vkicker", "kicker", "tkicker"):
        x, y = (get("kick", 0.0) if kind == f"{k}kicker" else 0.0 for k in "hv")
        return corrector(name, length, x + get("hkick", 0.0), y + get("vkick", 0.0))
    if kind == "solenoid":
        if not length and (get("ks") or get("ksi")):
            refuse("a thin solenoid is not supported")
        return solenoid(name, length, get("ks", 0.0))
    if kind == "rfcavity":
        frequency = 1e6 * get("freq", 0.0) or 1e6 * get("harmon", 0) * revolution
        phase = 2 * math.pi * (0.5 - get("lag", 0.0))
        return cavity(name, length, 1e6 * get("volt", 0.0) / energy, frequency, phase=phase)
    if kind not in ("multipole", "quadrupole", "sextupole", "octupole", "sbend", "rbend"):
        refuse(f"{kind} is not supported")
    is_bend, scale = kind in ("sbend", "rbend"), length or 1.0
    knl, ksl = (np.zeros(21) for _ in range(2))
    for column, suffix, key in ((knl, "", "knl"), (ksl, "s", "ksl")):
        column[:4] = [get(f"k{n}{suffix}", 0.0) * scale for n in range(4)]
        integrated = np.atleast_1d(get(key, 0.0))
        column[: len(integrated)] += integrated
    if kind == "multipole" and (knl[0] or ksl[0] or get("angle")):
        refuse("KNL[0], KSL[0] or ANGLE bend the reference orbit of a thin element")
    last = max([n for n in range(21) if knl[n] or ksl[n]], default=0)
    factors = scale * np.array([math.factorial(n) for n in range(last + 1)])
    field: dict[str, Any] = {"b": knl[: last + 1] / factors, "a": ksl[: last + 1] / factors}
    if not is_bend:
        return multipole(name, length, **field, kind=kind, model=model)
    angle, gap = get("angle", 0.0), 2 * get("hgap", 0.0)
    if get("k0"):
        field["b"][0] -= angle / length
    half = angle / 2 if kind == "rbend" else 0.0
    last_fint = get("fintx", -1.0)
    return bend(
        name, length, angle, **field, edge_in=get("e1", 0.0) + half, edge_out=get("e2", 0.0) + half,
        fringe_in=gap * get("fint", 0.0), model=model,
        fringe_out=gap * (get("fint", 0.0) if last_fint < 0 else last_fint),
    )  # fmt: skip


def from_latticejson(lattice: dict[str, Any], *, model: Model = "exact") -> Ring:
    """The ring in LatticeJSON, version 2, as ``json.load`` or ``latticejson.load`` return it.

    Its energy is in GeV, here 1 GeV without one. **Raises** `ValueError` with the elements
    that have no counterpart: tilt, dx and others, apertures, and cavities with a voltage.

    **Example**

    ```python
    lattice = {"root": "ring", "lattices": {"ring": ["QF", "D", "QF"]}, "elements": {
        "QF": ["Quadrupole", {"length": 0.5, "k1": 0.6}], "D": ["Drift", {"length": 2.0}]}}
    print(rings.from_latticejson(lattice).names)
    # ('QF', 'D', 'QF')
    ```
    """
    data = instance("lattice", lattice, dict, "a dictionary", "Read the file with json.load.")
    energy = 1e9 * data.get("energy", 1.0)

    def flat(name):
        if name not in data["lattices"]:
            return [name]
        return [x for child in data["lattices"][name] for x in flat(child)]

    def convert(name):
        kind, values = data["elements"][name]
        names = sorted(key for key in values.keys() - _LATTICE_JSON.keys() if values[key])
        if names:
            refuse(f"{', '.join(names)} is not supported")
        values = {_LATTICE_JSON[key]: value for key, value in values.items()}
        if kind == "Cavity" and values.get("volt"):
            refuse("the zero and the unit of its phase are not defined")
        label = {"Dipole": "sbend", "Cavity": "drift"}.get(kind, kind.lower())
        return _plain(name, label, values.get("l", 0.0), values, energy, 0.0, model)

    return Ring(convert_all(flat(data["root"]), convert, str), energy)
