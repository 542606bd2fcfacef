"""The result of `integrate`, and the choice of the states that it saves."""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lanewise.jaxprs.jaxapi import is_traced

from ..base.checks import in_order, only_one, require, whole
from ..base.inputs import as_times
from ..base.printing import first_lines
from ..base.results import RESULTS, status_counts, status_name
from ..base.signature import with_time
from ..base.types import State
from ..problem.elements import Elements, Keplerian, of_bodies
from .labelled import dataset_of, table_of
from .saved import read, write


# The times are an array, not static: they may be traced, and new times need no new compilation.
def _times(ts: Any) -> Any:
    return None if ts is None else as_times("Save(ts=...)", ts)


def _clock(clock: Any) -> Any:
    return None if clock is None else with_time("the clock of Save", clock)


class Save(eqx.Module):
    """The states that a run saves. The initial state is one of them, except with `ts`.

    - ``Save(every=m)``: the states after m, 2m, 3m, … steps.
    - ``Save(final=True)``: the state after the last step; together with `every`, also when
      num_steps is not a multiple of it.
    - ``Save()``: every state.
    - ``Save(ts=times)``: the states at these times and no others, in the order of the run. Between
      grid points it is a shorter step of the method to that time, which has the order of the
      method. Times outside of the run give NaN and the status `not_reached`. Invariants of the map
      at step h are conserved at grid points only, not at the end of a shorter step.
      With ``clock=f``, a function ``(q, p)`` or ``(t, q, p, args)`` → scalar that grows along the
      trajectory, an angle for instance, `ts` are values of it.

    **Raises** `ValueError` for an `every` that is not a positive integer, for `ts` together with
    another choice, and for times that are not one-dimensional, finite and in order.

    **Example**

    ```python
    orbit = systems.kepler()
    run = {"q0": orbit.q0, "p0": orbit.p0, "args": orbit.args, "h": 0.1, "num_steps": 1000}
    for save in (dvi.Save(every=300), dvi.Save(every=300, final=True), dvi.Save(ts=[0.25, 99.0])):
        print(np.round(dvi.integrate(orbit.system, **run, save=save).ts, 6))
    # [ 0. 30. 60. 90.]
    # [  0.  30.  60.  90. 100.]
    # [ 0.25 99.  ]
    ```
    """

    every: int | None = eqx.field(static=True, default=None)
    final: bool = eqx.field(static=True, default=False)
    ts: Float[Array, " times"] | None = eqx.field(default=None, converter=_times)
    clock: Callable[..., Any] | None = eqx.field(default=None, converter=_clock)

    def __check_init__(self):
        if self.every is not None:
            whole("every in Save(every=...)", self.every)
        if self.ts is None:
            if self.clock is not None:
                raise ValueError("clock of Save requires ts, its values at which states are saved.")
            return
        only_one(ts=self.ts, every=self.every, final=self.final or None)
        if not is_traced(self.ts):
            # In order, since a step finds its times by bisection. Traced ones are sorted in a run.
            in_order("ts in Save(ts=...)", self.ts)


