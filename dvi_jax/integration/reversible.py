"""Reverse-mode gradients along reconstructed states."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero

import lanewise
from lanewise import Layout
from lanewise.jaxprs.jaxapi import is_traced, linear_map, manual_axes

from ..base.checks import instance, positive, whole as check_whole
from ..engine.pairs import rounded
from .adjoints import AbstractAdjoint, Checkpointed
from .loop import outcome, run, start, with_start
from .plan import adds_start_outside, piece_length
from .reverse_pass import Smooth, pull_back, round_trip_defect, states_of
from .task import Outcome, Task


class Reversible(AbstractAdjoint):
    r"""Reverse mode that reconstructs the states by the inverse step instead of storing them.

    Going backwards from λ_{k+1}, the state before the step is Φ_h⁻¹(q_{k+1}, p_{k+1}) and

        λ_k = (∂Φ_h/∂(q_k, p_k))ᵀ λ_{k+1},     dL/dθ += (∂Φ_h/∂θ)ᵀ λ_{k+1}.

    Memory does not grow with num_steps, except for one state about every `checkpoint_every` steps,
    from which the reconstruction restarts: it amplifies round-off on chaotic or dissipative arcs.
    Where a reconstructed component differs from the stored one by more than `max_defect` of its
    size (None means 1e-6 in float64 and 1e-3 in float32; more where that is round-off of the
    largest component), or an inverse step has no solution, the steps of the trajectory from that
    checkpoint are computed again and their states stored: slower, and correct for any dynamics.
    With `report_defect` the solution has the largest of these differences, in
    ``stats["round_trip_defect"]`` (relative, ∞ where an inverse step has no solution). It takes as
    much time as the reconstruction of the states.

    The gradient of a trajectory that has failed is NaN. The gradient of one that the loss does not
    use is 0, failed or not, so that it does not affect parameters that a batch shares: a loss takes
    ``jnp.where(ok, q, 0.0)``, ok of ``sol.result == dvi.RESULTS.successful``, before it computes.

    Forward mode (`jvp`) and higher derivatives go through the scan as with `Direct`. A method
    without an inverse (`RungeKutta4`), a `Variational` lattice, a run with a `Stop`, with deviation
    vectors (such as `LyapunovSpectrum`) or with `Running` values, and a system or observable that
    *closes over* a value being differentiated (better: pass it in args), are differentiated as by
    `Checkpointed`.

    **Raises** `ValueError` for settings that are not positive, and for `report_defect` where no
    states are reconstructed.

    **Source** our own combination; reversible backpropagation: Maclaurin, Duvenaud & Adams 2015.
    """

    checkpoint_every: int = eqx.field(static=True, default=100)
    max_defect: float | None = eqx.field(static=True, default=None)
    report_defect: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        check_whole("checkpoint_every", self.checkpoint_every)
        if self.max_defect is not None:
            positive("max_defect", self.max_defect)
        instance("report_defect", self.report_defect, bool, "True or False")

    def allowed(self, dtype) -> float:
        """The largest relative difference that is accepted."""
        return self.max_defect or (1e-6 if jnp.dtype(dtype).itemsize >= 8 else 1e-3)

    def rollout(self, task, plan, q0, p0, layout=Layout()):
        theta, others = eqx.partition(task, eqx.is_inexact_array)
        # Integers and booleans may be traced as well: inputs without a derivative.
        whole, fixed = eqx.partition(others, eqx.is_array)

        @jax.jit  # so that its uses below share one trace, and one trace of its derivative
        def forward(inputs, whole):
            theta, q0, p0 = inputs
            task = eqx.combine(theta, whole, fixed)
            ran = run(task, plan, start(task, q0, p0), lax.scan, self._inner_loop)
            out = outcome(task, plan, ran, q0, p0)
            kept, counts = eqx.partition(out.saved, eqx.is_inexact_array)
            return Smooth(out.carry.q, out.carry.p, kept, out.reduced), (*ran, counts)

        inputs, every, allowed = (theta, q0, p0), self.checkpoint_every, self.allowed(q0.dtype)
        why = _why_not(task, inputs, whole)
        # A traced value that a function closes over is not an input of the trajectory: a custom
        # derivative with respect to the inputs would miss it.
        if not why and any(map(is_traced, jax.make_jaxpr(forward)(inputs, whole).consts)):
            why = "a function of the run uses a traced value from outside (pass it in args)"
        if why:
            if self.report_defect:
                raise ValueError(
                    "dvi.Reversible(report_defect=True) requires states that can be reconstructed "
                    f"backwards, but {why}. Leave report_defect out: gradients are then computed "
                    "in the same way as with dvi.Checkpointed()."
                )
            return Checkpointed().rollout(task, plan, q0, p0, layout)

        @jax.custom_jvp
        def trajectory(inputs, whole):
            return lanewise.call(forward, inputs, whole, layout=layout)

        @functools.partial(trajectory.defjvp, symbolic_zeros=True)
        def _(primals, tangents):
            # The tangent is L·dx with L the derivative: forward mode applies L along the scan,
            # reverse mode applies Lᵀ along reconstructed states. It is a linear map with its own
            # transpose, not a custom_vjp, under which forward mode would be impossible.
            (inputs, whole), (change, _) = primals, tangents
            smooth, trace = trajectory(inputs, whole)
            # Inputs with a tangent of zero are constants: no derivative is computed for them.
            moves = jax.tree.map(lambda x: not isinstance(x, SymbolicZero), change)
            moving, still = eqx.partition(inputs, moves)
            change = eqx.filter(change, moves)
            # Only the values that the reverse pass reads: the others need not be computed.
            carry, saved, tail, _ = trace
            known = (
                rounded(carry.reductions),
                states_of(saved),
                None if tail is None else states_of(tail),
            )

            def along(moving, still, whole, u):
                def of(moving):
                    return forward(eqx.combine(moving, still), whole)[0]

                return jax.jvp(of, (moving,), (u,))[1]

            def definition(residuals, u):
                moving, still, whole, _ = residuals
                return along(moving, still, whole, u)

            def push(residuals, u):
                moving, still, whole, _ = residuals
                return lanewise.call(along, moving, still, whole, u, layout=layout)

            def back(moving, still, whole, known, v):
                theta, q0, p0 = eqx.combine(moving, still)
                theta, others = eqx.partition(theta, moves[0])
                rest = eqx.combine(others, whole, fixed)
                out = pull_back(rest, plan, every, allowed, (theta, q0, p0), known, v)
                return eqx.filter(out, moves)

            def pull(residuals, v):
                out = lanewise.call(back, *residuals, v, layout=layout)
                # A failed trajectory that the loss does not use: zero, although the states along
                # which the cotangent zero would be transported are NaN.
                used = jnp.any(jnp.stack([jnp.any(x != 0) for x in jax.tree.leaves(v)]))
                return jax.tree.map(lambda x: jnp.where(used, x, 0), out)

            residuals = moving, still, whole, known
            moved = linear_map(push, pull, definition, residuals, change)
            return (smooth, trace), (moved, jax.tree.map(_no_tangent, trace))

        smooth, (carry, saved, tail, counts) = trajectory(inputs, whole)
        # In the forward pass: a reverse pass cannot return a number besides the cotangents.
        rebuilt = None
        if self.report_defect:

            def defect(theta, whole, *of):
                task = eqx.combine(theta, whole, fixed)
                return round_trip_defect(task, plan, every, allowed, *of)

            rebuilt = lanewise.call(
                defect, *lax.stop_gradient((theta, whole, (q0, p0), saved, tail)), layout=layout
            )
        kept = eqx.combine(smooth.saved, counts)
        if adds_start_outside(plan):
            kept = with_start(kept, q0, p0)
        # The differentiable outputs take the place of their copies in the carry, which have none.
        return Outcome(carry._replace(q=smooth.q, p=smooth.p), kept, smooth.reduced, rebuilt)

    def _inner_loop(self, body, state, _, count, state_of):
        """A scan over the steps of a block that stores a state every `checkpoint_every` steps."""
        size = piece_length(count, self.checkpoint_every)
        segments = (count - 1) // size  # the end of the block is saved anyway
        if segments == 0:
            return lax.scan(body, state, None, count)

        def segment(state, _):
            state, _ = lax.scan(body, state, None, size)
            return state, state_of(state)

        if count % size == 0:  # one loop to compile instead of two
            state, ends = lax.scan(segment, state, None, segments + 1)
            return state, jax.tree.map(lambda x: x[:-1], ends)
        state, ends = lax.scan(segment, state, None, segments)
        state, _ = lax.scan(body, state, None, count - segments * size)
        return state, ends


def _no_tangent(x):
    if jnp.issubdtype(x.dtype, jnp.inexact):
        return jnp.zeros_like(x)
    return np.zeros(x.shape, jax.dtypes.float0)


def _why_not(task: Task, *inputs) -> str | None:
    """Why no states of this run can be reconstructed; None if they can."""
    if not task.method.is_invertible:
        return f"{type(task.method).__name__} has no inverse step"
    if task.lattice.has_memory:
        return f"the steps of {type(task.lattice).__name__} depend on those before"
    if task.stop is not None:
        return "a run with a Stop may end before its last step"
    if task.has_deviations:
        return "deviation vectors cannot be followed backwards"
    if task.has_running_values:
        return "running values of reductions are not reconstructed"
    if manual_axes(*jax.tree.leaves(inputs)):
        return "the run is inside of jax.shard_map with check_vma=True"
    return None
