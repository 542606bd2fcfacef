"""Speed of other packages and this one relative to hand-written C, on one thread.

    pip install "dvi-jax[peers]"; python benchmarks/peers.py [--peers PATTERN] [--out DIR]

Three tasks, unperturbed (ε = 0): a batch of Kepler orbits, one Kepler orbit, a batch of implicit
chains of two masses. Peers that can run the map (12)–(13) take the same steps (diffrax's
SemiImplicitEuler for Kepler, numba). The others cover the same time with fixed steps of the same
size, or with steps to a tolerance, as printed. Their ratio is for the same time, not for equal
accuracy; for that see work_precision.py.

A peer is timed only after it has agreed with C over one unit of time in steps of 0.001: to 1e-12
if it runs the same map, else to FIRST_ORDER times the step, which is the error of the map itself.
Packages that are not installed are left out, and named. Exit status 1 if one
disagrees or fails.
"""

import argparse
import fnmatch
import functools
import importlib.metadata
import json
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from _baseline import Baseline
from _workloads import WORKLOADS, A, B, C, Workload
from speed import Clock, batched, last_state, pin, processor, ratio, say

SAME_MAP, FIRST_ORDER = 1e-12, 2.0
FINE_STEP, FINE_STEPS, FINE_LANES = 1e-3, 1000, 8
RELATIVE_TOLERANCE = 1e-9
"""Relative tolerance of adaptive peers."""


class Work(NamedTuple):
    """A run: a workload, its initial state (n, lanes) or (n,), the step, the number of steps."""

    w: Workload
    q0: np.ndarray
    p0: np.ndarray
    h: float
    steps: int

    @property
    def span(self) -> float:
        return self.h * self.steps


Call = Callable[[], tuple[Any, Any]]
"""Runs a peer: q and p at the end, shaped like the start."""

TASKS: dict[str, tuple[str, int | None, int]] = {
    "kepler, 1024 lanes": ("kepler", 1024, 1000),
    "one kepler": ("kepler", None, 10_000),
    "implicit chain, n = 2, 1024 lanes": ("chain2", 1024, 500),
}
"""Title: workload, lanes (None: one trajectory), steps."""


def chain_field(q, p):
    """dH/dq and dH/dp of the chain, for two rows of lanes."""
    w = q * p
    force = lambda d: d + C * d**3  # noqa: E731
    ends = np.stack([force(q[0]), force(q[1] - q[0]), force(-q[1])])
    coupling = A * w + B * w[::-1]
    return p * coupling + ends[:-1] - ends[1:], p + q * coupling


def kepler_field(q, p):
    """dH/dq and dH/dp of Kepler's problem."""
    return q / np.sum(q**2, axis=0) ** 1.5, p


FIELDS = {"kepler": kepler_field, "chain2": chain_field}


# Each peer: Work → Call. An import that fails leaves it out.


def run_dvi_jax(work: Work) -> Call:
    """This package."""
    one = last_state(work.w._replace(h=work.h), work.steps, epsilon=0.0)
    f = jax.jit(batched(one) if work.q0.ndim == 2 else one)
    start = jnp.asarray(work.q0), jnp.asarray(work.p0)
    return lambda: jax.block_until_ready(f(*start))[:2]


def run_diffrax(work: Work) -> Call:
    """SemiImplicitEuler, which is the map of Kepler with p stepped first; ImplicitEuler else."""
    import diffrax
    import optimistix

    w = work.w

    def H(q, p):
        return w.system.H_D(0.0, 0.0, q, p, w.args)

    of_q, of_p = jax.grad(H, 0), jax.grad(H, 1)
    if w.is_explicit:
        terms: Any = (
            diffrax.ODETerm(lambda t, q, args: -of_q(q, jnp.zeros_like(q))),
            diffrax.ODETerm(lambda t, p, args: of_p(jnp.ones_like(p), p)),
        )
        solver: Any = diffrax.SemiImplicitEuler()
        pack, unpack = (lambda q, p: (p, q)), (lambda y: (y[1], y[0]))
    else:
        terms = diffrax.ODETerm(lambda t, y, args: (of_p(*y), -of_q(*y)))
        solver = diffrax.ImplicitEuler(root_finder=optimistix.Newton(rtol=1e-8, atol=1e-8))
        pack, unpack = (lambda q, p: (q, p)), (lambda y: y)

    def one(q0, p0):
        sol = diffrax.diffeqsolve(
            terms,
            solver,
            0.0,
            work.span,
            work.h,
            pack(q0, p0),
            stepsize_controller=diffrax.ConstantStepSize(),
            saveat=diffrax.SaveAt(t1=True),
            max_steps=work.steps + 8,
        )
        q, p = unpack(sol.ys)
        return q[-1], p[-1]

    f = jax.jit(batched(one) if work.q0.ndim == 2 else one)
    start = jnp.asarray(work.q0), jnp.asarray(work.p0)
    return lambda: jax.block_until_ready(f(*start))


