"""The parts that elements are made of, by name."""

import functools
from collections.abc import Callable

from ._exact import (
    dipole_fringe,
    exact_bend,
    exact_drift,
    multipole_fringe,
    rotate,
    second_order_bend,
    second_order_edge,
    wedge,
)
from ._maps import (
    Piece,
    RingPart,
    affine,
    cavity,
    corrector,
    curved_kick,
    drift,
    drifts_and_kicks,
    edge,
    element_coordinates,
    kick,
    lens,
    near_identity,
    quadrupole_fringe,
    solenoid,
    thin_kick,
)


def _flow(move: Callable) -> list[Piece]:
    return [Piece(lambda z, par, turn, sign: move(z, sign * par["length"], par))]


def _plain(move: Callable) -> list[Piece]:
    return [Piece(lambda z, par, turn, sign: move(z, par, sign))]


def _near_identity_map(move: Callable) -> list[Piece]:
    """A map near the identity, given as a function from state to state."""

    def change(z, par):
        image = move(z, par)
        return {name: getattr(image, name) - getattr(z, name) for name in z._fields}

    return [near_identity(change)]


def _exact_fringe(side: int, order: int, skips_b0: bool) -> list[Piece]:
    return _near_identity_map(
        lambda z, par: multipole_fringe(z, par, side, order, skips_b0),
    )


_MAPS: dict[str, Callable[[RingPart], list[Piece]]] = {
    "drift": lambda p: _flow(drift),
    "half_drift": lambda p: _flow(lambda z, length, par: drift(z, length / 2, par)),
    "exact_drift": lambda p: _flow(exact_drift),
    "straight": lambda p: drifts_and_kicks(drift, kick, p),
    "bend": lambda p: drifts_and_kicks(drift, curved_kick, p),
    "exact_straight": lambda p: drifts_and_kicks(exact_drift, kick, p),
    "exact_bend": lambda p: drifts_and_kicks(exact_bend, kick, p),
    "second_order_bend": second_order_bend,
    "thin": lambda p: _plain(functools.partial(thin_kick, order=p.order)),
    "lens": lambda p: _plain(functools.partial(lens, potential=p.potential)),  # pyright: ignore[reportArgumentType]
    "edge_in": lambda p: [edge("in", True, p.scheme)],
    "edge_out": lambda p: [edge("out", True, p.scheme)],
    "at_edge_in": lambda p: [edge("in", False, p.scheme)],
    "at_edge_out": lambda p: [edge("out", False, p.scheme)],
    "second_order_edge_in": lambda p: [second_order_edge("in", 1)],
    "second_order_edge_out": lambda p: [second_order_edge("out", -1)],
    "fringe_in": lambda p: [quadrupole_fringe(1)],
    "fringe_out": lambda p: [quadrupole_fringe(-1)],
    "multipole_fringe_in": lambda p: _exact_fringe(1, p.order, False),
    "multipole_fringe_out": lambda p: _exact_fringe(-1, p.order, False),
    "gradient_fringe_in": lambda p: _exact_fringe(1, p.order, True),
    "gradient_fringe_out": lambda p: _exact_fringe(-1, p.order, True),
    "dipole_fringe_in": lambda p: _near_identity_map(
        lambda z, par: dipole_fringe(z, par["h"], par["fringe_in"])
    ),
    "dipole_fringe_out": lambda p: _near_identity_map(
        lambda z, par: dipole_fringe(z, -par["h"], par["fringe_out"])
    ),
    "rotation_in": lambda p: _plain(lambda z, par, sign: rotate(z, sign * par["edge_in"])),
    "rotation_out": lambda p: _plain(lambda z, par, sign: rotate(z, sign * par["edge_out"])),
    "wedge_in": lambda p: _plain(lambda z, par, sign: wedge(z, -sign * par["edge_in"], par["h"])),
    "wedge_out": lambda p: _plain(lambda z, par, sign: wedge(z, -sign * par["edge_out"], par["h"])),
    "cavity": lambda p: [Piece(cavity)],
    "corrector": lambda p: [Piece(corrector)],
    "solenoid": lambda p: [Piece(solenoid)],
    "placed_in": lambda p: _plain(element_coordinates),
    "placed_out": lambda p: _plain(lambda z, par, sign: element_coordinates(z, par, -sign)),
    "affine_in": lambda p: [affine("in")],
    "affine_out": lambda p: [affine("out")],
}


@functools.cache
def pieces_of(part: RingPart) -> tuple[Piece, ...]:
    """The maps of a part; none of an aperture, which does not move a particle."""
    make = _MAPS.get(part.name)
    return () if make is None else tuple(make(part))
