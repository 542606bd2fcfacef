"""Random programs as text: a system, how it is integrated, and where it starts.

A program is a Python script, so that a failure that hypothesis has shrunk can be read and run.
"""

import dataclasses

import numpy as np
from hypothesis import strategies as st

HEAD = """
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import dvi_jax as dvi

jax.config.update("jax_enable_x64", True)

TABLE = np.array([0.3, -1.2, 0.7, 2.0, 0.1])
MATRIX = np.array([[2.0, 0.3, -0.1], [0.1, 1.5, 0.2], [0.0, -0.4, 1.0]])


@jax.custom_jvp
def bent(x):  # the slope of its rule is not the true one
    return jnp.sin(x)


bent.defjvp(lambda x, dx: (bent(*x), 1.25 * jnp.cos(x[0]) * dx[0]))


def rounds(x, bound):  # a loop whose number of rounds differs between trajectories
    def body(state):
        return state[0] + 1, 0.5 * state[1] + 0.1

    return lax.while_loop(lambda s: (s[0] < 5) & (jnp.abs(s[1]) > bound), body, (0, x))[1]


def solved(x, n):
    A = MATRIX[:n, :n] + jnp.diag(jnp.tanh(x))
    return jnp.linalg.solve(A, x)
"""


@dataclasses.dataclass(frozen=True)
class Program:
    """The parts of a script; `smooth` says that gradients can be compared with differences."""

    n: int
    dtype: str
    H: str
    W: str | None
    observable: str
    stop: str | None
    settings: str
    start: str
    smooth: bool
    width: int | None

    @property
    def text(self) -> str:
        force = "" if self.W is None else f"def W(t0, t1, q, p, args):\n    return {self.W}\n\n\n"
        stop = "None" if self.stop is None else f"dvi.Stop(lambda t, q, p, args: {self.stop})"
        return f"""{HEAD}

def H(t0, t1, q, p, args):
    return {self.H}


{force}def observable(t0, t1, q0, p0, q, p, args):
    return {self.observable}


SYSTEM = dvi.System(H, force={"None" if self.W is None else "W"})
STOP = {stop}


def run(q, p, epsilon, args, form="auto"):
    return dvi.integrate(
        SYSTEM, q, p, epsilon=epsilon, args=args, stop=STOP, throw=False,
        layout=dvi.Layout(form=form, width={self.width}), {self.settings},
    )


{self.start}
SMOOTH = {self.smooth}
"""


# --- expressions --------------------------------------------------------------------------------

# Most constants are of order one, so that most runs succeed; some are at the ends of the range.
ORDINARY = st.sampled_from([0.1, 0.25, 0.5, 1.0, -0.3, 1.5, 2.0, 0.7])
EXTREME = st.sampled_from([1e-30, 1e30, 1e-8, 1e8, 0.0, -0.0])
CONSTANTS = st.one_of(ORDINARY, ORDINARY, ORDINARY, EXTREME)

UNARY_SMOOTH = [
    "jnp.sin({0})", "jnp.cos({0})", "jnp.tanh({0})", "({0}) ** 2", "-({0})", "({0}) ** 3",
    "jnp.exp(-({0}) ** 2)", "jnp.log1p(({0}) ** 2)", "jnp.sqrt(1.0 + ({0}) ** 2)",
    "1.0 / (1.0 + ({0}) ** 2)", "jnp.arctan({0})", "jnp.exp(jnp.tanh({0}))",
    "lax.fori_loop(0, 3, lambda i, y: 0.5 * y + 0.1 * jnp.sin(y), {0})",
]  # fmt: skip
UNARY_OTHER = [
    "jnp.abs({0})", "jnp.sqrt(jnp.abs({0}))", "jnp.sign({0})", "jnp.clip({0}, -0.5, 0.8)",
    "jnp.log(jnp.abs({0}))", "jnp.exp({0})", "1.0 / ({0})", "({0}) ** -2", "jnp.floor({0})",
    "lax.stop_gradient({0})", "bent({0})", "jnp.arcsin({0})", "rounds({0}, 0.3)",
    "TABLE[jnp.clip(jnp.abs({0}), 0, 4).astype(int)]", "jnp.interp({0}, TABLE[:0:-1].cumsum(), "
    "TABLE[1:])", "jnp.float32({0}).astype(q.dtype)", "jnp.abs({0}) ** 1.5",
    "jnp.linalg.norm(jnp.stack([{0}, 0.5]))",
    "lax.fori_loop(0, jnp.clip(jnp.abs({0}), 0, 3).astype(int), lambda i, y: 0.9 * y, {0})",
]  # fmt: skip
BINARY_SMOOTH = ["({0}) + ({1})", "({0}) - ({1})", "({0}) * ({1})", "({0}) / (1.0 + ({1}) ** 2)"]
BINARY_OTHER = [
    "({0}) / ({1})", "jnp.maximum({0}, {1})", "jnp.minimum({0}, {1})", "jnp.hypot({0}, {1})",
    "jnp.where(({0}) > ({1}), {0}, {1})", "jnp.arctan2({0}, {1})",
    "jnp.mod(jnp.clip({0}, -9, 9), {1})",
    "lax.cond(({0}) > 0.2, lambda x: jnp.sin(x), lambda x: 0.3 * x, {1})",
    "jnp.abs({0}) ** ({1})", "jnp.logaddexp({0}, {1})",
]  # fmt: skip
VECTORS_SMOOTH = [
    "q @ q", "p @ q", "jnp.sum(q ** 2 * p)", "jnp.einsum('i,i->', jnp.sin(q), p)",
    "q @ (MATRIX[:{n}, :{n}] @ q)", "jnp.sum(jnp.concatenate([q, p]) ** 2)", "jnp.prod(q)",
    "jnp.sum(jnp.cumsum(q) * p)",
]  # fmt: skip
VECTORS_OTHER = [
    "jnp.linalg.norm(q)", "1.0 / jnp.linalg.norm(q)", "jnp.max(q)", "jnp.min(jnp.abs(q))",
    "q[jnp.argmax(p)]", "jnp.sort(q)[0]", "jnp.sum(solved(q, {n}))",
    "jnp.sum(jnp.where(q > 0, q, 0.5 * p))",
]  # fmt: skip


