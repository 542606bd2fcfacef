r"""Elementary functions in float64 arithmetic, for a code generator that emits each of them once.

Every function takes and returns scalar float64 values of JAX and traces to a jaxpr of additions,
products, quotients, square roots, roundings, comparisons, selections, integer arithmetic on the
bits of a number, and `lax.cond` for rare arguments: the operands of a branch include the value for
ordinary ones. `jax.vmap` applies a function to arrays. Special values are those of C99, Annex F.

Largest errors in units in the last place (ulp) that we have seen over the whole range, subnormal
and huge numbers included, and the number of operations for ordinary arguments, a fused
multiply-add counting as one:

| function | error | operations | function | error | operations |
|---|---|---|---|---|---|
| sin | 0.88 | 41 | atanh | 1.56 | 56 |
| cos | 0.87 | 41 | logistic | 1.12 | 45 |
| tan | 1.52 | 52 | exp | 0.80 | 24 |
| asin | 1.55 | 30 | exp2 | 0.72 | 32 |
| acos | 1.08 | 37 | expm1 | 1.24 | 32 |
| atan | 1.35 | 40 | log | 0.83 | 28 |
| atan2 | 1.55 | 48 | log1p | 0.86 | 43 |
| sinh | 1.64 | 48 | pow | 0.72 | 106 |
| cosh | 0.83 | 37 | cbrt | 0.51 | 51 |
| tanh | 1.38 | 47 | erf | 0.96 | 17 |
| asinh | 1.21 | 51 | erfc | 1.58 | 24 |
| acosh | 1.70 | 49 | erf_inv | 3.73 | 60 |

sin and cos together take 48 operations (`sincos`), erf and erfc some 130 for |x| > 3/4.
`tests/test_lanewise_elementary.py` asserts bounds of at most 1.1 times these errors and derives
all coefficients again.

The errors hold whether or not a compiler contracts a product and a sum into a fused multiply-add:
a product that must be exact has few enough bits. Sums must not be reassociated. XLA does this with
constants, (x + c) − d = x + (c − d), which the functions avoid. They are right for subnormal
numbers too, which generated code has, and which XLA's own code on a CPU replaces by zero. `rem` is
exact, and requires contraction.
"""

from collections.abc import Callable

from jax import Array

from .circular import acos, asin, atan, atan2, cos, sin, sincos as sincos, tan
from .exponential import cosh, erf, erfc, exp, exp2, expm1, logistic, sinh, tanh
from .logarithmic import acosh, asinh, atanh, cbrt, erf_inv, log, log1p, pow
from .remainder import rem as rem

# From the name of a primitive of JAX to its function of float64 scalars.
FUNCTIONS: dict[str, Callable[..., Array]] = {
    function.__name__: function
    for function in (
        *(sin, cos, tan, asin, acos, atan, atan2),
        *(sinh, cosh, tanh, asinh, acosh, atanh, logistic),
        *(exp, exp2, expm1, log, log1p, pow, cbrt, erf, erfc, erf_inv),
    )
}
