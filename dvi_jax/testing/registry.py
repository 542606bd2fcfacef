"""Name → method: what is certified, and tested, by being listed here."""

# Abstract variables of equinox stay arguments of a subclass for pyright, though not at run time.
# pyright: reportCallIssue=false

import dvi_jax as dvi

_JUMP = 1 / (2 - 2 ** (1 / 3))

METHODS: dict[str, dvi.Method] = {
    "TypeII": dvi.TypeII(),
    "Adjoint": dvi.Adjoint(),
    "Strang": dvi.Strang(),
    "StrangOfAdjoint": dvi.Strang(base=dvi.Adjoint()),
    "Composition2": dvi.Composition((0.3, 0.2, 0.2, 0.3), order=2),
    "TripleOfStrang": dvi.Composition((_JUMP, 1 - 2 * _JUMP, _JUMP), order=4, base=dvi.Strang()),
    "Yoshida4": dvi.Yoshida(4),
    "Yoshida6": dvi.Yoshida(6),
    "Yoshida8": dvi.Yoshida(8),
    "Suzuki4": dvi.Suzuki(4),
    "BlanesMoan4": dvi.BlanesMoan(4),
    "BlanesMoan6": dvi.BlanesMoan(6),
    "McLachlan4": dvi.McLachlan(4),
    "McLachlan6": dvi.McLachlan(6),
    "McLachlan8": dvi.McLachlan(8),
    "KahanLi6": dvi.KahanLi(6),
    "KahanLi8": dvi.KahanLi(8),
    "GaussLegendre1": dvi.GaussLegendre(1),
    "GaussLegendre2": dvi.GaussLegendre(2),
    "GaussLegendre3": dvi.GaussLegendre(3),
    "GaussLegendre4": dvi.GaussLegendre(4),
    "LobattoIIIAIIIB2": dvi.LobattoIIIAIIIB(2),
    "LobattoIIIAIIIB3": dvi.LobattoIIIAIIIB(3),
    "LobattoIIIAIIIB4": dvi.LobattoIIIAIIIB(4),
    "RungeKutta4": dvi.RungeKutta4(),
}
"""The methods of the package. Another one is one line."""

QUICK = ("TypeII", "Strang", "Yoshida4", "GaussLegendre2", "RungeKutta4")
"""One of each kind."""
