"""Ways of running a step: the machine code of this package, or XLA; and what XLA does to rounding.

The machine code has the operations of the jaxpr, with elementary functions of its own. XLA rewrites
products and quotients, and some of its functions have large errors. Its numbers here are measured
against mpmath by `tests/test_proof_rounding.py`, and are at least twice the largest error.
"""

import os
from typing import Any

import jax
import jax.numpy as jnp

from lanewise.explained import compiled_by

from ..integration.integrate import integrate
from ..integration.integrator import Integrator, chosen, only
from ..problem.system import System

MACHINE_CODE, XLA = "machine code", "XLA"

RESULT_UNITS = {"log1p": 512, "atanh": 512, "expm1": 16, "tanh": 16, "logistic": 8, "pow": 4}
"""Errors of XLA's functions in units of round-off, next to those of the operations in the list that
stands for each. Measured: 241, 147, 5.5, 6.9, 2.6 and 1."""

ARGUMENT_UNITS = {"sinh": 2, "cosh": 2}
"""Errors of arguments: XLA computes e^(x + log ½) where it is e^x/2, which rounds x + log ½."""


def integrator_of(settings: Any, function: str) -> Integrator:
    """The integrator of a call with the keywords method, arithmetic and layout."""
    names = "method", "arithmetic", "layout"
    options = {name: settings.get(name) for name in names}
    return only(chosen(settings.get("integrator"), **options), function, *names)


def way_of_running(
    system: System, integrator: Integrator, shape: tuple[int, ...], h: float, args: Any
) -> tuple[str, str]:
    """How `integrate` runs a system in this process, and why not as machine code ("" if it does).

    The first is `MACHINE_CODE`, `XLA` if XLA computes a part of the run or all of it, or a way
    whose rounding is not known, such as another backend than that of a CPU.
    """
    backend = jax.default_backend()
    if backend != "cpu":
        return backend, f"JAX computes on a {backend} here, with other functions"
    if jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
        return XLA, "compilation is switched off (jax_disable_jit)"

    def run(q, p, epsilon):
        given = {"h": h, "num_steps": 4, "epsilon": epsilon, "args": args, "throw": False}
        solution = integrate(system, q, p, integrator=integrator, **given)
        return solution.qs, solution.ps

    state = jnp.full(shape, 0.1)
    targets, reason = compiled_by(run, state, state, jnp.asarray(0.1))
    if reason is None and "elements" in targets:
        # Their sums have another order than the one that is bounded.
        return "loops over arrays", "more than 48 coordinates are computed by loops over arrays"
    if reason is None:
        return MACHINE_CODE, ""
    flags = os.environ.get("XLA_FLAGS", "")
    if "fast_math" in flags.replace("fast_math=false", ""):
        return f"{XLA} with fast math", f"XLA may change all sums and products: XLA_FLAGS={flags!r}"
    return XLA, reason


def exponentials_in_products(operations: list[list[Any]]) -> int:
    """The largest number of exponentials in a product, quotient or power of a list of operations.

    XLA computes e^a e^b as e^(a + b), e^a/e^b as e^(a − b) and (e^a)^n as e^(na). With k
    exponentials the argument is a sum of k terms, whose rounding is at most k units of Σ |a|.
    """
    counts: list[int] = []
    for name, *operands in operations:
        if name == "exp":
            counts.append(1)
        elif name in ("multiply", "inverse", "sqrt", "inexact"):
            count = 2 if name == "multiply" else 1
            counts.append(sum(counts[k] for k in operands[:count]))
        else:
            counts.append(0)
    return max(counts, default=0)
