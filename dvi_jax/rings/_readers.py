"""Rings from pyAT, and from the files that it reads: .mat, .m, .json, also those of Xsuite."""

import importlib
import math
import os
from typing import Any

import numpy as np

from ._elements import C, Element, bend, cavity, corrector, drift, marker, multipole, solenoid
from ._maps import Part
from ._ring import Ring

# Our (x, px, y, py, ζ, δ) is _ORDER @ (x, px, y, py, δ, ct) of pyAT.
_ORDER = np.zeros((6, 6))
_ORDER[[0, 1, 2, 3, 5], [0, 1, 2, 3, 4]] = 1
_ORDER[4, 5] = -1

# Attributes of an element that change its map and have no counterpart here, and values without
# effect.
_WITHOUT_EFFECT = {
    **dict.fromkeys(["Scaling", "FieldScaling"], (1.0,)),
    **dict.fromkeys(["h1", "h2", "bax", "bay", "X0ref", "RefDZ"], (0.0,)),
    "FringeBendEntrance": (0, 1, 2),
    "FringeBendExit": (0, 1, 2),
    "FringeQuadEntrance": (0, 1),
    "FringeQuadExit": (0, 1),
}
_NO_FIELD = ("Drift", "Marker", "Monitor", "")


def to_at(z: Any) -> np.ndarray:
    """(x, px, y, py, δ, ct) as pyAT orders them, shape (6, …), from (x, px, y, py, ζ, δ)."""
    return np.asfortranarray(np.moveaxis(np.asarray(z) @ _ORDER, -1, 0))


def from_at_coordinates(r: Any) -> np.ndarray:
    """(x, px, y, py, ζ, δ), shape (…, 6), from pyAT's (x, px, y, py, δ, ct), shape (6, …)."""
    return np.moveaxis(np.asarray(r), 0, -1) @ _ORDER.T


def load(path: str | os.PathLike[str], *, symplectic: bool = False, **how: Any) -> Ring:
    """The ring in a file that pyAT can read; `how` goes to its ``load_lattice``.

    .mat, .m, .repr and .json of Accelerator Toolbox, .json of Xsuite (and so of MAD-X through
    Xsuite), .seq of MAD-X and others. See `from_at` for `symplectic` and what is refused.
    """
    try:
        at = importlib.import_module("at")
    except ImportError as error:
        raise ImportError(
            "rings.load requires the package accelerator-toolbox, which cannot be imported. "
            'Install it: pip install "dvi-jax[rings]".'
        ) from error
    return from_at(at.load_lattice(os.fspath(path), **how), symplectic=symplectic)


def from_at(lattice: Any, *, symplectic: bool = False) -> Ring:
    """The ring of a pyAT ``at.Lattice``, with the same maps.

    Without `symplectic` the result agrees with pyAT's tracking to round-off. pyAT's edges with a
    fringe field depend on δ without the change of ζ that belongs to it; with ``symplectic=True``
    it is added. Radiation and collective effects are not supported.

    **Raises** `ValueError` with a list of all elements, with name and number, that have no
    counterpart here.
    """
    refused: list[str] = []
    particle = getattr(lattice, "particle", None)
    rest = getattr(particle, "rest_energy", 0.0) or 0.0
    gamma = lattice.energy / rest if rest else math.inf
    period = lattice.get_s_pos(len(lattice))[0] / (C * math.sqrt(1 - 1 / gamma**2))
    elements = []
    for i, e in enumerate(lattice):
        try:
            element = _element(e, lattice.energy, period, "edge" if symplectic else "at_edge")
        except ValueError as reason:
            refused.append(f"  {i}: {e.FamName} ({type(e).__name__}, {e.PassMethod}): {reason}")
            continue
        elements.append(element)
    if refused:
        raise ValueError(
            f"{len(refused)} of {len(lattice)} elements have no counterpart here, so that the ring "
            "cannot be read:\n" + "\n".join(refused)
        )
    return Ring(elements, lattice.energy, int(lattice.periodicity))


