"""The list of operations of a certificate is the function, or the function is refused by name."""

import runpy
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

pytest.importorskip("flint")
from dvi_jax.proof import checker as exact, comparison, components
from dvi_jax.proof.comparison import Mistranslated, compare, random_points
from dvi_jax.proof.components import NotAnalytic, program_of

LONG_DOUBLE = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "proof.py"))["Extended"]
TABLE = np.array([3.0, 0.0, -2.0, 1.0])
MATRIX = np.array([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0], [0.0, -1.0, 1.0]])
BOX = (np.full(3, 0.3), np.full(3, 0.9))


def loop(x):
    return jax.lax.fori_loop(0, 4, lambda i, y: y.at[i % 3].add(x[(i + 1) % 3] ** 2) * 0.9, x)


def solve(x):
    a, b, c, d = 2 + x[0], x[1], x[2], 3.0
    return jnp.stack([x[0] * d - b * x[1], a * x[1] - c * x[0]]) / (a * d - b * c)


@jax.custom_jvp
def cube(x):
    return x**3


cube.defjvp(lambda primals, tangents: (cube(*primals), 3 * primals[0] ** 2 * tangents[0]))

TRANSLATED = {
    "add a constant at an index": lambda x: x.at[0].add(-0.5) ** 2,
    "add to a constant": jnp.asarray(TABLE).at[1:].add,
    "add twice to one place": jnp.zeros(2).at[jnp.array([0, 0, 1])].add,
    "set": lambda x: x.at[1].set(2.0) * x,
    "set a slice": jnp.asarray(TABLE).at[:3].set,
    "multiply by a table": lambda x: x * TABLE[:3],
    "gather with constant indices": lambda x: x[jnp.array([2, 0, 0, 1])] * TABLE,
    "take with fill": lambda x: jnp.take(x, jnp.array([0, 7]), mode="fill", fill_value=2.5),
    "take that clips": lambda x: jnp.take(x, jnp.array([0, 7]), mode="clip"),
    "pad": lambda x: jnp.pad(x, (1, 2), constant_values=3.5) ** 2,
    "where with constants": lambda x: jnp.where(jnp.arange(3) > 1, x, 1 / x),
    "cumsum": lambda x: jnp.cumsum(x[::-1]) * jnp.cumsum(x),
    "convolution": lambda x: jnp.convolve(x, TABLE[:2] + 1) * jnp.convolve(x[:2], x),
    "loop": loop,
    "derivative of a loop with indices": jax.grad(lambda x: jnp.sum(loop(x))),
    "scan backwards": lambda x: jax.lax.scan(
        lambda c, y: (c * y + 1, c), 0.5 * x[0], x, reverse=True
    )[1],
    "solve by hand": solve,
    "matrix": lambda x: x @ MATRIX @ x + MATRIX @ x,
    "batched product": lambda x: jnp.einsum("ij,jk,k->i", jnp.outer(x, x), MATRIX, x),
    "custom derivative": lambda x: (
        jax.checkpoint(cube)(x) + jax.grad(lambda y: jnp.sum(cube(y)))(x)
    ),
    "branch of a constant": lambda x: jax.lax.cond(
        jnp.asarray(True), lambda y: y * 2, lambda y: y * 3, x
    ),
    "switch beyond its branches": lambda x: jax.lax.switch(
        jnp.asarray(9), [lambda y: y, lambda y: -y], x
    ),
    "functions": lambda x: jnp.tanh(x) + jnp.sinh(x) * jnp.cosh(x) - jnp.expm1(x) / jnp.log1p(x),
    "powers": lambda x: x**-3 + x**2.5 + x**0.3 + jax.lax.rsqrt(x) + jax.nn.sigmoid(x),
    "arc functions": lambda x: jnp.arctan(x) * jnp.arcsin(x) - jnp.arccos(x) + jnp.tan(x),
    "product of all": lambda x: jnp.prod(x) + jnp.mean(x) + jnp.var(x),
    "a sum of a part": lambda x: jnp.sum(jnp.outer(x, MATRIX[0]), axis=0),
    "norm": lambda x: x / jnp.linalg.norm(x),
    "norm times a number": lambda x: jnp.linalg.norm(x) * x,
    "sines": lambda x: jnp.sin(x) * x + jnp.cos(x),
    "roll": lambda x: jnp.roll(x, 1) - jnp.flip(x),
    "split": lambda x: jnp.concatenate(jnp.split(x * x, 3)[::-1]),
    "constant of float32": lambda x: x * jnp.float32(0.1),
    "constant of integers": lambda x: x * jnp.arange(3) + 7 // 2,
    "remainder of constants": lambda x: x[jnp.arange(3) % 2],
    "computed powers": lambda x: x**x + 0.3**x + x**-0.3 + jnp.exp2(x),
    "inverse functions": lambda x: (
        jnp.arcsinh(-x) + jnp.arccosh(1 + x) - jnp.arctanh(x) * jnp.cbrt(x)
    ),
    "angles in all quadrants": lambda x: jnp.stack(
        [jnp.arctan2(a * x[0], b * x[1]) for a in (1, -1) for b in (1, -1)]
    ),
    "multiply at places": lambda x: x.at[jnp.array([0, 2, 0])].multiply(x + 1).at[9].multiply(3),
    "cumulative products": lambda x: jnp.stack(
        [jnp.cumprod(x), jax.lax.cumprod(x, reverse=True), jax.lax.stop_gradient(x)]
    ),
    "loop with a count": lambda x: jax.lax.while_loop(
        lambda c: c[0] < 3, lambda c: (c[0] + 1, c[1] * x + c[0]), (0, x)
    )[1],
    "constants without rounding": lambda x: x * jnp.round(jnp.sort(jnp.asarray(TABLE[:3])) % 2),
    "derivative of a changed array": jax.grad(lambda y: jnp.sum(y.at[1].add(2) ** 3)),
}

