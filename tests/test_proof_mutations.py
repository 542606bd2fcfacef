"""Certificates that were changed at random: what the checker still accepts is true.

The truth is found without the code of the checker: lists of operations are evaluated here by NumPy
in long double, at random points, which then move towards larger changes.
"""

import copy
import json
import operator
import signal
from functools import reduce

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

pytest.importorskip("flint")
import contextlib

from dvi_jax.proof import checker as exact

LONG = np.longdouble


# --- the truth -----------------------------------------------------------------------------------


def number(text, kind):
    return kind(float.fromhex(text))


FUNCTIONS = {"inverse": lambda x: 1 / x} | {
    name: getattr(np, {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}.get(name, name))
    for name in ("exp", "log", "sin", "cos", "tan", "atan", "asin", "acos", "sqrt")
}


def evaluate(program, inputs, kind=LONG):
    """The outputs of a list of operations, for arrays of inputs."""
    values = []
    for name, *operands in program["operations"]:
        if name == "input":
            value = inputs[operands[0]]
        elif name == "constant":
            value = number(operands[0], kind)
        elif name == "inexact":
            value = values[operands[0]]
        else:
            terms = [values[i] for i in operands]
            rules = {"sum": lambda *x: reduce(operator.add, x), "multiply": operator.mul}
            value = {**rules, **FUNCTIONS}[name](*terms)
        values.append(value)
    return [np.asarray(values[i], kind) * np.ones_like(inputs[0]) for i in program["outputs"]]


def before_and_after(c, x, kind=LONG):
    """States with (t, ε, h) before and after a step from rows (q, p, t, ε), or (q, p1, t, ε)."""
    n, h = len(c["spread"]), number(c["h"], kind)
    x = [np.asarray(column, kind) for column in x]
    q, p, t, epsilon = x[:n], x[n : 2 * n], x[-2], x[-1]
    step = evaluate(c["step"], [*x, h + 0 * t, 0 * t], kind)
    if c["implicit"]:
        step, p = [*step[n:], *p], [b - a for a, b in zip(step[:n], p, strict=True)]
    t1 = t + (epsilon * h if c["slow"] else h)
    return [*q, *p, t, epsilon, h + 0 * t], [*step, t1, epsilon, h + 0 * t]


def is_inside(c, x):
    n = len(c["spread"])
    low, high = (np.array([float.fromhex(v) for v in side]) for side in c["domain"])
    state = np.array(x[: 2 * n])
    inside = ((state >= low[:, None]) & (state <= high[:, None])).all(0)
    for margin in evaluate(c["inside"], x[: 2 * n]):
        inside &= np.asarray(margin >= 0)
    return inside


def intervals(c):
    ends = [*zip(*c["domain"], strict=True), c["time"], c["epsilon"]]
    return np.array([[float.fromhex(v) for v in pair] for pair in ends])


def starts(c, count, rng):
    low, high = intervals(c).T
    return rng.uniform(low + 0.0, high + 0.0, (count, len(low))).T  # −0.0 is below 0.0


