"""Elements of a ring: magnets, cavities, apertures."""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, TypedDict, Unpack, get_args

import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, finite, in_range, instance, one_of, positive, whole
from ...base.keywords import checked_keywords, user_level
from ...base.printing import printable
from ...base.signature import check_takes, output_of
from ._maps import KICKS, RingPart

Model = Literal["paraxial", "exact"]
Anchor = Literal["entrance", "middle"]
C = 299792458.0
"""Speed of light [m/s]."""


@printable
@dataclasses.dataclass(frozen=True)
class Element:
    """One element: its name and kind, its parts in order, and its parameters by name."""

    name: str
    kind: str
    parts: tuple[RingPart, ...] = ()
    values: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        instance("name of an element", self.name, str, "text")
        for key, value in self.values.items():
            if np.ndim(value) == 0:
                strength(f"{key} of element {self.name!r}", value)

    def placed(
        self,
        dx: float = 0.0,
        dy: float = 0.0,
        roll: float = 0.0,
        *,
        ds: float = 0.0,
        pitch: float = 0.0,
        yaw: float = 0.0,
        anchor: Anchor = "entrance",
        tilt: float = 0.0,
    ) -> "Element":
        """The element with errors of its alignment: it is moved as a rigid body, and the reference
        orbit is not.

        **Arguments** `dx`, `dy`, `ds`: shift along x, y and s [m]. `roll`, `pitch`, `yaw`: angles
        [rad] that turn x towards y, s towards y, and s towards x, in this order, about the
        `anchor`: "entrance", or "middle" of the reference orbit in the element, whose axes are
        those of x, y and s. `tilt`: angle [rad] of the *design* about the s-axis, x towards y; the
        reference orbit follows it, so that π/2 makes a vertical bend.

        **Raises** `ValueError` for an element that is placed already.

        **Source** EALIGN of MAD-X, with DPHI = pitch, DTHETA = yaw, DPSI = roll at the entrance.
        """
        values = {"dx": dx, "dy": dy, "roll": roll}
        offsets = {"ds": ds, "pitch": pitch, "yaw": yaw}
        for name, value in {**values, **offsets, "tilt": tilt}.items():
            strength(f"{name} of element {self.name!r}", value)
        middle = {"entrance": 0.0, "middle": 0.5}[one_of("anchor", anchor, get_args(Anchor))]
        element, name = self, "placed"
        if not _is_zero(tilt):
            element = element.within(RingPart("tilted_in"), RingPart("tilted_out"), tilt=tilt)
        # The ends of a curved element have different frames; those of other elements need them
        # only if they are inclined.
        if "h" in self.values or not all(map(_is_zero, offsets.values())):
            values, name = {**values, **offsets, "anchor": middle}, "moved"
        return element.within(RingPart(f"{name}_in"), RingPart(f"{name}_out"), **values)

    def inside(
        self, *, rectangle: Sequence[float] | None = None, ellipse: Sequence[float] | None = None
    ) -> "Element":
        """The element with an aperture at both ends: a rectangle (x_min, x_max, y_min, y_max), or
        an ellipse with the half axes (x, y) [m]."""
        element = self
        for name, limits, keys in (
            ("rectangle", rectangle, ("x_min", "x_max", "y_min", "y_max")),
            ("ellipse", ellipse, ("radius_x", "radius_y")),
        ):
            if limits is not None:
                is_list = isinstance(limits, Iterable) and not isinstance(limits, str)
                if not is_list or len(list(limits)) != len(keys):
                    raise ValueError(
                        f"{name} of {self.name!r} must be ({', '.join(keys)}), got {limits!r}."
                    )
                pairs = zip(limits[::2], limits[1::2], strict=True)
                widths = limits if name == "ellipse" else [high - low for low, high in pairs]
                sizes = [width for width in widths if not is_traced(width)]
                for width in sizes:
                    positive(f"each width of the {name} of element {self.name!r}", width)
                if max(sizes, default=0.0) > 2:
                    warnings.warn(
                        f"the {name} of element {self.name!r} has no effect, since particles are "
                        f"lost at 1 m. The unit is m, got {limits!r}.",
                        stacklevel=user_level(),
                    )
                ends = RingPart(name), RingPart(name)
                element = element.within(*ends, **dict(zip(keys, limits, strict=True)))
        return element

    def within(self, first: RingPart, last: RingPart, **values: Any) -> "Element":
        """The element between two parts with parameters of their own. **Raises** `ValueError` if it
        has one of these parameters already."""
        same = sorted(values.keys() & self.values.keys())
        if same:
            raise ValueError(
                f"element {self.name!r} must have one value of each parameter, got {same} again. "
                "Give all misalignments in one call of `placed`, each kind of aperture once in "
                "`inside`, or use an element `aperture`, and other names for those of a `lens`."
            )
        return dataclasses.replace(
            self,
            parts=(first, *self.parts, last) if self.parts else (first, last),
            values={**self.values, **values},
        )


