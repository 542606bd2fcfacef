"""Random runs of the parts that `programs` leaves out, each with a plain loop that computes it too.

A structure (functions, method, what is saved) is compiled once and run with many random numbers.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import rings

from . import loops
from .loops import POTENTIALS, SEQUENCES, Precise

Numbers = dict[str, Any]
Random = np.random.Generator


class Kind(NamedTuple):
    """One structure: the run in JAX and the loop in NumPy, both from numbers to named arrays.

    - `draw`: random numbers of one trajectory. `invalid`: functions that spoil them, after which
      the run must not be successful.
    - `shared`, `own`: names by which the results are differentiated, those that a batch shares and
      those of each trajectory.
    """

    text: str
    run: Callable[[Numbers], Numbers]
    loop: Callable[[Numbers], Numbers]
    draw: Callable[[Random], Numbers]
    invalid: list[Callable[[Numbers], Numbers]]
    shared: tuple[str, ...] = ()
    own: tuple[str, ...] = ()
    tolerance: float = 1e-10
    has_arrays: bool = True


def put(name: str, value: float, index: Any = ...) -> Callable[[Numbers], Numbers]:
    """A function that replaces a number."""

    def change(numbers: Numbers) -> Numbers:
        new = np.array(numbers[name])
        new[index] = value
        return {**numbers, name: new}

    return change


def outputs(solution: Any, **more: Any) -> Numbers:
    return {
        "status": dvi.RESULTS.successful == solution.result,
        "stopped": dvi.RESULTS.stopped == solution.result,
        "qs": solution.qs,
        "ps": solution.ps,
        **more,
    }


def pick(random: Random, *choices: Any) -> Any:
    return choices[random.integers(len(choices))]


def start(random: Random, n: int) -> Numbers:
    q, p = random.uniform(0.3, 1.0, n), random.uniform(-0.8, 0.8, n)
    k, m = random.uniform(0.5, 1.5, 2), random.uniform(0.5, 2.0)
    return {"q": q, "p": p, "k": k, "m": np.array(m), "h": np.array(random.uniform(0.05, 0.12))}


def potential(random: Random) -> tuple[str, Callable, Callable]:
    name = pick(random, *POTENTIALS)
    return name, *POTENTIALS[name]


def hamiltonian(V: Callable) -> Callable:
    return lambda t0, t1, q, p, a: p @ p / (2 * a["m"]) + V(jnp, q, a["k"])


SPOILED = [put("m", np.nan), put("k", np.nan, 1), put("q", np.nan, 0), put("h", np.nan)]


# --- stops ----------------------------------------------------------------------------------------

ENDS = {
    "q[0] - c": lambda t, q, p, c: q[0] - c,
    "|q|² - c": lambda t, q, p, c: q @ q - c,
    "t - c": lambda t, q, p, c: t - c,
    "c/5 - q[0]": lambda t, q, p, c: c / 5 - q[0],
    "q·p - c/3": lambda t, q, p, c: q @ p - c / 3,
}


def stop(random: Random) -> Kind:
    n, steps = pick(random, 1, 2), 24
    name, V, slope_of = potential(random)
    method, end = pick(random, *SEQUENCES), pick(random, *ENDS)
    every = pick(random, 1, 3)
    saved = pick(random, "every", "every", "final", "ts")
    adjoint = pick(random, dvi.Checkpointed(), dvi.Direct(), dvi.Reversible(), None)
    system = dvi.System(hamiltonian(V))
    g = ENDS[end]

    def run(s, form="auto"):
        save = {"every": dvi.Save(every=every), "final": dvi.Save(final=True),
                "ts": dvi.Save(ts=s["parts"] * s["h"] * steps)}[saved]  # fmt: skip
        sol = dvi.integrate(
            system, s["q"], s["p"], h=s["h"], num_steps=steps, adjoint=adjoint, throw=False,
            args={name: s[name] for name in ("k", "m", "c")}, layout=dvi.Layout(form=form),
            stop=dvi.Stop(lambda t, q, p, a: g(t, q, p, a["c"])), save=save,
            method=eval(f"dvi.{method}", {"dvi": dvi}),
        )  # fmt: skip
        return outputs(sol, t=sol.stop.t, q=sol.stop.q, p=sol.stop.p)

    def loop(s):
        def advance(h, q, p):
            return loops.step(SEQUENCES[method], lambda q: slope_of(np, q, s["k"]), h, q, p, s["m"])

        def value(t, q, p):
            return g(t, q, p, s["c"])

        states, point = loops.until(value, advance, 0.0, s["h"], s["q"], s["p"], steps)
        qs, ps = (np.full((steps + 1, n), np.nan) for _ in range(2))
        for i, (_, q, p) in enumerate(states):
            qs[i], ps[i] = q, p
        if saved == "ts":
            qs, ps = loops.between(advance, states, s["h"], s["parts"] * s["h"] * steps)
        else:
            rows = [0, -1] if saved == "final" else slice(None, None, every)
            qs, ps = qs[rows], ps[rows]
        nothing = np.nan, np.full(n, np.nan), np.full(n, np.nan)
        t, q, p = nothing if point is None else point
        result = {"status": point is None, "stopped": point is not None}
        return {**result, "qs": qs, "ps": ps, "t": t, "q": q, "p": p}

    def draw(random):
        # Parts of the run, not times: with the h that a batch shares, times may be after its end.
        parts = np.sort(random.uniform(0.01, 0.99, 4))
        return {**start(random, n), "parts": parts, "c": np.array(random.uniform(0.3, 1.6))}

    text = f"stop: {name}, n={n}, {method}, {end}, {saved} {every}, {adjoint}"
    invalid = [*SPOILED, put("c", np.nan)]
    return Kind(text, run, loop, draw, invalid, ("k", "m", "c", "h"), ("q", "p"))


# --- splittings -----------------------------------------------------------------------------------

LENGTHS = {
    "Strang()": [1.0],
    "Yoshida(4)": [loops.JUMP, 1 - 2 * loops.JUMP, loops.JUMP],
    "Suzuki(4)": [loops.FIFTH, loops.FIFTH, 1 - 4 * loops.FIFTH, loops.FIFTH, loops.FIFTH],
    # The printed coefficients; their order conditions are tested elsewhere.
    "KahanLi(8)": [2 * c for c in dvi.KahanLi(8).fractions()[::2]],
    "McLachlan(6)": [2 * c for c in dvi.McLachlan(6).fractions()[::2]],
}


def rotation(h, q, p, a):
    """The flow of p²/(2m) + m w² q²/2, with w = k[0]."""
    w, m = a["k"][0], a["m"]
    c, s = jnp.cos(w * h), jnp.sin(w * h)
    return c * q + s * p / (m * w), c * p - m * w * s * q


def splitting(random: Random) -> Kind:
    n, steps, scheme = pick(random, 1, 2), 12, pick(random, *LENGTHS)
    name, V, slope_of = potential(random)
    kinetic = lambda t0, t1, q, p, a: p @ p / (2 * a["m"])  # noqa: E731
    harmonic = lambda t0, t1, q, p, a: (  # noqa: E731
        p @ p / (2 * a["m"]) + a["m"] * a["k"][0] ** 2 * q @ q / 2
    )
    energy = lambda t0, t1, q, p, a: V(jnp, q, a["k"])  # noqa: E731
    quartic = lambda t0, t1, q, p, a: a["k"][1] * jnp.sum(q**4) / 4  # noqa: E731
    parts = pick(random, "TV", "VT", "TVQ", "AV", "VA", "QAV")
    table = {"T": (kinetic, None), "V": (energy, None), "Q": (quartic, None),
             "A": (harmonic, rotation)}  # fmt: skip
    hamiltonians, flows = zip(*(table[part] for part in parts), strict=True)
    split = dvi.Split(list(hamiltonians), flows=list(flows))
    system = dvi.System(split)
    adjoint = pick(random, None, dvi.Checkpointed(), dvi.Direct())
    sense = pick(random, 1, 1, -1)
    has_clock = pick(random, False, False, True)
    clock = (lambda t, q, p, a: 2 * t) if has_clock else None

    def run(s, form="auto"):
        sol = dvi.integrate(
            system, s["q"], s["p"], h=sense * s["h"], num_steps=steps, throw=False,
            args={name: s[name] for name in ("k", "m")}, layout=dvi.Layout(form=form),
            save=dvi.Save(ts=jnp.append(s["ts"], s["grid"]), clock=clock),
            observe=lambda t, q, p, a: q @ q, adjoint=adjoint,
            method=dvi.Splitting(eval(f"dvi.{scheme}", {"dvi": dvi})),
        )  # fmt: skip
        return outputs(sol, observed=sol.observed)

    def loop(s):
        k, m = s["k"], s["m"]
        flow_of = {
            "T": lambda h, q, p: (q + h * p / m, p),
            "V": lambda h, q, p: (q, p - h * slope_of(np, q, k)),
            "Q": lambda h, q, p: (q, p - h * k[1] * q**3),
            "A": lambda h, q, p: (
                np.cos(k[0] * h) * q + np.sin(k[0] * h) * p / (m * k[0]),
                np.cos(k[0] * h) * p - m * k[0] * np.sin(k[0] * h) * q,
            ),
        }
        flows = [flow_of[part] for part in parts]

        def advance(h, q, p):
            return loops.palindrome(flows, LENGTHS[scheme], h, q, p)

        h = sense * s["h"]
        states = loops.trajectory(advance, 0.0, h, s["q"], s["p"], steps)
        times = np.append(s["ts"], s["grid"]) / (2 if has_clock else 1)
        qs, ps = loops.between(advance, states, h, times)
        result = {"status": True, "stopped": False}
        return {**result, "qs": qs, "ps": ps, "observed": np.sum(qs**2, axis=1)}

    def draw(random):
        s = start(random, n)
        # Requested times, and one at the end of a step, where the curve has a corner.
        unit = sense * s["h"] * (2 if has_clock else 1)
        grid = unit * random.integers(1, steps)
        return {**s, "ts": random.uniform(0.01, 0.99, 4) * unit * steps, "grid": grid}

    text = f"splitting: {parts}, {name}, n={n}, {scheme}, {adjoint}, sense {sense}, {has_clock}"
    own = ("q", "p", "ts")
    return Kind(text, run, loop, draw, SPOILED, ("k", "m"), own)


# --- noise ----------------------------------------------------------------------------------------


def noise(random: Random) -> Kind:
    n, steps = pick(random, 1, 2), 16
    name, V, slope_of = potential(random)
    method = pick(random, "BAOAB", "BAOAB", "OBABO", "StochasticEuler", "StochasticMidpoint")
    every, adjoint = pick(random, 1, 4), pick(random, None, dvi.Checkpointed(), dvi.Direct())
    langevin = dvi.Langevin(*[lambda a, x=x: a[x] for x in ("friction", "temperature", "m")])
    system = dvi.System(hamiltonian(V), noise=langevin)
    parts = 2 if method == "OBABO" else 1
    names = "k", "m", "friction", "temperature"

    @jax.jit
    def normals(key):
        numbers = jnp.arange(parts * steps)
        one = lambda k: jax.random.normal(jax.random.fold_in(key, k), (n,))  # noqa: E731
        return jax.vmap(one)(numbers).reshape(steps, parts, n)

    def run(s, form="auto"):
        sol = dvi.integrate(
            system, s["q"], s["p"], h=s["h"], num_steps=steps, args={x: s[x] for x in names},
            path=dvi.Brownian(s["key"]), method=getattr(dvi, method)(), adjoint=adjoint,
            save=dvi.Save(every=every), throw=False, layout=dvi.Layout(form=form),
        )  # fmt: skip
        return outputs(sol)

    def loop(s):
        states, z = [(s["q"], s["p"])], np.asarray(normals(s["key"]))
        for k in range(steps):
            states.append(
                loops.noisy_step(
                    method, lambda q: slope_of(np, q, s["k"]), s["h"], *states[-1], z[k], s
                )
            )
        qs, ps = (np.array(x)[::every] for x in zip(*states, strict=True))
        return {"status": True, "stopped": False, "qs": qs, "ps": ps}

    def draw(random):
        key = random.integers(0, 2**32, 2, dtype=np.uint32)
        friction, temperature = random.uniform(0.1, 1.0, 2)
        more = {"friction": np.array(friction), "temperature": np.array(temperature)}
        return {**start(random, n), **more, "key": key}

    signs = ("friction", -0.3), ("temperature", -0.2), ("m", -1.0), ("m", 0.0)
    nans = [put(x, np.nan) for x in ("friction", "temperature")]
    invalid = [*SPOILED, *nans, *(put(*pair) for pair in signs)]
    text = f"noise: {name}, n={n}, {method}, every {every}, {adjoint}"
    return Kind(text, run, loop, draw, invalid, (*names, "h"), ("q", "p"))


# --- constraints ----------------------------------------------------------------------------------

SURFACES = {
    "sphere": (
        3,
        lambda q, size: np.array([(q @ q - size[0] * abs(size[0])) / 2]),
        lambda q, size: q[None],
    ),
    "ellipsoid": (
        3,
        lambda q, size: np.array([q[0] ** 2 + size[0] * q[1] ** 2 + size[1] * q[2] ** 2 - 1]),
        lambda q, size: 2 * np.array([[q[0], size[0] * q[1], size[1] * q[2]]]),
    ),
    "two rods": (
        4,
        lambda q, size: np.array([
            (q[:2] @ q[:2] - size[0] * abs(size[0])) / 2,
            ((q[2:] - q[:2]) @ (q[2:] - q[:2]) - size[1] * abs(size[1])) / 2,
        ]),
        lambda q, size: np.array([[q[0], q[1], 0, 0], [q[0] - q[2], q[1] - q[3], q[2] - q[0],
                                                       q[3] - q[1]]]),
    ),
}  # fmt: skip
"""Name → number of coordinates, g(q) and ∂g/∂q."""


def in_jax(name: str) -> Callable:
    def two_rods(q, a):
        pieces = q[:2], q[2:] - q[:2]
        squares = [x @ x for x in pieces]
        size = a["size"]
        return jnp.stack([(x - s * jnp.abs(s)) / 2 for x, s in zip(squares, size, strict=True)])

    return {
        "sphere": lambda q, a: (q @ q - a["size"][0] * jnp.abs(a["size"][0]))[None] / 2,
        "ellipsoid": lambda q, a: (
            q[0] ** 2 + a["size"][0] * q[1] ** 2 + a["size"][1] * q[2] ** 2 - 1
        )[None],
        "two rods": two_rods,
    }[name]


def constraint(random: Random) -> Kind:
    surface, steps = pick(random, *SURFACES), 10
    n, g, G = SURFACES[surface]
    name, V, slope_of = potential(random)
    scheme, every = pick(random, "Rattle", "Rattle", "Yoshida"), pick(random, 1, 5)
    method = dvi.Rattle() if scheme == "Rattle" else dvi.Yoshida(4, base=dvi.Rattle())
    adjoint = pick(random, None, dvi.Checkpointed(), dvi.Direct())
    system = dvi.System(hamiltonian(V), constraint=in_jax(surface))

    def run(s, form="auto"):
        sol = dvi.integrate(
            system, s["q"], s["p"], h=s["h"], num_steps=steps, method=method, adjoint=adjoint,
            args={x: s[x] for x in ("k", "m", "size")}, save=dvi.Save(every=every), throw=False,
            layout=dvi.Layout(form=form),
        )  # fmt: skip
        return outputs(sol)

    def loop(s):
        # A composition of order 2 takes the base, which is symmetric, twice over half a part.
        lengths = [1.0] if scheme == "Rattle" else np.repeat(LENGTHS["Yoshida(4)"], 2) / 2
        states = []
        q, p = s["q"], s["p"]
        for _ in range(steps):
            states.append((q, p))
            for c in lengths:
                q, p = loops.rattle(
                    lambda q: g(q, s["size"]), lambda q: G(q, s["size"]),
                    lambda q: slope_of(np, q, s["k"]), c * s["h"], q, p, s["m"],
                )  # fmt: skip
        qs, ps = (np.array(x)[::every] for x in zip(*states, (q, p), strict=True))
        return {"status": True, "stopped": False, "qs": qs, "ps": ps}

    def draw(random):
        s, size = start(random, n), random.uniform(0.7, 1.4, 2)
        q = random.normal(size=n)
        if surface == "sphere":
            q *= size[0] / np.linalg.norm(q)
        elif surface == "ellipsoid":
            q /= np.sqrt(q[0] ** 2 + size[0] * q[1] ** 2 + size[1] * q[2] ** 2)
        else:
            first, second = (x / np.linalg.norm(x) for x in (q[:2], q[2:]))
            q = np.concatenate([size[0] * first, size[0] * first + size[1] * second])
        rows, p = G(q, size), random.uniform(-0.5, 0.5, n)
        p = p - rows.T @ np.linalg.solve(rows @ rows.T, rows @ p)
        return {**s, "q": q, "p": p, "size": size}

    off = put("q", 3.0, 0)
    invalid = [*SPOILED, off, put("size", -1.0, 0), put("size", np.nan, 0), put("m", 0.0)]
    text = f"constraint: {surface}, {name}, {scheme}, every {every}, {adjoint}"
    return Kind(text, run, loop, draw, invalid, ("k", "m", "h"), (), 1e-9)


# --- pairs of numbers -----------------------------------------------------------------------------


def pairs(random: Random) -> Kind:
    n, steps = pick(random, 1, 2), 8
    name, V, slope_of = potential(random)
    method = pick(random, *SEQUENCES)
    system = dvi.System(hamiltonian(V))

    def run(s, form="auto"):
        def energy(t, q, p, a):
            return p @ p / (2 * a["m"]) + V(jnp, q, a["k"])

        sol = dvi.integrate(
            system, s["q"], s["p"], h=s["h"], num_steps=steps, throw=False,
            args={x: s[x] for x in ("k", "m")}, arithmetic=dvi.DoubleDouble(),
            observe=dvi.MaxDrift(energy), save=dvi.Save(every=2), layout=dvi.Layout(form=form),
            method=eval(f"dvi.{method}", {"dvi": dvi}),
        )  # fmt: skip
        return outputs(sol, drift=sol.observed)

    def loop(s):
        mpmath.mp.dps = 40
        exact = {x: np.array([mpmath.mpf(float(y)) for y in np.ravel(s[x])]) for x in s}
        k, m, h = exact["k"], exact["m"][0], exact["h"][0]
        sequence = [(kind, mpmath.mpf(c)) for kind, c in SEQUENCES[method]]

        def energy(q, p):
            return p @ p / (2 * m) + V(Precise, q, k)

        def advance(h, q, p):
            return loops.step(sequence, lambda q: slope_of(Precise, q, k), h, q, p, m)

        states = loops.trajectory(advance, 0, h, exact["q"], exact["p"], steps)
        energies = [energy(q, p) for _, q, p in states]
        drift = max(abs(x - energies[0]) for x in energies)
        qs, ps = (np.array([x[i] for x in states[::2]], float) for i in (1, 2))
        return {"status": True, "stopped": False, "qs": qs, "ps": ps, "drift": float(drift)}

    text = f"pairs: {name}, n={n}, {method}"
    nan = SPOILED[:3]
    shared = ("k", "m", "h")
    return Kind(text, run, loop, lambda r: start(r, n), nan, shared, ("q", "p"), 3e-16, False)


# --- rings ----------------------------------------------------------------------------------------


def ring(random: Random) -> Kind:
    slices, turns = int(random.integers(1, 4)), 6
    every = pick(random, 1, 3, 6)
    has_cavity, has_edge = random.integers(2, size=2).astype(bool).tolist()
    length = np.round(random.uniform(0.2, 0.6, 4), 3)
    model = [
        rings.quadrupole("QF", length[0], 0.0, slices=slices),
        rings.drift("D", length[1]),
        rings.sextupole("S", length[2], 0.0, slices=slices),
        rings.bend("B", length[3], 0.2, (0.0, 0.0), slices=slices,
                   **({"edge_in": 0.1, "edge_out": 0.1} if has_edge else {})),
        rings.multipole("T", 0.0, (0.0, 0.0, 0.0), (0.0, 0.0)),
        rings.aperture("A", ellipse=(0.02, 0.015)),
    ]  # fmt: skip
    wave = 2 * np.pi * 5e8 / 299792458.0
    model += [rings.cavity("RF", 0.0, 1e-3, 5e8)] * has_cavity
    order = random.permutation(len(model))
    model = [model[i] for i in order]
    whole = rings.Ring(model)

    def run(s, form="auto"):
        k = s["k"]
        line = whole.set("QF", b1=k[0]).set("S", b2=k[1]).set("B", b1=k[2]).set("T", b2=k[3])
        line = line.set("T", a1=k[4])
        out = rings.track(line, s["z"], turns, every=every)
        states = out.z if every < turns else out.z[None]
        lost = {"lost": out.lost, "turn": out.turn, "element": out.element}
        return {"status": ~out.lost, "stopped": out.lost, "z": states, "last": out.last, **lost}

    def loop(s):
        k, z, h = s["k"], s["z"], 0.2 / length[3]
        rows, last, place = [], np.full(6, np.nan), (-1, -1)
        maps = {
            "QF": lambda z: loops.magnet(z, length[0], (0, k[0]), slices),
            "D": lambda z: loops.drift(z, length[1]),
            "S": lambda z: loops.magnet(z, length[2], (0, 0, k[1]), slices),
            "T": lambda z: loops.kick(z, 1.0, (0, 0, k[3]), (0, k[4], 0)),
            "RF": lambda z: loops.cavity(z, 1e-3, wave),
            "A": lambda z: z,
            "B": lambda z: loops.magnet(z, length[3], (0, k[2]), slices, h),
        }
        for turn in range(turns):
            for i, element in enumerate(model):
                if place[0] >= 0:
                    break
                if element.name == "B" and has_edge:
                    z = loops.edge(maps["B"](loops.edge(z, h, 0.1)), h, 0.1)
                else:
                    z = maps[element.name](z)
                is_outside = (z[0] / 0.02) ** 2 + (z[2] / 0.015) ** 2 > 1
                if (element.name == "A" and is_outside) or np.abs(z[[0, 1, 2, 3, 5]]).max() > 1:
                    place, last, z = (turn, i), z, np.full(6, np.nan)
            if (turn + 1) % every == 0:
                rows.append(z)
        is_lost = place[0] >= 0
        result = {"status": not is_lost, "stopped": is_lost, "z": np.array(rows), "last": last}
        return {**result, "lost": is_lost, "turn": place[0], "element": place[1]}

    def draw(random):
        size = np.array([8e-3, 1e-3, 6e-3, 1e-3, 5e-3, 1e-3])
        k = random.normal(size=5) * np.array([0.8, 5.0, 0.3, 3.0, 0.1])
        return {"z": random.normal(size=6) * size, "k": k}

    names = [element.name for element in model]
    text = f"ring: {names}, slices {slices}, every {every}, edges {has_edge}"
    invalid = [put("z", np.nan, 0), put("z", np.nan, 4), put("z", np.inf, 5), put("k", np.nan, 0)]
    invalid += [put("k", np.nan, 3)]
    return Kind(text, run, loop, draw, invalid, ("k",), ("z",), 1e-11, False)


KINDS = (stop, splitting, noise, constraint, pairs, ring)
