"""Rings from pyAT, and from the files that it reads."""

import dataclasses
import math
import os
import warnings
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple, NoReturn, get_args

import numpy as np

from ...base.checks import instance, one_of
from ...base.files import user_file
from ...base.keywords import user_level
from ._elements import C, Element, Model, bend, cavity, corrector, drift, multipole, solenoid
from ._files import check_source, read_lattice
from ._maps import RingPart
from ._radiation import ELECTRON, constants
from ._ring import Ring

# Our (x, px, y, py, ζ, δ) is ORDER @ (x, px, y, py, δ, ct) of pyAT.
ORDER = np.zeros((6, 6))
ORDER[[0, 1, 2, 3, 5], [0, 1, 2, 3, 4]] = 1
ORDER[4, 5] = -1

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
_RADIATING = (
    "StrMPoleSymplectic4RadPass", "BndMPoleSymplectic4RadPass", "ExactMultipoleRadPass",
    "ExactSectorBendRadPass",
)  # fmt: skip
_AT_PARTS = ("exact_bend", "wedge_in", "wedge_out")
"""Parts of exact bends that are others in pyAT: with the field of straight multipoles in the body,
and without multipoles in the wedges."""


class Settings(NamedTuple):
    """What all elements of a lattice need: energy [eV], period [s], name of the edges of bends, the
    model, or None for that of the pass method, and the rest energy of the particle [eV]."""

    energy: float
    period: float
    edge: str
    model: Model | None
    mass: float

    def is_exact(self, source: Any) -> bool:
        return self.model == "exact" or (not self.model and source.PassMethod.startswith("Exact"))


def to_at(z: Any) -> np.ndarray:
    """(x, px, y, py, δ, ct) as pyAT orders them, shape (6, …), from (x, px, y, py, ζ, δ)."""
    return np.asfortranarray(np.moveaxis(np.asarray(z) @ ORDER, -1, 0))


def load(
    path: str | os.PathLike[str],
    *,
    use: str | None = None,
    symplectic: bool = False,
    model: Model | None = None,
    **options: Any,
) -> Ring:
    """The ring in a file that pyAT can read.

    .mat, .m, .repr and .json of Accelerator Toolbox, .json of Xsuite (and so of MAD-X through
    Xsuite), .seq and .madx of MAD-X, .mad8 of MAD8, .lte of elegant, .lat of Tracy.

    **Arguments** `use`: the name of the sequence or line, by default the only one, or the one that
    is called ring. `symplectic`, `model`: see `from_at`. `options` go to pyAT's reader: `energy`
    [eV], `periodicity`, values of variables of a MAD file, ``strict=True`` for an error if it does
    not define all of them.

    **Raises** `ValueError` for a file that cannot be read, and as `from_at`, also for attributes
    that pyAT leaves out, such as K0 of a bend that is not ANGLE/L.
    """
    at = accelerator_toolbox()
    path = user_file("path", path)  # some of the readers of pyAT have no clear error
    lattice = read_lattice(path, use, options)
    cavities = [e.FamName for e in lattice if isinstance(e, at.RFCavity) and _is_off(e)]
    if cavities and path.suffix not in (".mat", ".m", ".repr"):
        warnings.warn(
            "pyAT switches off the cavities of this file and may ignore their phases: "
            f"{cavities[:8]}. For a ring in 6D read the lattice with pyAT, set TimeLag of the "
            "cavities, call lattice.enable_6d(dipole_pass=None, quadrupole_pass=None) and then "
            "rings.from_at.",
            stacklevel=user_level(),
        )
    return from_at(lattice, symplectic=symplectic, model=model)


def accelerator_toolbox() -> Any:
    try:
        import at
    except ImportError as error:
        raise ImportError(
            'rings.load requires accelerator-toolbox: pip install "dvi-jax[rings]".'
        ) from error
    return at


def _is_off(cavity: Any) -> bool:
    return cavity.PassMethod in ("IdentityPass", "DriftPass") and cavity.Voltage != 0


def from_at(lattice: Any, *, symplectic: bool = False, model: Model | None = None) -> Ring:
    """The ring of a pyAT ``at.Lattice``, with the same maps.

    Without `symplectic` and `model` the result agrees with pyAT's tracking to round-off. pyAT's
    edges with a fringe field depend on δ without the change of ζ that belongs to it; with
    ``symplectic=True`` it is added. `model`: "exact" or "paraxial" for all drifts, multipoles and
    bends, whatever their pass method is; "exact" has multipoles of bends in curved coordinates, see
    `bend`. Magnets with a pass method that ends with RadPass radiate. Collective effects are not
    supported.

    **Raises** `ValueError` with the first ten elements, with name and number, that have no
    counterpart here or that pyAT has replaced by a drift or marker.
    """
    hint = "For the file of a lattice use rings.load(path)."
    instance("lattice", lattice, accelerator_toolbox().Lattice, "an at.Lattice of pyAT", hint)
    one_of("model", model, (None, *get_args(Model)))
    particle = getattr(lattice, "particle", None)
    rest_energy = getattr(particle, "rest_energy", 0.0) or 0.0
    gamma = lattice.energy / rest_energy if rest_energy else math.inf
    period = lattice.get_s_pos(len(lattice))[0] / (C * math.sqrt(1 - 1 / gamma**2))
    edge, mass = "edge" if symplectic else "at_edge", rest_energy or ELECTRON
    settings = Settings(lattice.energy, period, edge, model, mass)
    elements = convert_all(
        lattice,
        lambda source: _element(source, settings),
        lambda source: f"{source.FamName} ({type(source).__name__}, {source.PassMethod})",
    )
    return Ring(elements, lattice.energy, int(lattice.periodicity))


