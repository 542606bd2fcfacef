"""The truths of discovery checked in 60 digits, without the search.

    python tests/truths/precise.py [--kind KIND] [--case PART_OF_NAME]

evaluates derivatives of H_D, and the functions of the basis, from their jaxprs in the arithmetic
of mpmath, makes the step of the method there, and compares three things for each case:

- each function of the truth is conserved by the step, up to the rounding of its coefficients;
- each function of the truth is a linear combination of the basis;
- the matrix of the changes of the basis has a null space with as many independent functions as
  the truth. Its rank is that of a Gaussian elimination with complete pivoting.

The smallest pivot of the rank and the largest one of the null space are printed: a null space is
clear if they are many decades apart.
"""

import argparse
import operator
import sys
import time
from pathlib import Path

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import mpmath  # noqa: E402
import numpy as np  # noqa: E402
import sympy  # noqa: E402
from jax.extend.core import ClosedJaxpr  # noqa: E402
from jax.interpreters import partial_eval  # noqa: E402

import dvi_jax as dvi  # noqa: E402
import truths  # noqa: E402
from dvi_jax.discover.functions.basis import bind_basis  # noqa: E402

mpmath.mp.dps = 60
mpf = mpmath.mpf

ZEROS = (mpf(10) ** -14, mpf(10) ** -25)
"""Largest pivots of a null space that are tried: coefficients of most maps are rounded to 16
digits. Maps that expand by 1e4 have smaller pivots, and coefficients without rounding."""


def exactly(x) -> np.ndarray:
    """An array of numbers of mpmath, each the exact value of the float."""
    x = np.asarray(x)
    out = np.empty(x.shape, object)
    for i in np.ndindex(x.shape):
        out[i] = x[i] if isinstance(x[i], mpmath.mpf | bool | np.bool_) else mpf(float(x[i]))
    return out


def _each(function):
    return np.frompyfunc(function, 1, 1)


_UNARY = {
    "neg": lambda x: -x,
    "rsqrt": _each(lambda x: 1 / mpmath.sqrt(x)),
    "abs": _each(abs),
    "square": lambda x: x * x,
} | {
    name: _each(getattr(mpmath, name))
    for name in (
        *("sin", "cos", "tan", "sinh", "cosh", "tanh", "atan"),
        *("exp", "log", "log1p", "sqrt", "sign"),
    )
}
_SAME = {"copy", "copy_p", "stop_gradient", "convert_element_type", "reduce_precision"}
_BINARY = {
    "add": operator.add,
    "add_any": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "max": np.frompyfunc(max, 2, 1),
    "min": np.frompyfunc(min, 2, 1),
    "pow": np.frompyfunc(lambda x, y: x**y, 2, 1),
    "atan2": np.frompyfunc(mpmath.atan2, 2, 1),
} | {name: getattr(operator, name) for name in ("gt", "lt", "ge", "le", "eq", "ne")}
_MOVING = {
    *("reshape", "squeeze", "expand_dims", "transpose", "rev", "broadcast_in_dim", "iota"),
    *("concatenate", "split", "stack", "slice", "dynamic_slice", "pad", "gather", "select_n"),
}


def _evaluate(jaxpr, consts, *inputs):
    values = dict(zip(jaxpr.constvars, map(exactly, consts), strict=True))
    values.update(zip(jaxpr.invars, inputs, strict=True))

    def read(atom):
        return exactly(atom.val) if hasattr(atom, "val") else values[atom]

    for eqn in jaxpr.eqns:
        x = [read(atom) for atom in eqn.invars]
        inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        if inner is not None and eqn.primitive.name not in ("scan", "while", "cond"):
            inner = inner if hasattr(inner, "jaxpr") else ClosedJaxpr(inner, ())
            out = _evaluate(inner.jaxpr, inner.consts, *x)
        else:
            out = _made(eqn, x)
        values.update(zip(eqn.outvars, out, strict=True))
    return [read(atom) for atom in jaxpr.outvars]


def _made(eqn, x) -> list:
    """The results of one operation."""
    name, params = eqn.primitive.name, eqn.params
    if name in _SAME:
        return x
    if name in _MOVING:
        return _moved(eqn, x)
    if name in _UNARY or name in _BINARY:
        out = (_UNARY | _BINARY)[name](*x)
    elif name == "integer_pow":
        out = x[0] ** params["y"]
    elif name in ("reduce_sum", "reduce_prod"):
        reduce = np.sum if name == "reduce_sum" else np.prod
        out = reduce(x[0], axis=tuple(params["axes"]))
    elif name == "dot_general" and not any(params["dimension_numbers"][1]):
        axes = params["dimension_numbers"][0]
        out = np.tensordot(*x, axes) if axes[0] else np.multiply.outer(*x)
    elif name == "scatter-add":
        out = _added(eqn, x)
    else:
        raise NotImplementedError(f"{name} {params}")
    return [np.asarray(out, object)]


