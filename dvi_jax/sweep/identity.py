"""The description of a sweep as JSON and hashes: equal descriptions give equal numbers."""

import dataclasses
import datetime
import hashlib
import inspect
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.jaxprs.extent import functions_in
from lanewise.jaxprs.jaxapi import ClosedJaxpr, bodies, is_traced

from ..base.checks import known
from ..base.signature import accepts
from .axes import axes_in, is_axis
from .plan import SweepPlan
from .program import Sweep, state_of
from .variables import Variable

FORMAT = 1  # Of a store; greater when stores of this format cannot be read any more
PROGRAM = "program"

# In the text of a jaxpr or an object: what differs between processes or terminals.
_VOLATILE = re.compile(r" at 0x[0-9a-f]+|\x1b\[[0-9;]*m")

# Arguments of the functions that users write, by their number.
_SIGNATURES = {
    5: lambda t, x, args: (t, t, x, x, args),
    7: lambda t, x, args: (t, t, x, x, x, x, args),
    4: lambda t, x, args: (t, x, x, args),
    3: lambda t, x, args: (x, x, args),
    2: lambda t, x, args: (x, x),
}


def description(
    sweep: Sweep, plan: SweepPlan, variables: Mapping[str, Variable], programs: list[ClosedJaxpr]
) -> dict[str, Any]:
    """Everything that the numbers depend on, as JSON.

    There is one entry for each argument, so that a message can say which one differs, and
    `program`, the hash of all that is computed. A function is described by the hash of its jaxpr
    with its constants: it changes with a number in the function, not with the name of a variable.
    The computation of a callback to Python is not seen.
    """
    q0, args, t0 = _example(sweep)
    describe = Describer(jnp.asarray(t0, q0.dtype), q0, args)
    axes = {location: axis.name for location, axis in axes_in(sweep.inputs)}
    arrays = {n: [v.dtype, list(v.shape), list(v.dims)] for n, v in variables.items()}
    return {
        "format": FORMAT,
        "system": describe(sweep.system),
        **{name: describe(value) for name, value in sweep.inputs.items()},
        "start": describe(sweep.start),
        "method": describe(sweep.method),
        "num_steps": describe(sweep.num_steps),
        **{name: describe(value) for name, value in sweep.options.items()},
        "precision": str(q0.dtype),
        PROGRAM: [_hash(program) for program in programs],
        "dims": dict(plan.dims),
        "axes": axes,
        "chunk": list(plan.chunk),
        "variables": arrays,
    }


def _example(sweep: Sweep) -> tuple[Any, Any, Any]:
    """(q0, args, t0) of the first trajectory; of q0 only shape and type matter."""
    first = jax.tree.map(
        lambda leaf: jnp.asarray(leaf.values[0]) if is_axis(leaf) else leaf,
        dict(sweep.inputs),
        is_leaf=is_axis,
    )
    if sweep.start is None:
        q0 = jnp.asarray(state_of(first["q0"]))
    else:
        start, t0, args = sweep.start, first["t0"], first["args"]
        shape = jax.eval_shape(lambda i: start.at(i, t0, args), np.zeros((), np.int32))[0]
        q0 = jnp.ones(shape.shape, shape.dtype)
    if not jnp.issubdtype(q0.dtype, jnp.floating):
        q0 = q0.astype(jnp.result_type(float))
    args = jax.tree.map(lambda x: jnp.asarray(x) if isinstance(x, float) else x, first["args"])
    return q0, args, first["t0"]


