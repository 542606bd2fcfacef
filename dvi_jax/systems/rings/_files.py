"""Lattices from files that pyAT reads, and what it leaves out of them."""

import contextlib
import io
import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

from ...base.keywords import user_level
from ._xsuite import counterpart, fold_limits

_PARSERS = {
    ".seq": "MadxParser", ".madx": "MadxParser", ".mad8": "Mad8Parser", ".lte": "ElegantParser",
}  # fmt: skip

_FIELD_FREE = {
    "", "drift", "drif", "marker", "mark", "monitor", "hmonitor", "vmonitor", "instrument", "moni",
    "hmon", "vmon", "placeholder", "collimator", "rcollimator", "ecollimator", "watch", "charge",
    "recirc",
}  # fmt: skip
"""Elements that are a drift or a marker, in lower case; apertures of MAD-X files are not read."""

_STRENGTHS = {
    "solenoid": ("ks", "ksi", "b"),
    **dict.fromkeys(("kicker", "tkicker"), ("hkick", "vkick", "kick")),
    "elseparator": ("ex", "ey", "exl", "eyl"),
    **dict.fromkeys(("crabcavity", "hacdipole", "vacdipole", "twcavity"), ("volt",)),
    "rfmultipole": ("volt", "knl", "ksl"),
    **dict.fromkeys(("srotation", "xrotation", "yrotation"), ("angle",)),
    "translation": ("dx", "dy", "ds"),
    "nllens": ("knll",),
    **dict.fromkeys(("scraper", "ecol", "rcol", "maxamp"), ("x_max", "y_max", "position")),
}
"""Elements that are a drift or a marker if these attributes are zero."""

_OTHER_KINDS = (
    "srotation", "xrotation", "yrotation", "translation", "matrix", "changeref", "dipedge",
    "rcollimator", "ecollimator", "placeholder", "hacdipole", "vacdipole", "twcavity", "nllens",
    "beambeam", "wire",
)  # fmt: skip
"""Elements of MAD-X that pyAT's parser does not know."""

_NO_CHANGES = {
    "option", "select", "twiss", "survey", "use", "title", "assign", "value", "show", "print",
    "printf", "plot", "setplot", "resplot", "stop", "exit", "quit", "return", "help", "save",
    "esave", "eprint", "eoption", "set", "system", "emit", "ibs", "touschek", "dynap", "track",
    "endtrack", "start", "observe", "run", "aperture", "sixtrack", "sodd", "beta0", "savebeta",
    "coguess", "create", "fill", "write", "delete", "dumpsequ", "extract", "chdir", "list",
}  # fmt: skip
"""Commands of MAD that do not change a lattice. Other ones, such as EALIGN, are refused."""

_WITHOUT_EFFECT = {
    "at", "from", "type", "comments", "apertype", "aperture", "aper_tol", "aper_offset", "aper_vx",
    "aper_vy", "lrad", "slot_id", "assembly_id", "mech_sep", "v_pos", "polarity", "calib", "kmax",
    "kmin", "thick", "fint", "fintx", "hgap", *(f"t{i}" for i in range(10)),
    "group", "integration_order", "nonlinear", "edge_order", "edge_effects", "edge1_effects",
    "edge2_effects", "expansion_order", "steering",
}  # fmt: skip
"""Attributes without effect on the map, or read elsewhere."""


_XSUITE_SHIFTS = ("shift_x", "shift_y", "shift_s", "rot_x_rad", "rot_y_rad", "rot_s_rad_no_frame")
_XSUITE_FIELDS = {
    *_XSUITE_SHIFTS, "rot_s_rad", "rot_shift_anchor", "knl", "ksl", "delta_taper",
    *(f"k{n}{skew}" for n in range(4) for skew in ("", "s")),
}  # fmt: skip
_XSUITE_READ = {
    "order", "inv_factorial_order", "num_multipole_kicks", "isthick", "_isthick", "h", "k0_from_h",
    "length_straight", "radiation_flag",
}  # fmt: skip
"""Attributes of Xsuite that are read, or have no effect on the map."""


class _NoValue(float):
    """The value of a variable that a file does not define."""


