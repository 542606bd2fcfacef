"""Files of pyAT and of Xsuite from a ring."""

import json
import math
import os
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ...base.checks import instance, known, one_of
from ._elements import C, Element
from ._maps import LIMITS, Particle, RingPart, forward
from ._parts import pieces_of
from ._readers import ORDER, accelerator_toolbox, convert_all, refuse
from ._ring import Ring
from ._xsuite import content_of

_FRAMES = "placed", "tilted", "affine"
_PASSES = {
    "straight": "StrMPoleSymplectic4Pass",
    "exact_straight": "ExactMultipolePass",
    "bend": "BndMPoleSymplectic4Pass",
    "second_order_bend": "BndMPoleSymplectic4E2Pass",
    "exact_bend": "ExactSectorBendPass",
    "at_exact_bend": "ExactSectorBendPass",
    "thin": "ThinMPolePass",
}
_ENDS = (("in", "Entrance"), ("out", "Exit"))


def save(
    ring: Ring, path: str | os.PathLike[str], *, format: Literal["at", "xsuite"] = "at"
) -> None:
    """A file of a ring, which `load` reads back as the same map, to round-off.

    **Arguments** `path`: its end is that of a format of pyAT, .mat, .m, .json or .repr, or .json
    for ``format="xsuite"``, a line of Xsuite.

    Particles in the file have the speed of light in both. **Raises** `ValueError` with the elements
    that have no counterpart in the other program: lenses, kicks of beams, inclined magnets (pitch,
    yaw, ds), pipes with tapers, schemes of order 2 and 6, exact bends with multipoles. In Xsuite
    also matrices and cavities whose phase slips. An edge with a fringe field is saved as that of
    pyAT: read it with ``load(path, symplectic=True)``.

    **Example**

    ```python
    import tempfile
    ring = rings.Ring([rings.quadrupole("Q", 0.5, k1=0.6).placed(dx=1e-4), rings.drift("D", 2.0)])
    with tempfile.TemporaryDirectory() as folder:
        rings.save(ring, f"{folder}/ring.mat")
        print(rings.load(f"{folder}/ring.mat").names)
    # ('Q', 'D')
    ```
    """
    instance("ring", ring, Ring, "a rings.Ring").check()
    toolbox, path = accelerator_toolbox(), Path(path)
    one_of("end of path", path.suffix, (".json",) if format == "xsuite" else _SUFFIXES)
    for key, column in ring.columns.items():
        known(key, column)
    period = float(ring.period)
    is_at = one_of("format", format, ("at", "xsuite")) == "at"
    convert = _at_element if is_at else _xsuite_element

    def label(element):
        return f"{element.name} ({element.kind})"

    elements = convert_all(
        ring.elements, lambda x: convert(x, toolbox, ring.energy, period), label, "in this format"
    )
    if is_at:
        lattice = toolbox.Lattice(elements, energy=ring.energy, periodicity=ring.periods)
        toolbox.save_lattice(lattice, str(path))
        return
    table, names = {}, []
    for pieces in elements:
        for label, content in pieces.items():
            count = 0
            while table.get(name := f"{label}.{count}" if count else label, content) != content:
                count += 1
            table[name] = content
            names.append(name)
    mass = 510998.95
    gamma = ring.energy / mass
    particle = {"mass0": mass, "q0": -1, "gamma0": [gamma], "beta0": [math.sqrt(1 - gamma**-2)]}
    line = {
        "__class__": "Line",
        "elements": table,
        "element_names": names,
        "particle_ref": particle,
    }
    metadata = {"periodicity": ring.periods, "names": ring.names}
    path.write_text(json.dumps(line | {"metadata": metadata}, indent=1))


_SUFFIXES = ".mat", ".m", ".json", ".repr"