def drift(name: str, length: float, model: Model = "paraxial") -> Element:
    """A space without field."""
    one_of("model", model, get_args(Model))
    part = RingPart("drift" if model == "paraxial" else "exact_drift")
    return Element(name, "drift", (part,), {"length": strength("length", length)})


def marker(name: str, kind: str = "marker") -> Element:
    """A place with a name, such as a beam position monitor."""
    return Element(name, kind)


class MagnetSettings(TypedDict, total=False):
    """Keywords of a magnet in slices, see `multipole`."""

    slices: int
    scheme: int
    fringe: bool
    model: Model


class BendSettings(MagnetSettings, total=False):
    """Keywords of `bend`."""

    edge_in: float
    edge_out: float
    fringe_in: float
    fringe_out: float


@checked_keywords
def multipole(
    name: str,
    length: float,
    b: Iterable[float] = (0.0,),
    a: Iterable[float] = (0.0,),
    *,
    kind: str = "multipole",
    **options: Unpack[MagnetSettings],
) -> Element:
    """A straight magnet with the field Σ (b_n + i a_n)(x + i y)^n = (B_y + i B_x)/(Bρ).

    **Arguments** `b`, `a`: from n = 0 (dipole) [1/m^{n+1}]; MAD-X's k_n is n! b_n. Length zero: b
    and a are integrated over the length. A negative length gives the inverse map, as in pyAT.
    `options`: ``slices=10``; ``scheme=4``, the order 2, 4 or 6 of the composition in each slice;
    ``model="paraxial"`` or "exact"; ``fringe=False``, whether it has the hard edges of the
    quadrupole, or those of all multipoles if exact.
    """
    order, values = _field(name, b, a)
    slices, scheme, fringe, model = _slicing(**options)
    values["length"] = strength("length", length)
    if _is_zero(length):
        return Element(name, kind, (RingPart("thin", order),), values)
    body = RingPart("straight" if model == "paraxial" else "exact_straight", order, scheme, slices)
    edge = "fringe" if model == "paraxial" else "multipole_fringe"
    has_edges = fringe and (model == "exact" or order > 0)
    parts = (RingPart(f"{edge}_in", order), body, RingPart(f"{edge}_out", order))
    return Element(name, kind, parts if has_edges else (body,), values)


def quadrupole(name: str, length: float, k1: float, **options: Any) -> Element:
    """A quadrupole: b = (0, k1) [1/m²]; other arguments as for `multipole`."""
    return multipole(name, length, (0.0, k1), kind="quadrupole", **options)


def sextupole(name: str, length: float, b2: float, **options: Any) -> Element:
    """A sextupole: b = (0, 0, b2) [1/m³], b2 half of MAD-X's k2; others as for `multipole`."""
    return multipole(name, length, (0.0, 0.0, b2), kind="sextupole", **options)