MATRIX_OF = lambda x: jnp.asarray([[2.0, 0.3], [-0.5, 1.5]]) + jnp.outer(x[:2], x[1:])  # noqa: E731
UP = np.array([0.0, 1.0, 2.0])
CONDITIONS = {  # which are the same for all states of the box, but not for those of a wider one
    "abs": lambda x: jnp.abs(x) + jnp.abs(-x) * x,
    "sign": lambda x: jnp.sign(-x) * x + jnp.heaviside(x, 0.5),
    "where": lambda x: jnp.where(x > 0.2, x * x, jnp.sqrt(x - 0.6)),
    "where of abs": lambda x: jnp.where(jnp.abs(x - 0.6) < 1, x, 0.0),
    "cond": lambda x: jax.lax.cond(x[0] < 1, lambda y: y * y, lambda y: y, x),
    "clip": lambda x: jnp.clip(x, 0.1, 0.95) * x + jnp.clip(x, 1.0, 2.0) ** 2,
    "minimum, maximum": lambda x: jnp.minimum(x, 2 * x) + jnp.maximum(x, 0.1) + jnp.fmax(x, 0.2),
    "floor, ceil, trunc": lambda x: (jnp.floor(x + 2) + jnp.ceil(-x) - jnp.trunc(x + 1)) * x,
    "round": lambda x: jnp.round(x + 0.3, 0) * x,
    "mod, fmod": lambda x: jnp.mod(-x, 1.0) * jnp.fmod(-x - 2, 1.5) + x // 0.95,
    "integers": lambda x: x * (x + 1.05).astype(int) + x.astype(bool),
    "computed index": lambda x: jnp.asarray(TABLE)[(x + 2.05).astype(int)] * x,
    "interp": lambda x: jnp.interp(x, jnp.asarray([0.0, 0.25, 0.95, 2.0]), TABLE),
    "softplus, logaddexp": lambda x: jax.nn.softplus(x) * jnp.logaddexp(x, -x - 0.5),
    "relu, elu": lambda x: jax.nn.relu(x) + jax.nn.elu(-x) * jax.nn.leaky_relu(-x),
    "softmax": lambda x: jax.nn.softmax(x + UP) - jax.nn.logsumexp(x + UP),
    "sinc": jnp.sinc,
    "norms": lambda x: jnp.linalg.norm(x, ord=4) * x + jnp.linalg.norm(x + UP, ord=jnp.inf),
    "sort": lambda x: jnp.sort(x[::-1] + UP) * x + jnp.argsort(-x - UP),
    "largest": lambda x: jnp.max(x + UP) * jnp.argmin(x + UP[::-1]) - jnp.min(x - UP),
    "at min, max": lambda x: x.at[0].min(0.95).at[1].max(1.5).at[jnp.array([2])].max(0.1),
    "while": lambda x: jax.lax.while_loop(lambda y: y[0] < 2, lambda y: y + 0.95, x),
    "derivative": jax.grad(lambda x: jnp.sum(jnp.abs(x) ** 3) + jnp.hypot(x[0] + 1, x[1])),
    "tile": lambda x: jnp.tile(x, 2)[1:4] * jnp.nan_to_num(x),
    "solve": lambda x: (
        jnp.linalg.solve(MATRIX_OF(x), x[:2]) + jnp.linalg.inv(MATRIX[:2, :2]) @ x[:2]
    ),
    "determinant": lambda x: jnp.linalg.det(3 * jnp.eye(4) + jnp.outer(UP[:1] + x[0], UP[1:2])) * x,
    "Cholesky": lambda x: jnp.linalg.cholesky(jnp.diag(x) + 0.1) @ x,
    "hypot": lambda x: jnp.hypot(x, x[::-1]) + jnp.hypot(x[0], 0.3),
}
ANYWHERE = (
    "hypot",
    "Cholesky",
    "determinant",
    "solve",
    "tile",
)  # the checker rejects singular states