class Solution(eqx.Module):
    """A computed trajectory.

    - `ts`: saved times, shape (S,); ``ts[0]`` is t0, except with ``Save(ts=...)``.
    - `qs`, `ps`: saved positions and momenta, shape (S, *q0.shape).
    - `hs`: size of the step that ended at each saved time except the first, shape (S − 1,). With
      ``Save(ts=...)`` the first time is like the others: `hs` and the values of functions in
      `observed` have shape (S, …), of the shorter step that ends at each time (size zero at t0).
    - `observed`: the pytree given as `observe`; a function of the state is replaced by its values
      at ``ts``, shape (S, …), one of a step by its values on the steps that ended at ``ts[1:]``,
      shape (S − 1, …), a reduction by one value over all steps.
    - `result`: the status, one of `RESULTS`. After a failure states and observables are NaN.
    - `stop`: the end (t, q, p) of a run with a `Stop`, a `Stopped`, NaN if it did not; else None.
    - `jumps`: of a run with `jump`: a `Jumps`; else None.
    - `stats`: `num_steps`; `newton_iterations` (total); `max_residual` (largest last correction of
      a solve relative to its scale); `failed_step` (number of the failing step from 0, or −1) and
      `failed_residual` (its last correction, likewise, or 0); others of the grid and the method.

    Under `vmap` the first axis of every field is the batch.
    """

    ts: Float[Array, "..."]
    qs: State
    ps: State
    hs: Float[Array, "..."]
    observed: Any
    result: RESULTS
    stats: dict[str, Any]
    stop: Any = None
    jumps: Any = None

    @property
    def status(self) -> Any:
        """The name of `result`, such as "successful"; an array of names for a batch."""
        return status_name(self.result)

    @property
    def t_final(self) -> Array:
        """The last saved time, shape (*batch,)."""
        return self.ts[..., -1]

    @property
    def q_final(self) -> Array:
        """The last saved positions, shape (*batch, *q0.shape)."""
        # Axes of the batch come first, those of a state last: the saved states are in between.
        return jnp.take(self.qs, -1, axis=self.ts.ndim - 1)

    @property
    def p_final(self) -> Array:
        """The last saved momenta, shape (*batch, *q0.shape)."""
        return jnp.take(self.ps, -1, axis=self.ts.ndim - 1)

    def to_xarray(
        self,
        *,
        dims: Sequence[str] | str | None = None,
        coords: Mapping[str, Any] | None = None,
        observe: Any = None,
        components: Mapping[str, Any] | Sequence[Any] | None = None,
        units: Mapping[str, str] | None = None,
        attrs: Mapping[str, Any] | None = None,
    ) -> Any:
        """This trajectory, or batch of them, as an `xarray.Dataset`.

        - `dims`: names for the dimensions of the batch, in order (default ``trajectory``);
          `coords`: name → values along one.
        - `observe`: the same as for `integrate`, from which follows which observables have one
          value for each state or step. Without it their dimensions are not called so.
        - `components`: labels along the axes of q and p: ``["x", "y"]`` for one axis, or name →
          labels for each axis, ``{"body": ["Sun", "Jupiter"], "axis": ["x", "y", "z"]}``.
        - `units`: name of a variable → text, such as ``problem.units``; `attrs`: attributes of the
          whole, numbers and text as they are, anything else (a method) as its text.

        **Returns** a dataset with dimensions `dims`, then

        - ``time`` where all trajectories are saved at the same times, which are its coordinate;
          else ``save``, and the times are a variable `t`;
        - ``component`` or the names in `components`;
        - ``step`` for values of the step that ended at a saved time: its index is that of the
          state at its end (for ``Save(ts=...)`` the dimension of the states itself).

        Variables: `q`, `p`, `h`; observables by their place in the pytree, joined by points, one
        alone as ``observed``, the first of a list as ``observed.0``; `status` (int8, with
        ``flag_values`` and ``flag_meanings``); the arrays in `stats`; ``stop_t``, ``stop_q``,
        ``stop_p`` for a run with a `Stop`; ``jumps.ts``, ``jumps.qs_before`` and all others of
        `Jumps` for one with jumps, along ``jumps_dim``. NaN stays NaN.
        ``sol.to_xarray().to_netcdf(path, engine="h5netcdf")`` writes it (extra ``export``).

        **Raises** `ValueError` for a number of `dims` that is not that of the batch, labels that
        do not fit, an `observe` of another structure, and names that are in use; `TypeError` for
        coords with units (which belong in `units`), and under jit.
        """
        options = {"dims": dims, "coords": coords, "observe": observe, "components": components}
        return dataset_of(self, **options, units=units, attrs=attrs)

    def to_dataframe(
        self,
        *,
        dims: Sequence[str] | str | None = None,
        coords: Mapping[str, Any] | None = None,
        observe: Any = None,
        components: Mapping[str, Any] | Sequence[Any] | None = None,
    ) -> Any:
        """A `pandas.DataFrame` with a row for each saved state.

        Columns: ``t``; ``q_0``, ``q_1``, … or ``q_x``, ``q_y`` with `components`, likewise of p;
        ``h`` and observables with a value for each state or step (those of `observe`); ``status``.
        Values of a step are in the row of the state at its end, NaN in that of the start (for
        integers and booleans ``pandas.NA``).
        Reductions, which have one value for a run, are not in it. A batch has the rows of its
        trajectories one after the other, with `dims` (default ``trajectory``) and ``save`` as
        index. Arguments and errors are those of `to_xarray`.
        """
        return table_of(self, dims=dims, coords=coords, observe=observe, components=components)

    def elements(
        self,
        masses: Any = None,
        G: Any = 1.0,
        *,
        frame: Any = "jacobi",
        mu: Any = None,
        kind: Any = Keplerian,
    ) -> Any:
        """Orbital elements of the saved states, each of shape (*batch, S, bodies − 1).

        - `masses`, `G`, `frame`, `kind`: see `dvi.elements.of_bodies`.
        - `mu`: without masses, of one body around a centre, whose p is its velocity: see
          `dvi.elements`. Each element then has the shape (*batch, S).

        **Raises** `ValueError` for shapes that do not fit, `TypeError` without masses and mu.
        """
        only_one(masses=masses, mu=mu)
        require("Solution.elements", {"masses or mu": mu if masses is None else masses})
        if masses is None:
            return Elements(kind).kind.from_state(self.qs, self.ps, mu)
        return of_bodies(self.qs, self.ps, masses, G, frame=frame, kind=kind)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write it to one file (NumPy's npz), whole or not at all; `Solution.load` reads it.

        **Raises** `FileNotFoundError` without a directory for it; `TypeError` for observables in
        another pytree than dicts, lists and tuples, and under jit.
        """
        write(self, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "Solution":
        """Read what `save` wrote: the same numbers, with the same digits.

        **Raises** `FileNotFoundError`; `ValueError` for a damaged or another file;
        `TypeError` for float64 numbers where x64 is off.

        **Example**

        ```python
        orbit = dvi.integrate(systems.kepler(), h=0.05, num_steps=400)
        orbit.save("orbit.npz")
        print(np.array_equal(dvi.Solution.load("orbit.npz").qs, orbit.qs))
        # True
        ```
        """
        return cls(**read(path))

    def __getattr__(self, name: str) -> Any:
        # Called for names that do not exist only.
        hint = _OTHER_NAMES.get(name)
        hint = hint or "attributes are " + ", ".join([*self.__dataclass_fields__, "status"])
        text = f"a Solution has no attribute {name!r}. The {hint}."
        raise AttributeError(text, name=name, obj=self)

    def __getitem__(self, name: Any) -> Any:
        raise TypeError(
            f"a Solution has no items, got [{name!r}]. Its arrays are ts, qs, ps and observed; "
            "values of an observable are in observed[name]."
        )

    def __repr__(self) -> str:
        """Status, size and last state in words; the shapes under jit."""
        if any(is_traced(x) for x in jax.tree.leaves((self.ts, self.qs, self.result))):
            return f"Solution(ts={eqx.tree_pformat(self.ts)}, qs={eqx.tree_pformat(self.qs)}, …)"
        *batch, states = self.ts.shape
        size = f"{' × '.join(map(str, batch))} trajectories, " if batch else ""
        shape = self.qs.shape[len(batch) + 1 :]
        # The times of the first trajectory; those of others in the batch may differ.
        t = np.asarray(self.ts).reshape(-1, states)[0]
        lines = [
            f"Solution: {size}{status_counts(self.status)}; {self.stats['num_steps']} steps, "
            f"{states} saved states of shape {shape}, t = {t[0]:g} … {t[-1]:g}"
        ]
        if not batch:
            short = {"precision": 6, "threshold": 12, "separator": ", "}
            lines.append(f"  q_final = {np.array2string(np.asarray(self.q_final), **short)}")
            lines.append(f"  p_final = {np.array2string(np.asarray(self.p_final), **short)}")
        if self.observed is not None:
            lines.append(f"  observed = {eqx.tree_pformat(self.observed)}")
        return first_lines("\n".join(lines), "")


_OTHER_NAMES = {
    **dict.fromkeys(
        ("q", "x", "positions", "coordinates"), "positions are in qs, the last ones in q_final"
    ),
    **dict.fromkeys(("p", "v", "momenta"), "momenta are in ps, the last ones in p_final"),
    **dict.fromkeys(("t", "times", "time"), "times are in ts"),
    **dict.fromkeys(("y", "ys", "states", "state"), "states are in qs and ps"),
    **dict.fromkeys(("success", "converged"), 'status is "successful" for a run without a failure'),
    **dict.fromkeys(("observables", "observe"), "values of observables are in observed"),
}
"""Names in other packages → where it is here."""