def digest(description: Mapping[str, Any]) -> str:
    text = json.dumps(description, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """The entries in which two descriptions differ, with both values."""
    old, new = _flat(old), _flat(new)
    keys = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
    if keys == [PROGRAM]:
        return [f"{PROGRAM}: a function, or a part of the packages, computes something else"]
    keys = [key for key in keys if key != PROGRAM]
    return [f"{key}: {_short(old.get(key))} there, {_short(new.get(key))} now" for key in keys]


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if isinstance(tree, Mapping) and tree:
        entries: dict[str, Any] = {}
        for key, value in tree.items():
            entries |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
        return entries
    return {prefix: tree}


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "…"


@dataclasses.dataclass(frozen=True)
class Describer:
    """Describes arguments; functions are traced with this time, state and args."""

    t: Any
    state: Any
    args: Any

    def __call__(self, x: Any) -> Any:
        if isinstance(x, float):
            return repr(float(x))
        if x is None or isinstance(x, bool | int | str):
            return x
        if is_axis(x):
            values = x.values if isinstance(x.values, np.ndarray) else list(x.values)
            return {"axis": x.name, "values": self(values)}
        if isinstance(x, np.ndarray | np.generic | jax.Array):
            return _of_array(known("each value of a sweep", x))
        if isinstance(x, Mapping):
            return {str(k): self(value) for k, value in x.items()}
        if isinstance(x, list | tuple):
            return [self(value) for value in x]
        if dataclasses.is_dataclass(x) and not isinstance(x, type):
            names = [field.name for field in dataclasses.fields(x)]
            fields = {name: self(getattr(x, name, None)) for name in names}
            code = {"function": self.function(x)} if callable(x) else {}
            return {"is": type(x).__qualname__, **fields, **code}
        if isinstance(x, type):
            return x.__qualname__
        if callable(x):
            return self.function(x)
        return {"is": type(x).__qualname__, "repr": _VOLATILE.sub("", repr(x))}

    def function(self, subject: Callable[..., Any]) -> str:
        """The hash of what a function computes, or of its code where it cannot be traced alone."""
        number_required = _arity(subject)
        for count in sorted(_SIGNATURES, key=lambda number: number != number_required):
            if not accepts(subject, count):
                continue
            try:
                arguments = _SIGNATURES[count](self.t, self.state, self.args)
                dynamic, static = eqx.partition(arguments, eqx.is_array)
                jaxpr = jax.make_jaxpr(lambda d, s=static: subject(*eqx.combine(d, s)))(dynamic)
            except Exception:  # another kind of function; `integrate` reports errors in it
                continue
            return f"computes {_hash(jaxpr)}"
        try:
            code = inspect.getsource(subject)
        except (OSError, TypeError):
            code = _VOLATILE.sub("", repr(subject))
        return f"code {hashlib.sha256(code.encode()).hexdigest()[:16]}"


def _arity(function: Callable[..., Any]) -> int:
    """Number of arguments without default; constants of a function are often defaults."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):
        return -1
    return sum(p.kind <= p.POSITIONAL_OR_KEYWORD and p.default is p.empty for p in parameters)


def _hash(jaxpr: ClosedJaxpr) -> str:
    sha256 = hashlib.sha256()
    for part in _parts(jaxpr):
        sha256.update(_VOLATILE.sub("", str(part.jaxpr)).encode())
        for constant in part.consts:
            if not is_traced(constant):
                sha256.update(json.dumps(_of_array(np.asarray(constant))).encode())
    return sha256.hexdigest()[:16]


def _parts(jaxpr: ClosedJaxpr) -> Iterator[ClosedJaxpr]:
    """A jaxpr and those inside its loops and calls."""
    yield jaxpr
    for eqn in jaxpr.jaxpr.eqns:
        for body in (*bodies(eqn), *functions_in(eqn)):
            yield from _parts(body)


def _of_array(array: np.ndarray) -> Any:
    if array.size <= 8 and array.dtype.kind in "iufb":
        return {"dtype": array.dtype.name, "values": json.loads(json.dumps(array.tolist()))}
    sha256 = hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()
    return {"dtype": array.dtype.name, "shape": list(array.shape), "sha256": sha256}


def provenance() -> dict[str, Any]:
    """Time, machine and versions, for the attributes of a result."""
    devices = jax.local_devices()
    attributes = {
        "created": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "command": " ".join(sys.argv),
        "host": platform.node(),
        "platform": platform.platform(),
        "python": platform.python_version(),
        "devices": f"{len(devices)} × {devices[0].device_kind}",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }
    for package in ("dvi-jax", "jax", "jaxlib", "numpy", "zarr", "xarray"):
        try:
            attributes[package] = version(package)
        except PackageNotFoundError:
            attributes[package] = "not installed"
    return attributes | {"git_revision": _git_revision()}


def _git_revision() -> str:
    """The commit of the working directory, with "+" if files differ from it; or nothing."""
    commands = (["git", "rev-parse", "HEAD"], ["git", "status", "--porcelain", "-uno"])
    try:
        head, changes = (
            subprocess.run(words, capture_output=True, text=True, timeout=5, check=True).stdout
            for words in commands
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return head.strip() + ("+" if changes.strip() else "")
