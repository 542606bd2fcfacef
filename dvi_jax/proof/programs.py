"""What a proof is about: the map of a system and its invariants as lists of operations."""

import functools
import hashlib
import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import lanewise.elementary

from ..base.signature import accepts, check_takes, output_of
from ..base.types import Interval
from ..discover.invariants.discovery import Discovery
from ..discover.invariants.series import InvariantSeries
from ..integration.arithmetic import DoubleDouble
from ..integration.integrator import Integrator
from ..methods.step import Equations
from ..problem.system import System
from .comparison import compare, random_points
from .components import NotAnalytic, program_of
from .rational import ExactInvariant
from .ways import MACHINE_CODE


@dataclass(frozen=True)
class Region:
    """The states, times and ε of a proof, and h.

    - `shape`: of q. `sides`: the lower and upper bounds of the raveled (q, p).
    - `times`, `strengths`: intervals of t and ε. `is_timed`: whether the time may have an effect.
    """

    shape: tuple[int, ...]
    sides: tuple[list[float], list[float]]
    times: tuple[float, float]
    strengths: tuple[float, float]
    h: float
    is_timed: bool

    def points(self, inside: Callable | None) -> list[np.ndarray]:
        """Random points (q, p, t, ε, h, error of an increment), whose states are inside."""
        (q_low, p_low), (q_high, p_high) = (np.reshape(x, (2, *self.shape)) for x in self.sides)
        ends = [(q_low, q_high), (p_low, p_high), self.times, self.strengths]
        ends += [(self.h, self.h), (-1e-9, 1e-9)]
        if inside is None:
            return random_points(ends)
        state = jax.ShapeDtypeStruct(self.shape, jnp.float64)
        output_of("inside(q, p)", inside, state, state)
        return random_points(ends, lambda q, p, *_: jnp.all(jnp.asarray(inside(q, p)) >= 0))


def programs_of(
    system: System,
    integrator: Integrator,
    args: Any,
    functions: list[tuple[Callable, str]],
    inside: Callable | None,
    region: Region,
    points: list[np.ndarray],
    way: str,
) -> tuple[Callable, dict[str, Any]]:
    """The step of many states, and what a certificate has about the map and the invariants: their
    lists of operations, compared with them at the points, and the digests of their programs.

    `way`: how the step is run. In pairs XLA has the same functions as the machine code.
    """
    quantum = getattr(integrator.arithmetic, "quantum", 0.0)
    step_of_states, step, is_implicit = _step_of(system, integrator, args, region, points)
    step_points = points[: 6 if quantum else 5]
    is_paired = isinstance(integrator.arithmetic, DoubleDouble)
    inside = inside or (lambda q, p: jnp.zeros(0))
    way_of_functions = "pairs" if is_paired else way
    return step_of_states, {
        "step": _program("the step of the system", step, step_points, None, way_of_functions),
        "invariants": [_program(f"the invariant {n}", f, points[:5], 0) for f, n in functions],
        "inside": _program("inside", inside, points[:2], None),
        "implicit": is_implicit,
        "slow": system.slow_time,
        "quantum": float(quantum).hex(),
        "arithmetic": "pairs of float64" if is_paired else "float64",
        "way": way,
        "shape": list(region.shape),
        "program": {
            "step": _digest(step, step_points),
            "invariants": [_digest(function, points[:5]) for function, _ in functions],
            "elementary functions": digest_of_functions(),
            "versions": {name: version(name) for name in ("dvi_jax", "jax", "jaxlib")},
        },
    }


def _digest(function: Callable, points: list[np.ndarray]) -> str:
    """SHA-256 of the jaxpr of a function with its constants, without addresses in memory."""
    closed = jax.make_jaxpr(function)(*(jnp.asarray(column[0]) for column in points))
    text = re.sub("0x[0-9a-f]+", "0x", str(closed.jaxpr))
    digest = hashlib.sha256(text.encode())
    for constant in closed.consts:
        digest.update(np.asarray(constant).tobytes())
    return digest.hexdigest()


