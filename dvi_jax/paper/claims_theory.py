"""What the paper claims of the theory, judged."""

import math

import numpy as np

from .experiments import Measurements
from .numbers import slope
from .verdicts import ROUND_OFF, Check, Claim, Verdict


def theory_claims(m: Measurements) -> list[Claim]:
    """The claims about the theory."""
    limits, ids, symmetries = m.limits, m.identities, m.symmetries
    mesh = m.variational_mesh

    def order(values):
        return slope(limits.hs, values)

    lattice_mended = Check(
        "exponent in h of the residual of the mended form", order(limits.lattice_mended), 0.8
    )
    return [
        Claim(
            "limit",
            "(12), (13)",
            "The discrete equations become Hamilton's, disturbed, as h → 0.",
            (Check("exponent in h of the error of one step", order(limits.local_error), 1.8, 2.2),),
            (),
            Verdict.HOLDS,
            "The map is consistent and of first order: one step errs by O(h²).",
        ),
        Claim(
            "variation",
            "(11)",
            "The variation of the action in t_k gives the lattice equation.",
            (
                Check("distance from the derivative of the action", limits.stationarity, 0, 1e-12),
                lattice_mended,
            ),
            (),
            Verdict.HOLDS,
            "(11) agrees with automatic differentiation of the action, signs and slots included.",
        ),
        Claim(
            "lattice-sign",
            "(5), (14)",
            "The lattice equation has −H_{D,k−1}.",
            (
                Check(
                    "exponent in h of the residual (per time) as printed",
                    order(limits.lattice_sign),
                    0.8,
                ),
            ),
            (lattice_mended,),
            Verdict.MENDED,
            "Two energies of one sign cannot cancel; the sign of (11), +H_{D,k−1}, is right.",
        ),
        Claim(
            "lattice-slot",
            "(5), (14)",
            "H_{D,k−1} is differentiated with respect to t_{k−1}.",
            (
                Check(
                    "exponent in h of the residual with ∂/∂t_{k−1}", order(limits.lattice_slot), 0.8
                ),
            ),
            (lattice_mended,),
            Verdict.MENDED,
            "On a driven oscillator only ∂/∂t_k, as in (11), leaves a residual that vanishes; "
            "for the paper's autonomous examples the two agree.",
        ),
        Claim(
            "lattice-real",
            "(14)",
            "Equation (14) defines the lattice on which the equations are discretised.",
            (Check("fewest steps until no real step solves it", float(min(mesh.steps)), math.inf),),
            (),
            Verdict.FAILS,
            "With this H_D of first order the (mended) energy equation for the Kepler problem "
            "loses its real root near an apsis: known of energy–momentum integrators.",
            (
                *(
                    Check(f"end time for h0 = {h:g}", float(t))
                    for h, t in zip(mesh.hs, mesh.times, strict=True)
                ),
            ),
        ),
        Claim(
            "determining",
            "(17), (40), (41)",
            "Rotation, with or without a shift of time, leaves the Kepler equations conformally "
            "invariant.",
            (
                Check("residual of (40)", symmetries.rotation, 0, ROUND_OFF),
                Check("residual of (41)", symmetries.clocked, 0, ROUND_OFF),
                Check(
                    "distance of (40) from what the search for symmetries finds",
                    m.discoveries.found_rotation,
                    0,
                    ROUND_OFF,
                ),
                Check("its held-out residual", m.discoveries.found_residual, 0, ROUND_OFF),
                Check("variational ones found", float(m.discoveries.variational), 2, 2),
            ),
            (),
            Verdict.HOLDS,
            "A constant matrix Λ with prX(F) = ΛF exists at points off the solutions too.",
        ),
        Claim(
            "factor-kepler",
            "(24), (46), (48)",
            "The conformal factor of the disturbed Kepler problem is the matrix (48).",
            (Check("distance of Λ from (48)", symmetries.kepler_off_printed, 0, ROUND_OFF),),
            (
                Check("distance from (1+ε) times it", symmetries.kepler_off_mended, 0, ROUND_OFF),
                Check("residual of (24)", symmetries.kepler_disturbed, 0, ROUND_OFF),
            ),
            Verdict.MENDED,
            "The generators (46) carry a factor 1+ε, and so does Λ.",
        ),
        Claim(
            "factor-oscillator",
            "(33)",
            "pr X̃ = (1+ε)q ∂/∂q at three points, with conformal factor 1.",
            (
                Check("residual of (24) as printed", symmetries.scaling_printed, 0, ROUND_OFF),
                Check(
                    "distance of the factor from 1",
                    abs(symmetries.scaling_factor - 1),
                    0,
                    ROUND_OFF,
                ),
            ),
            (
                Check("residual with η = (1+ε)p", symmetries.scaling_mended, 0, ROUND_OFF),
                Check(
                    "distance of the factor from 1+ε",
                    abs(symmetries.scaling_factor - 1 - symmetries.epsilon),
                    0,
                    ROUND_OFF,
                ),
            ),
            Verdict.MENDED,
            "The momenta have to be scaled with the positions; the factor is then 1+ε.",
        ),
        Claim(
            "identity-0",
            "(25), below (32)",
            "With the gauge −pq the identity of order 0 holds for the oscillator.",
            (
                Check(
                    "largest |N_0| relative to the energy",
                    ids.oscillator_0 / ids.scale_oscillator,
                    0,
                    ROUND_OFF,
                ),
            ),
            (),
            Verdict.HOLDS,
            "N_0 = p_{k+1}² − q_k² + D(−pq) vanishes on every solution of the map.",
        ),
        Claim(
            "eta-p",
            "(26)",
            "The invariant of a generator contains η·p.",
            (Check("distance of η·p from L for a rotation", ids.eta_p, 0, ROUND_OFF),),
            (Check("distance of ξ·p from L", ids.xi_p, 0, ROUND_OFF),),
            Verdict.MENDED,
            "For a rotation η·p is zero; ξ·p, as in (29), is the angular momentum.",
        ),
        Claim(
            "theorem-4",
            "(29), (31)",
            "D(I_z) = ε^{z+1} W·(ξ_z − Dq ξ0_z) on the solutions.",
            (Check(f"largest gap for (50), h = {ids.hs[0]:g}", float(ids.law_31[0]), 0, 1e-10),),
            (
                Check("largest gap of the full balance", float(np.max(ids.balance)), 0, 1e-11),
                Check(
                    "the same by noether_balance, every step, relative to the largest cause",
                    m.discoveries.balance,
                    0,
                    ROUND_OFF,
                ),
                Check("exponent in h of the gap", slope(ids.hs, ids.law_31), 0.8, 1.2),
            ),
            Verdict.MENDED,
            "True on the lattice of (14) when the identities hold; on any other mesh the "
            "residuals of the identities and of (14) have to be added, and the balance is exact.",
        ),
    ]
