"""The problem of the user: a discrete Hamiltonian, a perturbing force, a perturbation."""

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.checks import array, finite, instance, require
from ..base.indices import out_of_bounds
from ..base.keywords import tracing_note
from ..base.machine import refuse_fork
from ..base.reads import Reads, differences, reads
from ..base.signature import accepts, array_type, check_takes, warn_of_exchanged
from ..base.types import Args, ConstraintFn, ForceFn, HamiltonianFn, Scalar, State
from .discretise import refuse_step_from_times
from .noise import Noise, as_noise

_NAMES = "(t0, t1, q0, p1, args)"
_CONTINUOUS = "Use dvi.discretise(H) for a continuous H(t, q, p, args)."


class System(eqx.Module):
    r"""A perturbed discrete Hamiltonian system (*disturbed* in the paper).

    The discrete Hamiltonian is ``H_D + epsilon * perturbation`` and the perturbing force
    ``epsilon * force``; the map they define is (12)–(13) of the paper:

        q1 = q0 + h ∂H_D/∂p1,        p1 = p0 − h ∂H_D/∂q0 + h ε W(t0, t1, q0, p1).

    **Arguments**

    - `H_D`: function ``(t0, t1, q0, p1, args)`` → scalar [energy].
    - `force`: W, function of the same arguments → array like q0 [energy / unit of q]; or None.
    - `perturbation`: H1_D, function of the same arguments → scalar [energy]; or None.
      ``epsilon * H1_D`` is added to H_D: a perturbation that derives from a Hamiltonian. It may
      take ``epsilon`` as a sixth argument, for an energy that is not linear in ε.
    - `slow_time`: if True all three functions receive the slow times ``epsilon * t0`` and
      ``epsilon * t1`` in place of t0 and t1. Observables and the g of `Stop` and `Section` receive
      the time t; ``systems.InSlowTime(f)`` is an observable that receives ε t.
    - `noise`: a function σ ``(t, q, p, args)`` → array like q0, or of the shape (*q0.shape, m), for
      ``dp = … + σ ∘ dB`` [unit of p/√time]; a `Langevin`; or `NoiseHamiltonians`. Runs then need a
      path and a method for noise. ε does not multiply noise; integrals are Stratonovich's.
    - `epsilon`: strength of the perturbation in runs without ``epsilon=``. None: each run of a
      system with a force, a perturbation or a slow time must give it. Systems of the library: 0.
    - `constraint`: g, function ``(q, args)`` → array of m numbers that are all zero for the
      positions allowed; or None. `Rattle` and its compositions take such a system; see also
      `project` for initial conditions and `ConstraintForce`.

    q0 and p1 are arrays of one shape, the one given to `integrate`. `args` is any pytree; its
    arrays and floats are differentiable.

    Values that the functions read from outside (globals, closures, ``self.k``) are those at the
    time when the system is made. If they change, runs of this system raise `ValueError`: make a new
    system, or pass such values in `args`.

    **Raises** `TypeError` when a function is not callable or does not take the five arguments.
    **Warns** when the names of the arguments suggest that p and q are exchanged.

    **Source** H_D: type II generating function S = p1·q0 + h H_D (Marsden & West 2001, *Acta
    Numerica* 10, 357; Leok & Zhang 2011). Perturbations: the paper, (6)–(13).

    **Example**

    ```python
    system = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2,
                        force=lambda t0, t1, q0, p1, args: -p1)          # friction
    sol = dvi.integrate(system, [1.0], [0.0], h=0.1, num_steps=100, epsilon=0.2, args={"k": 4.0})
    print(sol.status, round(float(sol.qs[-1, 0]), 3))
    # successful 0.165
    ```
    """

    H_D: HamiltonianFn
    force: ForceFn | None = None
    perturbation: HamiltonianFn | None = None
    slow_time: bool = eqx.field(static=True, default=False)
    epsilon: float | None = eqx.field(static=True, default=None)
    noise: Noise | None = None
    constraint: ConstraintFn | None = None
    reads: Reads = eqx.field(static=True, init=False, repr=False)

    def __post_init__(self):
        self.noise = as_noise(self.noise)
        self.reads = _read_by(self)

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)  # a module is frozen
        # A copy or an unpickled system has other objects: marks by identity would all differ.
        vars(self)["reads"] = _read_by(self)

    def __check_init__(self):
        for name in ("H_D", "force", "perturbation"):
            is_absent = getattr(self, name) is None and name != "H_D"
            if not is_absent and not (name == "perturbation" and self._is_nonlinear):
                check_takes(name, getattr(self, name), _NAMES, {4: _CONTINUOUS})
                warn_of_exchanged(name, getattr(self, name), _NAMES)
        if self.constraint is not None:
            check_takes("constraint", self.constraint, "(q, args)")
        instance("slow_time", self.slow_time, bool, "True or False")
        if self.epsilon is not None:
            finite("epsilon of a System", self.epsilon)
        if self.slow_time:
            refuse_step_from_times("H_D of a System with slow_time=True", self.H_D)
            refuse_step_from_times("perturbation with slow_time=True", self.perturbation)

    @property
    def depends_on_epsilon(self) -> bool:
        """Whether ε has an effect: on a force, a perturbation or the time."""
        return self.force is not None or self.perturbation is not None or self.slow_time

    @property
    def _is_nonlinear(self) -> bool:
        """Whether the perturbation takes ε."""
        function = self.perturbation
        return callable(function) and accepts(function, 6) and not accepts(function, 5)

    def strength(self, epsilon: Any) -> Any:
        """ε of a run: the one given, else the default of the system, else 0 for a system that does
        not depend on it. **Raises** `ValueError` if a perturbed system has none."""
        if epsilon is not None:
            return epsilon
        if self.epsilon is not None:
            return self.epsilon
        names = ["a force"] * (self.force is not None)
        names += ["a perturbation"] * (self.perturbation is not None)
        names += ["slow_time=True"] * self.slow_time
        if names:
            raise ValueError(
                f"epsilon=... must be given for a system with {' and '.join(names)}: it is the "
                "factor of the perturbation. epsilon=0.0 is the unperturbed motion."
            )
        return 0.0

    def hamiltonian(
        self, t0: Scalar, t1: Scalar, q0: State, p1: State, epsilon: Scalar, args: Args
    ) -> Scalar:
        """H_D(t0, t1, q0, p1) + ε H1_D(t0, t1, q0, p1): a scalar [energy]."""
        s0, s1 = self.times(t0, t1, epsilon)
        H = self.H_D(s0, s1, q0, p1, args)
        if self.perturbation is not None:
            extra = (epsilon,) if self._is_nonlinear else ()
            H = H + epsilon * self.perturbation(s0, s1, q0, p1, args, *extra)
        return jnp.asarray(H, p1.dtype)  # also where args are in double and the state is not

    def disturbing_force(
        self, t0: Scalar, t1: Scalar, q0: State, p1: State, epsilon: Scalar, args: Args
    ) -> State:
        """ε W(t0, t1, q0, p1): an array like q0 [energy / unit of q]; zero without a force."""
        if self.force is None:
            return jnp.zeros_like(q0)
        s0, s1 = self.times(t0, t1, epsilon)
        return epsilon * self.force(s0, s1, q0, p1, args)

    def times(self, t0: Scalar, t1: Scalar, epsilon: Scalar) -> tuple[Scalar, Scalar]:
        """The times that the user's functions receive: slow ones if `slow_time` is set."""
        return (epsilon * t0, epsilon * t1) if self.slow_time else (t0, t1)

    def check_shapes(self, t: Scalar, q: State, p: State, epsilon: Scalar, args: Args) -> None:
        """**Raises** `ValueError` or `TypeError` for functions with values of a wrong kind."""
        leaves, tree = jax.tree.flatten((t, q, p, args))
        # A function is traced once for each combination of shapes, types and values that it reads.
        types = [(x.shape, x.dtype) if eqx.is_array(x) else (type(x), x) for x in leaves]
        kinds = (self.reads, tree, *types)
        for name, shape in (("H_D", ()), ("perturbation", ()), ("force", q.shape)):
            function = getattr(self, name)
            if function is not None:
                extra = (t,) if name == "perturbation" and self._is_nonlinear else ()
                out = _traced_output(function, name, kinds, (t, t, q, p, args, *extra))
                hint = "Use jnp.sum or one component." if out.shape and not shape else ""
                array(f"{name}{_NAMES}", out, shape, verb="return", hint=hint)
        if self.constraint is not None:
            # A scalar is refused too: one component needs an axis as several do.
            out = _traced_output(self.constraint, "constraint", kinds, (q, args))
            array("constraint(q, args)", out, ("m",), verb="return", hint="Use jnp.ravel.")


