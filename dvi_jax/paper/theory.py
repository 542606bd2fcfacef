"""Measurements on the theory: limits, the lattice equation, symmetries, identities, balance."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

from .kepler import CLOCKED_ROTATION, INVARIANT_50, ROTATION, gauge
from .oscillator import Tick

EPSILON = 0.01
"""Strength of the disturbance in the checks that need one value of it."""

STEP_SIZES = np.array([0.04, 0.02, 0.01, 0.005])


@dataclass(frozen=True)
class Limits:
    """What happens as h → 0: `hs` (H,), each other field (H,), largest over sampled starts.

    `local_error`: one step of (12)–(13) against the flow. On a driven oscillator, per unit of
    time: `lattice_mended`, residual of (14) with the signs of (11); `lattice_sign`, of (14) as
    printed; `lattice_slot`, with the sign mended and H_{D,k−1} still differentiated in t_{k−1}.
    `stationarity` (): largest difference between the mended form and the derivative of the
    action with respect to t_k, by autodiff.
    """

    hs: np.ndarray
    local_error: np.ndarray
    lattice_mended: np.ndarray
    lattice_sign: np.ndarray
    lattice_slot: np.ndarray
    stationarity: float


@dataclass(frozen=True)
class Symmetries:
    """Conformal factors, each a least-squares Λ over sampled points off the solutions.

    Residuals are relative (round-off: Λ exists). `kepler_off_printed`, `kepler_off_mended`:
    distance of the measured Λ from (48), and from (1+ε) times it. `scaling_printed`: residual
    with the generator (33) as printed; `scaling_mended`: with its momentum part;
    `scaling_factor`: the factor then. `display_*`: distance of the equation of motion
    displayed after (32) from (13) with W = q and with W = −q. `epsilon`: used throughout.
    """

    epsilon: float
    rotation: float
    clocked: float
    kepler_disturbed: float
    kepler_off_printed: float
    kepler_off_mended: float
    scaling_printed: float
    scaling_mended: float
    scaling_factor: float
    display_printed: float
    display_mended: float


@dataclass(frozen=True)
class Identities:
    """Noether's identities and the balance law along trajectories; largest absolute values.

    `oscillator_0`: N_0 with the gauge −pq at ε = 0; `oscillator_1`: N_1 of (34) at ε, and
    `oscillator_1_rest`: what is left of it after q_k(p_{k+1} − q_k) + εq_k². Kepler at `hs`:
    `kepler_1` (H,), N_1 of (50), and `kepler_1_rest` (H,), after −(h/2)|Dq|². `law_31` (H,):
    D I − ε²W·(ξ − Dq ξ0) for (50); `balance` (H,): the same with the causes that (31) leaves
    out. `rotation`: largest D I of (49). `eta_p`, `xi_p`: largest distance of η·p and ξ·p from
    the angular momentum.
    """

    epsilon: float
    oscillator_0: float
    oscillator_1: float
    oscillator_1_rest: float
    scale_oscillator: float
    hs: np.ndarray
    kepler_1: np.ndarray
    kepler_1_rest: np.ndarray
    law_31: np.ndarray
    balance: np.ndarray
    rotation: float
    eta_p: float
    xi_p: float


def limits(tick: Tick) -> Limits:
    """One-step error and the forms of the lattice equation as h → 0, from sampled starts."""
    problem = systems.kepler()
    orbit = dvi.integrate(
        problem.system,
        problem.q0,
        problem.p0,
        h=0.01,
        num_steps=4000,
        args=problem.args,
        method=dvi.Yoshida(4),
        save=dvi.Save(every=125),
    )
    tick(0.2)

    def flight(method, parts):
        def run(h, q, p):
            solution = dvi.integrate(
                problem.system,
                q,
                p,
                h=h / parts,
                num_steps=parts,
                epsilon=EPSILON,
                args=problem.args,
                method=method,
                save=dvi.Save(final=True),
            )
            return jnp.concatenate([solution.qs[-1], solution.ps[-1]])

        over_starts = jax.vmap(run, in_axes=(None, 0, 0))
        return jax.vmap(over_starts, in_axes=(0, None, None))(
            jnp.asarray(STEP_SIZES), orbit.qs, orbit.ps
        )

    gap = flight(dvi.TypeII(), 1) - flight(dvi.Yoshida(4), 32)
    tick(0.6)
    mended, sign, slot, stationarity = (np.asarray(x) for x in _lattice_forms())
    tick(1.0)
    return Limits(
        hs=STEP_SIZES,
        local_error=np.max(np.abs(np.asarray(gap)), axis=(1, 2)),
        lattice_mended=mended,
        lattice_sign=sign,
        lattice_slot=slot,
        stationarity=float(stationarity),
    )


@jax.jit
def _lattice_forms():
    """Residuals of the three forms of (14), (H,) each, and the largest gap to ∂S/∂t_k."""

    # The paper's examples are autonomous and cannot tell the slots of time apart: drive one.
    def driven(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + (1 + 0.3 * jnp.cos(t0)) * jnp.sum(q0**2) / 2

    system = dvi.System(driven, force=lambda t0, t1, q0, p1, args: -q0)
    free = dvi.System(driven)

    def H(t0, t1, q0, p1):
        return driven(t0, t1, q0, p1, None)

    def forms(h, start):
        solution = dvi.integrate(
            system,
            jnp.cos(start)[None],
            jnp.sin(2 * start)[None] + 0.5,
            t0=start,
            h=h,
            num_steps=2,
            epsilon=EPSILON,
        )
        points = [
            dvi.LatticePoint(*x) for x in zip(solution.ts, solution.qs, solution.ps, strict=True)
        ]
        (t_, q_, _), (t0, q0, p0), (t1, q1, p1) = points
        before, after = (t_, t0, q_, p0), (t0, t1, q0, p1)
        work = EPSILON * jnp.sum(-q0 * (q1 - q0))
        change = h * jax.grad(H, 0)(*after) - H(*after)
        sign = change + h * jax.grad(H, 0)(*before) - H(*before) + work
        slot = change + h * jax.grad(H, 0)(*before) + H(*before) + work

        def action(t):
            return (
                jnp.sum(p0 * (q0 - q_))
                - (t - t_) * H(t_, t, q_, p0)
                + jnp.sum(p1 * (q1 - q0))
                - (t1 - t) * H(t, t1, q0, p1)
            )

        still = jnp.zeros(())
        gap = jax.grad(action)(t0) / (t1 - t0) - dvi.lattice_defect(free, points, still)
        mended = dvi.lattice_defect(system, points, jnp.asarray(EPSILON))
        return jnp.abs(jnp.stack([mended, sign / h, slot / h, gap]))

    starts = jnp.linspace(0.0, 12.0, 48)
    each = jax.vmap(jax.vmap(forms, (None, 0)), (0, None))(jnp.asarray(STEP_SIZES), starts)
    mended, sign, slot, gap = jnp.moveaxis(jnp.max(each, axis=1), 1, 0)
    return mended, sign, slot, jnp.max(gap)


def symmetries(tick: Tick) -> Symmetries:
    """The conformal factors of the examples, from points off the solutions."""
    found = {k: float(v) for k, v in _conformal_factors().items()}
    tick(1.0)
    return Symmetries(epsilon=EPSILON, **found)


@jax.jit
def _conformal_factors():
    rng = np.random.default_rng(0)
    kepler, oscillator = systems.kepler(), systems.oscillator()

    def pairs(n):
        q, p = rng.uniform(0.5, 1.5, (2, 64, n)), rng.normal(size=(2, 64, n))
        t = rng.uniform(0, 10, 64)
        first = dvi.LatticePoint(jnp.asarray(t), jnp.asarray(q[0]), jnp.asarray(p[0]))
        return first, dvi.LatticePoint(jnp.asarray(t + 0.1), jnp.asarray(q[1]), jnp.asarray(p[1]))

    def kepler_factor(generators, epsilon):
        return dvi.conformal_factor(
            kepler.system, generators, *pairs(2), epsilon=jnp.asarray(epsilon), args=kepler.args
        )

    printed = jnp.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]])
    disturbed = kepler_factor([ROTATION, ROTATION], EPSILON)

    def scaling(eta):
        generator = dvi.Generator(xi=lambda t, q, p, args: q, eta=eta)
        return dvi.conformal_factor(
            oscillator.system, [generator, generator], *pairs(1), epsilon=jnp.asarray(EPSILON)
        )

    without, with_momenta = scaling(None), scaling(lambda t, q, p, args: p)

    def display(sign):
        """Distance of (p1 − p0)/h + q0 + εq0 = 0 from (13) with W = sign·q."""
        system = dvi.System(oscillator.system.H_D, force=lambda t0, t1, q0, p1, args: sign * q0)

        def gap(first, second):
            F_p = dvi.discrete_equations(system, first, second, jnp.asarray(EPSILON))[1]
            shown = (second.p - first.p) / (second.t - first.t) + (1 + EPSILON) * first.q
            return jnp.max(jnp.abs(F_p - shown))

        return jnp.max(jax.vmap(gap)(*pairs(1)))

    return {
        "rotation": kepler_factor(ROTATION, 0.0).residual,
        "clocked": kepler_factor(CLOCKED_ROTATION, 0.0).residual,
        "kepler_disturbed": disturbed.residual,
        "kepler_off_printed": jnp.max(jnp.abs(disturbed.factor - printed)),
        "kepler_off_mended": jnp.max(jnp.abs(disturbed.factor - (1 + EPSILON) * printed)),
        "scaling_printed": without.residual,
        "scaling_mended": with_momenta.residual,
        "scaling_factor": with_momenta.factor[0, 0],
        "display_printed": display(1.0),
        "display_mended": display(-1.0),
    }


def identities(tick: Tick) -> Identities:
    """Noether's identities and the balance of the invariants along trajectories."""
    kepler, oscillator = systems.kepler(), systems.oscillator()
    start = np.sum(np.square(oscillator.q0) + np.square(oscillator.p0)) / 2
    on_oscillator = {k: float(v) for k, v in _oscillator_identities().items()}
    tick(0.4)
    hs = np.array([0.1, 0.05, 0.02, 0.01])
    span = 20.0  # through the first two passages near the centre, where |Dq| is largest

    def orbit(h):
        return dvi.integrate(
            kepler.system,
            kepler.q0,
            kepler.p0,
            h=h,
            num_steps=round(span / h),
            epsilon=EPSILON,
            args=kepler.args,
            observe={"50": INVARIANT_50, "49": kepler.observables["angular_momentum"]},
        )

    runs, rows = [], []
    for i, h in enumerate(hs):
        run = orbit(h)
        runs.append(run)
        # As many triples at every h, evenly chosen: one compiled program for all of them.
        middle = np.linspace(1, round(span / h) - 1, 199).astype(int)
        triples = [dvi.LatticePoint(run.ts[k], run.qs[k], run.ps[k]) for k in (middle - 1, middle)]
        triples.append(dvi.LatticePoint(run.ts[middle + 1], run.qs[middle + 1], run.ps[middle + 1]))
        values = run.observed["50"]
        gain = (values[middle] - values[middle - 1]) / h
        rows.append({k: float(v) for k, v in _kepler_balance(triples, gain).items()})
        tick(0.4 + 0.6 * (i + 1) / len(hs))

    def column(name):
        return np.array([row[name] for row in rows])

    momentum = np.asarray(runs[0].observed["49"])
    q, p = np.asarray(runs[0].qs)[1:], np.asarray(runs[0].ps)[1:]
    eta_p = np.sum(np.stack([-p[:, 1], p[:, 0]], 1) * p, axis=1)
    xi_p = np.sum(np.stack([-q[:, 1], q[:, 0]], 1) * p, axis=1)
    return Identities(
        epsilon=EPSILON,
        **on_oscillator,
        scale_oscillator=float(start),
        hs=hs,
        kepler_1=column("identity"),
        kepler_1_rest=column("rest"),
        law_31=column("law_31"),
        balance=column("balance"),
        rotation=float(np.max(column("rotation"))),
        eta_p=float(np.max(np.abs(eta_p - momentum))),
        xi_p=float(np.max(np.abs(xi_p - momentum))),
    )