REFUSED = {
    "staircase": (lambda x: x - (3 * x).astype(int), "int"),
    "conversion to float32": (lambda x: x.astype(jnp.float32).astype(float) ** 3, "float32"),
    "conversion to bool": (lambda x: x * (x - 0.5).astype(bool), "bool"),
    "product in float32": (
        lambda x: jax.lax.dot(x, x, preferred_element_type=jnp.float32) * x, "float32"),
    "reduced precision": (lambda x: jax.lax.reduce_precision(x, 8, 10), "reduce_precision"),
    "table with a computed index": (lambda x: jnp.asarray(TABLE)[(x * 2).astype(int)], "indices"),
    "slice at a computed place": (
        lambda x: jax.lax.dynamic_slice(x, ((x[0] * 2).astype(int),), (1,)), "indices"),
    "update at a computed place": (
        lambda x: jax.lax.dynamic_update_slice(x, x[:1], ((x[0] * 2).astype(int),)), "indices"),
    "addition at a computed place": (lambda x: x.at[(x[0] * 2).astype(int)].add(1.0), "indices"),
    "largest": (lambda x: x * jnp.argmax(x), "int"),
    "index out of range": (
        lambda x: jnp.take(x, jnp.array([0, 7]), mode="fill"), "out of range|nan"),
    "comparison": (lambda x: jnp.where(x > 0.5, x, 0.0), "select_n"),
    "comparison as a number": (lambda x: (x > 0.5) * x, "bool"),
    "floor": (lambda x: x - jnp.floor(3 * x), "floor"),
    "remainder": (lambda x: x % 0.25, "rem|floor|select_n"),
    "absolute value": (lambda x: jnp.abs(x - 0.5), "abs"),
    "maximum": (lambda x: jnp.maximum(x, 0.5), "max"),
    "clip": (lambda x: jnp.clip(x, 0.4, 0.5), "max|min|clamp"),
    "sign": (lambda x: jnp.sign(x - 0.5), "sign"),
    "sorted": (lambda x: jnp.sort(x) * x, "sort"),
    "interpolation": (lambda x: jnp.interp(3 * x, jnp.arange(4.0), TABLE), "select_n|int|computed"),
    "loop without an end": (
        lambda x: jax.lax.while_loop(lambda n: n >= 0, lambda n: n * 0, 0) * x, "int64"),
    "loop until": (
        lambda x: jax.lax.while_loop(lambda y: y[0] < 2, lambda y: y * 2, x), "while"),
    "branch of the state": (
        lambda x: jax.lax.cond(x[0] > 0.5, lambda y: y, lambda y: -y, x), "cond|convert|bool"),
    "an infinite constant": (lambda x: x * jnp.inf, "inf"),
    "an error function": (jax.scipy.special.erf, "erf"),
    "a constant of another function": (
        lambda x: x * jax.lax.lgamma(jnp.asarray(0.3)), "lgamma .*outside"),
    "complex numbers": (lambda x: jnp.real(jnp.exp(1j * x)), "complex|real"),
}  # fmt: skip


def points():
    return random_points([BOX])