def _read_by(system: System) -> Reads:
    of_noise = [] if system.noise is None else system.noise.functions
    functions = (system.H_D, system.force, system.perturbation, system.constraint, *of_noise)
    # A counter of calls, for instance, changes with every trace, and no program depends on it.
    counters = {name for function in functions for name in _changed_by_tracing(function)}
    return tuple(item for item in reads(*functions) if item[0] not in counters)


def of_problem(
    system: Any, q0: Any, p0: Any, h: Any, args: Any, has_start: bool = False, jumps_allowed=False
) -> tuple[Any, ...]:
    """System, initial state, step and args of a call that may have a problem of the library, which
    has defaults. **Raises** `TypeError` for a system without an initial state.

    `has_start`: the call has its initial states in another argument. `jumps_allowed`: it makes the
    jumps of the problem, too.
    """
    # Recognised by its attribute, since the class `Problem` is in a layer above this one.
    if isinstance(getattr(system, "system", None), System):
        problem, system = system, system.system
        if not jumps_allowed:
            without_jumps(problem)
        defaults = (("q0", q0), ("p0", p0), ("h", h), ("args", args))
        values = (getattr(problem, name) if value is None else value for name, value in defaults)
        q0, p0, h, args = (None, None, *tuple(values)[2:]) if has_start else values
    elif isinstance(system, System) and not has_start:
        require("a call with a dvi.System", {"q0": q0, "p0": p0})
    return system, q0, p0, h, args


