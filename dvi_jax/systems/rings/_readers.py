"""Rings from pyAT, and from the files that it reads: .mat, .m, .json, also those of Xsuite."""

import dataclasses
import math
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from ._elements import C, Element, bend, cavity, corrector, drift, multipole, solenoid
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
_BARE = ("RFCavityPass", "CavityPass", "AperturePass", "Matrix66Pass")
"""Pass methods without apertures; only that of a matrix may be misaligned."""
_FIELD_FREE = ("", "Drift", "Marker")


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
        import at
    except ImportError as error:
        raise ImportError(
            "rings.load requires the package accelerator-toolbox, which cannot be imported. "
            'Install it: pip install "dvi-jax[rings]".'
        ) from error
    Path(path).stat()  # a missing file has a clear error here, and none in some of the readers
    lattice = at.load_lattice(os.fspath(path), **how)
    off = [e.FamName for e in lattice if isinstance(e, at.RFCavity) and _is_off(e)]
    if off and Path(path).suffix not in (".mat", ".m", ".repr"):
        warnings.warn(
            f"pyAT switches off the cavities of this file and may ignore their phases: {off[:8]}. "
            "For a ring in 6D read the lattice with pyAT, set TimeLag of the cavities, call "
            "lattice.enable_6d(dipole_pass=None, quadrupole_pass=None) and then rings.from_at.",
            stacklevel=2,
        )
    return from_at(lattice, symplectic=symplectic)


def _is_off(e: Any) -> bool:
    return e.PassMethod in ("IdentityPass", "DriftPass") and e.Voltage != 0


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
    if type(e).__name__ in ("Marker", "Drift") and origin not in _FIELD_FREE:
        raise ValueError(f"pyAT has no element for Xsuite's {origin}")
    make = _MAKERS.get(e.PassMethod)
    if make is None:
        off = "; to switch it off: lattice.enable_6d(dipole_pass=None, quadrupole_pass=None)"
        radiates = any(name in e.PassMethod for name in ("Rad", "Quant"))
        why = f"radiation is not supported{off}" if radiates else "its map is not supported"
        raise ValueError(why)
    element = make(e, energy, period, edge)
    if e.PassMethod in _BARE:
        return element
    rectangle, ellipse = (getattr(e, f"{k}Apertures", None) for k in "RE")
    return _transformed(element.inside(rectangle=rectangle, ellipse=ellipse), e)


def _placement(e: Any) -> tuple[np.ndarray, ...]:
    """R1, R1 T1, R2 and T2 in our order of coordinates."""
    R1, R2 = (_ORDER @ getattr(e, n, np.eye(6)) @ _ORDER.T for n in ("R1", "R2"))
    T1, T2 = (_ORDER @ getattr(e, n, np.zeros(6)) for n in ("T1", "T2"))
    return R1, R1 @ T1, R2, T2


def _transformed(element: Element, e: Any) -> Element:
    """The element between the maps of its placement, if they are not the identity."""
    values = _placement(e)
    if all(np.array_equal(x, y) for x, y in zip(values, _placement(None), strict=True)):
        return element
    names = "matrix_in", "shift_in", "matrix_out", "shift_out"
    ends = Part("affine_in"), Part("affine_out")
    return element.within(*ends, **dict(zip(names, values, strict=True)))


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
    return Element(e.FamName, type(e).__name__.lower(), (), {"length": e.Length})


def _fringes(e: Any, exact: bool, b: np.ndarray) -> list[bool]:
    """Whether it has a quadrupole fringe at its ends; a paraxial one needs a gradient."""
    ends = [bool(getattr(e, f"FringeQuad{side}", 0)) for side in ("Entrance", "Exit")]
    return ends if exact or (len(b) > 1 and b[1] != 0) else [False, False]


def _without(element: Element, name: str, has: list[bool]) -> Element:
    """The element without the parts of the ends at which it has none."""
    missing = [f"{name}{s}" for s, there in zip(("_in", "_out"), has, strict=True) if not there]
    parts = [p for p in element.parts if not p.name.endswith(tuple(missing) or ("-",))]
    return dataclasses.replace(element, parts=tuple(parts))


def _straight(e, energy, period, edge):
    if e.Length == 0:
        return _marker(e, energy, period, edge)
    exact, field = e.PassMethod.startswith("Exact"), _field(e)
    has = _fringes(e, exact, field["b"])
    element = multipole(
        e.FamName, e.Length, **field, slices=e.NumIntSteps, fringe=any(has),
        model="exact" if exact else "paraxial", kind=type(e).__name__.lower(),
    )  # fmt: skip
    return _without(element, "fringe", has)


def _bend(e, energy, period, edge):
    exact, second, field = e.PassMethod.startswith("Exact"), "E2" in e.PassMethod, _field(e)
    sides = (1, "Entrance"), (2, "Exit")
    method = [getattr(e, f"FringeBend{side}", 1) for _, side in sides]
    gap = getattr(e, "FullGap", 0.0)
    gaps = [gap * getattr(e, f"FringeInt{i}", 0.0) * (m != 0 or second)
            for m, (i, _) in zip(method, sides, strict=True)]  # fmt: skip
    gaps = [getattr(e, "gK", 0.0)] * 2 if exact else gaps
    has = [False, False] if second else _fringes(e, exact, field["b"])
    element = bend(
        e.FamName, e.Length, e.BendingAngle, **field, edge_in=e.EntranceAngle,
        edge_out=e.ExitAngle, fringe_in=gaps[0], fringe_out=gaps[1], slices=e.NumIntSteps,
        fringe=any(has), model="exact" if exact else "paraxial",
    )  # fmt: skip
    element = _without(element, "gradient_fringe" if exact else "fringe", has)
    if exact:
        return _without(element, "dipole_fringe", [m != 0 for m in method])
    edge = "second_order_edge" if second else edge
    changed = {
        "edge_in": {"name": f"{edge}_in", "scheme": method[0]},
        "edge_out": {"name": f"{edge}_out", "scheme": method[1]},
        **({"bend": {"name": "second_order_bend"}} if second else {}),
    }
    parts = tuple(p._replace(**changed.get(p.name, {})) for p in element.parts)
    return dataclasses.replace(element, parts=parts)


def _cavity(e, energy, period, edge):
    by_turn = e.PassMethod == "RFCavityPass"
    slip = 2 * math.pi * (e.HarmNumber - e.Frequency * period) if by_turn else 0.0
    lag, phase = (getattr(e, name, 0.0) for name in ("TimeLag", "PhaseLag"))
    return cavity(e.FamName, e.Length, e.Voltage / energy, e.Frequency, lag, phase, slip)


def _matrix(e, energy, period, edge):
    R1, T1, R2, T2 = _placement(e)
    M = R2 @ _ORDER @ e.M66 @ _ORDER.T
    values = {"length": e.Length, "matrix_in": M @ R1, "shift_in": M @ T1 + T2}
    return Element(e.FamName, "matrix", (Part("affine_in"),), values)


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
