"""Hamiltonians that are sums of parts with simpler flows."""

from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from ..base.checks import instance, whole
from ..base.signature import check_takes
from ..base.types import Args, HamiltonianFn, Scalar, State
from .discretise import refuse_step_from_times
from .flows import Flow, Known


class Split(eqx.Module):
    r"""The discrete Hamiltonian H = H_1 + H_2 + …, for methods that compose the flows of its parts.

    Give it to `System`: the default method is then `Splitting`, which needs no solve where all
    flows are known. Other methods use the sum.

    **Arguments**

    - `parts`: functions ``(t0, t1, q0, p1, args)`` → scalar [energy], or objects of `dvi.flows`
      such as ``flows.Kepler()``. The flow of a part that depends on p1 alone or on q0 alone is its
      map (12)–(13). That of others is computed by a Gauss–Legendre method of the same order.
    - `flows`: for each part None or a function ``(h, q, p, args)`` → (q, p), its flow.
    - `perturbed`: number of the part to which the perturbing force and the perturbation of the
      `System` belong; its flow is then computed with them. None: they are the last part.

    The first part carries the time: the others are evaluated at fixed times within a step.

    **Raises** `TypeError` for parts that are not functions of these arguments, `ValueError` for
    fewer than two parts, another number of flows, a perturbed part with a known flow, and parts
    that compute the step as t1 − t0.

    **Source** McLachlan & Quispel 2002, *Acta Numerica* 11, 341.
    """

    parts: tuple[HamiltonianFn, ...]
    perturbed: int | None = eqx.field(static=True)

    def __init__(
        self, parts: Sequence[HamiltonianFn], flows: Any = None, perturbed: int | None = None
    ):
        parts = list(instance("parts of Split", parts, Iterable, "a list of functions"))
        if len(parts) < 2:
            raise ValueError(f"parts of Split must be two or more functions, got {len(parts)}.")
        all_flows = [None] * len(parts) if flows is None else list(flows)
        if len(all_flows) != len(parts):
            raise ValueError(
                f"flows of Split must have one entry, a function or None, for each of the "
                f"{len(parts)} parts, got {len(all_flows)}."
            )
        for i, (H, flow) in enumerate(zip(parts, all_flows, strict=True)):
            check_takes(f"part {i} of Split", H, "(t0, t1, q0, p1, args)")
            refuse_step_from_times(f"part {i} of Split", H)
            parts[i] = H if flow is None else Known(H, flow)
        if perturbed is not None:
            whole("perturbed", perturbed, 0, len(parts) - 1, hint="It is the number of a part.")
            if isinstance(parts[perturbed], Flow):
                raise ValueError(
                    f"perturbed={perturbed} must be a part of Split without a known flow, which "
                    "does not contain the perturbation."
                )
        self.parts, self.perturbed = tuple(parts), perturbed

    def __call__(self, t0: Scalar, t1: Scalar, q0: State, p1: State, args: Args) -> Scalar:
        """The sum of the parts at (t0, t1, q0, p1)."""
        return sum((jnp.asarray(H(t0, t1, q0, p1, args)) for H in self.parts), jnp.zeros(()))
