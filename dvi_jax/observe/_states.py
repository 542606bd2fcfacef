"""Observables of a state, (q, p) or (t, q, p, args), as functions of a step."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
from jaxtyping import PyTree
from wadler_lindig import TextDoc

from ..base.signature import accepts, argument_names, signature_of, takes_state, warn_of_exchanged
from ..base.types import Bindable
from ._reductions import Reduction, Running, is_observable

FORMS = "(q, p), (t, q, p, args) or (t0, t1, q0, p0, q1, p1, args)"
"""Arguments that an observable can have."""


TAU = {"tau", "tau0", "τ", "τ0"}
"""Names of the first argument of functions of a slow time."""


class OfState(eqx.Module):
    """A function of the state at the end of a step, which has a value at the initial state, too.

    It is called with the arguments of a step or with (t, q, p, args).
    """

    function: Callable[..., Any]
    takes_time: bool = eqx.field(static=True)

    def __call__(self, *arguments):
        t, q, p, args = (arguments[1], *arguments[4:]) if len(arguments) == 7 else arguments
        return self.function(t, q, p, args) if self.takes_time else self.function(q, p)

    def __pdoc__(self, **_options: Any) -> TextDoc:  # what equinox prints, also in other modules
        return TextDoc(f"<{self.__name__} of the state>")

    def bind(self, system: Any, epsilon: Any) -> "OfState":
        """The same observable, for a function that requires the system or ε."""
        if not isinstance(self.function, Bindable):
            return self
        return OfState(self.function.bind(system, epsilon), self.takes_time)

    @property
    def __name__(self) -> str:
        return getattr(self.function, "__name__", type(self.function).__name__)


class AtEnd(eqx.Module):
    """A function of a step that depends on its end alone, as one of the state."""

    function: Callable[..., Any]

    # A step of length zero: both ends are the state.
    def __call__(self, t, q, p, args):
        return self.function(t, t, q, p, q, p, args)

    @property
    def __name__(self) -> str:
        return getattr(self.function, "__name__", type(self.function).__name__)


class InSlowTime(eqx.Module):
    """An observable of a system with ``slow_time=True`` that receives τ = εt in place of t.

    - `function`: ``(τ0, τ1, q0, p0, q1, p1, args)``, ``(τ, q, p, args)`` or ``(q, p)`` → array.

    `integrate` supplies ε; without it: ``observable.bind(system, epsilon)(...)``.

    **Raises** `ValueError` when called with times without ε.
    """

    function: Callable[..., Any]
    epsilon: Any = None

    def bind(self, system: Any, epsilon: Any) -> "InSlowTime":
        """The same observable, for this ε."""
        return InSlowTime(self.function, epsilon)

    def __call__(self, *arguments):
        count = {7: 2, 4: 1}.get(len(arguments), 0)  # of the times, which come first
        if count and self.epsilon is None:
            raise ValueError(
                f"{getattr(self.function, '__name__', 'f')} needs the value of epsilon: bind(system"
                ", epsilon). Section, Stop, clock, speed and data do not receive ε: compute ε t."
            )
        function = _of_step(self.function) if count == 2 else self.function
        times = (self.epsilon * t for t in arguments[:count])
        return function(*times, *arguments[count:])


def has_initial_value(function: Any) -> bool:
    """Whether an observable is a function of the state, and not of a step."""
    return isinstance(function, OfState) or getattr(function, "is_of_state", False)


def of_steps(observe: PyTree) -> PyTree:
    """The observables, all as functions of a step. **Raises** `TypeError` for other functions."""
    return jax.tree.map(_of_step, observe, is_leaf=is_observable)


def refuse_slow_time(*functions: PyTree) -> None:
    """**Raises** `TypeError` for a function with an argument τ in a place where it receives t."""
    for leaf in jax.tree.leaves(functions, is_leaf=is_observable):
        function = leaf
        for name in ("reduction", "g", "function", "function"):  # of a reduction, of OfState
            if not isinstance(function, InSlowTime):
                function = getattr(function, name, function)
        if not isinstance(function, InSlowTime) and {*argument_names(function)[:1]} & TAU:
            raise TypeError(
                f"the first argument of {signature_of(function)} is the time t, not τ = εt, in "
                "integrate with slow_time=True. For τ observe systems.InSlowTime(f); elsewhere "
                "compute ε t in f."
            )


def _of_step(leaf: Any) -> Any:
    if isinstance(leaf, Running):
        return Running(_of_step(leaf.reduction))
    if isinstance(leaf, Reduction):
        function = getattr(leaf, "function", None)
        observable = _of_step(function)
        if observable is function or not isinstance(observable, OfState):
            return leaf
        return eqx.tree_at(lambda r: r.function, leaf, observable)
    if isinstance(leaf, InSlowTime):
        observable = _of_step(leaf.function)
        return OfState(leaf, observable.takes_time) if isinstance(observable, OfState) else leaf
    # The longest form first: a function with defaults or *rest accepts several of them.
    if not callable(leaf) or isinstance(leaf, type) or accepts(leaf, 7):
        return leaf
    for count, fits in ((4, accepts(leaf, 4)), (2, takes_state(leaf))):
        if fits:
            warn_of_exchanged("an observable", leaf, {2: "(q, p)", 4: "(t, q, p, args)"}[count])
            return OfState(leaf, count == 4)
    raise TypeError(f"an observable must be a function of {FORMS}, got {signature_of(leaf)}.")