def read_lattice(path: Path, use: str | None, options: dict[str, Any]) -> Any:
    """The ``at.Lattice`` of a file. Elements of MAD, elegant and Xsuite have the attributes that
    pyAT does not use in a dictionary `unread`. **Raises** `ValueError` for what is not readable."""
    import at

    suffix = path.suffix.lower()
    if suffix in _PARSERS:
        return _lattice_of(getattr(at, _PARSERS[suffix])(), path, use, options)
    try:
        data = json.loads(path.read_text()) if suffix == ".json" else {}
        if "__class__" in data and "atjson" not in data and not options.get("from_at"):
            return _of_xsuite(data, path, use, options)
        return at.load_lattice(str(path), **({} if use is None else {"use": use}), **options)
    except KeyError as error:
        if "extension" not in str(error):
            raise
        names = [*_PARSERS, ".mat", ".m", ".repr", ".json", ".lat"]
        message = f"path must end with one of {names}, got {path.name!r}."
        if suffix == ".bmad":
            message += " Bmad's program bmad_to_mad_sad_elegant writes files of MAD-X."
        raise ValueError(message) from None
    except (TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path.name} cannot be read: {error}") from error


def _line_of(names: list[str], use: str | None, path: Path) -> str:
    """The name of the sequence or line to read."""
    labels = {name.lower().replace(".", "_"): name for name in names}
    choice = "ring" if use is None and len(names) != 1 else (use or names[0]).replace(".", "_")
    if choice.lower() not in labels:
        ellipsis = ", …" if len(names) > 10 else ""
        raise ValueError(
            f"use must be the name of a sequence or line of {path.name}: "
            f"{', '.join(names[:10]) or 'it contains neither'}{ellipsis}; got {use!r}."
        )
    return labels[choice.lower()]


def _lattice_of(parser: Any, path: Path, use: str | None, options: dict[str, Any]) -> Any:
    """The lattice in a file of MAD or elegant. Variables that the file does not define are zero, as
    in MAD, with a warning, unless ``strict=True``."""
    options = dict(options)
    strict = options.pop("strict", type(parser).__name__ == "ElegantParser")
    keys = ("name", "particle", "energy", "periodicity")
    parameters = {key: options.pop(key) for key in keys if key in options}
    parser.env = {**parser.env, **_descriptions(parser)}
    read_statement = parser._statement
    parser._statement = lambda statement: read_statement(_readable(statement))
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # pyAT prints what it reads
            for read in (lambda: parser.parse_files(path, **options), lambda: None):
                if not strict:
                    parser["none"] = _NoValue()
                read()
            line = _line_of(parser.sequences, use, path)
            lattice = parser.lattice(use=line, **parameters)
    except Exception as error:
        names = ", ".join(sorted({*parser.ignored, *map(str, parser.missing)})[:10])
        unknown = f" Not known to pyAT or not defined: {names}." if names else ""
        raise ValueError(f"{path.name} cannot be read: {error}{unknown}") from error
    commands = {command for _, label, command, *_ in parser.postponed if label is None}
    changes = sorted(
        c for c in commands & parser.ignored if c not in _NO_CHANGES and c[:4] != "ptc_"
    )
    beams = (value for key, value in parser.items() if key.startswith("beam%"))
    if any(float(beam.get("bv", 1)) < 0 for beam in beams):
        changes.append("beam, bv=-1")
    if changes:
        raise ValueError(
            f"{path.name} changes its lattice by {', '.join(changes)}, which pyAT ignores. Save "
            "the sequence in MAD-X after these commands, and read that file."
        )
    overlaps = [e for e in lattice if e.FamName.startswith("drift_") and e.Length < 0]
    if overlaps:
        raise ValueError(
            f"elements of {line} in {path.name} must not overlap, or end behind it: "
            f"{len(overlaps)} of them do, the first by {-overlaps[0].Length:.3g} m."
        )
    empty_names = sorted(k for k, v in parser.items() if isinstance(v, _NoValue) and k != "none")
    if empty_names:
        names = ", ".join(empty_names[:10]) + (", …" if len(empty_names) > 10 else "")
        warnings.warn(
            f"{path.name} does not define {names}: zero, as in MAD. Pass their values, such as "
            f"rings.load(path, {empty_names[0]}=1.0), or strict=True for an error.",
            stacklevel=user_level(),
        )
    return lattice


