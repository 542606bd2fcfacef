"""What the paper claims of the Kepler problem, judged."""

import numpy as np

from .experiments import Measurements
from .numbers import relative_spread, slope
from .verdicts import ROUND_OFF, Check, Claim, Verdict


def kepler_claims(m: Measurements) -> list[Claim]:
    """The claims about the Kepler problem."""
    sweep, small, runs, found = m.mesh_sweep, m.small_step_sweep, m.long_runs, m.discoveries
    rk4, variational = runs["RK4"], runs["variational (order 1)"]

    def largest(run):
        return float(np.max(np.abs(run.energy_errors)))

    attracting, repelling = (
        small.exponent(small.beyond_zero(drifts)) for drifts in (small.attracting, small.repelling)
    )
    at_01, at_001 = (float(sweep.spread_50[list(sweep.hs).index(h), 0]) for h in (0.1, 0.01))
    wiggle = slope(sweep.hs, sweep.spread_50[:, 0])
    return [
        Claim(
            "attraction",
            "(35), (37)",
            "The potential energy is +K²/r.",
            (
                Check(
                    "largest distance in t = 200, as printed",
                    float(max(m.repulsion.printed)),
                    0,
                    10,
                ),
            ),
            (Check("with −K²/r", float(max(m.repulsion.mended)), 0, 10),),
            Verdict.MENDED,
            "+K²/r repels and the body escapes; the equations after (45) attract.",
        ),
        Claim(
            "momentum",
            "(42)",
            "The angular momentum is an exact invariant.",
            (
                Check(
                    "largest relative range, all h",
                    float(np.max(sweep.relative_49[:, 0])),
                    0,
                    1e-13,
                ),
            ),
            (),
            Verdict.HOLDS,
            "ξ0 = 0: a symmetry of H_D that does not move time is kept on any mesh.",
        ),
        Claim(
            "constant-43",
            "(43)",
            "Angular momentum less energy, L − H_{k−1}, is constant.",
            (Check("range at h = 0.1", at_01, 0, 1e-10),),
            (
                Check("exponent in h of the range", wiggle, 0.8, 1.2),
                Check("range at h = 0.01", at_001, 0, 0.01),
            ),
            Verdict.MENDED,
            "ξ0 = 1 needs the lattice of (14): on a fixed mesh it wiggles by O(h), so it is "
            "constant as h → 0.",
        ),
        Claim(
            "rk4-fig4",
            "Fig. 4a",
            "RK4 shows artificial dissipation: its loop gains a width.",
            (
                Check("largest relative energy error after 1e5 steps", largest(rk4), 1e-4),
                Check("error in all of the run over that in half", _growth(rk4), 1.8, 2.2),
            ),
            (),
            Verdict.HOLDS,
            "The error grows in proportion to time, in energy and in angular momentum.",
            (
                Check("angular momentum error", float(np.max(np.abs(rk4.momentum_errors)))),
                Check("width of the loop at the apocentre", rk4.width),
            ),
        ),
        Claim(
            "structure-fig4",
            "Fig. 4b, Section 6",
            "The variational method preserves the structure.",
            (
                Check(
                    "angular momentum error after 1e5 steps",
                    float(np.max(np.abs(variational.momentum_errors))),
                    0,
                    1e-12,
                ),
                Check(
                    "energy error in all of the run over that in half",
                    _growth(variational),
                    0.9,
                    1.1,
                ),
            ),
            (),
            Verdict.HOLDS,
            "Angular momentum is kept to round-off and the energy error is bounded.",
        ),
        Claim(
            "curves-fig4",
            "Fig. 4b",
            "The variational orbits are overlapping closed curves, unlike those of RK4.",
            (Check("width of the loop over that of RK4", variational.width / rk4.width, 0, 1),),
            (),
            Verdict.FAILS,
            "At h = 0.1 the ellipse of the first-order map turns by much more per revolution than "
            "RK4's, so that the loop is the wider one.",
            (
                Check("turn per revolution [rad]", variational.turn),
                Check("RK4's", rk4.turn),
            ),
        ),
        Claim(
            "energy-fig4",
            "Fig. 4",
            "The variational method is the more accurate one (energy, 1e5 steps).",
            (
                Check(
                    "its largest relative energy error over RK4's",
                    largest(variational) / largest(rk4),
                    0,
                    1,
                ),
            ),
            (
                Check(
                    "the same for the order-4 composition",
                    largest(runs["variational (order 4, Yoshida)"]) / largest(rk4),
                    0,
                    1,
                ),
            ),
            Verdict.MENDED,
            "Bounded does not mean small: the first-order map errs more. Its composition of "
            "order 4 is ahead of RK4; of order 2 it is not yet, at this length.",
            (
                Check("order 1", largest(variational)),
                Check("order 2", largest(runs["variational (order 2, Strang)"])),
                Check("RK4", largest(rk4)),
            ),
        ),
        Claim(
            "force-kepler",
            "(45)",
            "The disturbance enters as −εW with W = −q, a force +εq.",
            (Check("exponent in ε of the drift of (50) under +εq", repelling, 1.8),),
            (Check("under −εq", attracting, 1.8),),
            Verdict.MENDED,
            "(13) has +εW; the invariant (50) belongs to the force −εq (between ε = 1e-4 and "
            "2e-4; h → 0; drift beyond that of ε = 0).",
        ),
        Claim(
            "invariant-49",
            "(49)",
            "(1+ε)L is an adiabatic invariant of first order.",
            (
                Check(
                    "largest relative range, all ε and h",
                    float(np.max(sweep.relative_49)),
                    0,
                    1e-13,
                ),
                Check("invariants that discovery finds with 1/r", float(found.kepler_count), 1, 1),
                Check("held-out residual", found.kepler_residual, 0, ROUND_OFF),
                Check("kept at ε = 0.5 and −0.3 too (1: yes)", found.kepler_exact, 1),
            ),
            (),
            Verdict.HOLDS,
            "It is even exact: the force −εq has no torque.",
        ),
        Claim(
            "gauge-50",
            "(28), (50)",
            "With the gauge −ε|q|²/2 the identity of order 1 holds.",
            (
                Check("largest |N_1| at h = 0.1", float(m.identities.kepler_1[0]), 0, 1e-10),
                Check(
                    "what the best gauge of degree 4 leaves of it, relative",
                    float(found.gauge_50[0]),
                    0,
                    ROUND_OFF,
                ),
            ),
            (
                Check(
                    "exponent in h of |N_1|",
                    slope(m.identities.hs, m.identities.kepler_1),
                    0.8,
                    1.2,
                ),
                Check(
                    "rest after −(h/2)|Dq|²", float(np.max(m.identities.kepler_1_rest)), 0, 1e-11
                ),
                Check(
                    "exponent in h of what the best gauge leaves",
                    slope(found.hs, found.gauge_50),
                    0.8,
                    1.2,
                ),
            ),
            Verdict.MENDED,
            "q_k·Dq is D(|q|²/2) − (h/2)|Dq|²: the product rule of differences leaves O(h).",
        ),
        Claim(
            "invariant-50",
            "(50)",
            "(1+ε)(L − H_{k−1}) − ε|q|²/2 is an adiabatic invariant of first order.",
            (
                Check(
                    "exponent in ε of its range at h = 0.1",
                    slope(sweep.epsilons[1:], sweep.spread_50[0, 1:]),
                    1.8,
                ),
            ),
            (Check("as h → 0, from ε = 1e-4 to 2e-4", attracting, 1.8),),
            Verdict.MENDED,
            "On the fixed mesh the wiggle O(h) drowns the drift; without it the drift is O(ε²). "
            "With ξ0 = 1, as (47) has it, (1+ε)L − H − ε|q|²/2 does not drift at all.",
            (
                Check(
                    "the same without taking off the drift at ε = 0",
                    small.exponent(small.attracting[1:]),
                ),
                Check(
                    "largest drift of (1+ε)L − H − ε|q|²/2 beyond that at ε = 0",
                    float(np.max(small.beyond_zero(small.literal))),
                ),
            ),
        ),
        Claim(
            "constant-fig5",
            "Fig. 5",
            "(50) is almost constant for different ε.",
            (
                Check(
                    "relative range at h = 0.1, ε ≤ 0.01",
                    float(np.max(relative_spread(sweep.values_50[:-1]))),
                    0,
                    1e-3,
                ),
            ),
            (Check("exponent in h of the range", wiggle, 0.8, 1.2),),
            Verdict.MENDED,
            "It wiggles by O(h), much the same for every ε, because the mesh is fixed; the wiggle "
            "shrinks in proportion to h.",
            (Check("range at ε = 0", at_01),),
        ),
    ]


def _growth(run) -> float:
    """Largest energy error in all of the run over that in its first half."""
    return run.error_at(1.0) / run.error_at(0.5)