def without_jumps(problem: Any) -> Any:
    """The problem. **Raises** `ValueError` for one with jumps, which a call does not make."""
    # Without them a ball would fall through the floor, and no number would show it.
    if getattr(problem, "jumps", ()):
        raise ValueError(
            "the problem has jumps, such as bounces, and only dvi.integrate and dvi.sweep make "
            "them: give problem.system for the motion between jumps."
        )
    return problem


def check_system(system: Any, of_map: str = "", noise_allowed: bool = False) -> None:
    """**Raises** `TypeError` for an object that is not a `System`, `ValueError` for a system whose
    functions read a value that has changed since it was made, for one with noise, and for a
    constraint if `of_map` is the name of a function that examines the map (12)–(13) itself."""
    refuse_fork()
    if not isinstance(system, System):
        hint = "Write dvi.System(H_D) for a function H_D(t0, t1, q0, p1, args)."
        if isinstance(getattr(system, "system", None), System):
            hint = "Write problem.system."
        name = getattr(system, "__name__", "")
        of_library = str(getattr(system, "__module__", "")).startswith("dvi_jax.systems.")
        if of_library and accepts(system, 0):
            hint = f"Call the function: {name}()."
        kind = "class" if isinstance(system, type) else type(system).__name__
        description = f"the {kind} {name}" if name else f"a value of type {kind}"
        raise TypeError(f"system must be a dvi.System, got {description}. {hint}")
    if system.noise is not None and not noise_allowed:
        raise ValueError(
            "the system must not have noise, except in dvi.integrate, dvi.sweep and "
            "dvi.invariant_diffusion."
        )
    if of_map and system.constraint is not None:
        raise ValueError(f"{of_map} requires a system without constraint: use other coordinates.")
    # Programs that are compiled already would compute with the old value.
    current = _read_by(system)
    names = differences(system.reads, current) if current != system.reads else []
    if names:
        raise ValueError(
            "values that the functions of the system read have changed since it was made: "
            f"{', '.join(names)}. Make a new System, or pass them in args."
        )


def require_constraint(name: str, system: System) -> None:
    """**Raises** `ValueError` for a system without a constraint."""
    if system.constraint is None:
        raise ValueError(f"{name} requires a constraint: dvi.System(H_D, constraint=g).")


# Weak, so that functions and the arrays in their closures can be deleted.
_OUTPUTS: weakref.WeakKeyDictionary[Callable, dict] = weakref.WeakKeyDictionary()
"""Function → kinds of arguments → output."""

_CHANGED_BY_TRACING: weakref.WeakKeyDictionary[Callable, frozenset] = weakref.WeakKeyDictionary()
"""Function → names of the values that it changes itself."""


def _changed_by_tracing(function: Callable | None) -> frozenset[str]:
    try:
        return _CHANGED_BY_TRACING.get(function, frozenset()) if function else frozenset()
    except TypeError:  # a function without a hash or a weak reference
        return frozenset()


def _traced_output(
    function: Callable, name: str, kinds: tuple, arguments: Sequence[Any]
) -> jax.ShapeDtypeStruct:
    q, args = (arguments[2], arguments[4]) if len(arguments) > 2 else (arguments[0], arguments[-1])
    names = _NAMES if len(arguments) > 2 else "(q, args)"
    try:
        outputs = _OUTPUTS.setdefault(function, {})
        if kinds in outputs:
            return outputs[kinds]
    except TypeError:  # a function or an argument without a hash: it is traced in every call
        outputs = {}
    # Traced, not called: at a start in a singularity a value would be NaN, its shape is the same.
    values = reads(function)
    try:
        program, *out = eqx.filter_make_jaxpr(function)(*arguments)
    except Exception as error:
        error.add_note(f"(in {name}{names}, called with q0 of shape {q.shape} and args={args!r})")
        error.add_note(tracing_note(name, error))
        if q.ndim == 0:
            error.add_note(
                "The state is one number. For one coordinate give arrays: q0=[1.0] of shape (1,), "
                "samples of shape (2, N, 1)."
            )
        if q.ndim > 1:
            error.add_note(f"{name} receives the whole q0. For a batch of states use jax.vmap.")
        raise
    # JAX moves such an index to the end of the array, so that the result would be wrong silently.
    for index, size in out_of_bounds(program):
        raise IndexError(
            f"{name}{names} uses the index {index}, out of bounds for an axis of length {size}; q0 "
            f"has the shape {q.shape}."
        )
    out = eqx.combine(*out)
    new_values = reads(function)
    if new_values != values:  # such as a counter of calls
        marks = dict(values)
        changes = {name for name, mark in new_values if marks.get(name) != mark}
        _CHANGED_BY_TRACING[function] = _changed_by_tracing(function) | changes
    return outputs.setdefault(kinds, array_type(f"{name}{names}", out))
