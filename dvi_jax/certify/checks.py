"""Name → check: what is measured of every method, and what it is held to."""

from collections.abc import Callable
from dataclasses import dataclass

from . import derivatives, orders, programs, structure
from .candidate import Candidate
from .measured import Measured, not_measured


@dataclass(frozen=True)
class Check:
    """A check: its name, what it says in words, how it measures and how its numbers are shown."""

    name: str
    says: str
    measure: Callable[[Candidate], Measured]
    digits: str = ".0e"

    def __call__(self, candidate: Candidate) -> Measured:
        """What the check measures; an exception that the method raises is a failure."""
        try:
            return self.measure(candidate)
        except Exception as error:  # whatever a method of the user's raises
            said = str(error).strip().splitlines() or [""]
            return not_measured("no error", f"{type(error).__name__}: {said[0][:200]}")


_ALL = (
    Check(
        "order",
        "The r of log error = c + r log h + d h², by least squares through the six smallest of the "
        "steps h = 4/8 … 4/512 whose global errors at t = 4 are above 3e-13 (below is round-off), "
        "on the coupled problem without its force. Within 0.2 of the order claimed, from both "
        "sides.",
        orders.order,
        ".2f",
    ),
    Check(
        "forced-order",
        "The same with the force on.",
        orders.forced_order,
        ".2f",
    ),
    Check(
        "symplecticity",
        "max |MᵀJM − J|, M the Jacobian of one step by autodiff, h = 0.1, coupled problem without "
        "its force. At most 1e-12.",
        structure.symplecticity,
    ),
    Check(
        "reversal",
        "max |z − z0| after ten steps of h = 0.1 and ten of −h, coupled problem with its force. "
        "At most 1e-12.",
        structure.reversal,
    ),
    Check(
        "adjoint",
        "max |z − z0| after four steps of the method and four of its adjoint over −h, coupled "
        "problem with its force. At most 1e-12.",
        structure.adjoint,
    ),
    Check(
        "energy",
        "Drift of the energy, which is its slope times the length of the run, as a part of its "
        "swing, over 100 000 steps of h = 0.2 on the central problem. At most 0.05; a swing of "
        "less than 1e-10 of the energy counts as that much. Claimed by symplectic methods.",
        structure.energy,
    ),
    Check(
        "momentum",
        "Largest relative change of the angular momentum over the same run. At most 1e-12. Claimed "
        "by symplectic methods.",
        structure.momentum,
    ),
    Check(
        "gradient",
        "Worst relative difference of the reverse-mode gradient from a central difference "
        "quotient, over q0, p0, t0, h, ε and args; four steps of the coupled problem with its "
        "force. At most 1e-6.",
        derivatives.differences,
    ),
    Check(
        "modes",
        "Worst relative difference of a derivative by `Direct`, `Checkpointed` and `Reversible` "
        "from that by forward mode. At most 1e-10.",
        derivatives.modes,
    ),
    Check(
        "jit",
        "Relative difference of a step under jit from the same step op by op, central problem "
        "with its force. At most 1e-14.",
        programs.jit_equals_eager,
    ),
    Check(
        "vmap",
        "Relative difference of four lanes under vmap, different in every input, from the four run "
        "one by one; coupled problem with its force. At most 1e-12.",
        programs.vmap_equals_loop,
    ),
    Check(
        "failure",
        "The same with a lane that overflows: it must have the status of a failure and be NaN, and "
        "its neighbours be what they are alone, to 1e-12.",
        programs.failed_lane,
    ),
    Check(
        "traces",
        "Further traces of the run when q0, p0, t0, h, ε and args change and the method is made "
        "anew. None.",
        programs.retraces,
        ".0f",
    ),
)

CHECKS: dict[str, Check] = {check.name: check for check in _ALL}

GROUPS: dict[str, tuple[str, ...]] = {
    "Order and structure": ("order", "forced-order", "symplecticity", "reversal", "adjoint"),
    "Long runs and derivatives": ("energy", "momentum", "gradient", "modes"),
    "Programs": ("jit", "vmap", "failure", "traces"),
}
"""The checks as tables show them together."""
