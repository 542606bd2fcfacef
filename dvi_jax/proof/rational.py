"""`ExactInvariant`: an invariant whose coefficients are rational functions of h."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..base.printing import printable
from ..base.types import Scalar, State
from ..discover.functions.basis import BoundBasis


@printable
class ExactInvariant(eqx.Module):
    r"""An invariant Σ_m ε^m Σ_j c_mj φ_j(q, p, t) with exact c = (n_0 + n_1 h + n_2 h²)/d.

    - `basis`: φ. `numbers`: the integers (d, n_0, n_1, n_2), shape (order + 1, functions, 4).

    Give it to `bound_drift`, which proves that it is conserved exactly, or a bound of its change.
    """

    basis: BoundBasis
    numbers: np.ndarray = eqx.field(converter=np.asarray)

    def evaluate(self, q: State, p: State, epsilon: Any, h: Any, t: Any = 0.0) -> Scalar:
        """The value at a point, a scalar."""
        values, total = self.basis(q, p, t), jnp.zeros(())
        for m, row in enumerate(self.numbers):
            for j in np.flatnonzero(row[:, 1:].any(axis=1)):
                d, *n = (float(x) for x in row[j])
                total = total + epsilon**m * (n[0] + n[1] * h + n[2] * h * h) * values[j] / d
        return total

    def __str__(self) -> str:
        parts = []
        for m, row in enumerate(self.numbers):
            for name, (d, *n) in zip(self.basis.names, row, strict=True):
                powers = ["", "h", "h²"]
                terms = [f"{int(k)} {x}".strip() for k, x in zip(n, powers, strict=True) if k]
                if terms:
                    text = " + ".join(terms)
                    text = f"({text})" if len(terms) > 1 else text
                    parts.append(f"{text}{f'/{int(d)}' if d > 1 else ''} {'ε ' * m}{name}")
        return " + ".join(parts).replace("+ -", "− ").replace("-", "−")