def _matrix(part: RingPart, values: Any) -> tuple[np.ndarray, np.ndarray]:
    """M and v of an affine map z → M z + v."""

    def image(z):
        return jnp.stack(forward(pieces_of(part), Particle(*z), values, 0, 1))

    return np.asarray(jax.jacfwd(image)(jnp.zeros(6))), np.asarray(image(jnp.zeros(6)))


def _layers(element: Element) -> tuple[list[RingPart], list[str], dict[str, Any]]:
    """The parts inside of the misalignments and apertures, the frames from the outside, and the
    apertures as attributes of pyAT."""
    parts, frames, apertures = list(element.parts), [], {}
    while len(parts) > 1:
        first, last = parts[0].name, parts[-1].name
        frame = first.removesuffix("_in")
        if first == last and first in LIMITS:
            limits = [float(element.values[key]) for key in LIMITS[first]]
            apertures[f"{first[0].upper()}Apertures"] = np.array(limits)
        elif frame in _FRAMES and last == f"{frame}_out":
            frames.append(frame)
            if apertures:
                refuse("its aperture does not follow its misalignment: use inside before placed")
        else:
            break
        parts = parts[1:-1]
    return parts, frames, apertures


def _at_element(element: Element, toolbox: Any, energy: float, period: float) -> Any:
    """The element of pyAT. **Raises** `ValueError` with the reason for others."""
    parts, frames, attributes = _layers(element)
    if frames:
        ends = {}
        for side, order in (("in", 1), ("out", -1)):
            M, v = np.eye(6), np.zeros(6)
            for frame in frames[::order]:
                A, shift = _matrix(RingPart(f"{frame}_{side}"), element.values)
                M, v = A @ M, A @ v + shift
            ends[side] = M, v
        (M, v), (N, w) = ends["in"], ends["out"]
        attributes |= {"R1": ORDER.T @ M @ ORDER, "T1": ORDER.T @ np.linalg.solve(M, v)}
        attributes |= {"R2": ORDER.T @ N @ ORDER, "T2": ORDER.T @ w}
    return _core(element, parts, attributes, toolbox, energy, period)


def _xsuite_element(element: Element, toolbox: Any, energy: float, period: float) -> dict[str, Any]:
    source = _at_element(element, toolbox, energy, period)
    content = content_of(source, element, _layers(element)[1])
    return refuse(content) if isinstance(content, str) else content


