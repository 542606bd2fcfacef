"""What the paper claims of the oscillator, judged."""

import numpy as np

from .experiments import Measurements
from .numbers import max_drift, relative_spread, spread
from .verdicts import ROUND_OFF, Check, Claim, Verdict


def oscillator_claims(m: Measurements) -> list[Claim]:
    """The claims about the oscillator."""
    mesh, cross, small, found = m.fixed_mesh, m.crossover, m.small_step, m.discoveries
    band = float(spread(mesh.mixed[0]))
    rk4_end = float(mesh.rk4[-1] - mesh.energy)
    rk4_largest = float(np.max(np.abs(mesh.rk4 - mesh.energy)))
    accuracy = relative_spread(mesh.printed)[1:]
    exact = relative_spread(mesh.exact)
    return [
        Claim(
            "energy-fig1",
            "Fig. 1",
            "The energy error of the variational method is about 1e-8 after 10 000 steps, "
            "relative error 1e-8.",
            (
                Check("range of (p_k² + q_{k−1}²)/2", band, 0, 5e-8),
                Check("relative to the energy", float(relative_spread(mesh.mixed[0])), 0, 5e-8),
            ),
            (),
            Verdict.FAILS,
            "On the fixed mesh the energy wiggles by O(h) of its value, without growing; an error "
            "near 1e-8 is what RK4 has at this length.",
            (
                Check("largest distance from the first value", float(max_drift(mesh.mixed[0]))),
                Check("RK4's largest error", rk4_largest),
            ),
        ),
        Claim(
            "exact-oscillator",
            "below (32)",
            "(p_k² + q_{k−1}²)/2 is an exact invariant of the undisturbed map.",
            (Check("its relative range", float(relative_spread(mesh.mixed[0])), 0, ROUND_OFF),),
            (Check("relative range of (p² + q² − hqp)/2", float(exact[0]), 0, ROUND_OFF),),
            Verdict.MENDED,
            "It has ξ0 = 1 and needs the lattice of (14); the map on a fixed mesh keeps "
            "(p² + q² − hqp)/2 to round-off.",
        ),
        Claim(
            "rk4-fig2",
            "Fig. 2",
            "Over 10 000 steps the variational method is more precise than RK4.",
            (Check("variational band over RK4's largest error", band / rk4_largest, 0, 1),),
            (),
            Verdict.FAILS,
            "At this length RK4's error is far smaller: it loses h⁶/72 of its energy per step.",
            (
                Check("RK4's energy error at the end", rk4_end),
                Check("loss per step", cross.loss),
                Check("h⁶/72", float(cross.loss_theory)),
            ),
        ),
        Claim(
            "rk4-long",
            "Fig. 2",
            "In the long run the variational method has the advantage in energy.",
            (
                Check("steps until RK4's error is the larger", float(cross.steps[0]), 0, 1e8),
                Check(
                    "largest gap to the predicted crossover, relative",
                    float(np.max(np.abs(cross.steps / cross.predicted - 1))),
                    0,
                    0.05,
                ),
                Check("relative range of what the map keeps", float(exact[0]), 0, ROUND_OFF),
            ),
            (),
            Verdict.HOLDS,
            "RK4's error grows without bound while the variational band stays; the crossover, run "
            "in full for four h, comes where a loss of h⁶/72 per step puts it.",
        ),
        Claim(
            "force-oscillator",
            "Section 5.1",
            "The disturbance is εW = εq.",
            (Check("distance of (13) from the display", m.symmetries.display_printed, 0, 1e-12),),
            (Check("with W = −q", m.symmetries.display_mended, 0, 1e-12),),
            Verdict.MENDED,
            "The force F = −εq and the equation displayed both mean W = −q.",
        ),
        Claim(
            "identity-1",
            "(28), (34)",
            "With the gauge −(1+ε)pq the identity of order 1 holds for the oscillator.",
            (
                Check(
                    "largest |N_1| relative to the energy",
                    m.identities.oscillator_1 / m.identities.scale_oscillator,
                    0,
                    ROUND_OFF,
                ),
                Check(
                    "what the best gauge of degree 4 leaves of it, relative",
                    float(found.gauge_34[1]),
                    0,
                    ROUND_OFF,
                ),
            ),
            (),
            Verdict.FAILS,
            "N_1 = q_k(p_{k+1} − q_k) + εq_k² on the solutions (rest at round-off), so (34) is no "
            "invariant of first order.",
            (
                Check(
                    "rest after q_k(p_{k+1} − q_k) + εq_k²",
                    m.identities.oscillator_1_rest / m.identities.scale_oscillator,
                ),
                Check("what it leaves at order 0", float(found.gauge_34[0])),
            ),
        ),
        Claim(
            "invariant-34",
            "(34)",
            "(1+ε)(p_k² + q_{k−1}²)/2 is an adiabatic invariant of first order.",
            (
                Check(
                    "exponent in ε of its drift as h → 0",
                    found.order_34,
                    1.8,
                ),
            ),
            (
                Check(
                    "relative range of (p² + (1+ε)q²)/2 as h → 0",
                    float(np.max(small.corrected)),
                    0,
                    1e-8,
                ),
                Check(
                    "relative range of (p² + (1+ε)q² − h(1+ε)qp)/2 at h = 0.1",
                    float(np.max(exact[1:])),
                    0,
                    ROUND_OFF,
                ),
                Check(
                    "distance of the one invariant that discovery finds from it",
                    found.oscillator_off,
                    0,
                    ROUND_OFF,
                ),
                Check("its held-out residual", found.oscillator_residual, 0, ROUND_OFF),
                Check("kept at ε = 0.5 and −0.3 too (1: yes)", found.oscillator_exact, 1),
            ),
            Verdict.MENDED,
            "The disturbance stiffens the spring: (1+ε) belongs before q² only. That form is kept "
            "as h → 0, and with −h(1+ε)qp the map itself keeps it, for every ε.",
        ),
        Claim(
            "accuracy-fig3",
            "Fig. 3",
            "The accuracy of (34) is almost the same for growing ε.",
            (
                Check(
                    f"relative range at ε = {mesh.epsilons[-1]:g} over that at "
                    f"{mesh.epsilons[1]:g}",
                    float(accuracy[-1] / accuracy[0]),
                    0.5,
                    2,
                ),
            ),
            (),
            Verdict.HOLDS,
            "But for a poor reason: the wiggle O(h) of the fixed mesh hides the drift O(ε).",
            (
                Check("relative range at the smallest ε", float(accuracy[0])),
                Check("at the largest", float(accuracy[-1])),
            ),
        ),
    ]
