"""Random runs of the systems of the library: method, output, end and noise, by plain steps.

The steps solve the equations that the docstrings of the methods print, by Newton iterations of a
fixed number in plain JAX; they take only the functions of the user from the package.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from scipy.optimize import brentq

import dvi_jax as dvi
from dvi_jax.base.signature import accepts

from .kinds import LENGTHS, Kind, Random, outputs, pick, put

SIZES = dict.fromkeys(("fput", "thermal_chain", "toda", "chain", "stiff_fput"), (3,))
SIZES |= dict.fromkeys(("sine_gordon", "phi4", "klein_gordon", "lennard_jones"), (4,))
"""Sizes of chains and lattices, which take less time with few particles."""

PARTS = {
    "TypeII()": [("euler", 1.0)],
    "Adjoint(dvi.TypeII())": [("adjoint", 1.0)],
    "GaussLegendre(1)": [("gauss1", 1.0)],
    "GaussLegendre(2)": [("gauss2", 1.0)],
    "RungeKutta4()": [("rk4", 1.0)],
    **{name: [(kind, c / 2) for c in lengths for kind in ("euler", "adjoint")]
       for name, lengths in LENGTHS.items()},
}  # fmt: skip
"""Method → kinds and lengths of the parts of its step."""
RATTLE = {
    "Rattle()": [("rattle", 1.0)],
    "Yoshida(4, base=dvi.Rattle())": [
        ("rattle", c / 2) for c in LENGTHS["Yoshida(4)"] for _ in range(2)
    ],
}
NOISY = {
    "StochasticEuler()": [("euler", 1.0)],
    "StochasticMidpoint()": [("gauss1", 1.0)],
    "BAOAB()": [("euler", 0.5), ("kick", 1.0), ("adjoint", 0.5)],
    "OBABO()": [("kick", 0.5), ("euler", 0.5), ("adjoint", 0.5), ("kick", 0.5)],
}

ROOT = np.sqrt(3) / 6
TABLEAUX = {
    "gauss1": ([[0.5]], [1.0], [0.5]),
    "gauss2": ([[0.25, 0.25 - ROOT], [0.25 + ROOT, 0.25]], [0.5, 0.5], [0.5 - ROOT, 0.5 + ROOT]),
}


def newton(residual: Callable, guess: Any) -> Any:
    def better(_, x):
        return x - jnp.linalg.solve(jax.jacfwd(residual)(x), residual(x))

    return lax.fori_loop(0, 7, better, guess)


def sigma(t, q, p, args):
    """A noise of the momenta that depends on the time and the position."""
    return 0.05 * (1.0 + 0.5 * jnp.cos(q + t))


def step_of(system: Any, parts: list, is_thermal: bool) -> Callable:
    """The function (t, h, q, p, ε, args, z) → (q, p) of one step."""

    def advance(t, h, q, p, epsilon, args, z):
        shape, n = q.shape, q.size

        def amplitude(t, q):
            """Friction and amplitude of the noise."""
            if is_thermal:
                return args["friction"], jnp.sqrt(2 * args["friction"] * args["temperature"])
            return 0.0, sigma(t, q, None, args) if system.noise is not None else 0.0

        def slopes(t0, t1, q, p):
            """∂H/∂p and −∂H/∂q + εW + noise."""
            scale = epsilon if system.slow_time else 1.0

            def energy(q, p):
                H = system.H_D(scale * t0, scale * t1, q, p, args)
                more = system.perturbation
                return H if more is None else H + epsilon * more(scale * t0, scale * t1, q, p, args)

            at_q, at_p = jax.grad(energy, (0, 1))(q, p)
            force = -at_q
            if system.force is not None:
                force = force + epsilon * system.force(scale * t0, scale * t1, q, p, args)
            if "kick" not in [kind for kind, _ in parts] and system.noise is not None:
                friction, size = amplitude(t0, q)
                force = force - friction * p + size * z[0] / jnp.sqrt(h)
            return at_p, force

        def flat(function):
            return lambda x, *more: function(x.reshape(shape), *more).ravel()

        def euler(t, h, q, p):
            root = newton(
                flat(lambda p1: p1 - p - h * slopes(t, t + h, q, p1)[1]), p.ravel()
            ).reshape(shape)
            return q + h * slopes(t, t + h, q, root)[0], root

        def adjoint(t, h, q, p):
            root = newton(
                flat(lambda q1: q1 - q - h * slopes(t + h, t, q1, p)[0]), q.ravel()
            ).reshape(shape)
            return root, p + h * slopes(t + h, t, root, p)[1]

        def rates(t, z):
            q, p = z.reshape(2, *shape)
            return jnp.stack(slopes(t, t, q, p)).ravel()

        def gauss(kind, t, h, q, p):
            A, b, c = map(np.array, TABLEAUX[kind])
            z = jnp.stack([q, p]).ravel()

            def stages(K):
                K = K.reshape(len(c), -1)
                return jnp.stack([rates(t + c[i] * h, z + h * A[i] @ K) for i in range(len(c))])

            guess = jnp.tile(rates(t, z), len(c))
            K = newton(lambda K: K - stages(K).ravel(), guess).reshape(len(c), -1)
            return tuple((z + h * b @ K).reshape(2, *shape))

        def rk4(t, h, q, p):
            z = jnp.stack([q, p]).ravel()
            k1 = rates(t, z)
            k2 = rates(t + h / 2, z + h / 2 * k1)
            k3 = rates(t + h / 2, z + h / 2 * k2)
            k4 = rates(t + h, z + h * k3)
            return tuple((z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)).reshape(2, *shape))

        def rattle(t, h, q, p):
            g = lambda q: system.constraint(q, args)  # noqa: E731
            G, m = lambda q: jax.jacfwd(g)(q).reshape(-1, n), g(q).size
            middle = t + h / 2

            def halves(x):
                of_m, half, q1 = x[:m], *x[m:].reshape(2, *shape)
                v0, force = slopes(t, middle, q, half)
                v1, _ = slopes(t + h, middle, q1, half)
                p_half = p + h / 2 * force - (G(q).T @ of_m).reshape(shape)
                return of_m, half, q1, p_half, q + h / 2 * (v0 + v1)

            def defects(x):
                _, half, q1, right_p, right_q = halves(x)
                pieces = g(right_q) / h, half - right_p, q1 - right_q
                return jnp.concatenate([y.ravel() for y in pieces])

            first = q + h * slopes(t, t, q, p)[0]
            guess = jnp.concatenate([jnp.zeros(m), p.ravel(), first.ravel()])
            _, half, q1, *_ = halves(newton(defects, guess))
            p1 = half + h / 2 * slopes(t + h, middle, q1, half)[1]
            push = lambda x: p1 - (G(q1).T @ x).reshape(shape)  # noqa: E731
            across = lambda x: G(q1) @ slopes(t + h, t + h, q1, push(x))[0].ravel()  # noqa: E731
            return q1, push(newton(across, jnp.zeros(m)))

        kinds = {"euler": euler, "adjoint": adjoint, "rk4": rk4, "rattle": rattle}
        elapsed, kicks = 0.0, 0
        for kind, c in parts:
            if kind == "kick":  # the exact part of friction and noise, in the middle of its time
                place = t + (0.5 if c == 1 else 0.25 + 0.5 * kicks) * h
                friction, size = amplitude(place, q)
                if is_thermal:
                    p = jnp.exp(-friction * c * h) * p
                    size = jnp.sqrt(args["temperature"] * -jnp.expm1(-2 * friction * c * h))
                else:
                    size = size * jnp.sqrt(c * h)
                p, kicks = p + size * z[kicks], kicks + 1
                continue
            begin = t + elapsed * h
            q, p = (gauss(kind, begin, c * h, q, p) if kind in TABLEAUX
                    else kinds[kind](begin, c * h, q, p))  # fmt: skip
            elapsed += c
        return q, p

    return jax.jit(advance)


REDUCED = {
    "MaxDrift": lambda x: np.max(np.abs(x - x[0]), axis=0),
    "Mean": lambda x: np.mean(x, axis=0),
    "Range": lambda x: np.ptp(x, axis=0),
    "Last": lambda x: x[-1],
}
"""Name of a reduction → its result from the values at the initial state and after each step."""

ENDS = {
    "t": lambda t, q, p, a: t - a["c"],
    "far": lambda t, q, p, a: jnp.ravel(q)[0] - a["c"],
    "near": lambda t, q, p, a: a["c"] - jnp.ravel(q)[0],
}


def problem_of(name: str, is_thermal: bool) -> Any:
    sizes = SIZES.get(name, ())
    thermal = {"temperature": 0.4, "friction": 0.5} if is_thermal else {}
    return getattr(dvi.systems, name)(*sizes, **thermal)


def library(random: Random) -> Kind:
    # A gradient of ten bodies takes minutes to compile.
    name = pick(random, *(x for x in dvi.systems.LIBRARY if "solar_system" not in x))
    has_noise = bool(random.integers(4) == 0)
    is_thermal = has_noise and name in ("double_well", "thermal_chain")
    problem = problem_of(name, is_thermal)
    system, steps = problem.system, 9
    has_noise &= system.constraint is None
    table = RATTLE if system.constraint else NOISY if has_noise else PARTS
    method = pick(random, *table)
    if has_noise and not is_thermal:
        system = dvi.System(
            system.H_D, system.force, system.perturbation, system.slow_time, 0.0, sigma
        )
    adjoint = pick(random, None, dvi.Checkpointed(), dvi.Direct())
    saved = pick(random, "every", "final", "ts") if not has_noise else "every"
    every, end = pick(random, 1, 3), pick(random, None, None, *ENDS) if not has_noise else None
    of_state = [f for f in problem.observables.values() if accepts(f, 4)]
    observable = pick(random, *of_state, lambda t, q, p, a: jnp.stack([q.sum() + t, p.sum()]))
    reduction = pick(random, None, *REDUCED)
    observed = observable if reduction is None else getattr(dvi, reduction)(observable)
    args = {} if problem.args is None else dict(problem.args)
    advance = step_of(system, table[method], is_thermal)
    count = sum(kind == "kick" for kind, _ in table[method]) or 1

    def args_of(s):
        return {key: s["args " + key] for key in args}

    def run(s, form="auto"):
        save = {"every": dvi.Save(every=every), "final": dvi.Save(final=True),
                "ts": dvi.Save(ts=s["parts"] * s["h"] * steps)}[saved]  # fmt: skip
        stop = None if end is None else dvi.Stop(ENDS[end])
        sol = dvi.integrate(
            system, s["q"], s["p"], h=s["h"], num_steps=steps, epsilon=s["epsilon"], save=save,
            args={**args_of(s), "c": s["c"]}, method=eval(f"dvi.{method}", {"dvi": dvi}),
            observe=observed, stop=stop, adjoint=adjoint, throw=False,
            path=dvi.Brownian(s["key"]) if has_noise else None, layout=dvi.Layout(form=form),
        )  # fmt: skip
        more = {} if end is None else {"t": sol.stop.t, "q": sol.stop.q, "p": sol.stop.p}
        return outputs(sol, observed=sol.observed, **more)

    @jax.jit
    def normals(key):
        one = lambda k: jax.random.normal(jax.random.fold_in(key, k), problem.q0.shape)  # noqa: E731
        numbers = jax.vmap(one)(jnp.arange(count * steps))
        return numbers.reshape(steps, count, *problem.q0.shape)

    values_of = jax.jit(
        lambda t, q, p, a, epsilon: (
            observable.bind(system, epsilon) if hasattr(observable, "bind") else observable
        )(t, q, p, a)
    )

    def loop(s):
        a, h, z = args_of(s), s["h"], np.asarray(normals(s["key"]))

        def move(t, h, q, p, k=0):
            return map(np.asarray, advance(t, h, q, p, s["epsilon"], a, z[k]))

        def g(t, q, p):
            return -1.0 if end is None else float(ENDS[end](t, q, p, {"c": s["c"]}))

        states, point = [(0.0, s["q"], s["p"])], None
        if g(*states[0]) >= 0:
            point = states[0]
        for k in range(steps):
            if point is not None:
                break
            t, q, p = k * h, *states[-1][1:]

            def inside(part, t=t, q=q, p=p, k=k):
                return t + part * h, *move(t, part * h, q, p, k)

            if g(*inside(1.0)) >= 0:
                point = inside(brentq(lambda part: g(*inside(part)), 0, 1, xtol=1e-15))
            else:
                states.append(inside(1.0))
        return results(s, states, point, move)

    def results(s, states, point, move):
        h, shape = s["h"], s["q"].shape

        def value(t, q, p):
            return np.asarray(values_of(t, q, p, args_of(s), s["epsilon"]))

        nothing = np.nan, np.full(shape, np.nan), np.full(shape, np.nan)
        rows = [*states, *[nothing] * (steps + 1 - len(states))]
        if saved == "ts":
            rows = []
            for time in s["parts"] * h * steps:
                k = int(time / h)
                is_after = k >= len(states) - 1 and len(states) <= steps
                t, q, p = states[min(k, len(states) - 1)]
                rows.append(nothing if is_after else (time, *move(t, time - t, q, p)))
        elif saved == "final":
            rows = [rows[0], rows[-1]]
        else:
            rows = rows[::every]
        _, qs, ps = (np.array(x) for x in zip(*rows, strict=True))
        if reduction is None:
            observed = np.array([value(*row) for row in rows])
        else:
            observed = REDUCED[reduction](np.array([value(*row) for row in states]))
        t, q, p = nothing if point is None else point
        more = {} if end is None else {"t": t, "q": q, "p": p}
        result = {"status": point is None, "stopped": point is not None, **more}
        return {**result, "qs": qs, "ps": ps, "observed": observed}

    def draw(random):
        q, p, h = (np.asarray(x, float) for x in (problem.q0, problem.p0, problem.h))
        wide = 0.0 if system.constraint else 0.02
        q, p = (x * (1 + wide * random.uniform(-1, 1, x.shape)) for x in (q, p))
        more = {f"args {key}": np.asarray(x, float) for key, x in args.items()}
        first = q.flat[0] + random.uniform(-0.05, 0.05) * np.abs(q).max()
        c = steps * h * random.uniform(0.2, 1.3) if end == "t" else first
        return {
            "q": q, "p": p, "h": h * random.uniform(0.5, 1.0), "c": np.array(c), **more,
            "epsilon": np.array(random.uniform(0.0, 0.1)), "parts": random.uniform(0.01, 0.99, 4),
            "key": random.integers(0, 2**32, 2, dtype=np.uint32),
        }  # fmt: skip

    invalid = [put("q", np.nan, (0,) * np.ndim(problem.q0)), put("h", np.nan)]
    invalid += [put("p", np.inf, (0,) * np.ndim(problem.q0))]
    invalid += [put(f"args {key}", np.nan) for key in args]
    invalid += [put("c", np.nan)] * (end is not None)
    shared = ("h",) if system.constraint else ("h", *(f"args {key}" for key in args))
    own = () if system.constraint else ("q", "p")
    text = (f"library {name}: {method}, {saved} {every}, observe "
            f"{getattr(observable, '__name__', 'sum')} {reduction}, stop {end}, {adjoint}, "
            f"noise {has_noise} {is_thermal}")  # fmt: skip
    return Kind(text, run, loop, draw, invalid, shared, own, 1e-9)