def _core(
    element: Element,
    parts: list[RingPart],
    attributes: dict[str, Any],
    toolbox: Any,
    energy: float,
    period: float,
) -> Any:
    names, values = {part.name: part for part in parts}, element.values
    length = float(values.get("length", 0.0))
    attributes |= {"FamName": element.name, "Length": length}

    def build(kind: Any, method: str, **options: Any) -> Any:
        return kind.from_file({**attributes, "PassMethod": method, **options})

    if not parts:
        kind = toolbox.Monitor if element.kind == "monitor" else toolbox.Marker
        return build(kind if length == 0 else toolbox.Element, "IdentityPass")
    if names.keys() == {"drift"} or names.keys() == {"exact_drift"}:
        method = "DriftPass" if "drift" in names else "ExactDriftPass"
        return build(toolbox.Drift, method)
    if names.keys() == {"rectangle"}:
        limits = [float(values[key]) for key in LIMITS["rectangle"]]
        return build(toolbox.Aperture, "AperturePass", Limits=np.array(limits))
    if names.keys() == {"corrector"}:
        kicks = np.array([float(values["kick_x"]), float(values["kick_y"])])
        return build(toolbox.Corrector, "CorrectorPass", KickAngle=kicks)
    if names.keys() == {"solenoid"}:
        return build(toolbox.Element, "SolenoidLinearPass", K=float(values["ks"]))
    if names.keys() == {"affine_in"}:
        if np.any(values["shift_in"]):
            attributes["T2"] = ORDER.T @ np.asarray(values["shift_in"])
        return build(
            toolbox.M66, "Matrix66Pass", M66=ORDER.T @ np.asarray(values["matrix_in"]) @ ORDER
        )
    if "cavity" in names and names.keys() <= {"cavity", "half_drift"}:
        frequency = float(values["wave_number"]) * C / (2 * math.pi)
        slip, turns = float(values["slip"]) / (2 * math.pi), frequency * period
        if "RApertures" in attributes or "EApertures" in attributes or "R1" in attributes:
            refuse("cavities have no apertures and no misalignments there")
        if slip and abs(slip + turns - round(slip + turns)) > 1e-9 * turns:
            refuse("the slip of its phase is not that of a harmonic number")
        return build(
            toolbox.RFCavity, "RFCavityPass" if slip else "CavityPass", Frequency=frequency,
            Voltage=float(values["voltage"]) * energy, Energy=energy, TimeLag=float(values["lag"]),
            HarmNumber=round(slip + turns), PhaseLag=float(values["phase"]),
        )  # fmt: skip
    bodies = [part for part in parts if part.name in _PASSES]
    ends = [name for name in names if name not in _PASSES]
    has_multipoles = any(float(values[f"{k}{n}"]) for n in range(bodies[0].order + 1)
                         for k in "ba" if n) if bodies else False  # fmt: skip
    if len(bodies) != 1 or any(name.rsplit("_", 1)[0] not in _EDGES for name in ends):
        refuse(f"{', '.join(names)} is not there")
    body = bodies[0]
    if body.scheme != 4 and body.name != "thin":
        refuse(f"scheme={body.scheme} is not there")
    if has_multipoles and "exact_bend" in names:
        refuse("its multipoles in curved coordinates are not there")
    for key in "ba":
        field = [float(values[f"{key}{n}"]) for n in range(body.order + 1)]
        attributes[f"Polynom{key.upper()}"] = np.array(field)
    attributes["MaxOrder"] = body.order
    if body.name == "thin":
        return build(toolbox.ThinMultipole, _PASSES["thin"])
    is_exact = body.name.endswith(("exact_bend", "exact_straight"))
    fringe = {"exact_bend": "gradient_fringe", "at_exact_bend": "gradient_fringe",
              "exact_straight": "multipole_fringe"}.get(body.name, "fringe")  # fmt: skip
    attributes |= {f"FringeQuad{end}": int(f"{fringe}_{side}" in names) for side, end in _ENDS}
    attributes["NumIntSteps"] = body.slices
    if "h" not in values:
        kinds = {
            "quadrupole": toolbox.Quadrupole,
            "sextupole": toolbox.Sextupole,
            "octupole": toolbox.Octupole,
        }
        return build(kinds.get(element.kind, toolbox.Multipole), _PASSES[body.name])
    if body.name == "exact_straight":
        refuse("an exact bend without an angle is not there")
    attributes |= {"BendingAngle": float(values["h"]) * length}
    for i, (side, end) in enumerate(_ENDS):
        attributes[f"{end}Angle"] = float(values[f"edge_{side}"])
        edge = next((p for p in parts if p.name.endswith(f"edge_{side}")), None)
        present = f"dipole_fringe_{side}" in names
        attributes[f"FringeBend{end}"] = int(present) if is_exact else edge.scheme if edge else 0
        if edge is not None and edge.name == f"edge_{side}" and edge.scheme == 4:
            attributes[f"FringeBend{end}"] = 1
        attributes[f"FringeInt{i + 1}"] = float(values[f"fringe_{side}"])
    gaps = [attributes[f"FringeInt{i}"] for i in (1, 2)]
    if is_exact:
        if gaps[0] != gaps[1]:
            refuse("its ends have different fringe fields")
        attributes["gK"] = gaps[0]
    attributes["FullGap"] = 1.0
    return build(toolbox.Dipole, _PASSES[body.name])


_EDGES = {
    "edge", "at_edge", "second_order_edge", "fringe", "multipole_fringe", "gradient_fringe",
    "dipole_fringe", "rotation", "wedge", "at_wedge",
}  # fmt: skip