@st.composite
def expressions(draw, leaves, n, smooth, depth):
    """The text of a number made of the leaves."""
    kind = draw(st.integers(0, 5 if depth else 1))
    if kind <= 1:
        constants = ORDINARY if smooth else CONSTANTS
        return draw(st.one_of(st.sampled_from(leaves), constants.map(repr)))
    one = expressions(leaves, n, smooth, depth - 1)
    if kind == 2 and "q[0]" in leaves:
        vectors = VECTORS_SMOOTH if smooth else VECTORS_SMOOTH + VECTORS_OTHER
        return draw(st.sampled_from(vectors)).replace("{n}", str(n))
    if kind <= 3:
        unary = UNARY_SMOOTH if smooth else UNARY_SMOOTH + UNARY_OTHER
        return draw(st.sampled_from(unary)).format(draw(one))
    binary = BINARY_SMOOTH if smooth else BINARY_SMOOTH + BINARY_OTHER
    return draw(st.sampled_from(binary)).format(draw(one), draw(one))


# --- runs ---------------------------------------------------------------------------------------

METHODS = st.sampled_from(
    ["dvi.TypeII()"] * 12
    + ["dvi.Adjoint(dvi.TypeII())", "dvi.Strang()", "dvi.Yoshida(4)", "dvi.GaussLegendre(2)",
       "dvi.RungeKutta4()", "dvi.LobattoIIIAIIIB(2)"]
)  # fmt: skip
SAVES = st.sampled_from(
    ["dvi.Save()", "dvi.Save(every=3)", "dvi.Save(final=True)", "dvi.Save(every=4, final=True)"] * 4
    + ["dvi.Save(ts=np.array([0.07, 0.21]))"] * 2
    + ["dvi.Save(ts=np.array([0.01, 0.02]), clock=lambda t, q, p, args: t * (1 + 0.1 * t))"]
)  # fmt: skip
OBSERVED = st.sampled_from(
    ["observable", "dvi.MaxDrift(observable)", "dvi.Last(observable)", "dvi.Mean(observable)",
     "dvi.Range(observable)", "{'a': dvi.MaxDrift(observable), 'b': [observable, None]}"] * 3
    + ["[dvi.Mean(observable), dvi.Range(observable), dvi.Running(dvi.MaxDrift(observable))]",
     "dvi.Section(lambda t, q, p, args: q[0] - 0.45, max_crossings=3)",
     "(dvi.Section(lambda t, q, p, args: p[0], direction=1, max_crossings=2), observable)"]
)  # fmt: skip
# A program of Variational() takes XLA half a minute.
LATTICES = st.sampled_from(
    ["dvi.Uniform()"] * 48
    + ["dvi.Given(np.array([0.0, 0.05, 0.2, 0.25, 0.3]))"] * 5
    + ["dvi.TimeTransformed(lambda t, q, p, args: jnp.sqrt(0.1 + q @ q))"] * 3
    + ["dvi.AdaptiveReversible(lambda t, q, p, args: jnp.sqrt(0.1 + q @ q))"] * 2
    + ["dvi.Variational()"]
)
ARITHMETICS = st.sampled_from(
    ["dvi.FloatingPoint()"] * 6 + ["dvi.Compensated()", "dvi.FixedPoint(2.0 ** -30)"]
)
SOLVERS = st.sampled_from(
    ["dvi.Newton()"] * 6 + ["dvi.SimplifiedNewton()", "dvi.Picard()", "dvi.PicardThenNewton()"]
)
STARTS = st.one_of(
    st.sampled_from([0.5, -0.4, 1.1, 0.3, -0.9, 0.8]),
    st.sampled_from([0.5, -0.4, 1.1, 0.3, -0.9, 0.8]),
    st.sampled_from([0.5, -0.4, 1.1, 0.3, -0.9, 0.8]),
    st.sampled_from([np.nan, np.inf, 0.0, -0.0, 1e-310, 1e-30, 1e30]),
)
LANES = 5