@functools.cache
def digest_of_functions() -> str:
    """SHA-256 of the files with the elementary functions of the machine code."""
    digest = hashlib.sha256()
    for path in sorted(Path(lanewise.elementary.__file__).parent.glob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


class _WithErrors(Equations):
    """Equations of which each increment has an error."""

    error: Any = 0.0

    def increment(self, h: Any, rate: Any) -> Any:
        return h * rate + self.error


def _step_of(
    system: System, integrator: Integrator, args: Any, region: Region, points: list[np.ndarray]
) -> tuple[Callable, Callable, bool]:
    """The step of many states; that of one as a function of (q, p, t, ε, h[, error]), which is that
    at t = 0 if the region has no times; and whether p is p1, because the step is implicit."""
    shape = region.shape
    method = integrator.method_for(system)
    explicit = method.is_explicit(system, jnp.zeros(shape), args)
    if not (explicit or method.is_the_map):
        raise ValueError(
            f"method must be dvi.TypeII() or explicit for this system, got {method!r}."
        )
    plain = System(system.H_D, system.force, system.perturbation)
    start, number = jnp.full(shape, 0.1), jnp.asarray(0.1)
    equations = Equations(plain, number, args)
    first_interval = functools.partial(Interval, 0 * number, number, number)
    integrator.arithmetic.prepare(method, equations, first_interval, start, start)

    def step_map(q, p, t, epsilon, h, error=0.0):
        equations = _WithErrors(plain, epsilon, args, error=error)
        interval = Interval(t, t + (epsilon * h if system.slow_time else h), h)
        if explicit:
            return method.step(equations, interval, q, p)[:2]
        rate = h * equations.momentum_rate(interval, q, p)
        return rate, q + h * equations.position_rate(interval, q, p)

    step_of_states = jax.vmap(step_map, (0, 0, 0, 0, None))
    if not region.is_timed:
        # From the operations, since a force may begin late, or be the same at all times of a test.
        numbers = (), (), ()  # t, ε, h
        try:
            program = program_of(step_map, shape, shape, *numbers, points=points[:5])
        except NotAnalytic as error:
            raise NotAnalytic(f"the step of the system: {error}") from None
        _require_time(not depends_on_input(program, 2 * int(np.prod(shape))), "the map")
    zero = jnp.zeros(())

    def step_at_zero(q, p, t, *numbers):
        return step_map(q, p, zero, *numbers)

    return step_of_states, step_map if region.is_timed else step_at_zero, not explicit


def depends_on_input(program: dict[str, Any], place: int) -> bool:
    """Whether an output of a list of operations may depend on one input.

    The slope of each number with respect to the input is a known constant, or None. t1 − t0 has the
    slope 0, and is h.
    """
    slopes: list[Fraction | None] = []
    factors: list[Fraction | None] = []  # of products: constants only
    for name, *operands in program["operations"]:
        factor, slope = None, Fraction(0)
        if name == "input":
            slope = Fraction(operands[0] == place)
        elif name == "constant":
            factor = Fraction(float.fromhex(operands[0]))
        else:
            parts = [slopes[i] for i in (operands[:1] if name == "inexact" else operands)]
            if name in ("sum", "inexact"):
                slope = None if None in parts else sum(filter(None, parts), slope)
            elif any(part != 0 for part in parts):
                slope = None
                if name == "multiply":
                    pairs = zip(parts, (factors[i] for i in reversed(operands)), strict=True)
                    known = [a * b for a, b in pairs if a is not None and b is not None]
                    slope = known[0] if known else None
        slopes.append(slope)
        factors.append(factor)
    # Only the list of a condition has a number that may depend on it, but no output that does.
    return None in slopes or any(slopes[i] != 0 for i in program["outputs"])


def functions_of(invariants: Any, system: System, with_time: bool) -> list[tuple[Callable, str]]:
    """(function of (q, p, t, ε, h), formula) for each invariant."""
    if isinstance(invariants, Discovery):
        invariants = list(invariants.invariants)
    if isinstance(invariants, InvariantSeries):
        _require_time(with_time or not invariants.basis.uses_time, "an invariant")
        if invariants.basis.uses_time and invariants.slow_time != system.slow_time:
            raise ValueError(
                f"found and system must have one slow_time, got {invariants.slow_time} and "
                f"{system.slow_time}."
            )
        return [
            (
                lambda q, p, t, epsilon, h: invariants.evaluate(q, p, epsilon, t),
                invariants.formula(terms=8),
            )
        ]
    if isinstance(invariants, ExactInvariant):
        return [
            (lambda q, p, t, epsilon, h: invariants.evaluate(q, p, epsilon, h, t), str(invariants))
        ]
    if isinstance(invariants, str) or not (callable(invariants) or np.iterable(invariants)):
        raise TypeError(
            "found must be a Discovery, InvariantSeries, ExactInvariant, a function (q, p[, "
            f"epsilon[, t]]) or a list of these, got {invariants!r:.200}."
        )
    if callable(invariants):
        name = getattr(invariants, "__name__", type(invariants).__name__)
        if accepts(invariants, 4) and (with_time or not accepts(invariants, 3)):
            return [(lambda q, p, t, epsilon, h: invariants(q, p, epsilon, t), name)]
        if accepts(invariants, 3):
            return [(lambda q, p, t, epsilon, h: invariants(q, p, epsilon), name)]
        check_takes("found", invariants, "(q, p)")
        return [(lambda q, p, t, epsilon, h: invariants(q, p), name)]
    pairs = [pair for item in invariants for pair in functions_of(item, system, with_time)]
    if not pairs:
        raise ValueError(
            "found must have at least one invariant, got none: use more functions or a lower order."
        )
    return pairs


def _require_time(fits: Any, subject: str) -> None:
    if not fits:
        raise ValueError(
            f"{subject} depends on the time: give time=(t_begin, t_end) of the steps, of τ = εt "
            "with slow_time=True."
        )


def _program(
    subject: str, function: Callable, points: list, ndim: int | None, way: str = MACHINE_CODE
) -> dict[str, Any]:
    """The operations of a function, whose result must have so many axes (None: any), compared with
    the function at points. The rounding of invariants is not part of a proof: it has no `way`."""
    shapes = [column.shape[1:] for column in points]
    structs = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes]
    # Not of the step: `System` has checked its functions.
    if ndim is not None and len(shape := output_of(subject, function, *structs).shape) != ndim:
        raise ValueError(f"{subject} must return one number, got shape {shape}.")
    try:
        program = program_of(function, *shapes, way=way, points=points)
    except NotAnalytic as error:
        raise NotAnalytic(f"{subject}: {error}") from None
    compare(subject, function, program, points)
    return program