def convert_all(
    sources: Iterable[Any], convert: Callable, label: Callable[[Any], str], place: str = "here"
) -> list[Any]:
    """All elements. **Raises** `ValueError` with the first ten that have no counterpart."""
    reasons, elements = [], []
    for i, source in enumerate(sources):
        try:
            elements.append(convert(source))
        except ValueError as reason:
            reasons.append(f"  {i}: {label(source)}: {reason}")
    if reasons:
        raise ValueError(
            f"{len(reasons)} of {len(reasons) + len(elements)} elements have no counterpart {place}"
            ":\n"
            + "\n".join(
                [*reasons[:10], *([f"  and {len(reasons) - 10} more"] * (len(reasons) > 10))]
            )
        )
    return elements


def refuse(reason: str) -> NoReturn:
    """**Raises** `ValueError`, for `convert_all`."""
    raise ValueError(reason)


def _element(source: Any, settings: Settings) -> Element:
    """One element. **Raises** `ValueError` with the reason if it has no counterpart."""
    check_source(source)
    for name, neutral in _WITHOUT_EFFECT.items():
        value = getattr(source, name, neutral[0])
        if value not in neutral:
            refuse(f"{name} = {value} is not supported")
    radiates = source.PassMethod in _RADIATING
    make = _MAKERS.get(source.PassMethod.replace("Rad", "") if radiates else source.PassMethod)
    if make is None:
        remedy = "; to switch it off: lattice.enable_6d(dipole_pass=None, quadrupole_pass=None)"
        radiates = any(name in source.PassMethod for name in ("Rad", "Quant"))
        message = f"radiation is not supported{remedy}" if radiates else "its map is not supported"
        refuse(message)
    element = make(source, settings)
    if radiates:
        values = {**element.values, **constants(settings.energy, settings.mass)}
        element = dataclasses.replace(element, values=values)
    if source.PassMethod in _BARE:
        return element
    rectangle, ellipse = (getattr(source, f"{k}Apertures", None) for k in "RE")
    return _with_placement(element.inside(rectangle=rectangle, ellipse=ellipse), source)


def _placement(source: Any) -> tuple[np.ndarray, ...]:
    """R1, R1 T1, R2 and T2 in our order of coordinates."""
    R1, R2 = (ORDER @ getattr(source, n, np.eye(6)) @ ORDER.T for n in ("R1", "R2"))
    T1, T2 = (ORDER @ getattr(source, n, np.zeros(6)) for n in ("T1", "T2"))
    return R1, R1 @ T1, R2, T2


def _with_placement(element: Element, source: Any) -> Element:
    """The element between the maps of its placement, if they are not the identity."""
    values = _placement(source)
    if all(np.array_equal(x, y) for x, y in zip(values, _placement(None), strict=True)):
        return element
    names = "matrix_in", "shift_in", "matrix_out", "shift_out"
    ends = RingPart("affine_in"), RingPart("affine_out")
    return element.within(*ends, **dict(zip(names, values, strict=True)))


def _field(source: Any, thin: bool = False) -> dict[str, Any]:
    """The multipoles up to MaxOrder, with the kicks of correctors in them."""
    b, a = (np.array(x[: source.MaxOrder + 1], float) for x in (source.PolynomB, source.PolynomA))
    kicks = getattr(source, "KickAngle", None)
    if kicks is not None:
        x, y = kicks if thin else np.sin(kicks) / source.Length
        b[0], a[0] = b[0] - x, a[0] + y
    return {"b": b, "a": a}


def _drift(source, settings):
    model = "exact" if settings.is_exact(source) else "paraxial"
    return drift(source.FamName, source.Length, model)


def _marker(source, settings):
    return Element(source.FamName, type(source).__name__.lower(), (), {"length": source.Length})


def _fringes(source: Any, exact: bool, field: np.ndarray) -> list[bool]:
    """Whether it has a quadrupole fringe at its ends; a paraxial one needs a gradient."""
    ends = [bool(getattr(source, f"FringeQuad{side}", 0)) for side in ("Entrance", "Exit")]
    return ends if exact or (len(field) > 1 and field[1] != 0) else [False, False]