def _indices(eqn, x) -> list:
    """Operands that are integers or truth values, as JAX takes them; None for the others."""

    def given(value, kind):
        return jnp.asarray(np.array(value.tolist(), kind)) if kind.kind in "iub" else None

    return [given(v, atom.aval.dtype) for v, atom in zip(x, eqn.invars, strict=True)]


def _moved(eqn, x) -> list:
    """Of an operation that only moves numbers: it is made with their places."""
    indices = _indices(eqn, x)
    numbers = [v.ravel() for v, given in zip(x, indices, strict=True) if given is None]
    places, count = [], 0
    for v, given in zip(x, indices, strict=True):
        places.append(
            jnp.arange(count, count + v.size).reshape(v.shape) if given is None else given
        )
        count += v.size if given is None else 0
    out = eqn.primitive.bind(*places, **eqn.params)
    out = out if eqn.primitive.multiple_results else [out]
    if not numbers:
        return [exactly(o) for o in out]
    flat = np.concatenate(numbers)
    return [np.asarray(flat[np.asarray(o)], object) for o in out]


def _added(eqn, x) -> np.ndarray:
    """Scattered numbers added to others, one after the other."""
    out, updates, where = np.array(x[0]), x[2], _indices(eqn, x)[1]
    for k in range(updates.size):
        one = np.zeros(updates.size)
        one[k] = 1
        zero = jnp.zeros(out.shape)
        there = eqn.primitive.bind(zero, where, one.reshape(updates.shape), **eqn.params)
        out = np.where(np.asarray(there) != 0, out + updates.ravel()[k], out)
    return out


def precisely(function, *like):
    """The function of arrays, evaluated in many digits; `like`: examples of its arguments."""
    closed = jax.make_jaxpr(function)(*like)
    jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), True)
    return lambda *x: _evaluate(jaxpr, closed.consts, *map(exactly, x))


def solved(residual, start):
    """A root by Newton's method with differences for derivatives."""
    x, step = start, mpf(10) ** -28
    for _ in range(60):
        r = residual(x)
        scale = max(*(abs(v) for v in x), mpf(10) ** -40)
        J = mpmath.matrix(len(x), len(x))
        for j in range(len(x)):
            moved = x.copy()
            moved[j] = moved[j] + step * scale
            for i, value in enumerate((residual(moved) - r) / (step * scale)):
                J[i, j] = value
        dx = mpmath.lu_solve(J, mpmath.matrix(list(-r)))
        x = x + np.array([dx[i] for i in range(len(x))], object)
        if max(abs(v) for v in dx) < scale * mpf(10) ** -52:
            return x
    raise ArithmeticError("no root")