def _readable(statement: str) -> str:
    """The statement of a file in a form that pyAT reads. **Raises** `ValueError` for those that it
    misreads or, as with braces that are not closed, never ends to read."""
    text = re.sub(r"\"[^\"]*\"|'[^']*'", "", statement).lower()
    is_line = re.search(r"\bline\s*=", text)
    for description, is_misread in (
        (
            "conditions, loops and macros",
            any(text.count(a) != text.count(b) for a, b in ("()", "{}")),
        ),
        ("lines that are repeated backwards", is_line and re.search(r"-\s*\d+\s*\*|\*\W*-", text)),
        (
            "RBARC = FALSE",
            re.match(r"\s*option\b", text) and re.search(r"-\s*rbarc|rbarc\W*f", text),
        ),
    ):
        if is_misread:
            raise ValueError(f"pyAT does not read {description}")
    # An attribute of an element; pyAT would make a variable.
    return re.sub(
        r"^\s*([\w.$]+)\s*(?:->\s*(\w+)|\[\s*(\w+)\s*\])\s*(:?=)", r"\1, \2\3\4", statement
    )


def _descriptions(parser: Any) -> dict[str, type]:
    """The parser's classes of elements, which pass on the attributes that pyAT does not read."""
    from at.load.file_input import ElementDescr, ignore_class

    kinds = {k: v for k, v in parser.env.items() if isinstance(v, type)}
    kinds = {k: v for k, v in kinds.items() if issubclass(v, ElementDescr)}
    if type(parser).__name__ != "ElegantParser":
        base = kinds["drift"].__base__
        kinds |= {k: ignore_class(k, base) for k in _OTHER_KINDS}  # pyright: ignore[reportArgumentType]
        content = {"meval": staticmethod(lambda params: {"unread": params})}
        return {k: type(v.__name__, (v,), content) for k, v in kinds.items()}
    return {k: _of_elegant(v) for k, v in kinds.items()}


def _of_elegant(kind: type) -> type:
    import at

    def to_at(self, *args, **params):
        elements = kind.to_at(self, *args, **params)  # pyright: ignore[reportAttributeAccessIssue]
        # pyAT leaves out elements such as MALIGN.
        elements = elements or [at.Marker(self.name, origin=kind.__name__, **params)]
        for element in elements:
            is_strength = kind.__name__.lower() in _STRENGTHS
            element.unread = {k: v for k, v in params.items() if is_strength or k in vars(element)}
        return elements

    return type(kind.__name__, (kind,), {"to_at": to_at})


def _of_xsuite(data: dict[str, Any], path: Path, use: str | None, options: dict[str, Any]) -> Any:
    import at
    from at.load.xsuite import XsLine

    if "lines" in data:
        use = _line_of([*data["lines"]], use, path)
    with contextlib.redirect_stdout(io.StringIO()):  # pyAT prints what it does not know
        line = XsLine.from_dict(data, use=use)
    unread = {name: _unread_of_xsuite(element) for name, element in line.elements.items()}
    metadata = data.get("metadata", {})  # of `save`: what a line of Xsuite does not have
    options = {"periodicity": metadata.get("periodicity", 1), **options}
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", message=".*unknown class (Limit(Rect|Ellipse)|UniformSolenoid) "
        )
        lattice = line.to_at(**options)
    for element in lattice:
        element.unread = unread.get(element.FamName, {})
        gap = line.elements.get(element.FamName, {}).get("edge_entry_hgap")
        if gap is not None:
            element.FullGap = 2 * gap  # pyAT 0.9.0 takes the half gap for the gap
    contents = [line.elements[name] for name in line.element_names]
    elements = [counterpart(*pair, at) for pair in zip(lattice, contents, strict=True)]
    lattice[:] = fold_limits(line.element_names, elements)
    for element, name in zip(lattice, metadata.get("names", ()), strict=False):
        element.FamName = name
    return lattice