@functools.cache
def _numba_kernels() -> dict[str, Any]:
    import numba

    @numba.njit(fastmath=True)
    def kepler(q0, p0, h, steps):
        q, p = q0.copy(), p0.copy()
        for lane in range(q.shape[1]):
            x, y, u, v = q[0, lane], q[1, lane], p[0, lane], p[1, lane]
            for _ in range(steps):
                square = x * x + y * y
                pull = h / (square * np.sqrt(square))
                u -= pull * x
                v -= pull * y
                x += h * u
                y += h * v
            q[0, lane], q[1, lane], p[0, lane], p[1, lane] = x, y, u, v
        return q, p

    @numba.njit(fastmath=True)
    def chain(q0, p0, h, steps):
        q, p = q0.copy(), p0.copy()
        for lane in range(q.shape[1]):
            x, y, u, v = q[0, lane], q[1, lane], p[0, lane], p[1, lane]
            for _ in range(steps):
                d = y - x
                between = d + C * d * d * d
                known0 = u - h * (x + C * x * x * x - between)
                known1 = v - h * (between + y + C * y * y * y)
                u0, v0 = u, v
                u = known0 - h * u0 * (A * x * u0 + B * y * v0)
                v = known1 - h * v0 * (A * y * v0 + B * x * u0)
                for _ in range(2):
                    s0, s1 = A * x * u + B * y * v, A * y * v + B * x * u
                    F0, F1 = u - known0 + h * u * s0, v - known1 + h * v * s1
                    a, b = 1 + h * (s0 + A * x * u), h * u * B * y
                    c, e = h * v * B * x, 1 + h * (s1 + A * y * v)
                    inverse = 1 / (a * e - b * c)
                    u, v = u - (e * F0 - b * F1) * inverse, v - (a * F1 - c * F0) * inverse
                s0, s1 = A * x * u + B * y * v, A * y * v + B * x * u
                x, y = x + h * (u + x * s0), y + h * (v + y * s1)
            q[0, lane], q[1, lane], p[0, lane], p[1, lane] = x, y, u, v
        return q, p

    return {"kepler": kepler, "chain2": chain}


def run_numba(work: Work) -> Call:
    """The map written out for one lane after the other; two Newton iterations for the chain."""
    kernel = _numba_kernels()[work.w.kernel]
    q0, p0 = (np.ascontiguousarray(x.reshape(2, -1)) for x in (work.q0, work.p0))
    shape = work.q0.shape

    def call():
        q, p = kernel(q0, p0, work.h, work.steps)
        return q.reshape(shape), p.reshape(shape)

    return call


def run_rebound(work: Work, integrator: str) -> Call:
    """A massless body around one of unit mass, in a compiled simulation."""
    import rebound

    def call():
        simulation = rebound.Simulation()
        simulation.add(m=1.0)
        (x, y), (vx, vy) = work.q0, work.p0
        simulation.add(m=0.0, x=x, y=y, vx=vx, vy=vy)
        simulation.integrator = integrator
        simulation.dt = work.h
        simulation.steps(work.steps)
        if integrator == "whfast":
            simulation.synchronize()
        body = simulation.particles[1]
        return np.array([body.x, body.y]), np.array([body.vx, body.vy])

    return call


def run_heyoka(work: Work) -> Call:
    """Taylor's method of its own order and steps, to round-off; a lane after the other, or one."""
    import heyoka

    x, y, u, v = heyoka.make_vars("x", "y", "u", "v")
    if work.w.kernel == "kepler":
        H = (u**2 + v**2) / 2.0 - (x**2 + y**2) ** -0.5
    else:
        a, b, d = x * u, y * v, y - x
        H = (u**2 + v**2 + A * (a**2 + b**2)) / 2.0 + B * a * b
        for stretch in (x, d, y):
            H = H + stretch**2 / 2.0 + C / 4.0 * stretch**4
    field = [
        (x, heyoka.diff(H, u)),
        (y, heyoka.diff(H, v)),
        (u, -heyoka.diff(H, x)),
        (v, -heyoka.diff(H, y)),
    ]
    start = np.concatenate([work.q0.reshape(2, -1), work.p0.reshape(2, -1)])
    end = np.empty_like(start)
    shape = work.q0.shape
    if shape == (2,):
        one = heyoka.taylor_adaptive(field, [0.0] * 4)

        def call():
            one.time = 0.0
            one.state[:] = start[:, 0]
            one.propagate_until(work.span)
            return one.state[:2].copy(), one.state[2:].copy()

        return call
    width = int(heyoka.recommended_simd_size())
    if shape[1] % width:
        raise ValueError(f"{shape[1]} lanes are no multiple of heyoka's {width}.")
    several = heyoka.taylor_adaptive_batch(field, np.zeros((4, width)))

    def call_batch():
        for first in range(0, shape[1], width):
            several.set_time(0.0)
            several.state[:] = start[:, first : first + width]
            several.propagate_until(work.span)
            end[:, first : first + width] = several.state
        return end[:2].copy(), end[2:].copy()

    return call_batch


