"""The rounding that a proof assumes is at least that of the computer, for both ways of running.

The claims are those of the checker for the list of operations of a function; the truth is the
difference between computed values and mpmath.
"""

import os
from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

import dvi_jax as dvi
import lanewise

pytest.importorskip("flint")
from flint import arb
from test_double_double import FUNCTIONS as PAIR_FUNCTIONS, drawn, worst

from dvi_jax.proof import checker as exact, components, scalars, ways
from dvi_jax.proof.components import program_of

WAYS = "machine code", "XLA"
ARRAYS = dvi.Layout(form="arrays")
NUMBERS = (-1e3, 1e3), (1e-300, 1e-3), (-1e-3, -1e-300), (1e3, 1e15)
"""Ranges of arguments: those with one sign are drawn evenly by logarithm."""
POSITIVE = (1e-300, 1e300), (0.2, 4.0), (1.0, 1 + 1e-9)
EXPONENTS = (-700.0, 700.0), (-40.0, 40.0), (-2.0, 2.0), (1e-300, 1e-3), (-1e-3, -1e-300)

POWERS = (-24.0, -3.0, -1.5, -0.5, 0.3, 0.5, 2.5, 7.0, 65.0)
mp = mpmath.mp
FUNCTIONS = {
    "exp": (jnp.exp, mp.exp, EXPONENTS),
    "expm1": (jnp.expm1, mp.expm1, EXPONENTS),
    "sinh": (jnp.sinh, mp.sinh, EXPONENTS),
    "cosh": (jnp.cosh, mp.cosh, EXPONENTS),
    "tanh": (jnp.tanh, mp.tanh, (*EXPONENTS, (10.0, 25.0))),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + mp.exp(-x)), EXPONENTS),
    "log": (jnp.log, mp.log, POSITIVE),
    "log1p": (
        jnp.log1p, mp.log1p,
        ((-0.4142, -0.35), (-0.99999, -1e-300), (1e-300, 1e-3), (0.1, 0.5), (1e-3, 1e300))),
    "sqrt": (jnp.sqrt, mp.sqrt, POSITIVE),
    "rsqrt": (jax.lax.rsqrt, lambda x: 1 / mp.sqrt(x), POSITIVE),
    "inverse": (lambda x: 1 / x, lambda x: 1 / x, POSITIVE),
    "sin": (jnp.sin, mp.sin, (*NUMBERS, (1e15, 1e300))),
    "cos": (jnp.cos, mp.cos, (*NUMBERS, (1e15, 1e300))),
    "tan": (jnp.tan, mp.tan, (*NUMBERS, (1e15, 1e300))),
    "atan": (jnp.arctan, mp.atan, (*NUMBERS, (1e15, 1e300))),
    "asin": (jnp.arcsin, mp.asin, ((-0.9999, 0.9999), (0.99, 1 - 1e-12), (1e-300, 1e-3))),
    "acos": (jnp.arccos, mp.acos, ((-0.9999, 0.9999), (0.99, 1 - 1e-12), (1e-300, 1e-3))),
    **{
        f"power {y}": (lambda x, y=y: jax.lax.pow(x, y), lambda x, y=y: x**y, POSITIVE)
        for y in POWERS
    },
    "a whole power": (lambda x: x**-7, lambda x: x**-7, POSITIVE),
    "a computed power": (lambda x: x ** (x - 0.7), lambda x: x ** (x - mp.mpf(0.7)),
                         ((1e-300, 1.0), (0.2, 4.0), (1.0, 100.0))),
    "a power of a constant": (lambda x: 0.3**x, lambda x: mp.mpf(0.3) ** x, EXPONENTS),
    "exp2": (jnp.exp2, lambda x: mp.mpf(2) ** x, EXPONENTS),
    "cbrt": (jnp.cbrt, mp.cbrt, POSITIVE),
    "asinh": (jnp.arcsinh, mp.asinh, NUMBERS),
    "acosh": (jnp.arccosh, mp.acosh, ((1.0001, 2.0), (1.0, 1 + 1e-9), (2.0, 1e15))),
    "atanh": (jnp.arctanh, mp.atanh, ((-0.999, 0.999), (1e-300, 1e-3), (-1e-3, -1e-300))),
    "atan2": (lambda x: jnp.arctan2(x, 0.7 - x), lambda x: mp.atan2(x, mp.mpf(0.7) - x), NUMBERS),
    "hypot": (lambda x: jnp.hypot(x, 0.7 - x), lambda x: mp.hypot(x, mp.mpf(0.7) - x), NUMBERS),
    "atan2 of a small number": (lambda x: jnp.arctan2(x, x * x), lambda x: mp.atan2(x, x * x),
                                ((1e-12, 1e3), (-3.0, 3.0))),
}  # fmt: skip