def _element(e: Any, energy: float, period: float, edge: str) -> Element:
    """One element. **Raises** `ValueError` with the reason if it has no counterpart."""
    for name, allowed in _WITHOUT_EFFECT.items():
        value = getattr(e, name, allowed[0])
        if value not in allowed:
            raise ValueError(f"{name} = {value} is not supported")
    origin = getattr(e, "origin", "")
    if (
        e.PassMethod in ("IdentityPass", "DriftPass")
        and origin not in _NO_FIELD
        and not (type(e).__name__ not in ("Marker", "Drift"))
    ):
        raise ValueError(f"pyAT has no element for Xsuite's {origin}")
    make = _MAKERS.get(e.PassMethod)
    if make is None:
        raise ValueError("this pass method is not supported")
    element = make(e, energy, period, edge)
    if element.kind != "aperture":
        rectangle, ellipse = (getattr(e, f"{k}Apertures", None) for k in "RE")
        acts = e.PassMethod not in ("IdentityPass", "RFCavityPass", "CavityPass")
        if e.PassMethod == "IdentityPass" or acts:
            element = element.inside(rectangle=rectangle, ellipse=ellipse)
    return _transformed(element, e)


def _transformed(element: Element, e: Any) -> Element:
    """The element with R1, T1 before and R2, T2 after it."""
    if e.PassMethod in ("RFCavityPass", "CavityPass", "AperturePass"):
        return element
    R1, R2 = (getattr(e, n, np.eye(6)) for n in ("R1", "R2"))
    T1, T2 = (getattr(e, n, np.zeros(6)) for n in ("T1", "T2"))
    if all((np.eye(6) == R).all() for R in (R1, R2)) and not (np.any(T1) or np.any(T2)):
        return element
    values = {
        "matrix_in": _ORDER @ R1 @ _ORDER.T,
        "shift_in": _ORDER @ R1 @ T1,
        "matrix_out": _ORDER @ R2 @ _ORDER.T,
        "shift_out": _ORDER @ T2,
    }
    return element.within(Part("affine_in"), Part("affine_out"), **values)


def _field(e: Any, thin: bool = False) -> dict[str, Any]:
    """The multipoles up to MaxOrder, with the kicks of correctors in them."""
    b, a = (np.array(x[: e.MaxOrder + 1], float) for x in (e.PolynomB, e.PolynomA))
    kicks = getattr(e, "KickAngle", None)
    if kicks is not None:
        x, y = kicks if thin else np.sin(kicks) / e.Length
        b[0], a[0] = b[0] - x, a[0] + y
    return {"b": b, "a": a}


def _drift(e, energy, period, edge):
    return drift(e.FamName, e.Length, "exact" if e.PassMethod.startswith("Exact") else "paraxial")


def _marker(e, energy, period, edge):
    element = marker(e.FamName, type(e).__name__.lower())
    return Element(e.FamName, element.kind, (), {"length": e.Length})


def _straight(e, energy, period, edge):
    if e.Length == 0:
        return _marker(e, energy, period, edge)
    model = "exact" if e.PassMethod.startswith("Exact") else "paraxial"
    kind = type(e).__name__.lower()
    field = _field(e)
    has = [bool(getattr(e, f"FringeQuad{side}", 0)) for side in ("Entrance", "Exit")]
    # pyAT has no paraxial fringe of a magnet without gradient.
    if model == "paraxial" and (len(field["b"]) < 2 or field["b"][1] == 0):
        has = [False, False]
    element = multipole(
        e.FamName, e.Length, **field, slices=e.NumIntSteps, fringe=any(has), model=model, kind=kind
    )
    return _without(element, "fringe", has)


def _without(element: Element, name: str, has: list[bool]) -> Element:
    """The element without the parts of the ends at which it has none."""
    ends = ("_in", "_out")
    missing = [f"{name}{end}" for end, there in zip(ends, has, strict=True) if not there]
    parts = [p for p in element.parts if not any(p.name.endswith(m) for m in missing)]
    return Element(element.name, element.kind, tuple(parts), element.values)