def _remove_ends(element: Element, name: str, flags: list[bool]) -> Element:
    """The element without the parts of the ends at which it has none."""
    ends = zip(("_in", "_out"), flags, strict=True)
    suffixes = [f"{name}{side}" for side, flag in ends if not flag]
    parts = [p for p in element.parts if not p.name.endswith(tuple(suffixes) or ("-",))]
    return dataclasses.replace(element, parts=tuple(parts))


def _straight(source, settings):
    if source.Length == 0:
        return _marker(source, settings)
    exact, field = settings.is_exact(source), _field(source)
    fringes = _fringes(source, exact, field["b"])
    element = multipole(
        source.FamName, source.Length, **field, slices=source.NumIntSteps, fringe=any(fringes),
        model="exact" if exact else "paraxial", kind=type(source).__name__.lower(),
    )  # fmt: skip
    return _remove_ends(element, "fringe", fringes)


def _bend(source, settings):
    exact, at_exact = settings.is_exact(source), source.PassMethod.startswith("Exact")
    second = "E2" in source.PassMethod and settings.model is None
    field = _field(source)
    sides = (1, "Entrance"), (2, "Exit")
    method = [getattr(source, f"FringeBend{side}", 1) for _, side in sides]
    gap = getattr(source, "FullGap", 0.0)
    gaps = [gap * getattr(source, f"FringeInt{i}", 0.0) * (m != 0 or second)
            for m, (i, _) in zip(method, sides, strict=True)]  # fmt: skip
    gaps = [getattr(source, "gK", 0.0)] * 2 if at_exact else gaps
    fringes = [False, False] if second else _fringes(source, exact, field["b"])
    element = bend(
        source.FamName, source.Length, source.BendingAngle, **field, edge_in=source.EntranceAngle,
        edge_out=source.ExitAngle, fringe_in=gaps[0], fringe_out=gaps[1], slices=source.NumIntSteps,
        fringe=any(fringes), model="exact" if exact else "paraxial",
    )  # fmt: skip
    element = _remove_ends(element, "gradient_fringe" if exact else "fringe", fringes)
    if exact and at_exact:
        element = _remove_ends(element, "dipole_fringe", [m != 0 for m in method])
    if exact:
        prefixes = ("at_" * (settings.model is None and p.name in _AT_PARTS) for p in element.parts)
        parts = (p._replace(name=k + p.name) for k, p in zip(prefixes, element.parts, strict=True))
        return dataclasses.replace(element, parts=tuple(parts))
    edge = "second_order_edge" if second else settings.edge
    replacements = {
        "edge_in": {"name": f"{edge}_in", "scheme": method[0]},
        "edge_out": {"name": f"{edge}_out", "scheme": method[1]},
        **({"bend": {"name": "second_order_bend"}} if second else {}),
    }
    parts = tuple(p._replace(**replacements.get(p.name, {})) for p in element.parts)
    return dataclasses.replace(element, parts=parts)


def _cavity(source, settings):
    by_turn = source.PassMethod == "RFCavityPass"
    slip = source.HarmNumber - source.Frequency * settings.period if by_turn else 0.0
    lag, phase = (getattr(source, name, 0.0) for name in ("TimeLag", "PhaseLag"))
    return cavity(
        source.FamName, source.Length, source.Voltage / settings.energy, source.Frequency, lag,
        phase, 2 * math.pi * slip,
    )  # fmt: skip


def _matrix(source, settings):
    R1, T1, R2, T2 = _placement(source)
    M = R2 @ ORDER @ source.M66 @ ORDER.T
    values = {"length": source.Length, "matrix_in": M @ R1, "shift_in": M @ T1 + T2}
    return Element(source.FamName, "matrix", (RingPart("affine_in"),), values)


_MAKERS = {
    "IdentityPass": _marker,
    **dict.fromkeys(("DriftPass", "ExactDriftPass"), _drift),
    **dict.fromkeys(("StrMPoleSymplectic4Pass", "ExactMultipolePass"), _straight),
    **dict.fromkeys(("BndMPoleSymplectic4Pass", "BndMPoleSymplectic4E2Pass"), _bend),
    "ExactSectorBendPass": _bend,
    "ThinMPolePass": lambda source, *_: multipole(
        source.FamName, 0.0, **_field(source, thin=True), kind=type(source).__name__.lower()
    ),
    "CorrectorPass": lambda source, *_: corrector(source.FamName, source.Length, *source.KickAngle),
    "SolenoidLinearPass": lambda source, *_: solenoid(source.FamName, source.Length, source.K),
    **dict.fromkeys(("RFCavityPass", "CavityPass"), _cavity),
    "Matrix66Pass": _matrix,
    "AperturePass": lambda source, *_: Element(
        source.FamName,
        "aperture",
        (RingPart("rectangle"),),
        dict(zip(("x_min", "x_max", "y_min", "y_max"), source.Limits, strict=True), length=0.0),
    ),
}
