"""Roots of one unknown between two points, with the implicit derivative."""

from collections.abc import Callable

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

import lanewise

Number = Float[Array, ""]
Function = Callable[[Number], Number]

_EVALUATIONS = 100
"""Maximum number of evaluations of a search."""


def bracketed_root(
    function: Function, a: Number, at_a: Number, b: Number, at_b: Number, exists: Bool[Array, ""]
) -> Number:
    """The root of `function` between a and b, where it has the values `at_a` and `at_b`; b, without
    a derivative, where no root `exists`.

    To the last digit, by false position (Illinois) with bisection in every third iteration.
    Derivatives in values that `function` closes over are those of the implicit function theorem,
    to any order.
    """
    # The root does not depend on the ends of the bracket: no derivative of theirs enters it.
    a, at_a, b, at_b = lax.stop_gradient((a, at_a, b, at_b))

    # `function` has to be finite even where no root exists: reverse mode multiplies the branch that
    # is not taken by zero, and NaN times zero is NaN.
    def equation(x):
        return jnp.where(exists, function(x), x - b)

    def search(_, x):
        return jnp.where(exists, _false_position(function, a, at_a, b, at_b, exists), x), ()

    return lanewise.implicit_root(equation, b, search, divide)[0]


def divide(linear: Function, rhs: Number) -> Number:
    """The solution of linear(x) = rhs for one unknown."""
    return rhs / linear(jnp.ones_like(rhs))


def _false_position(f: Function, a, fa, b, fb, exists) -> Number:
    # The values at the ends may come from another program, and have another sign where they are
    # round-off: without a change of sign the root is the end where the function is smaller.
    has_sign_change = jnp.sign(fa) * jnp.sign(fb) <= 0
    is_at_a = ~has_sign_change & (jnp.abs(fa) < jnp.abs(fb))
    b, fb = jnp.where(is_at_a, a, b), jnp.where(is_at_a, fa, fb)
    exists = exists & has_sign_change

    def proceed(state):
        a, _, b, fb, n = state
        apart = jnp.abs(b - a) > 2 * jnp.finfo(a.dtype).eps * jnp.maximum(jnp.abs(a), jnp.abs(b))
        # A value that is NaN ends the search there: the point gets the status of its step.
        return exists & apart & (jnp.abs(fb) > 0) & (n < _EVALUATIONS)

    def narrow(state):
        a, fa, b, fb, n = state
        secant = b - fb * (b - a) / (fb - fa)
        # Every third point is the midpoint, so that the interval shrinks for every f. A secant
        # through two equal values is infinite or NaN: the midpoint as well.
        c = jnp.where(jnp.isfinite(secant) & (n % 3 != 2), secant, (a + b) / 2)
        fc = f(c)
        crosses = jnp.sign(fc) * jnp.sign(fb) <= 0
        # An end that stays has its value halved (Illinois): plain false position would approach
        # the root from one side only, linearly.
        a, fa = jnp.where(crosses, b, a), jnp.where(crosses, fb, fa / 2)
        return a, fa, c, fc, n + 1

    return lax.while_loop(proceed, narrow, (a, fa, b, fb, 0))[2]