ORDINARY = ((-30.0, 30.0), (1e-12, 1.0), (22.0, 29.0))
REWRITTEN = {
    "exp(x) exp(y)": (lambda x: jnp.exp(2 * x) * jnp.exp(x / 2), lambda x: mp.exp(2.5 * x)),
    "a cube of exp": (lambda x: jnp.exp(x) ** 3, lambda x: mp.exp(3 * x)),
    "a power of exp": (lambda x: jnp.exp(x / 7) ** 12, lambda x: mp.exp(x / 7 * 12)),
    "a real power of exp": (
        lambda x: jax.lax.pow(jnp.exp(x), 1.7), lambda x: mp.exp(x * mp.mpf(1.7))),
    "exp(x)/exp(y)": (
        lambda x: jnp.exp(x) / jnp.exp(0.3 * x), lambda x: mp.exp(x - x * mp.mpf(0.3))),
    "z/exp(x)/exp(y)": (lambda x: x / jnp.exp(x) / jnp.exp(-3 * x), lambda x: x * mp.exp(2 * x)),
    "log(exp(x))": (lambda x: jnp.log(jnp.exp(x)), lambda x: x),
    "log of a power": (lambda x: jnp.log((x * x) ** 1.5), lambda x: 3 * mp.log(abs(x))),
    "quotients": (lambda x: ((x / 3) / (x * x + 2)) / (7 / x),
                  lambda x: x * x / (21 * (x * x + 2))),
    "a quotient by a root": (lambda x: x / jnp.sqrt(x * x + 1) ** 3,
                             lambda x: x / mp.sqrt(x * x + 1) ** 3),
    "sums with constants": (lambda x: ((x + 1e6) - 1e6) * 3 + 5 * (x - 0.1),
                            lambda x: 8 * x - 5 * mp.mpf(0.1)),
    "a product and a sum": (lambda x: x * x - (x * 1.1) * x, lambda x: x * x * (1 - mp.mpf(1.1))),
}  # fmt: skip
"""What XLA's simplifier writes in another way, or what LLVM contracts."""
CASES = FUNCTIONS | {name: (*pair, ORDINARY) for name, pair in REWRITTEN.items()}


def arguments(ranges, count):
    """Random numbers of ranges, and their ends."""
    rng, rows = np.random.default_rng(0), []
    for low, high in ranges:
        if low * high > 0:
            size = np.exp(rng.uniform(*np.sort(np.log(np.abs([low, high]))), count))
            rows.append(np.sign(low) * size)
        else:
            rows.append(rng.uniform(low, high, count))
        rows.append([low, high])
    return np.concatenate(rows)


def computed(function, x, way):
    by = lanewise.batched if way == "machine code" else jax.vmap
    return np.asarray(jax.jit(by(function))(jnp.asarray(x)))


def claims(function, x, way):
    """The claimed errors of the values at these points; NaN where nothing is claimed."""
    program = program_of(function, (), way=way)
    algebra = exact.Rounding(exact.UNITS["float64"], exact.WAYS[way])
    exact.ctx.prec, errors = 160, []
    for value in x:
        try:
            start = [(exact.ball(Fraction(float(value))), arb(0))]
            errors.append(exact.round_up(exact.run(program, start, algebra)[0][1]))
        except (exact.Failure, ValueError, ArithmeticError):
            errors.append(np.nan)
    return np.array(errors)


