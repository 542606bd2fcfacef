"""From a continuous Hamiltonian to a discrete one."""

import inspect
from collections.abc import Callable
from typing import Any

import equinox as eqx

from ._types import Args, HamiltonianFn, Scalar, State


class _LeftRule(eqx.Module):
    H: Callable[..., Any]

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        del t1
        return self.H(t0, q0, p1, args)


def discretise(H: Callable[..., Any], order: int = 1) -> HamiltonianFn:
    """The discrete Hamiltonian of a continuous one, by the paper's rule.

        H_D(t0, t1, q0, p1) = H(t0, q0, p1)

    The map (12)–(13) that it defines is of first order and symplectic (symplectic Euler
    when H is separable); `Strang` and `Yoshida` raise the order by composition.

    **Arguments**

    - `H`: function ``(t, q, p, args)`` → scalar [energy].
    - `order`: order of the generating function in h. Only 1, the paper's rule, exists.

    **Returns** a function ``(t0, t1, q0, p1, args)`` → scalar [energy], for `System`.

    **Raises** `TypeError` for a function that does not take the four arguments,
    `ValueError` for any other order.

    **Source** the paper, (36)–(37) and the text before (32).
    """
    if not callable(H):
        raise TypeError(f"H must be a function (t, q, p, args), got {H!r}.")
    try:
        signature = inspect.signature(H)
    except (TypeError, ValueError):
        signature = None
    if signature is not None:
        try:
            signature.bind(*range(4))
        except TypeError as error:
            raise TypeError(
                "H must take four positional arguments (t, q, p, args); "
                f"{getattr(H, '__name__', type(H).__name__)}{signature} does not: {error}."
                + (
                    " A discrete Hamiltonian H_D(t0, t1, q0, p1, args) needs no discretise: give "
                    "it to dvi.System directly."
                    if len(signature.parameters) == 5
                    else ""
                )
            ) from None
    if order != 1:
        raise ValueError(
            f"discretise knows order 1 (the paper's rule), got order={order!r}. For a higher order "
            "compose the map: method=dvi.Strang() (order 2) or dvi.Yoshida(4)."
        )
    return _LeftRule(H)