def octupole(name: str, length: float, b3: float, **options: Any) -> Element:
    """An octupole: b = (0, 0, 0, b3) [1/m⁴], b3 a sixth of MAD-X's k3; others as for
    `multipole`."""
    return multipole(name, length, (0.0, 0.0, 0.0, b3), kind="octupole", **options)


@checked_keywords
def bend(
    name: str,
    length: float,
    angle: float,
    b: Iterable[float] = (0.0, 0.0),
    a: Iterable[float] = (0.0,),
    **options: Unpack[BendSettings],
) -> Element:
    """A bend by `angle` [rad] along an arc of `length` [m]; `edge_in` = `edge_out` = angle/2 for a
    rectangular one.

    **Arguments** `b`, `a`: further field, as for `multipole`; b_0 is an error of the main field.
    `edge_in`, `edge_out`: angles of the pole faces [rad], `fringe_in`, `fringe_out`: gap times
    fringe field integral [m], all 0 by default; other `options` as for `multipole`: the exact model
    has the hard edges of the main field.

    In the exact model b_n and a_n are the field in the plane of the bend, B_y = Σ b_n x^n and
    B_x = Σ a_n x^n over Bρ, as K_n/n! of MAD-X; the rest follows from Maxwell's equations in curved
    coordinates, and there are multipoles in the wedges at the pole faces. The paraxial model leaves
    out both: its field is b_n x^n/(1 + hx), which changes chromaticities by terms of the order
    h b_1.

    **Raises** `ValueError` for a length that is not positive, or an angle above 2π.
    """
    length = length if is_traced(length) else positive("length of a bend", length)
    if not is_traced(angle):
        hint = "The unit is rad: a degree is 0.01745."
        in_range("angle of a bend", angle, -2 * math.pi, 2 * math.pi, hint)
    order, values = _field(name, b, a)
    values |= {"length": length, "h": strength("angle", angle) / length}
    settings: dict[str, Any] = {**options}
    for end in ("edge_in", "edge_out", "fringe_in", "fringe_out"):
        values[end] = strength(end, settings.pop(end, 0.0))
    slices, scheme, fringe, model = _slicing(**settings)
    if model == "exact" and not _is_zero(angle):
        ends = ["rotation", "dipole_fringe", *["gradient_fringe"] * fringe, "wedge"]
        body = RingPart("exact_bend", order, scheme, slices)
    else:
        ends = ["edge", *["fringe"] * (fringe and order > 0)]
        body = RingPart("bend" if model == "paraxial" else "exact_straight", order, scheme, slices)
    first = [RingPart(f"{end}_in", order) for end in ends]
    last = [RingPart(f"{end}_out", order) for end in reversed(ends)]
    return Element(name, "bend", (*first, body, *last), values)


def corrector(name: str, length: float, kick_x: float, kick_y: float) -> Element:
    """A dipole corrector with kicks of px and py [rad]."""
    values = {"length": length, "kick_x": kick_x, "kick_y": kick_y}
    return Element(name, "corrector", (RingPart("corrector"),), values)


def lens(name: str, potential: Callable[..., Any], **values: float) -> Element:
    """A thin lens of any potential: px − ∂V/∂x, py − ∂V/∂y with V = potential(x, y, par) [m].

    **Arguments** `potential`: a function of JAX; elements with the same function share compiled
    code. `values`: parameters of the element, which it reads as ``par["name"]``, and by which
    results can be differentiated.

    **Example** The kick in x of a McMillan map: ``rings.lens("M", lambda x, y, par: -par["g"] *
    jnp.log(1 + x * x) / 2, g=1.6)``
    """
    values = {key: strength(f"{key} of lens {name!r}", value) for key, value in values.items()}
    if same := values.keys() & {"length", "voltage"}:  # that of a cavity makes a ring 6D
        raise ValueError(
            f"{min(same)} of lens {name!r} is zero: use another name for its parameter."
        )
    check_takes("potential", potential, "(x, y, par)")
    subject = f"potential(x, y, par) of lens {name!r} with par = {values}"
    values = {**values, "length": 0.0}
    x, par = jnp.zeros(()), {key: jnp.asarray(value) for key, value in values.items()}
    array(subject, output_of(subject, potential, x, x, par), (), verb="return")
    return Element(name, "lens", (RingPart("lens", potential=potential),), values)