@st.composite
def settings(draw):
    lattice = draw(LATTICES)
    steps = "" if "Given" in lattice else f", h={draw(st.sampled_from([0.1, 0.05, -0.1, 0.3]))}, "
    steps += "" if "Given" in lattice else f"num_steps={draw(st.integers(1, 7))}"
    save = draw(SAVES)
    if "ts=" in save and "-0.1" in steps:
        save = "dvi.Save()"
    observed = draw(OBSERVED)
    if "ts=" in save and "Running" in observed:
        observed = "observable"
    # Each of these works with some methods only.
    arithmetic = "dvi.FloatingPoint()" if "Uniform" not in lattice else draw(ARITHMETICS)
    explicit_only = "Variational" in lattice or "FixedPoint" in arithmetic
    method = "dvi.TypeII()" if explicit_only else draw(METHODS)
    method = "dvi.Strang()" if "Adaptive" in lattice else method  # a symmetric one
    return (
        f"method={method}, save={save}, observe={observed}, lattice={lattice}, "
        f"arithmetic={arithmetic}, newton={draw(SOLVERS)}{steps}"
    )


def _array(values, dtype):
    text = ", ".join(repr(v).replace("nan", "np.nan").replace("inf", "np.inf") for v in values)
    return f"np.array([{text}], np.{dtype})"


@st.composite
def programs(draw):
    n = draw(st.sampled_from([1, 1, 2, 3]))
    smooth = draw(st.booleans())
    dtype = draw(st.sampled_from(["float64", "float64", "float64", "float32"]))
    state = [f"{x}[{i}]" for x in "qp" for i in range(n)]
    leaves = [*state, "t0", "args['k']", "args['more']['c'][0]"]
    chosen = draw(settings())
    kinetics = ["p @ p / 2", "p @ p / 2 * (1.0 + 0.1 * q @ q)", "0.0 * p[0]"]
    if "FixedPoint" in chosen:  # no step may need a solve
        leaves = ["q[0] * 1.0", *(x for x in leaves if "p[" not in x and x != "q[0]")]
        kinetics = kinetics[:1]
    # Most programs are small: the time of a program is that of its compilation.
    depth = draw(st.sampled_from([1, 1, 2, 3]))
    one, small = (expressions(leaves, n, smooth, d) for d in (depth, depth - 1))
    kinetic = draw(st.sampled_from(kinetics))
    H = f"{kinetic} + {draw(one)}"
    W = None
    if draw(st.booleans()):
        W = f"jnp.stack([{', '.join(f'q[0] * 0 + {draw(small)}' for _ in range(n))}])"
    observable = draw(expressions(state, n, smooth, depth - 1))
    stop = None
    if draw(st.integers(0, 4)) == 0:
        stop = draw(expressions(["q[0]", "p[0]", "t"], n, smooth, 1)) + " - 1.0"
    shared = draw(st.sets(st.sampled_from(["p", "epsilon", "args"])))
    starts = st.sampled_from([0.5, -0.4, 1.1, 0.3]) if smooth else STARTS

    def numbers(count, name):
        lanes = 1 if name in shared else LANES
        rows = [_array(draw(st.lists(starts, min_size=count, max_size=count)), dtype)
                for _ in range(lanes)]  # fmt: skip
        return rows[0] if name in shared else f"np.stack([{', '.join(rows)}])"

    epsilon, k, c = (numbers(1, name) for name in ("epsilon", "args", "args"))
    if "args" not in shared or draw(st.booleans()):
        c += draw(st.sampled_from(["", "", ".astype(np.float32)"]))
    start = (
        f"SHARED = {sorted(shared)}\nSTART = {{\n    'q': {numbers(n, 'q')},\n    'p': "
        f"{numbers(n, 'p')},\n    'epsilon': {epsilon}[..., 0],\n    'args': {{'k': {k}[..., 0], "
        f"'more': {{'c': {c}, 'none': None}}}},\n}}"
    )
    # A gradient takes longer to compile than all the rest: of one program in eight.
    smooth = smooth and stop is None and dtype == "float64" and "Variational" not in chosen
    # FixedPoint has the slope of the map without rounding.
    smooth = smooth and "FixedPoint" not in chosen and draw(st.integers(0, 2)) == 0
    # One vector in a block compiles in less time than several, which one program in three has.
    width = draw(st.sampled_from([8, 8, None]))
    return Program(n, dtype, H, W, observable, stop, chosen, start, smooth, width)
