"""Name → method: what is certified, and tested, by being listed here."""

# Abstract variables of equinox stay arguments of a subclass for pyright, though not at run time.
# pyright: reportCallIssue=false

from typing import Any

import dvi_jax as dvi

_JUMP = 1 / (2 - 2 ** (1 / 3))


def _family(method: type[Any], *numbers: int) -> dict[str, dvi.Method]:
    """Methods by their name with the order or the number of stages."""
    return {f"{method.__name__}{number}": method(number) for number in numbers}


METHODS: dict[str, dvi.Method] = {
    "TypeII": dvi.TypeII(),
    "Adjoint": dvi.Adjoint(),
    "Strang": dvi.Strang(),
    "StrangOfAdjoint": dvi.Strang(base=dvi.Adjoint()),
    "Composition2": dvi.Composition((0.3, 0.2, 0.2, 0.3), order=2),
    "TripleOfStrang": dvi.Composition((_JUMP, 1 - 2 * _JUMP, _JUMP), order=4, base=dvi.Strang()),
    **_family(dvi.Yoshida, 4, 6, 8),
    **_family(dvi.Suzuki, 4),
    **_family(dvi.BlanesMoan, 4, 6),
    **_family(dvi.McLachlan, 4, 6, 8),
    **_family(dvi.KahanLi, 6, 8),
    **_family(dvi.GaussLegendre, 1, 2, 3, 4),
    **_family(dvi.LobattoIIIAIIIB, 2, 3, 4),
    "RungeKutta4": dvi.RungeKutta4(),
}
"""The methods of the package. Another one is one line."""

QUICK = ("TypeII", "Strang", "Yoshida4", "GaussLegendre2", "RungeKutta4")
"""One of each kind."""