def solenoid(name: str, length: float, ks: float) -> Element:
    """A solenoid with hard edges, ks = B/(Bρ) [1/m]."""
    return Element(name, "solenoid", (RingPart("solenoid"),), {"length": length, "ks": ks})


def cavity(
    name: str,
    length: float,
    voltage: float,
    frequency: float,
    lag: float = 0.0,
    phase: float = 0.0,
    slip: float = 0.0,
) -> Element:
    """A cavity between two half drifts: δ changes by −V sin(2π f (−ζ − lag)/c − phase).

    **Arguments** `voltage`: V over the energy. `frequency`: f [Hz], positive; 0 only with V = 0.
    `lag` [m]. `phase` [rad]. `slip`: change of phase per turn [rad], 2π (f T − number of periods)
    for a frequency that is not a multiple of 1/T.
    """
    if not is_traced(voltage):
        in_range("voltage of a cavity", voltage, -1.0, 1.0, "It is that over the energy.")
    if not is_traced(frequency):
        # Files give 0 for cavities that are off.
        is_off = not is_traced(voltage) and voltage == 0
        positive("frequency of a cavity", frequency, zero=is_off, hint="The unit is Hz.")
    values = {"length": length, "voltage": voltage, "lag": lag, "phase": phase, "slip": slip}
    values["wave_number"] = 2 * math.pi * frequency / C
    half = RingPart("half_drift")
    parts = (half, RingPart("cavity"), half) if not _is_zero(length) else (RingPart("cavity"),)
    return Element(name, "cavity", parts, values)


def aperture(
    name: str,
    *,
    rectangle: Sequence[float] | None = None,
    ellipse: Sequence[float] | None = None,
) -> Element:
    """An aperture; arguments as for `Element.inside`, at least one of them."""
    element = Element(name, "aperture").inside(rectangle=rectangle, ellipse=ellipse)
    if not element.parts:
        raise ValueError(
            f"aperture {name!r} must have the limits rectangle=... or ellipse=..., got neither."
        )
    return element


def strength(name: str, value: Any) -> Any:
    """A finite number, or one that is traced, so that results can be differentiated by it."""
    return value if is_traced(value) and value.shape == () else finite(name, value)


def _is_zero(value: Any) -> bool:
    """Whether it is known to be zero. The parts of an element cannot depend on a traced value."""
    return not is_traced(value) and value == 0


def _coefficients(name: str, values: Any) -> tuple[Any, ...]:
    return tuple(instance(name, values, Iterable, "a list, from n = 0 (dipole)"))


def _field(name: str, b: Iterable[float], a: Iterable[float]) -> tuple[int, dict[str, Any]]:
    b, a = (_coefficients(f"{key} of element {name!r}", x) for key, x in (("b", b), ("a", a)))
    order = max(len(b), len(a), 1) - 1
    values = {}
    for key, coefficients in (("b", b), ("a", a)):
        for n in range(order + 1):
            value = coefficients[n] if n < len(coefficients) else 0.0
            values[f"{key}{n}"] = strength(f"{key}{n} of element {name!r}", value)
    return order, values


def _slicing(
    slices: int = 10, scheme: int = 4, fringe: bool = False, model: Model = "paraxial"
) -> tuple[int, int, bool, Model]:
    """The checked settings of a magnet in slices. **Raises** `ValueError` for an invalid one."""
    one_of("scheme", scheme, KICKS)
    one_of("model", model, get_args(Model))
    return whole("slices", slices), scheme, fringe, model
