"""The paper's numbered equations: what each says, the code that implements it, what is mended."""

import importlib
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Equation:
    """One numbered equation.

    `number`; `what` it says; `code`: dotted names of what implements it; `note`: how the print
    differs from what is right, empty where it does not.
    """

    number: int
    what: str
    code: tuple[str, ...]
    note: str = ""


_STEP = ("dvi_jax._step.step", "dvi_jax.TypeII")
_LATTICE = ("dvi_jax.lattice_defect", "dvi_jax.outgoing_energy", "dvi_jax.incoming_energy")
_KEPLER = "dvi_jax.systems.kepler"
_SCALING_NOTE = "W is printed as q; the force −εq of the text, and the equation shown, need W = −q."
_SIGN_NOTE = "+K²/r is a repulsion; the equations after (45) attract. −K²/r is used."

EQUATIONS = (
    Equation(1, "q̇ = ∂H/∂p", ("dvi_jax.discretise",)),
    Equation(2, "ṗ = −∂H/∂q", ("dvi_jax.discretise",)),
    Equation(
        3, "discrete equation for q, undisturbed", ("dvi_jax._step.Equations.position_rate", *_STEP)
    ),
    Equation(
        4, "discrete equation for p, undisturbed", ("dvi_jax._step.Equations.momentum_rate", *_STEP)
    ),
    Equation(
        5,
        "lattice (energy) equation, undisturbed",
        _LATTICE,
        "The second energy has the wrong sign, and H_{D,k−1} is differentiated in t_{k−1}; (11) "
        "has both right: E⁺_k − E⁻_k = 0.",
    ),
    Equation(6, "action sum Σ p_{k+1}·(q_{k+1} − q_k) − h H_D", ("dvi_jax.noether_identity",)),
    Equation(7, "disturbed variational principle", ("dvi_jax.System", *_STEP)),
    Equation(8, "displacement δq = Δq − Dq Δt", ("dvi_jax.noether_identity",)),
    Equation(9, "the terms of the action at one point", (_LATTICE[0],)),
    Equation(10, "variation of the action", _STEP),
    Equation(11, "variation of the action, in full", (*_STEP, *_LATTICE)),
    Equation(12, "q1 = q0 + h ∂H_D/∂p1", ("dvi_jax._step.Equations.position_rate", *_STEP)),
    Equation(13, "p1 = p0 − h ∂H_D/∂q0 + h εW", ("dvi_jax._step.Equations.momentum_rate", *_STEP)),
    Equation(
        14,
        "lattice (energy) equation, disturbed",
        _LATTICE,
        "As in (5). Mended: E⁺_k − E⁻_k = εW_k·(q_{k+1} − q_k).",
    ),
    Equation(15, "prolonged generator", ("dvi_jax.prolong", "dvi_jax.Generator")),
    Equation(16, "left sides F of the discrete equations", ("dvi_jax.discrete_equations",)),
    Equation(
        17,
        "determining equation prX(F) = ΛF",
        ("dvi_jax.determining_residual", "dvi_jax.conformal_factor"),
    ),
    Equation(18, "series of ξ0 in ε", ("dvi_jax.Generator", "dvi_jax.prolong")),
    Equation(19, "series of ξ in ε", ("dvi_jax.Generator", "dvi_jax.prolong")),
    Equation(20, "series of η in ε", ("dvi_jax.Generator", "dvi_jax.prolong")),
    Equation(21, "prolongation of the series", ("dvi_jax.prolong",), "A sum over m is meant."),
    Equation(22, "prolongation of order m", ("dvi_jax.prolong",)),
    Equation(23, "left sides F̃ of the disturbed equations", ("dvi_jax.discrete_equations",)),
    Equation(
        24,
        "determining equation of the disturbed system",
        ("dvi_jax.determining_residual", "dvi_jax.conformal_factor"),
    ),
    Equation(25, "Noether's identity, undisturbed (m = 0)", ("dvi_jax.noether_identity",)),
    Equation(
        26,
        "exact invariant",
        ("dvi_jax.AdiabaticInvariant", "dvi_jax.incoming_energy"),
        "Prints η·p; (29) has it right: ξ·p. Constant on the lattice of (14), or as h → 0.",
    ),
    Equation(27, "what an adiabatic invariant of order z is", ("dvi_jax.AdiabaticInvariant",)),
    Equation(28, "Noether's identity of order m", ("dvi_jax.noether_identity",)),
    Equation(
        29,
        "adiabatic invariant of order z",
        ("dvi_jax.AdiabaticInvariant", "dvi_jax.incoming_energy"),
    ),
    Equation(30, "series of the gauge in ε", ("dvi_jax.AdiabaticInvariant",)),
    Equation(
        31,
        "D(I_z) = ε^{z+1} W·(ξ_z − Dq ξ0_z)",
        (
            "dvi_jax.AdiabaticInvariant",
            "dvi_jax.noether_identity",
            "dvi_jax.lattice_defect",
            "dvi_jax.paper.theory.identities",
        ),
        "Needs (14) and all identities to hold. On any mesh the identities' residuals "
        "Σ ε^m N_m are added and the lattice's defect Σ ε^m ξ0_m r is subtracted.",
    ),
    Equation(32, "oscillator: F", ("dvi_jax.systems.oscillator",), _SCALING_NOTE),
    Equation(
        33,
        "oscillator: prolonged generator",
        ("dvi_jax.prolong", "dvi_jax.paper.theory.symmetries"),
        "The momentum components (1+ε)p are missing; with them the factor is 1+ε, not 1.",
    ),
    Equation(
        34,
        "oscillator: adiabatic invariant",
        (
            "dvi_jax.systems.oscillator",
            "dvi_jax.paper.oscillator.FixedMesh",
            "dvi_jax.paper.oscillator.SmallStep",
        ),
        "Drifts at first order. As h → 0 (p² + (1+ε)q²)/2 is kept; "
        "the map itself keeps (p² + (1+ε)q² − h(1+ε)qp)/2.",
    ),
    Equation(35, "Kepler: Lagrangian", (_KEPLER,), _SIGN_NOTE),
    Equation(36, "Kepler: momenta and Legendre transform", (_KEPLER, "dvi_jax.discretise")),
    Equation(37, "Kepler: H_D", ("dvi_jax.systems.kepler.hamiltonian",), _SIGN_NOTE),
    Equation(38, "Kepler: equation for q", (_KEPLER, *_STEP)),
    Equation(39, "Kepler: equation for p", (_KEPLER, *_STEP)),
    Equation(40, "Kepler: rotation", ("dvi_jax.paper.kepler.ROTATION",)),
    Equation(41, "Kepler: rotation with time shift", ("dvi_jax.paper.kepler.CLOCKED_ROTATION",)),
    Equation(42, "Kepler: angular momentum", ("dvi_jax.paper.kepler.INVARIANT_49",)),
    Equation(
        43,
        "Kepler: angular momentum less energy",
        ("dvi_jax.paper.kepler.INVARIANT_50",),
        "ξ0 = 1: on a fixed mesh it wiggles by O(h).",
    ),
    Equation(44, "disturbed Kepler: equation for q", (_KEPLER, *_STEP)),
    Equation(
        45,
        "disturbed Kepler: equation for p",
        (_KEPLER, *_STEP),
        "−εW contradicts (13), and the display after it; +εW with W = −q is used.",
    ),
    Equation(46, "disturbed Kepler: rotation", ("dvi_jax.paper.kepler.ROTATION",)),
    Equation(
        47,
        "disturbed Kepler: rotation with time shift",
        ("dvi_jax.paper.kepler.CLOCKED_ROTATION",),
        "ξ0 = 1 here, but (50) puts 1+ε before the energy.",
    ),
    Equation(
        48,
        "disturbed Kepler: conformal factor",
        ("dvi_jax.conformal_factor", "dvi_jax.paper.theory.symmetries"),
        "The matrix shown has to be multiplied by 1+ε.",
    ),
    Equation(49, "adiabatic invariant of (46)", ("dvi_jax.paper.kepler.INVARIANT_49",)),
    Equation(
        50,
        "adiabatic invariant of (47)",
        ("dvi_jax.paper.kepler.INVARIANT_50", "dvi_jax.paper.kepler.SmallStepSweep"),
        "Of first order as h → 0 with the force −εq only; with ξ0 = 1 as (47) has it, "
        "(1+ε)L − H − ε|q|²/2, it is even exact there.",
    ),
)
"""All fifty, in order."""


def resolve(name: str) -> Any:
    """The object that a dotted name stands for.

    **Raises** `ModuleNotFoundError` or `AttributeError` when there is none.
    """
    parts = name.split(".")
    for cut in range(len(parts), 0, -1):
        module = ".".join(parts[:cut])
        try:
            found = importlib.import_module(module)
        except ModuleNotFoundError as error:
            # Only the name asked for may be missing; an import that fails inside it may not.
            if cut == 1 or error.name is None or not module.startswith(error.name):
                raise
            continue
        for part in parts[cut:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)