def largest_change(c, k, rng, count=2000, rounds=12):
    """Ascent: the best tenth of the points moves by smaller and smaller random steps."""
    low, high = intervals(c).T[:, :, None]
    x, best = starts(c, count, rng), 0.0
    for i in range(rounds):
        before, after = before_and_after(c, x)
        start, end = (evaluate(c["invariants"][k], z)[0] for z in (before, after))
        change = np.where(is_inside(c, before), np.abs(end - start), 0)
        change = np.where(np.isfinite(change), change, np.inf)
        best = max(best, float(np.max(change)))
        best_points = x[:, np.argsort(change)[-count // 10 :]].repeat(10, axis=1)
        x = np.clip(best_points + rng.normal(0, 0.3 * 0.5**i, x.shape) * (high - low), low, high)
    return best


def largest_rounding(c, k, rng):
    """By how much a step of float64 differs from one of long double, in I_k."""
    x = starts(c, 2000, rng)
    before, after = before_and_after(c, x)
    computed = before_and_after(c, x, np.float64)[1]
    n = 2 * len(c["spread"])
    ends = [evaluate(c["invariants"][k], [*np.asarray(z[:n], LONG), *after[n:]])[0]
            for z in (after, computed)]  # fmt: skip
    return float(np.max(np.where(is_inside(c, before), np.abs(ends[0] - ends[1]), 0)))


def leaves_the_domain(c, rng):
    """Whether a trajectory that satisfies the level leaves the domain, in 300 steps or fewer."""
    weights, value = [number(w, LONG) for w in c["level"][0]], number(c["level"][1], LONG)
    x = starts(c, 4000, rng)
    x[-2] = float.fromhex(c["start"])
    z = [*np.asarray(x, LONG), number(c["h"], LONG) + 0 * x[0]]
    combination = sum(w * evaluate(f, z)[0] for w, f in zip(weights, c["invariants"], strict=True))
    good = is_inside(c, z) & np.asarray(combination <= value)
    x = x[:, good]
    for _ in range(min(300, c["steps"])):
        if not x.size:
            return False
        if c["implicit"]:  # p1 from p0 by iteration
            n, p0 = len(c["spread"]), x[len(c["spread"]) : -2].copy()
            for _ in range(60):
                x[n:-2] = np.asarray(
                    x[n:-2] + p0 - np.asarray(before_and_after(c, x)[0][n:-3]), float
                )
        after = before_and_after(c, x)[1]
        x = np.asarray(after[:-1], float)
        if not np.all(is_inside(c, after)):
            return True
    return False


def is_true(c, seed):
    """Whether no counterexample to a certificate is found."""
    rng = np.random.default_rng(seed)
    with np.errstate(all="ignore"):
        for k, (bound, rounding) in enumerate(zip(c["per_step"], c["rounding"], strict=True)):
            slack = 1e-15 * (1 + float.fromhex(bound))  # of long double, and of the first h·rate
            if largest_change(c, k, rng) > float.fromhex(bound) + 1e-3 * slack:
                return False
            if largest_rounding(c, k, rng) > float.fromhex(rounding) + 1e-3 * slack:
                return False
        return c["level"] is None or not leaves_the_domain(c, rng)


# --- the certificates ----------------------------------------------------------------------------


def energy(q, p, epsilon):
    return (p @ p + q @ q - 0.1 * (q @ p)) / 2


def quadratic(t0, t1, q, p, args):
    return (p @ p + q @ q) / 2


CUBE = dvi.System(quadratic, force=lambda t0, t1, q, p, args: -(q**3))
HALF = np.array([0.5])


@pytest.fixture(scope="module")
def certificates():
    slow = dvi.System(lambda t0, t1, q, p, a: (p @ p + (1 + t0**2 / 9) * q @ q) / 2, slow_time=True)
    coupled = dvi.System(lambda t0, t1, q, p, a: (p @ p + q @ q + 0.1 * (q * p) @ (q * p)) / 2)
    how = {"h": 0.1, "epsilon": 0.01, "domain": HALF}
    proofs = [
        dvi.bound_drift(energy, CUBE, **how),
        dvi.bound_drift(energy, CUBE, inside=lambda q, p: 0.2 - energy(q, p, 0.0), **how),
        dvi.bound_drift(energy, coupled, method=dvi.TypeII(), **how),
        dvi.bound_drift(
            lambda q, p, e, t: (p @ p + (1 + t**2 / 9) * q @ q - 0.1 * (q @ p)) / 2,
            slow, time=(0.0, 1.0), change=1e-2, **how | {"epsilon": (-0.02, 0.01)},
        ),
        dvi.bound_drift(
            lambda q, p, e: p @ p / 2 - jnp.sum(jnp.cos(q)),
            dvi.System(lambda t0, t1, q, p, a: p @ p / 2 - jnp.sum(jnp.cos(q))), **how,
        ),
    ]  # fmt: skip
    return [json.loads(json.dumps(proof.certificate)) for proof in proofs]


def test_the_certificates_are_accepted_and_true(certificates):
    for i, c in enumerate(certificates):
        assert exact.check(c)
        assert is_true(c, i)
    assert sum(c["level"] is not None for c in certificates) >= 3


def test_the_example_of_a_level_is_at_the_start(certificates):
    """Otherwise no state at the start need satisfy the level."""
    c = copy.deepcopy(certificates[3])
    assert exact.check(c)
    c["example"][-2] = (0.5 * float.fromhex(c["start"])).hex()
    with pytest.raises(exact.Failure, match="no start"):
        exact.check(c | {"hash": exact.digest(c)})


def test_the_search_for_counterexamples_finds_them(certificates):
    """The control: bounds and levels that are false by a little."""
    c = certificates[0]
    largest = largest_change(c, 0, np.random.default_rng(0))
    assert not is_true(c | {"per_step": [(0.98 * largest).hex()]}, 0)
    assert not is_true(c | {"rounding": [(1e-18).hex()]}, 0)
    assert not is_true(c | {"level": [c["level"][0], (0.2).hex()]}, 0)
    late = certificates[3]
    assert not is_true(late | {"per_step": [(0.5 * float.fromhex(late["per_step"][0])).hex()]}, 0)


# --- the mutations -------------------------------------------------------------------------------


def places(node, path=()):
    """The paths of all parts of a certificate, but its checksum."""
    if path:
        yield path
    if isinstance(node, dict | list):
        for key in node if isinstance(node, dict) else range(len(node)):
            if path or key != "hash":
                yield from places(node[key], (*path, key))


FACTORS = (-1.0, 0.0, 0.5, 0.9, 0.999, 1 + 2.0**-50, 1.001, 1.1, 2.0, 1e5, 1e300, 1e-300)
STRANGE = (None, True, "", "x", "nan", "inf", [], {}, -1, 10**30, 0.5, [[]], "0x1p+1023")
NAMES = ("sum", "multiply", "constant", "input", "inexact", "inverse", *exact.FUNCTIONS)
CLAIMS = ("bounded", "outside", "inside", "unreachable", "above")


def changed(value, rng):
    """Another value for a part of a certificate, of the same kind or of a strange one."""
    choose = lambda options: options[rng.integers(len(options))]  # noqa: E731
    if rng.random() < 0.1:
        return choose(STRANGE)
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + int(choose((-1, 1, -2, 2, -10, 10, value, -value, -2 * value)))
    if isinstance(value, str) and value in NAMES:
        return choose(NAMES)
    if isinstance(value, str) and value in CLAIMS:
        return choose(CLAIMS)
    if isinstance(value, str):
        try:
            return (float.fromhex(value) * choose(FACTORS)).hex()
        except (ValueError, OverflowError):
            return choose(("float64", "pairs of float64", "float32"))
    if isinstance(value, list) and value:
        i, j = rng.integers(len(value), size=2)
        return choose((value[::-1], value[:-1], [*value, value[i]], [*value[:i], *value[i + 1 :]],
                       [*value[:i], value[j], *value[i + 1 :]]))  # fmt: skip
    return choose(STRANGE)


def mutant(c, rng):
    """A certificate with one to three changed parts, and a checksum that agrees."""
    c = copy.deepcopy(c)
    fields = list(c)
    for _ in range(rng.integers(1, 4)):
        # Every field as often as the long trees and lists.
        field = fields[rng.integers(len(fields))]
        paths = [path for path in places(c) if path[0] == field]
        if not paths:
            continue
        path = paths[rng.integers(len(paths))]
        parent = reduce(operator.getitem, path[:-1], c)
        parent[path[-1]] = changed(parent[path[-1]], rng)
    with contextlib.suppress(TypeError, ValueError):
        c["hash"] = exact.digest(c)
    return c


class Late(Exception):
    pass


def accepts(c, seconds=20):
    """Whether the checker accepts a certificate within a time."""

    def stop(*_):
        raise Late

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        exact.check(c)
    except Exception:
        return False
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    return True


TEN_THOUSAND = [pytest.param(2_000, seed, marks=pytest.mark.slow) for seed in range(5)]


@pytest.mark.parametrize(("count", "seed"), [(200, 200), *TEN_THOUSAND])
def test_what_is_accepted_after_a_change_is_true(certificates, count, seed, capsys):
    rng, accepted = np.random.default_rng(seed), 0
    for i in range(count):
        c = mutant(certificates[i % len(certificates)], rng)
        if accepts(c):
            accepted += 1
            assert is_true(c, i), json.dumps(c)
    with capsys.disabled():
        print(f"\n{count} changed certificates, {accepted} accepted, all of them true", end="")
    assert 0.02 * count < accepted < 0.6 * count