@jax.jit
def _oscillator_identities():
    problem = systems.oscillator()
    generator = dvi.Generator(
        xi0=lambda t, q, p, args: jnp.ones_like(t),
        xi=lambda t, q, p, args: q,
        eta=lambda t, q, p, args: p,
    )
    gauges = [lambda t, q, p, args: -jnp.sum(p * q)] * 2

    def pairs(epsilon):
        run = dvi.integrate(
            problem.system, problem.q0, problem.p0, h=problem.h, num_steps=500, epsilon=epsilon
        )
        points = dvi.LatticePoint(run.ts, run.qs, run.ps)
        return jax.tree.map(lambda x: x[:-1], points), jax.tree.map(lambda x: x[1:], points)

    def identity(order, epsilon):
        def one(first, second):
            return dvi.noether_identity(
                problem.system,
                [generator, generator],
                gauges,
                order,
                first,
                second,
                jnp.asarray(epsilon),
            )

        first, second = pairs(epsilon)
        q0, p1 = first.q[:, 0], second.p[:, 0]
        return jax.vmap(one)(first, second), q0 * (p1 - q0) + epsilon * q0**2

    order_0, _ = identity(0, 0.0)
    order_1, known = identity(1, EPSILON)
    return {
        "oscillator_0": jnp.max(jnp.abs(order_0)),
        "oscillator_1": jnp.max(jnp.abs(order_1)),
        "oscillator_1_rest": jnp.max(jnp.abs(order_1 - known)),
    }