def largest_share(name, way, count):
    """The largest error over its claim; at least a third of the points have a claim."""
    function, reference, ranges = CASES[name]
    x = arguments(ranges, count)
    claim = claims(function, x, way)
    with mpmath.workprec(200):
        pairs = zip(computed(function, x, way), x, claim, strict=True)
        shares = [
            float(abs(mp.mpf(float(y)) - reference(mp.mpf(float(v)))) / mp.mpf(c))
            for y, v, c in pairs
            if np.isfinite(c)
        ]
    assert len(shares) > len(x) / 3
    return max(shares)


QUICK = "log1p", "sinh", "tanh", "power -3.0", "a cube of exp", "quotients"


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", QUICK)
def test_an_error_is_at_most_its_claim(name, way):
    assert 0.01 < largest_share(name, way, 40) <= 1


TIGHT = (
    "hypot",
    "sqrt",
    "inverse",
    "rsqrt",
    "a whole power",
    *(f"power {y}" for y in POWERS),
    *REWRITTEN,
)
"""Cases with operations that are rounded to nearest, whose errors reach their bounds."""


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", CASES)
def test_an_error_is_at_most_its_claim_at_many_points(name, way):
    """Half of it for elementary functions: the errors of other points may be larger."""
    assert largest_share(name, way, 400) <= (1 if name in TIGHT else 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("name", PAIR_FUNCTIONS)
def test_xla_has_the_functions_of_pairs_of_the_machine_code(name):
    function, reference, ranges = PAIR_FUNCTIONS[name]
    for low, high in ranges:
        with mpmath.workdps(60):
            error = worst(function, reference, drawn(low, high), by=jax.vmap)
        assert error < 5e-31


def test_a_linear_system_is_solved_with_at_most_the_claimed_error():
    """Its rows are exchanged, in machine code, as in the list."""
    rows = [[0.1, 2.0, 0.3], [4.0, 0.2, -1.0], [0.3, 0.1, 1.0]]
    function = lambda x: jnp.linalg.solve(jnp.asarray(rows) + x, jnp.arange(3.0) * x)[0]  # noqa: E731
    x = arguments(((0.2, 0.9),), 200)
    program = program_of(function, (), points=[x])
    algebra, claim = exact.Rounding(exact.UNITS["float64"]), []
    exact.ctx.prec = 160
    for value in x:
        start = [(exact.ball(Fraction(float(value))), arb(0))]
        claim.append(exact.round_up(exact.run(program, start, algebra)[0][1]))
    errors = []
    with mpmath.workprec(200):
        for v, y in zip(x, computed(function, x, "machine code"), strict=True):
            matrix = mp.matrix(rows) + mp.matrix(3, 3).apply(lambda _, v=v: mp.mpf(float(v)))
            right = mp.matrix([k * mp.mpf(float(v)) for k in range(3)])
            errors.append(float(abs(mp.lu_solve(matrix, right)[0] - mp.mpf(float(y)))))
    shares = np.array(errors) / claim
    assert 0.01 < shares.max() <= 1


# --- the controls --------------------------------------------------------------------------------


def test_a_negative_power_in_machine_code_has_more_error_than_a_quotient():
    """The claim for 1/x³ is false for x**-3, which is (1/x)³ in machine code."""
    x = arguments(((0.2, 4.0),), 1000)
    claim = claims(lambda x: 1 / (x * x * x), x, "machine code")
    values = computed(lambda x: x**-3, x, "machine code")
    with mpmath.workprec(200):
        pairs = zip(values, x, strict=True)
        errors = [float(abs(mp.mpf(float(y)) - mp.mpf(float(v)) ** -3)) for y, v in pairs]
    assert (np.array(errors) > claim).any()
    assert (errors <= claims(lambda x: x**-3, x, "machine code")).all()


@pytest.mark.parametrize("name", ["log1p", "cosh", "tanh", "a cube of exp"])
def test_without_the_model_of_xla_a_claim_is_false(name, monkeypatch):
    monkeypatch.setattr(components, "RESULT_UNITS", {})
    monkeypatch.setattr(components, "ARGUMENT_UNITS", {})
    monkeypatch.setattr(scalars, "exponentials_in_products", lambda operations: 0)
    assert largest_share(name, "XLA", 200) > 1


LARGE_ERRORS = {  # with the range of arguments where the error is large
    "log1p": (jnp.log1p, np.log1p, (-0.4143, -0.4141)),
    "atanh": (jnp.arctanh, np.arctanh, (-0.4143, -0.4141)),
    "expm1": (jnp.expm1, np.expm1, (-0.01, 0.01)),
    "tanh": (jnp.tanh, np.tanh, (-5.0, 5.0)),
    "logistic": (jax.nn.sigmoid, lambda x: 1 / (1 + np.exp(-x)), (-40.0, -1.0)),
    "pow": (lambda x: jax.lax.pow(x, 0.3), lambda x: x ** np.longdouble(0.3), (0.9, 1.1)),
}


def test_the_errors_of_xla_are_at_most_half_of_those_of_its_model():
    """And more than an eighth of them: where a number of the model is too small, this fails."""
    rng = np.random.default_rng(0)
    assert LARGE_ERRORS.keys() == ways.RESULT_UNITS.keys()
    for name, (function, reference, ends) in LARGE_ERRORS.items():
        x = rng.uniform(*ends, 20_000)
        exact_values = reference(x.astype(np.longdouble))
        errors = np.abs(computed(function, x, "XLA") - exact_values) / np.abs(exact_values)
        units = ways.RESULT_UNITS[name]
        assert units / 8 < float(np.max(errors)) * 2.0**53 <= units / 2, name


def test_products_that_xla_regroups_are_in_range():
    """(x c) c' is x (c c') for XLA, and here infinite."""
    function = lambda x: (x * 2.0**600) * 2.0**600  # noqa: E731
    x = np.array([2.0**-700])
    assert np.isfinite(computed(function, x, "machine code")).all()
    assert not np.isfinite(computed(function, x, "XLA")).all()
    assert np.isfinite(claims(function, x, "machine code")).all()
    assert np.isnan(claims(function, x, "XLA")).all()


# --- the way in a certificate --------------------------------------------------------------------


def momentum(q, p, epsilon):
    return jnp.sum(p)


def forced(force):
    return dvi.System(lambda t0, t1, q, p, args: (p @ p) / 2, force=force)


LOGARITHM = forced(lambda t0, t1, q, p, args: jnp.log1p(q))
ONCE = {"h": 1.0, "epsilon": (1.0, 1.0 + 2**-40)}
BOX = np.array([[-0.4142], [-0.413]]), np.array([[0.0], [1e-9]])


@pytest.fixture(scope="module")
def proofs():
    """Proofs about the same system for both ways, by the layout."""
    return {
        way: dvi.bound_drift(momentum, LOGARITHM, domain=BOX, layout=layout, **ONCE)
        for way, layout in zip(WAYS, (None, ARRAYS), strict=True)
    }


@pytest.mark.parametrize("way", WAYS)
def test_a_step_has_the_claimed_rounding(proofs, way):
    q = np.linspace(*BOX[0][:, 0], 4000)
    layout = ARRAYS if way == "XLA" else None

    def step(q):
        given = {"h": 1.0, "num_steps": 1, "epsilon": 1.0, "method": dvi.TypeII()}
        return dvi.integrate(LOGARITHM, q[None], jnp.zeros(1), layout=layout, **given).ps[-1, 0]

    values = np.asarray(jax.vmap(step)(q))
    error = max(
        float(abs(mp.mpf(float(p)) - mp.log1p(mp.mpf(float(x)))))
        for p, x in zip(values, q, strict=True)
    )
    assert error <= proofs[way].rounding[0]
    if way == "XLA":  # the control: the other proof says nothing about this run
        assert error > proofs["machine code"].rounding[0]


def test_a_certificate_names_its_way(proofs):
    for way, bound in proofs.items():
        assert bound.certificate["way"] == way
        assert f"by {way}" in exact.check(bound.certificate)
        assert f"by {way}" in str(bound)
        other = bound.certificate | {"way": "GPU"}
        with pytest.raises(KeyError):
            exact.check(other | {"hash": exact.digest(other)})


def test_a_proof_holds_for_its_way_of_running(proofs, monkeypatch):
    compiled, arrays = (proofs[way] for way in WAYS)
    assert dvi.holds_for(LOGARITHM, compiled, momentum)
    assert dvi.holds_for(LOGARITHM, arrays, momentum, layout=ARRAYS)
    assert "uses XLA here" in str(dvi.holds_for(LOGARITHM, compiled, layout=ARRAYS))
    assert "uses machine code here" in str(dvi.holds_for(LOGARITHM, arrays))
    monkeypatch.setenv("LANEWISE", "off")
    (difference,) = dvi.holds_for(LOGARITHM, compiled, momentum).differences
    assert "the variable LANEWISE is off" in difference
    assert dvi.holds_for(LOGARITHM, arrays, momentum)


def test_another_xla_has_other_errors(proofs):
    def made_with(bound):
        program = bound.certificate["program"]
        versions = program["versions"] | {"jaxlib": "0.0.1"}
        other = bound.certificate | {"program": program | {"versions": versions}}
        return other | {"hash": exact.digest(other)}

    compiled, arrays = (made_with(proofs[way]) for way in WAYS)
    assert dvi.holds_for(LOGARITHM, compiled)
    assert "jaxlib was 0.0.1" in dvi.holds_for(LOGARITHM, arrays, layout=ARRAYS).differences[0]


def test_a_way_whose_rounding_is_not_known_is_refused(proofs, monkeypatch):
    given = {"domain": BOX, **ONCE}
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", f"{os.environ['XLA_FLAGS']} --xla_cpu_enable_fast_math=true")
        with pytest.raises(ValueError, match=r"XLA_FLAGS=.*fast_math"):
            dvi.bound_drift(momentum, LOGARITHM, layout=ARRAYS, **given)
    monkeypatch.setattr(ways.jax, "default_backend", lambda: "gpu")
    with pytest.raises(ValueError, match="on a CPU, but JAX computes on a gpu"):
        dvi.bound_drift(momentum, LOGARITHM, **given)


def test_what_is_too_large_for_machine_code_is_run_by_xla():
    """So is everything without `jit`."""
    system = dvi.System(lambda t0, t1, q, p, args: (p @ p + q @ q) / 2)
    how = {"shape": (1,), "h": 0.1, "args": None}
    assert ways.way_of_running(system, dvi.Integrator(), **how) == ("machine code", "")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lanewise.targets.numbers.most_operations", lambda jaxpr: 10)
        way, reason = ways.way_of_running(system, dvi.Integrator(), **how)
    assert way == "XLA"
    assert "number of operations" in reason
    with jax.disable_jit():
        assert ways.way_of_running(system, dvi.Integrator(), **how)[0] == "XLA"


def test_loops_over_long_arrays_are_another_way_of_running():
    """Their sums have another order than the one whose rounding is bounded."""
    from dvi_jax.proof.ways import MACHINE_CODE, XLA, way_of_running

    system = dvi.System(lambda t0, t1, q, p, args: jnp.sum(p**2 + q**2) / 2)
    ways = [way_of_running(system, dvi.Integrator(), (n,), 0.1, None)[0] for n in (48, 49)]
    assert ways[0] == MACHINE_CODE
    assert ways[1] not in (MACHINE_CODE, XLA)
