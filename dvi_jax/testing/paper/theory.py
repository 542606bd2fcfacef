"""Measurements on the theory: limits, the lattice equation, symmetries, identities, balance.

Each returns its numbers by the names that `claims.toml` has for them.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

from .kepler import CLOCKED_ROTATION, INVARIANT_50, ROTATION, gauge
from .numbers import Tick, largest, run, slope
from .oscillator import SCALING

EPSILON = 0.01
"""Strength of the perturbation in the checks with a single value."""

STEP_SIZES = np.array([0.04, 0.02, 0.01, 0.005])


def limits(tick: Tick) -> dict[str, float]:
    """Convergence as h → 0: exponents in h of the largest error over sampled starts.

    `local_error_exponent`: one step of (12)–(13) against the flow. On a driven oscillator, per unit
    of time: `lattice_corrected_exponent`, residual of (14) with the signs of (11);
    `lattice_sign_exponent`, of (14) as printed; `lattice_slot_exponent`, with the right sign but
    H_{D,k−1} still differentiated in t_{k−1}. `stationarity`: largest difference between the
    corrected form and the derivative of the action with respect to t_k, by autodiff.
    """
    problem = systems.kepler()
    orbit = run(problem, 0.01, 4000, method=dvi.Yoshida(4), save=dvi.Save(every=125))
    tick(0.2)

    def flight(method, parts):
        def end_of(h, q, p):
            start = dataclasses.replace(problem, q0=q, p0=p)
            options = {"epsilon": EPSILON, "method": method, "save": dvi.Save(final=True)}
            solution = run(start, h / parts, parts, **options)
            return jnp.concatenate([solution.qs[-1], solution.ps[-1]])

        over_starts = jax.vmap(end_of, in_axes=(None, 0, 0))
        sizes = jnp.asarray(STEP_SIZES)
        return jax.vmap(over_starts, in_axes=(0, None, None))(sizes, orbit.qs, orbit.ps)

    gap = np.abs(np.asarray(flight(dvi.TypeII(), 1) - flight(dvi.Yoshida(4), 32)))
    tick(0.6)
    right_form, sign, slot, stationarity = (np.asarray(x) for x in _lattice_forms())
    tick(1.0)
    return {
        "local_error_exponent": slope(STEP_SIZES, np.max(gap, axis=(1, 2))),
        "lattice_corrected_exponent": slope(STEP_SIZES, right_form),
        "lattice_sign_exponent": slope(STEP_SIZES, sign),
        "lattice_slot_exponent": slope(STEP_SIZES, slot),
        "stationarity": float(stationarity),
    }


@jax.jit
def _lattice_forms():
    """Residuals of the three forms of (14), (H,) each, and the largest gap to ∂S/∂t_k."""

    # In the autonomous examples of the paper derivatives by t0 and by t1 agree; this one is driven.
    def hamiltonian(t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + (1 + 0.3 * jnp.cos(t0)) * jnp.sum(q0**2) / 2

    system = dvi.System(hamiltonian, force=lambda t0, t1, q0, p1, args: -q0)
    free = dvi.System(hamiltonian)

    def H(t0, t1, q0, p1):
        return hamiltonian(t0, t1, q0, p1, None)

    def forms(h, start):
        q0, p0 = jnp.cos(start)[None], jnp.sin(2 * start)[None] + 0.5
        sol = dvi.integrate(system, q0, p0, t0=start, h=h, num_steps=2, epsilon=EPSILON)
        points = [dvi.LatticePoint(*x) for x in zip(sol.ts, sol.qs, sol.ps, strict=True)]
        (t_, q_, _), (t0, q0, p0), (t1, q1, p1) = points
        previous, interval = (t_, t0, q_, p0), (t0, t1, q0, p1)
        work = EPSILON * jnp.sum(-q0 * (q1 - q0))
        change = h * jax.grad(H, 0)(*interval) - H(*interval)
        sign = change + h * jax.grad(H, 0)(*previous) - H(*previous) + work
        slot = change + h * jax.grad(H, 0)(*previous) + H(*previous) + work

        def action(t):
            first = jnp.sum(p0 * (q0 - q_)) - (t - t_) * H(t_, t, q_, p0)
            return first + jnp.sum(p1 * (q1 - q0)) - (t1 - t) * H(t, t1, q0, p1)

        zero = jnp.zeros(())
        gap = jax.grad(action)(t0) / (t1 - t0) - dvi.lattice_defect(free, points, zero)
        right_form = dvi.lattice_defect(system, points, jnp.asarray(EPSILON))
        return jnp.abs(jnp.stack([right_form, sign / h, slot / h, gap]))

    starts = jnp.linspace(0.0, 12.0, 48)
    residuals = jax.vmap(jax.vmap(forms, (None, 0)), (0, None))(jnp.asarray(STEP_SIZES), starts)
    right_form, sign, slot, gap = jnp.moveaxis(jnp.max(residuals, axis=1), 1, 0)
    return right_form, sign, slot, jnp.max(gap)


def symmetries(tick: Tick) -> dict[str, float]:
    """Conformal factors of the examples, each a least-squares Λ over points off the solutions.

    Residuals are relative (round-off: Λ exists). `kepler_factor_off_…`: distance of the measured Λ
    from (48) as printed, and from (1+ε) times it. `scaling_…`: with the generator (33) as printed,
    and with its momentum part. `display_off_…`: distance of the equation of motion displayed after
    (32) from (13) with W = q (printed) and with W = −q (corrected).
    """
    numbers = {k: float(v) for k, v in _conformal_factors().items()}
    factor = numbers.pop("scaling_factor")
    tick(1.0)
    return numbers | {
        "scaling_factor_off_1": abs(factor - 1),
        "scaling_factor_off_corrected": abs(factor - 1 - EPSILON),
    }


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

    matrix = jnp.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]])
    factors = kepler_factor([ROTATION, ROTATION], EPSILON)

    def scaling(eta):
        generator = dvi.Generator(xi=lambda t, q, p, args: q, eta=eta)
        return dvi.conformal_factor(
            oscillator.system, [generator, generator], *pairs(1), epsilon=jnp.asarray(EPSILON)
        )

    positions_only, with_momenta = scaling(None), scaling(lambda t, q, p, args: p)

    def display(sign):
        """Distance of (p1 − p0)/h + q0 + εq0 = 0 from (13) with W = sign·q."""
        system = dvi.System(oscillator.system.H_D, force=lambda t0, t1, q0, p1, args: sign * q0)

        def gap(first, second):
            F_p = dvi.discrete_equations(system, first, second, jnp.asarray(EPSILON))[1]
            equation = (second.p - first.p) / (second.t - first.t) + (1 + EPSILON) * first.q
            return jnp.max(jnp.abs(F_p - equation))

        return jnp.max(jax.vmap(gap)(*pairs(1)))

    return {
        "rotation_residual": kepler_factor(ROTATION, 0.0).residual,
        "clocked_residual": kepler_factor(CLOCKED_ROTATION, 0.0).residual,
        "kepler_factor_residual": factors.residual,
        "kepler_factor_off_printed": jnp.max(jnp.abs(factors.factor - matrix)),
        "kepler_factor_off_corrected": jnp.max(jnp.abs(factors.factor - (1 + EPSILON) * matrix)),
        "scaling_residual_printed": positions_only.residual,
        "scaling_residual_corrected": with_momenta.residual,
        "scaling_factor": with_momenta.factor[0, 0],
        "display_off_printed": display(1.0),
        "display_off_corrected": display(-1.0),
    }


def identities(tick: Tick) -> dict[str, float]:
    """Noether's identities and the balance law along trajectories; largest absolute values.

    Oscillator, relative to its energy: `oscillator_identity_0`, N_0 with the gauge −pq at ε = 0;
    `…_1`, N_1 of (34) at ε, and `…_1_rest`, its difference from q_k(p_{k+1} − q_k) + εq_k².
    Kepler at h = 0.1: `kepler_identity_1`, N_1 of (50), and its exponent in h;
    `kepler_identity_rest`, after −(h/2)|Dq|², at all h. `law_31_gap`: D I − ε²W·(ξ − Dq ξ0) for
    (50), with its exponent in h; `balance_gap`, the same with the causes that (31) leaves out, at
    all h. `eta_p_off`, `xi_p_off`: largest distance of η·p and ξ·p from the angular momentum.
    """
    kepler = systems.kepler()
    oscillator = systems.oscillator()
    scale = float(np.sum(np.square(oscillator.q0) + np.square(oscillator.p0)) / 2)
    on_oscillator = {k: float(v) / scale for k, v in _oscillator_identities().items()}
    tick(0.4)
    hs = np.array([0.1, 0.05, 0.02, 0.01])
    span = 20.0  # through the first two passages near the centre, where |Dq| is largest
    observe = {"50": INVARIANT_50, "49": kepler.observables["angular_momentum"]}
    orbits, rows = [], []
    for i, h in enumerate(hs):
        orbit = run(kepler, h, round(span / h), epsilon=EPSILON, observe=observe)
        orbits.append(orbit)
        # As many triples at every h, evenly chosen: one compiled program for all of them.
        middle = np.linspace(1, round(span / h) - 1, 199).astype(int)
        places = middle - 1, middle, middle + 1
        triples = [dvi.LatticePoint(orbit.ts[k], orbit.qs[k], orbit.ps[k]) for k in places]
        values = orbit.observed["50"]
        gain = (values[middle] - values[middle - 1]) / h
        rows.append(_kepler_balance(triples, gain))
        tick(0.4 + 0.6 * (i + 1) / len(hs))
    column = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    momentum = np.asarray(orbits[0].observed["49"])[1:]
    q, p = np.asarray(orbits[0].qs)[1:], np.asarray(orbits[0].ps)[1:]

    def turned_times_p(v):
        return np.sum(np.stack([-v[:, 1], v[:, 0]], 1) * p, axis=1)

    return on_oscillator | {
        "kepler_identity_1": column["identity"][0],
        "kepler_identity_exponent": slope(hs, column["identity"]),
        "kepler_identity_rest": np.max(column["rest"]),
        "law_31_gap": column["law_31"][0],
        "law_31_smallest_gap": np.min(column["law_31"]),
        "law_31_exponent": slope(hs, column["law_31"]),
        "balance_gap": np.max(column["balance"]),
        "eta_p_off": largest(turned_times_p(p) - momentum),
        "xi_p_off": largest(turned_times_p(q) - momentum),
    }


@jax.jit
def _oscillator_identities():
    problem = systems.oscillator()
    gauges = [lambda t, q, p, args: -jnp.sum(p * q)] * 2

    def identity(order, epsilon):
        orbit = run(problem, problem.h, 500, epsilon=epsilon)
        points = dvi.LatticePoint(orbit.ts, orbit.qs, orbit.ps)
        first, second = (jax.tree.map(lambda x, k=k: x[k : 500 + k], points) for k in (0, 1))

        def of_pair(first, second):
            return dvi.noether_identity(
                problem.system, [SCALING] * 2, gauges, order, first, second, jnp.asarray(epsilon)
            )

        q0, p1 = first.q[:, 0], second.p[:, 0]
        return jax.vmap(of_pair)(first, second), q0 * (p1 - q0) + epsilon * q0**2

    order_0, _ = identity(0, 0.0)
    order_1, reference = identity(1, EPSILON)
    return {
        "oscillator_identity_0": jnp.max(jnp.abs(order_0)),
        "oscillator_identity_1": jnp.max(jnp.abs(order_1)),
        "oscillator_identity_1_rest": jnp.max(jnp.abs(order_1 - reference)),
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

    def terms(previous, current, second, gain):
        velocity = (second.q - current.q) / (second.t - current.t)
        place = current, second, epsilon, problem.args
        zeroth, first = (
            dvi.noether_identity(problem.system, series, gauges, order, *place) for order in (0, 1)
        )
        _, xi, _ = CLOCKED_ROTATION(current, problem.args)
        work = EPSILON**2 * jnp.sum(-current.q * (xi - velocity))
        points = previous, current, second
        defect = dvi.lattice_defect(problem.system, points, epsilon, problem.args)
        symmetry = zeroth + EPSILON * first
        return {
            "identity": first,
            "rest": first + (second.t - current.t) / 2 * jnp.sum(velocity**2),
            "law_31": gain - work,
            "balance": gain - symmetry - work + (1 + EPSILON) * defect,
        }

    previous, current, second = triples
    gaps = jax.vmap(terms)(previous, current, second, gain)
    return jax.tree.map(lambda x: jnp.max(jnp.abs(x)), gaps)