@pytest.mark.parametrize("name", [*TRANSLATED, *CONDITIONS])
def test_the_list_is_the_function(name):
    """In long double, at random points, without the comparison of the package."""
    function = (TRANSLATED | CONDITIONS)[name]
    program = program_of(function, (3,), points=points() if name in CONDITIONS else None)
    (x,) = points()
    values = exact.run(program, list(x.T.astype(np.longdouble)), LONG_DOUBLE)
    values = np.stack([np.broadcast_to(v, len(x)) for v in values]).astype(float)
    function = jax.jit(function)
    expected = np.stack([np.ravel(function(jnp.asarray(row))) for row in x[:6]], 1)
    np.testing.assert_allclose(values[:, :6], expected, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("name", REFUSED)
def test_what_a_list_cannot_express_is_refused_by_name(name):
    function, word = REFUSED[name]
    with pytest.raises(NotAnalytic, match=word):
        program_of(function, (3,), points=points())


@pytest.mark.parametrize("name", [name for name in CONDITIONS if name not in ANYWHERE])
def test_a_condition_that_changes_in_the_domain_is_refused(name):
    wide = random_points([(np.full(3, -2.2), np.full(3, 2.1))])
    for seen in (wide, None):
        with pytest.raises(NotAnalytic, match="does not allow"):
            program_of(CONDITIONS[name], (3,), points=seen)


def system_of(name):
    """One step adds the function to p; the invariant has it, too."""
    function = (TRANSLATED | CONDITIONS)[name]
    system = dvi.System(
        lambda t0, t1, q, p, args: (p @ p + q @ q) / 2,
        force=lambda t0, t1, q, p, args: jnp.zeros(3) + jnp.sum(jnp.atleast_1d(function(q))),
    )
    return system, lambda q, p: p @ UP + jnp.sum(function(q)) * 0.3 + q @ p


DOMAIN = np.stack([np.full(3, 0.35), np.full(3, 0.85)]), np.full(3, 0.02)


def largest_change(name):
    """By ascent from random states, of the step and the invariant computed by JAX."""
    system, invariant = system_of(name)
    rng = np.random.default_rng(0)
    low, high = (np.stack([DOMAIN[0][k], (2 * k - 1) * DOMAIN[1]]) for k in (0, 1))

    def change(x):
        p1 = x[1] + 0.1 * (system.force(0.0, 0.1, x[0], x[1], None) - x[0])
        return jnp.abs(invariant(x[0] + 0.1 * p1, p1) - invariant(*x))

    change, x = jax.jit(jax.vmap(change)), rng.uniform(low, high, (4000, 2, 3))
    for k in range(12):
        best = x[np.argsort(change(x))[-200:]]
        shift = 0.5**k * (high - low) * rng.normal(size=(20, 200, 2, 3))
        x = np.clip(best + shift, low, high).reshape(4000, 2, 3)
    return float(np.max(change(x)))


def check_bound(name):
    system, invariant = system_of(name)
    how = {"h": 0.1, "epsilon": (1.0, 1.0 + 2**-40), "domain": DOMAIN, "ratio": 3.0}
    bound = dvi.bound_drift(invariant, system, **how, max_boxes=300)
    largest = largest_change(name)
    assert 0 < largest <= bound.per_step[0] * (1 + 1e-12) <= 8 * largest
    assert dvi.holds_for(system, bound, invariant)
    return bound


# "where of abs" is in the next test; the pivots of the determinant are not decided on a box.
OTHERS = {"where of abs", "determinant"}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in CONDITIONS if name not in OTHERS])
def test_a_bound_with_conditions_is_above_the_largest_change(name):
    check_bound(name)


def test_the_checker_proves_a_condition():
    """In a wider domain, where |x − 0.6| < 1 does not hold, the same list is rejected."""
    certificate = check_bound("where of abs").certificate
    assert "a step changes I" in exact.check(certificate)
    for side, value in ((0, -0.5), (1, 1.7)):
        domain = [[*ends] for ends in certificate["domain"]]
        domain[side][0] = value.hex()
        other = certificate | {"domain": domain}
        with pytest.raises(exact.Failure, match="sqrt is singular"):
            exact.check(other | {"hash": exact.digest(other)})


def test_a_condition_that_changes_between_the_points_is_not_proved():
    """(q − 0.6)² < 1e-12 holds at none of the points."""
    force = lambda t0, t1, q, p, args: jnp.where((q - 0.6) ** 2 < 1e-12, 5.0, q)  # noqa: E731
    system = dvi.System(lambda t0, t1, q, p, args: p @ p / 2, force=force)
    how = {"h": 0.1, "epsilon": 1.0, "domain": (np.array([[0.3], [0.8]]), np.array([0.1]))}
    with pytest.raises(dvi.ProofError, match="a condition"):
        dvi.bound_drift(lambda q, p: jnp.sum(p), system, **how, max_boxes=50)


def test_linear_systems_are_refused_where_xla_solves_them():
    solve = CONDITIONS["solve"]
    with pytest.raises(NotAnalytic, match="triangular_solve"):
        program_of(solve, (3,), way="XLA", points=points())


# --- the comparison ------------------------------------------------------------------------------


def of_module(name, spoiled):
    """A fault of a function of the translator: `spoiled` makes the wrong one from the right one."""
    return components, name, spoiled


def of_numbers(name, spoiled):
    return components.ProgramNumber, name, spoiled


def of_rule(name, rule):
    """A wrong rule for one elementary operation."""
    return components._ELEMENTWISE, name, lambda right: rule


def result(change):
    return lambda right: lambda *args: change(right(*args))


