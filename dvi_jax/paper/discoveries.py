"""The paper's invariants, gauges and orders as the package's own tools find them."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

from .kepler import CLOCKED_ROTATION, ROTATION, gauge
from .oscillator import Tick

SCALING = dvi.Generator(
    xi0=lambda t, q, p, args: jnp.ones_like(t),
    xi=lambda t, q, p, args: q,
    eta=lambda t, q, p, args: p,
)
"""The generator of (34) in both orders: a scaling with a shift of time, (33) mended."""


@dataclass(frozen=True)
class Discoveries:
    """What discovery, gauge solving and drift measurement say; nothing of it is put in by hand.

    Oscillator, h = 0.1, disturbed by −εq. `oscillator`: the invariant of order 1 that is found
    in quadratics, as text; `oscillator_off`: distance of its coefficients from those of
    (p² + (1+ε)q² − h(1+ε)qp)/2; `oscillator_residual`: held-out; `oscillator_exact`: 1 when it is
    kept at any ε. `gauge_34` (2,): what the best gauges in polynomials of degree 4 leave of the
    identities of order 0 and 1 for (34), relative. `order_34`: exponent in ε of the drift of
    (1+ε)(p² + q²)/2 as h → 0.

    Kepler with −εq, in polynomials of degree 3 and 1/r: `kepler`, `kepler_residual`,
    `kepler_exact` likewise, `kepler_count` invariants found, at h = 0.1. `hs` (H,) and
    `gauge_50` (H,): what the best gauge of degree 4 leaves of the identity of order 1 for (50).
    `balance`: largest gap of the balance law of (50) over 200 steps, relative to its causes.

    Of the undisturbed Kepler equations, in polynomials of degree 1: `symmetries`, how many are
    found, `variational`, how many of them, and `found_rotation`, distance of (40) from their
    span; `found_residual`, of the determining equations, held-out.
    """

    oscillator: str
    oscillator_off: float
    oscillator_residual: float
    oscillator_exact: float
    gauge_34: np.ndarray
    order_34: float
    kepler: str
    kepler_count: int
    kepler_residual: float
    kepler_exact: float
    hs: np.ndarray
    gauge_50: np.ndarray
    balance: float
    symmetries: int
    variational: int
    found_rotation: float
    found_residual: float


def discoveries(tick: Tick) -> Discoveries:
    """All of them."""
    spring, h = systems.oscillator(), 0.1
    rng = np.random.default_rng(0)
    line = tuple(rng.uniform(-1, 1, (2, 200, 1)))
    quadratics = dvi.Polynomials(2)
    found = dvi.discover_invariants(spring.system, quadratics, 1, h=h, samples=line)
    names = list(found.basis.names)
    exact = np.zeros((2, len(names)))
    exact[:, names.index("q²")], exact[:, names.index("q p")] = 0.5, -h / 2
    exact[0, names.index("p²")] = 0.5
    off = np.max(np.abs(np.asarray(found.coefficients[0]) - exact)) if found.count == 1 else np.inf
    tick(0.2)
    gauges = dvi.solve_gauge(
        spring.system, [SCALING, SCALING], dvi.Polynomials(4), h=h, samples=line
    )
    tick(0.3)
    printed = np.zeros((2, len(names)))
    printed[:, names.index("q²")] = printed[:, names.index("p²")] = 0.5
    order = dvi.drift_order(
        spring.system,
        dvi.InvariantSeries(found.basis, jnp.asarray(printed)),
        spring.q0,
        spring.p0,
        epsilons=[1e-4, 2e-4, 1e-3, 1e-2, 1e-1],
        h=0.01,
        num_steps=20_000,
        method=dvi.Yoshida(4),
    )
    tick(0.5)
    kepler = systems.kepler()
    ring = _ring(rng, 400)
    kept = dvi.discover_invariants(
        kepler.system,
        dvi.Polynomials(3) + dvi.Radial(),
        1,
        h=h,
        samples=ring,
        args=kepler.args,
    )
    tick(0.8)
    hs = np.array([0.1, 0.05, 0.025])
    clocked = [
        dvi.solve_gauge(
            kepler.system,
            [CLOCKED_ROTATION, CLOCKED_ROTATION],
            dvi.Polynomials(4),
            h=float(step),
            samples=ring,
            args=kepler.args,
        ).residuals[1]
        for step in hs
    ]
    tick(0.95)
    found_symmetries = dvi.find_symmetries(
        kepler.system, dvi.Polynomials(1, constant=True), h=h, samples=ring, args=kepler.args
    )
    orbit = dvi.integrate(
        kepler.system, kepler.q0, kepler.p0, h=h, num_steps=200, epsilon=0.01, args=kepler.args
    )
    causes = dvi.noether_balance(
        kepler.system,
        [CLOCKED_ROTATION, CLOCKED_ROTATION],
        [None, gauge],
        orbit,
        epsilon=0.01,
        args=kepler.args,
    )
    largest = max(
        float(jnp.max(jnp.abs(c))) for c in (causes.symmetry, causes.work, causes.lattice)
    )
    tick(1.0)
    return Discoveries(
        oscillator=str(found.invariants[0]) if found.count else "",
        oscillator_off=float(off),
        oscillator_residual=float(np.max(found.residuals, initial=0.0)),
        oscillator_exact=float(all(found.exact) and found.count == 1),
        gauge_34=gauges.residuals,
        order_34=order.slope,
        kepler=str(kept.invariants[0]) if kept.count else "",
        kepler_count=kept.count,
        kepler_residual=float(np.max(kept.residuals, initial=0.0)),
        kepler_exact=float(all(kept.exact) and kept.count == 1),
        hs=hs,
        gauge_50=np.array(clocked),
        symmetries=found_symmetries.count,
        variational=len(found_symmetries.variational),
        found_rotation=_outside(found_symmetries, ring),
        found_residual=max((float(np.max(s.residuals)) for s in found_symmetries), default=np.inf),
        balance=float(jnp.max(jnp.abs(causes.defect))) / largest,
    )


def _ring(rng, count):
    """Positions at 0.8 < r < 2, momenta below 1 in size in each component: (qs, ps)."""
    angle, r = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.8, 2.0, count)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], 1), rng.uniform(-1, 1, (count, 2))


def _outside(found: dvi.Symmetries, samples) -> float:
    """How far the rotation (40) is outside of the span of what was found, relative."""

    def at_samples(generator):
        def one(q, p):
            return jnp.concatenate(
                [jnp.ravel(x) for x in generator(dvi.LatticePoint(jnp.zeros(()), q, p))]
            )

        return np.asarray(jax.vmap(one)(*samples)).ravel()

    wanted = at_samples(ROTATION)
    if not found.count:
        return np.inf
    columns = np.stack([at_samples(s.generators[0]) for s in found], axis=1)
    rest = wanted - columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.linalg.norm(rest) / np.linalg.norm(wanted))