def _unread_of_xsuite(element: Any) -> dict[str, Any] | None:
    """What pyAT leaves out of an element, None of one that acts and that it does not know. What it
    misreads is changed in the element."""
    is_replaced = element.origin and element.origin != type(element).__name__
    is_field = hasattr(element, "_set_at_poly")
    attributes = {*_XSUITE_READ, *element._xsuite2at_attr, *(_XSUITE_FIELDS if is_field else ())}
    if element.origin == "Quadrupole":
        attributes |= {"edge_entry_active", "edge_exit_active"}
    if element.origin in ("Bend", "RBend"):
        attributes |= {"edge_entry_hgap", "edge_entry_active", "edge_exit_active"}
    values = {key: value for key, value in element.items() if key not in attributes}
    if is_replaced:
        return None if any(map(_acts, values.values())) else values
    if is_field:
        order = max(len(element.get(key, ())) for key in ("knl", "ksl")) - 1
        element["order"] = max(element.get("order", 0), order)
    if element.origin == "Multipole" and not (element.get("isthick") or element.get("_isthick")):
        element["length"] = 0.0  # that of the radiation only
    anchor, roll = element.get("rot_shift_anchor", 0.0), element.get("rot_s_rad", 0.0)
    if roll or not any(abs(anchor - x * element._l_anchor) < 1e-9 for x in (0, 0.5)):
        # pyAT has these without a roll of the design, at the entrance or in the middle.
        values |= {key: element.get(key) for key in _XSUITE_SHIFTS}
    if element.origin in ("Bend", "RBend"):
        if element.get("edge_exit_hgap") == element.get("edge_entry_hgap"):
            values.pop("edge_exit_hgap", None)
        for side in ("entry", "exit"):
            is_off = element.get(f"edge_{side}_model") == "suppressed"
            values[f"edge_{side}, suppressed"] = is_off or not element.get(f"edge_{side}_active", 1)
        length = element.get("length", 0.0)
        if element.origin == "RBend":
            half = element.get("angle", 0.0) / 2
            straight = element.get("length_straight", length)
            length = straight * half / math.sin(half) if half else straight
        angle = element.setdefault("angle", element.get("h", 0.0) * length)
        k0 = element.pop("k0", None)  # pyAT adds it to the field that bends by the angle
        if k0 is not None and not element.get("k0_from_h", False):
            excess = k0 - angle / length
            values["k0 - angle/length"] = excess if abs(excess) > 1e-9 * abs(k0) else 0.0
    return values


def check_source(source: Any) -> None:
    """**Raises** `ValueError` for an element of a file that pyAT replaces by a drift or a marker,
    or of which it leaves out a part."""
    origin, unread = getattr(source, "origin", ""), getattr(source, "unread", None)
    if type(source).__name__ in ("Marker", "Drift") and origin.lower() not in _FIELD_FREE:
        strengths = _STRENGTHS.get(origin.lower())
        if strengths and unread is not None and not any(_acts(unread.get(k)) for k in strengths):
            return
        kind = type(source).__name__
        raise ValueError(f"pyAT has no element for {origin}, and replaces it by a {kind}")
    for name, value in (unread or {}).items():
        if (
            name.lower() in _WITHOUT_EFFECT
            or not _acts(value)
            or type(source).__name__ == "RFCavity"
        ):
            continue
        if name == "k0" and math.isclose(
            float(value) * source.Length, getattr(source, "BendingAngle", 0.0), rel_tol=1e-9
        ):
            continue
        raise ValueError(f"pyAT leaves out {name} = {value}")
    if origin == "multipole" and (source.PolynomB[0] or source.PolynomA[0]):
        raise ValueError(
            f"KNL[0] = {source.PolynomB[0]:g}, KSL[0] = {source.PolynomA[0]:g} bend the reference "
            "orbit, which pyAT leaves out; a kicker does not bend it"
        )
    if origin == "rbend" and source.BendingAngle < 0:
        raise ValueError(
            "pyAT gives the pole faces of an RBEND with a negative angle the wrong sign; an SBEND "
            "with E1 and E2 is read"
        )


def _acts(value: Any) -> bool:
    """Whether an attribute has an effect: a number that is not zero, or numbers with one."""
    if value is None or isinstance(value, str):
        return False
    if isinstance(value, tuple | list):
        return any(map(_acts, value))
    try:
        return float(value) != 0.0
    except (TypeError, ValueError):
        return False