class Step:
    """The step of a case in many digits."""

    def __init__(self, case: truths.Case, shape):
        system, options = case.system, dict(case.options)
        args, self.h = options.get("args"), mpf(float(case.h))
        self.method, self.shape = options.get("method", dvi.TypeII()), shape
        self.slow = system.slow_time
        one, state = jnp.zeros(()), jnp.zeros(shape)

        def slopes(t0, t1, q, p):
            H = lambda q, p: jnp.asarray(system.H_D(t0, t1, q, p, args), float)  # noqa: E731
            return jax.grad(H, argnums=(0, 1))(q, p)

        self.slopes = precisely(slopes, one, one, state, state)

    def __call__(self, q, p, t):
        h = self.h
        q, p = self.of(self.method, q, p, t, t if self.slow else t + h, h)
        return q, p, t if self.slow else t + h

    def of(self, method, q, p, t0, t1, h):
        if isinstance(method, dvi.TypeII):
            rate = lambda p1: self.slopes(t0, t1, q, p1.reshape(self.shape))  # noqa: E731
            p1 = self._fixed(lambda p1: p.ravel() - h * rate(p1)[0].ravel(), p.ravel())
            return q + h * rate(p1)[1], p1.reshape(self.shape)
        if isinstance(method, dvi.Adjoint):
            return self.inverse(method.method, q, p, t1, t0, -h)
        if isinstance(method, dvi.GaussLegendre):
            return self._gauss(method.stages, q, p, t0, t1, h)
        start = mpf(0)
        for i, c in enumerate(method.fractions()):
            a, b = t0 + start * (t1 - t0), t0 + (start + c) * (t1 - t0)
            if i % 2:
                q, p = self.inverse(method.base, q, p, b, a, -c * h)
            else:
                q, p = self.of(method.base, q, p, a, b, c * h)
            start = start + c
        return q, p

    def inverse(self, method, q, p, t0, t1, h):
        """What the step (t0, t1, h) of a method leads from to (q, p)."""
        if isinstance(method, dvi.Adjoint):
            return self.of(method.method, q, p, t1, t0, -h)
        if not isinstance(method, dvi.TypeII):
            raise NotImplementedError(repr(method))
        rate = lambda q0: self.slopes(t0, t1, q0.reshape(self.shape), p)  # noqa: E731
        q0 = self._fixed(lambda q0: q.ravel() - h * rate(q0)[1].ravel(), q.ravel())
        return q0.reshape(self.shape), p + h * rate(q0)[0]

    def _fixed(self, function, x):
        first = function(x)
        if all(first == function(first)):
            return first
        return solved(lambda y: y - function(y), first)

    def _gauss(self, stages, q, p, t0, t1, h):
        roots = sympy.Poly(sympy.legendre(stages, sympy.Symbol("x"))).nroots(n=70)
        nodes = [mpf(str(r)) for r in roots]
        c = [(x + 1) / 2 for x in sorted(nodes)]
        powers = mpmath.matrix([[x**k for x in c] for k in range(stages)])
        b = mpmath.lu_solve(powers, mpmath.matrix([mpf(1) / (k + 1) for k in range(stages)]))
        moments = ([x ** (k + 1) / (k + 1) for k in range(stages)] for x in c)
        a = [mpmath.lu_solve(powers, mpmath.matrix(moment)) for moment in moments]
        z0 = np.concatenate([q.ravel(), p.ravel()])
        n = q.size

        def rates(z):
            out = []
            for i, x in enumerate(z.reshape(stages, 2 * n)):
                t = t0 + c[i] * (t1 - t0)
                Hq, Hp = self.slopes(t, t, x[:n].reshape(self.shape), x[n:].reshape(self.shape))
                out.append(np.concatenate([Hp.ravel(), -Hq.ravel()]))
            return out

        def function(z):
            f = rates(z)
            return np.concatenate(
                [z0 + h * sum(a[i][j] * f[j] for j in range(stages)) for i in range(stages)]
            )

        z = self._fixed(function, np.concatenate([z0] * stages))
        f = rates(z)
        z1 = z0 + h * sum(b[j] * f[j] for j in range(stages))
        return z1[:n].reshape(self.shape), z1[n:].reshape(self.shape)


def eliminated(matrix, zero):
    """Pivots in descending order of their choice, the rank, and the null vectors."""
    A = matrix.copy()
    rows, columns = A.shape
    order = np.arange(columns)
    pivots = []
    size = np.abs(A)
    for k in range(min(rows, columns)):
        i, j = np.unravel_index(np.argmax(size[k:, k:]), (rows - k, columns - k))
        i, j = i + k, j + k
        if size[i, j] == 0:
            break
        A[[k, i]] = A[[i, k]]
        A[:, [k, j]] = A[:, [j, k]]
        order[[k, j]] = order[[j, k]]
        pivots.append(abs(A[k, k]))
        A[k + 1 :, k:] = A[k + 1 :, k:] - np.multiply.outer(A[k + 1 :, k] / A[k, k], A[k, k:])
        A[k + 1 :, k] = mpf(0)
        size = np.abs(A)
    pivots = [x / pivots[0] for x in pivots]
    rank = sum(x > zero for x in pivots)
    null = np.full((columns, columns - rank), mpf(0), object)
    for m in range(columns - rank):
        x = np.full(columns, mpf(0), object)
        x[rank + m] = mpf(1)
        for k in range(rank - 1, -1, -1):
            x[k] = -np.sum(A[k, k + 1 :] * x[k + 1 :]) / A[k, k]
        null[order, m] = x
    return pivots, rank, null


def check(case: truths.Case, zero=ZEROS[0]) -> tuple[bool, str]:
    """Whether the truth of the case is one, and what was measured."""
    good, text = _check(case, zero)
    if good or zero == ZEROS[-1]:
        return good, text
    better, other = _check(case, ZEROS[-1])
    return (True, other + ", smallest pivots taken as not zero") if better else (good, text)