@jax.jit
def _kepler_balance(triples, gain):
    r"""The identity N_1 of (50), its known part, (31), and the full balance law.

        D I = Σ_m ε^m N_m + ε² W·(ξ − Dq ξ0) − Σ_m ε^m ξ0 r

    with ξ0 = 1 in both orders; `gain` is D I.
    """
    problem = systems.kepler()
    series, gauges = [CLOCKED_ROTATION, CLOCKED_ROTATION], [None, gauge]
    epsilon = jnp.asarray(EPSILON)

    def one(before, here, after, gain):
        def identity(generators, gauges, order):
            return dvi.noether_identity(
                problem.system, generators, gauges, order, here, after, epsilon, problem.args
            )

        velocity = (after.q - here.q) / (after.t - here.t)
        zeroth, first = (identity(series, gauges, order) for order in (0, 1))
        _, xi, _ = CLOCKED_ROTATION(here, problem.args)
        work = EPSILON**2 * jnp.sum(-here.q * (xi - velocity))
        defect = dvi.lattice_defect(problem.system, (before, here, after), epsilon, problem.args)
        symmetry = zeroth + EPSILON * first
        turning = identity([ROTATION, ROTATION], [None, None], 1)
        return {
            "identity": first,
            "rest": first + (after.t - here.t) / 2 * jnp.sum(velocity**2),
            "law_31": gain - work,
            "balance": gain - symmetry - work + (1 + EPSILON) * defect,
            "rotation": turning,
        }

    before, here, after = triples
    each = jax.vmap(one)(before, here, after, gain)
    return jax.tree.map(lambda x: jnp.max(jnp.abs(x)), each)
