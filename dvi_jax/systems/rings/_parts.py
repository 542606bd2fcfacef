"""The parts that elements are made of, by name."""

import functools
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from . import _beams as beams, _curved as curved, _exact as exact, _frames as frames, _maps as maps
from ._maps import Parameters, Piece, RingPart
from ._radiation import radiant, wedge


def _flow(move: Callable) -> list[Piece]:
    return [Piece(lambda z, par, turn, sign: move(z, sign * par["length"], par))]


def _plain(move: Callable) -> list[Piece]:
    return [Piece(lambda z, par, turn, sign: move(z, par, sign))]


def _angle(side: str, par: Parameters) -> Any:
    """The angle of a pole face from the plane of the reference orbit."""
    return par[f"edge_{side}"] if side == "in" else -par[f"edge_{side}"]


def _at_face(side: str, change: Callable) -> list[Piece]:
    """A map near the identity in the plane of a pole face, of the whole px."""

    def of_whole(z, par):
        return change(z.plus(px=jnp.sin(_angle(side, par))), par)

    return [maps.near_identity(of_whole)]


def _turn(side: str, move: Callable, direction: int) -> Piece:
    """Motion from the end of a bend to its pole face, or back for direction −1."""

    def apply(z, par, turn, sign):
        return move(z, par, *(0.0, _angle(side, par))[:: sign * direction])

    return Piece(apply)


def _wedge(side: str, end: int, order: int) -> list[Piece]:
    """The same in the main field and in multipoles."""

    def kick(z, par, turn, sign):
        return exact.wedge_kick(z, -sign * jnp.tan(par[f"edge_{side}"]), par, order)

    return [_turn(side, exact.wedge, -end), Piece(kick), wedge(side)][::end]


Make = Callable[[RingPart], list[Piece]]


def _ends(side: str, sign: int) -> dict[str, Make]:
    """The parts at the entrance of an element, "in" and 1, or at its exit, "out" and −1."""
    return {
        f"edge_{side}": lambda p: [maps.edge(side, True, p.scheme), wedge(side)][::sign],
        f"at_edge_{side}": lambda p: [maps.edge(side, False, p.scheme)],
        f"second_order_edge_{side}": lambda p: [exact.second_order_edge(side, sign)],
        f"fringe_{side}": lambda p: [maps.quadrupole_fringe(sign)],
        f"multipole_fringe_{side}": lambda p: [
            maps.near_identity(lambda z, par: exact.multipole_fringe(z, par, sign, p.order, False))
        ],
        f"gradient_fringe_{side}": lambda p: _at_face(
            side, lambda z, par: exact.multipole_fringe(z, par, sign, p.order, True)
        ),
        f"dipole_fringe_{side}": lambda p: _at_face(
            side, lambda z, par: exact.dipole_fringe(z, par["h"], par[f"fringe_{side}"], sign)
        ),
        f"rotation_{side}": lambda p: [_turn(side, exact.rotate, sign)],
        f"wedge_{side}": lambda p: _wedge(side, sign, p.order),
        f"at_wedge_{side}": lambda p: [_turn(side, exact.wedge, -sign)],
        f"placed_{side}": lambda p: _plain(
            lambda z, par, direction: frames.placed(z, par, sign * direction)
        ),
        f"tilted_{side}": lambda p: _plain(
            lambda z, par, direction: frames.turned(z, sign * direction * par["tilt"])
        ),
        f"moved_{side}": lambda p: _plain(
            lambda z, par, direction: frames.moved(z, par, (1 - sign) / 2, sign * direction)
        ),
        f"affine_{side}": lambda p: [maps.affine(side)],
        f"scaled_{side}": lambda p: _plain(
            lambda z, par, direction: maps.rescaled(z, par["scale"], sign * direction)
        ),
    }


_MAPS: dict[str, Make] = {
    "drift": lambda p: _flow(maps.drift),
    "half_drift": lambda p: _flow(lambda z, length, par: maps.drift(z, length / 2, par)),
    "exact_drift": lambda p: _flow(exact.exact_drift),
    "straight": lambda p: maps.drifts_and_kicks(maps.drift, radiant(maps.kick), p),
    "bend": lambda p: maps.drifts_and_kicks(maps.drift, radiant(maps.curved_kick), p),
    "exact_straight": lambda p: maps.drifts_and_kicks(exact.exact_drift, radiant(maps.kick), p),
    "exact_bend": lambda p: maps.drifts_and_kicks(exact.exact_bend, radiant(curved.curved_kick), p),
    "at_exact_bend": lambda p: maps.drifts_and_kicks(exact.exact_bend, radiant(maps.kick), p),
    "second_order_bend": exact.second_order_bend,
    "thin": lambda p: _plain(functools.partial(maps.thin_kick, order=p.order)),
    "lens": lambda p: _plain(functools.partial(maps.lens, potential=p.potential)),  # pyright: ignore[reportArgumentType]
    "beam": lambda p: _plain(beams.beam_kick),
    "beam_slices": lambda p: _plain(functools.partial(beams.beam_slices, count=p.slices)),
    "cavity": lambda p: [Piece(maps.cavity)],
    "corrector": lambda p: [Piece(maps.corrector)],
    "solenoid": lambda p: [Piece(frames.solenoid)],
    **_ends("in", 1),
    **_ends("out", -1),
}


@functools.cache
def pieces_of(part: RingPart) -> tuple[Piece, ...]:
    """The maps of a part; none of an aperture, which does not move a particle."""
    make = _MAPS.get(part.name)
    return () if make is None else tuple(make(part))