def _points(case, needed) -> list[tuple]:
    """So many (q, p, t) of the samples of the case, drawn again if they are too few."""
    points, draw = [], case.points or case.samples
    for seed in range(100, 131):
        drawn = [np.asarray(x, float) for x in draw(np.random.default_rng(seed))]
        drawn = drawn if len(drawn) == 3 else [*drawn, np.zeros(len(drawn[0]))]
        some = np.random.default_rng(seed).permutation(len(drawn[0]))[:needed]
        points += list(zip(*(x[some] for x in drawn), strict=True))
        if len(points) >= needed:
            break
    return points[:needed]


def _check(case: truths.Case, zero) -> tuple[bool, str]:
    shape = np.shape(case.samples(np.random.default_rng(0))[0])[1:]
    bound = bind_basis(case.basis, shape)
    points = _points(case, bound.size + 12)
    step, one, state = Step(case, shape), jnp.zeros(()), jnp.zeros(shape)

    def true(q, p, t):
        values = [jnp.asarray(f(q, p, t), float) for f in case.truth]
        return jnp.stack(values) if values else jnp.zeros(0)

    basis, truth = (precisely(f, state, state, one) for f in (bound, true))
    at = [[exactly(x) for x in point] for point in points]
    after = [step(*z) for z in at]
    values, later = (np.array([basis(*z)[0] for z in where]) for where in (at, after))
    changes, scale = later - values, np.array([_norm(c) for c in values.T])
    still = [_norm(c) < s * mpf(10) ** -40 for c, s in zip(changes.T, scale, strict=True)]
    changes[:, np.array(still)] = mpf(0)
    rows = changes / scale
    sizes = np.array([_norm(r) or mpf(1) for r in rows])
    pivots, rank, null = eliminated(rows / sizes[:, None], zero)
    null = null / scale[:, None]
    q, p, t = (jnp.asarray(np.array(x)) for x in zip(*points, strict=True))
    null = null / np.array([_norm(c) for c in (values @ null).T])
    spread = np.array(values @ null - np.mean(values @ null, axis=0), float)
    _, sizes, V = np.linalg.svd(spread, full_matrices=False)
    null = np.array(null @ exactly(V[sizes > 1e-9].T), float)  # without a constant
    found = 0
    if null.shape[1]:
        d = truths.differentials(lambda q, p, t: jnp.asarray(null).T @ bound(q, p, t), (q, p, t))
        found = truths.rank(d)
    ends = [mpmath.nstr(x, 2) for x in ([mpf(0), *pivots, mpf(0)][rank : rank + 2])]
    text = f"rank {rank} of {bound.size}, {found} independent, pivots {' | '.join(ends)}"
    good = found == len(case.truth)
    if case.truth:
        wanted, then = (np.array([truth(*z)[0] for z in where]) for where in (at, after))
        # relative to how the function varies over the samples
        change = max(
            float(_norm(k) / (_norm(w - np.mean(w)) or _norm(w)))
            for k, w in zip((then - wanted).T, wanted.T, strict=True)
        )
        floats = np.column_stack([np.array(values / scale, float), np.ones(len(values))])
        off = max(truths.distance(floats, np.array(w / (_norm(w) or 1), float)) for w in wanted.T)
        independent = truths.rank(truths.differentials(true, (q, p, t)))
        text += f", truth of rank {independent} changes by {change:.1e}, off the basis {off:.1e}"
        good = good and change < 1e-11 and off < 1e-6 and independent == len(case.truth)
    return good, text


def _norm(x):
    return mpmath.sqrt(sum(v * v for v in np.ravel(x)))


def main() -> int:
    """Check, print, and return 1 if a truth is wrong."""
    from truths.table import all_cases

    parser = argparse.ArgumentParser()
    parser.add_argument("--kind", default="")
    parser.add_argument("--case", default="")
    chosen = parser.parse_args()
    bad = 0
    for case in all_cases():
        named = chosen.kind in case.kind and chosen.case in case.name
        if not named or case.sought != "invariants" or case.order > 0:
            continue
        start = time.time()
        try:
            good, text = check(case)
        except Exception as error:
            good, text = False, f"{type(error).__name__}: {str(error)[:300]}"
        bad += not good
        head = f"{'ok ' if good else 'BAD'} {case.name}"
        print(f"{head}: {text} ({time.time() - start:.1f} s)", flush=True)
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main())