def _bend(e, energy, period, edge):
    gap = [
        getattr(e, "FullGap", 0.0) * getattr(e, f"FringeInt{i}", 0.0)
        * (getattr(e, f"FringeBend{side}", 1) != 0)
        for i, side in ((1, "Entrance"), (2, "Exit"))
    ]  # fmt: skip
    exact = e.PassMethod.startswith("Exact")
    if exact:
        gap = [getattr(e, "gK", 0.0)] * 2
    second = "E2" in e.PassMethod
    field = _field(e)
    has = [bool(getattr(e, f"FringeQuad{side}", 0)) for side in ("Entrance", "Exit")]
    if not exact and (second or len(field["b"]) < 2 or field["b"][1] == 0):
        has = [False, False]
    element = bend(
        e.FamName, e.Length, e.BendingAngle, **field, edge_in=e.EntranceAngle,
        edge_out=e.ExitAngle, fringe_in=gap[0], fringe_out=gap[1], slices=e.NumIntSteps,
        fringe=any(has), model="exact" if exact else "paraxial",
    )  # fmt: skip
    element = _without(element, "fringe" if not exact else "gradient_fringe", has)
    if exact:
        has = [bool(getattr(e, f"FringeBend{side}", 1)) for side in ("Entrance", "Exit")]
        return _without(element, "dipole_fringe", has)
    names = {"bend": "second_order_bend"} if second else {}
    prefix = "second_order_edge" if second else edge
    names |= {"edge_in": f"{prefix}_in", "edge_out": f"{prefix}_out"}
    methods = {
        "edge_in": getattr(e, "FringeBendEntrance", 1),
        "edge_out": getattr(e, "FringeBendExit", 1),
    }
    parts = [
        p._replace(name=names.get(p.name, p.name), scheme=methods.get(p.name, p.scheme))
        for p in element.parts
    ]
    return Element(element.name, element.kind, tuple(parts), element.values)


def _cavity(e, energy, period, edge):
    frequency, waves = e.Frequency, getattr(e, "HarmNumber", 0)
    slip = 0.0
    if e.PassMethod == "RFCavityPass":
        slip = 2 * math.pi * (waves - frequency * period)
    phase = getattr(e, "PhaseLag", 0.0)
    lag = getattr(e, "TimeLag", 0.0)
    return cavity(e.FamName, e.Length, e.Voltage / energy, frequency, lag, phase, slip)


def _matrix(e, energy, period, edge):
    values = {"length": e.Length, "matrix_in": _ORDER @ e.M66 @ _ORDER.T, "shift_in": np.zeros(6)}
    element = Element(e.FamName, "matrix", (Part("affine_in"),), values)
    if not all((getattr(e, n, np.eye(6)) == np.eye(6)).all() for n in ("R1", "R2")):
        raise ValueError("a rotation of a matrix is not supported")
    return element


_MAKERS = {
    "IdentityPass": _marker,
    "DriftPass": _drift,
    "ExactDriftPass": _drift,
    "StrMPoleSymplectic4Pass": _straight,
    "ExactMultipolePass": _straight,
    "BndMPoleSymplectic4Pass": _bend,
    "BndMPoleSymplectic4E2Pass": _bend,
    "ExactSectorBendPass": _bend,
    "ThinMPolePass": lambda e, *_: multipole(
        e.FamName, 0.0, **_field(e, thin=True), kind=type(e).__name__.lower()
    ),
    "CorrectorPass": lambda e, *_: corrector(e.FamName, e.Length, *e.KickAngle),
    "SolenoidLinearPass": lambda e, *_: solenoid(e.FamName, e.Length, e.K),
    "RFCavityPass": _cavity,
    "CavityPass": _cavity,
    "Matrix66Pass": _matrix,
    "AperturePass": lambda e, *_: Element(
        e.FamName,
        "aperture",
        (Part("rectangle"),),
        {"length": 0.0, **dict(zip(("x_min", "x_max", "y_min", "y_max"), e.Limits, strict=True))},
    ),
}