def run_pyhamsys(work: Work) -> Call:
    """Strang's splitting of a separable H, on arrays; the extended phase space (BM4) for others."""
    import pyhamsys

    shape, span = work.q0.shape, (0.0, work.span)
    ends = np.array(span)
    start = np.concatenate([work.q0.ravel(), work.p0.ravel()])
    field = FIELDS[work.w.kernel]

    def halves(y):
        q, p = np.split(y, 2)
        return q.reshape(shape), p.reshape(shape)

    def result(sol):
        return halves(sol.y[..., -1])

    if work.w.is_explicit:
        parameters = pyhamsys.Parameters(step=work.h, solver="Verlet", display=False)

        def kick_drift(h, t, y):
            q, p = halves(y)
            p = p - h * field(q, p)[0]
            return np.concatenate([(q + h * p).ravel(), p.ravel()])

        def drift_kick(h, t, y):
            q, p = halves(y)
            q = q + h * p
            return np.concatenate([q.ravel(), (p - h * field(q, p)[0]).ravel()])

        return lambda: result(
            pyhamsys.solve_ivp_symp(
                kick_drift, drift_kick, span, start, t_eval=ends, params=parameters
            )
        )
    parameters = pyhamsys.Parameters(
        step=work.h, solver="BM4", extension=True, projection="midpoint", display=False
    )

    def y_dot(t, y):
        of_q, of_p = field(*halves(y))
        return np.concatenate([of_p.ravel(), -of_q.ravel()])

    system = pyhamsys.HamSys(ndof=start.size // 2, y_dot=y_dot)
    return lambda: result(pyhamsys.solve_ivp_sympext(system, span, start, parameters, t_eval=ends))


def run_scipy(work: Work) -> Call:
    """DOP853 with steps to a relative tolerance, all lanes as one system."""
    from scipy.integrate import solve_ivp

    shape, field = work.q0.shape, FIELDS[work.w.kernel]
    start = np.concatenate([work.q0.ravel(), work.p0.ravel()])

    def rate(t, y):
        q, p = np.split(y, 2)
        of_q, of_p = field(q.reshape(shape), p.reshape(shape))
        return np.concatenate([of_p.ravel(), -of_q.ravel()])

    def call():
        sol = solve_ivp(
            rate,
            (0.0, work.span),
            start,
            "DOP853",
            t_eval=[work.span],
            rtol=RELATIVE_TOLERANCE,
            atol=RELATIVE_TOLERANCE,
        )
        q, p = np.split(sol.y[:, -1], 2)
        return q.reshape(shape), p.reshape(shape)

    return call


class Peer(NamedTuple):
    """A package on one task: what it does there, whether that is the same map, and how."""

    package: str
    task: str
    method: str
    same_map: bool
    prepare: Callable[[Work], Call]


def all_peers() -> list[Peer]:
    """Every peer on every task that it can do."""
    _, one, implicit = TASKS
    steps, fit = "steps of the same size", f"steps to {RELATIVE_TOLERANCE:g}"
    peers = []
    for task in TASKS:
        explicit = task != implicit
        peers += [
            Peer("dvi_jax", task, "TypeII", True, run_dvi_jax),
            Peer("numba", task, "the map, lane after lane", True, run_numba),
            Peer(
                "diffrax",
                task,
                "SemiImplicitEuler" if explicit else f"ImplicitEuler, {steps}",
                explicit,
                run_diffrax,
            ),
            Peer("heyoka", task, "Taylor, its own steps to round-off", False, run_heyoka),
            Peer(
                "pyhamsys",
                task,
                f"Verlet, {steps}" if explicit else f"BM4 extended, {steps}",
                False,
                run_pyhamsys,
            ),
            Peer("scipy", task, f"DOP853, {fit}", False, run_scipy),
        ]
    for integrator in ("leapfrog", "whfast"):
        prepare = functools.partial(run_rebound, integrator=integrator)
        peers.append(Peer("rebound", one, f"{integrator}, {steps}", False, prepare))
    return peers


def agreement(peer: Peer, baseline: Baseline) -> tuple[float, float]:
    """Largest difference from C over one unit of time in small steps, and what is allowed."""
    name, lanes, _ = TASKS[peer.task]
    w = WORKLOADS[name]
    q0, p0 = w.start(None if lanes is None else FINE_LANES)
    q, p = peer.prepare(Work(w, q0, p0, FINE_STEP, FINE_STEPS))()
    c = c_run(baseline, w, q0, p0, FINE_STEP, FINE_STEPS)()
    found = np.max(np.abs(np.stack([q - c["q"], p - c["p"]])))
    return float(found), SAME_MAP if peer.same_map else FIRST_ORDER * FINE_STEP


def c_run(baseline: Baseline, w: Workload, q0, p0, h: float, steps: int):
    """The C side of a task, unperturbed."""
    if w.is_explicit:
        return baseline.final(w.kernel, q0, p0, h=h, steps=steps, epsilon=0.0)
    iterations, _ = baseline.iterations_needed(w.kernel, q0, p0, h=h, steps=steps, epsilon=0.0)
    return baseline.implicit(w.kernel, q0, p0, h=h, steps=steps, epsilon=0.0, iterations=iterations)


def compared(peer: Peer, baseline: Baseline, clock: Clock) -> dict[str, Any]:
    """A peer's line of the table."""
    result: dict[str, Any] = peer._asdict()
    del result["prepare"]
    try:
        difference, allowed = agreement(peer, baseline)
    except ImportError as error:
        return result | {"status": "not installed", "error": str(error)}
    except Exception as error:
        return result | {"status": "FAILED", "error": f"{type(error).__name__}: {error}"[:500]}
    result |= {"difference": difference, "allowed": allowed, "version": version(peer.package)}
    if not difference <= allowed:
        return result | {"status": "DISAGREES"}
    name, lanes, steps = TASKS[peer.task]
    w = WORKLOADS[name]
    q0, p0 = w.start(lanes)
    call = peer.prepare(Work(w, q0, p0, w.h, steps))
    measured = ratio(clock.times(call, c_run(baseline, w, q0, p0, w.h, steps).call))
    low, high = np.quantile(measured.samples, [0.25, 0.75])
    quartiles = [float(low), float(high)]
    return result | {
        "status": "ok",
        "value": float(measured),
        "quartiles": quartiles,
        **measured.details,
    }


def version(package: str) -> str:
    """The installed version, "?" for a package without metadata."""
    try:
        return importlib.metadata.version(package.replace("_", "-"))
    except importlib.metadata.PackageNotFoundError:
        return "?"


def line(r: dict[str, Any]) -> str:
    """A peer in words."""
    head = f"{r['package']:9s} {r.get('version', ''):8s} {r['method']:36s}"
    if "difference" not in r:
        return f"{head} {r['status']}: {r['error']}"
    agrees = f"differs from C by {r['difference']:.0e} (allowed {r['allowed']:.0e})"
    if r["status"] != "ok":
        return f"{head} {r['status']}: {agrees}"
    low, high = r["quartiles"]
    return f"{head} {r['value']:9.3g} × C ({low:.3g} – {high:.3g}); {agrees}"


def main(words: list[str] | None = None) -> int:
    """Compare, print, write; the exit status."""
    parser = argparse.ArgumentParser(description="Other packages compared with hand-written C.")
    parser.add_argument("--peers", default="*", help="only packages of this name (*, ?)")
    parser.add_argument("--rounds", type=int, default=9, help="of each at most (default 9)")
    parser.add_argument("--budget", type=float, default=6.0, help="seconds of each (default 6)")
    parser.add_argument("--core", type=int, help="to run on (default: the last one allowed)")
    parser.add_argument("--out", type=Path, help="folder for peers.json")
    options = parser.parse_args(words)
    peers = [p for p in all_peers() if fnmatch.fnmatch(p.package, options.peers)]
    if not peers:
        names = ", ".join(dict.fromkeys(p.package for p in all_peers()))
        parser.error(f"no peer is called {options.peers!r}; there are {names}.")
    os.environ["JAX_PLATFORMS"] = "cpu"
    jax.config.update("jax_enable_x64", True)
    pinned = pin(options.core)
    baseline, clock = Baseline(), Clock(options.rounds, options.budget)
    say(f"# {processor()}, {pinned}; {baseline}")
    results = []
    for task in TASKS:
        print(f"{task}, {TASKS[task][2]} steps of {WORKLOADS[TASKS[task][0]].h:g}")
        for peer in peers:
            if peer.task == task:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # theirs
                    results.append(compared(peer, baseline, clock))
                print("  " + line(results[-1]), flush=True)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        report = {"machine": {"processor": processor(), "pinned": pinned}, "peers": results}
        (options.out / "peers.json").write_text(json.dumps(report, indent=1, default=float))
    return int(any(r["status"] in ("DISAGREES", "FAILED") for r in results))


if __name__ == "__main__":
    sys.exit(main())