def one_round_less(right):
    return lambda params: (params.update(length=params["length"] - 1), right(params))[1]


def without_constants(right):
    """The fault that this package had."""

    def linear(program, equation, values):
        return right(program, equation, [values[0] * 0, *values[1:]])

    return linear


def rounded(right):
    def scalar(self, other):
        return right(self, other if isinstance(other, components.ProgramNumber) else other + 1e-8)

    return scalar


def exchanged(old, new):
    return lambda right: lambda x, name: right(x, new if name == old else name)


MISTRANSLATIONS = {
    "sinh for cosh": ("functions", of_rule("sinh", lambda a: (a.apply("exp") + 1) * 0.5)),
    "tanh of x/2": ("functions", of_rule("tanh", lambda a: 1 - 2 / (a.apply("exp") + 1))),
    "exp for expm1": ("functions", of_rule("expm1", lambda a: a.apply("exp"))),
    "log for log1p": ("functions", of_rule("log1p", lambda a: a.apply("log"))),
    "the sigmoid of −x": ("powers", of_rule("logistic", lambda a: 1 / (a.apply("exp") + 1))),
    "1/x for 1/√x": ("powers", of_rule("rsqrt", lambda a: 1 / a)),
    "a − b as b − a": ("roll", of_rule("sub", lambda a, b: b - a)),
    "a/b as b/a": ("norm", of_rule("div", lambda a, b: b / a)),
    "a + b as a": ("matrix", of_rule("add", lambda a, b: a)),
    "a b as a": ("norm times a number", of_rule("mul", lambda a, b: a)),
    "a power with |n|": ("powers", of_numbers("power", lambda f: lambda x, n: f(x, abs(n)))),
    "√x for x^y": ("powers", of_rule("pow", lambda x, y: x.apply("sqrt"))),
    "a constant with an error of 1e-8": ("functions", of_numbers("_scalar", rounded)),
    "a product transposed": ("matrix", of_module("_dot", result(lambda out: out[:, ::-1]))),
    "a sum without its last term": ("matrix", of_module("total", lambda f: lambda x: f(x[:-1]))),
    "places moved by one": (
        "roll", of_module("_rearrange", result(lambda outs: [np.roll(x, 1) for x in outs]))),
    "a sum of places without constants": (
        "add to a constant", of_module("_linear", without_constants)),
    "a loop without its last round": ("loop", of_module("scan_counts", one_round_less)),
    "a loop forwards": ("scan backwards", of_module("_scan", result(lambda outs: outs[::-1]))),
    "arc sine for arc cosine": ("arc functions", of_numbers("apply", exchanged("acos", "asin"))),
    "cosine for sine": ("sines", of_numbers("apply", exchanged("sin", "cos"))),
    "x − y as x + y": ("roll", of_numbers("__sub__", lambda f: lambda x, y: x + y)),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTRANSLATIONS)
def test_a_seeded_mistranslation_is_found(name, monkeypatch):
    case, (place, attribute, spoiled) = MISTRANSLATIONS[name]
    function = TRANSLATED[case]
    right = program_of(function, (3,))
    assert compare("the function", function, right, points()) == comparison.POINTS
    if isinstance(place, dict):
        monkeypatch.setitem(place, attribute, spoiled(place[attribute]))
    else:
        monkeypatch.setattr(place, attribute, spoiled(getattr(place, attribute)))
    program = program_of(function, (3,))
    assert program != right
    with pytest.raises(Mistranslated, match="list of operations"):
        compare("the function", function, program, points())


def test_a_proof_stops_at_a_mistranslation(monkeypatch):
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2 + jnp.sum(jnp.cos(q)))
    energy = lambda q, p, epsilon: (p @ p + q @ q) / 2 + jnp.sum(jnp.cos(q))  # noqa: E731
    how = {"h": 0.1, "epsilon": 0.1, "domain": np.array([0.5])}
    assert dvi.bound_drift(energy, system, **how).per_step[0] > 0
    right = components.ProgramNumber.apply
    spoiled = lambda x, name: right(x, "cos" if name == "sin" else name)  # noqa: E731
    monkeypatch.setattr(components.ProgramNumber, "apply", spoiled)
    with pytest.raises(Mistranslated, match="the step of the system"):
        dvi.bound_drift(energy, system, **how)


def test_a_function_that_is_not_a_number_where_the_list_has_a_value_is_refused():
    """0·log(x) has no operation in the list."""
    function = lambda x: x + 0.0 * jnp.log(x - 0.6)  # noqa: E731
    program = program_of(function, (3,))
    with pytest.raises(Mistranslated, match="nan"):
        compare("the function", function, program, points())
