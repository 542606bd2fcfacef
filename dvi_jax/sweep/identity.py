"""What a sweep is, in words and hashes: two sweeps of one description give the same numbers."""

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
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lanewise.extent import functions_in
from lanewise.jaxapi import ClosedJaxpr, bodies, is_traced

from ..engine.signature import accepts
from .axes import is_axis, leaves_with_axes
from .plan import Plan
from .program import Sweep, stacked
from .variables import Variable

FORMAT = 1
"""Of the store: raised when a store of an older one cannot be read any more."""

PROGRAM = "program"

_ADDRESS = re.compile(r" at 0x[0-9a-f]+")

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")

_SIGNATURES = {
    5: lambda t, x, args: (t, t, x, x, args),
    7: lambda t, x, args: (t, t, x, x, x, x, args),
    4: lambda t, x, args: (t, x, x, args),
    3: lambda t, x, args: (x, x, args),
    2: lambda t, x, args: (x, x),
}
"""Arguments of the functions that users write, by how many they are."""


def description(
    sweep: Sweep, plan: Plan, variables: Mapping[str, Variable], programs: Sequence[ClosedJaxpr]
) -> dict[str, Any]:
    """Everything that the numbers depend on, as JSON: one entry for each argument, so that it can
    be said which differs, and `program`, which sees all that any function does.

    Functions stand there as the hash of what they compute (their jaxpr, with its constants), so
    that renaming a variable changes nothing and changing a number in them does. What a callback to
    Python computes is not seen.
    """
    q0, args, t0 = _example(sweep)
    known = Describer(jnp.asarray(t0, q0.dtype), q0, args)
    axes = {leaf.name: leaf.axis.name for leaf in leaves_with_axes(dict(sweep.inputs))}
    return {
        "format": FORMAT,
        "system": known(sweep.system),
        **{name: known(value) for name, value in sweep.inputs.items()},
        "start": known(sweep.start),
        "method": known(sweep.method),
        "num_steps": known(sweep.num_steps),
        **{name: known(value) for name, value in sweep.options.items()},
        "precision": str(q0.dtype),
        PROGRAM: [_hash(program) for program in programs],
        "dims": dict(plan.dims),
        "axes": axes,
        "chunk": list(plan.chunk),
        "variables": {n: [v.dtype, list(v.shape), list(v.dims)] for n, v in variables.items()},
    }


def _example(sweep: Sweep) -> tuple[Any, Any, Any]:
    """(q0, args, t0) of the first trajectory; of the starts only shape and type matter."""

    def begin(leaf):
        return jnp.asarray(leaf.values[0]) if is_axis(leaf) else leaf

    first = jax.tree.map(begin, dict(sweep.inputs), is_leaf=is_axis)
    if sweep.start is None:
        q0 = jnp.asarray(stacked(first["q0"]))
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
    a, b = _flat(old), _flat(new)
    keys = [key for key in sorted({*a, *b}) if a.get(key) != b.get(key)]
    if keys == [PROGRAM]:
        return [f"{PROGRAM}: a function, or a part of the packages, computes something else"]
    return [
        f"{key}: {_short(a.get(key))} there, {_short(b.get(key))} now"
        for key in keys
        if key != PROGRAM
    ]


def _flat(tree: Any, prefix: str = "") -> dict[str, Any]:
    if isinstance(tree, Mapping) and tree:
        found: dict[str, Any] = {}
        for key, value in tree.items():
            found |= _flat(value, f"{prefix}.{key}" if prefix else str(key))
        return found
    return {prefix: tree}


def _short(value: Any) -> str:
    text = "nothing" if value is None else json.dumps(value)
    return text if len(text) <= 60 else text[:57] + "…"


@dataclasses.dataclass(frozen=True)
class Describer:
    """Describes arguments; functions are traced with a time, a state and args like these."""

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
            return _of_array(np.asarray(x))
        if isinstance(x, Mapping):
            return {str(k): self(v) for k, v in x.items()}
        if isinstance(x, list | tuple):
            return [self(v) for v in x]
        if dataclasses.is_dataclass(x) and not isinstance(x, type):
            fields = {f.name: self(getattr(x, f.name, None)) for f in dataclasses.fields(x)}
            code = {"function": self.function(x)} if callable(x) else {}
            return {"is": type(x).__qualname__, **fields, **code}
        if isinstance(x, type):
            return x.__qualname__
        if callable(x):
            return self.function(x)
        return {"is": type(x).__qualname__, "repr": _ADDRESS.sub("", repr(x))}

    def function(self, f: Callable[..., Any]) -> str:
        """The hash of what a function computes, or of its code where it cannot be traced alone."""
        first = [n for n in _SIGNATURES if n == _required(f)]
        for count in (*first, *(n for n in _SIGNATURES if n not in first)):
            arguments = _SIGNATURES[count]
            if not accepts(f, count):
                continue
            try:
                given = arguments(self.t, self.state, self.args)
                dynamic, static = eqx.partition(given, eqx.is_array)
                traced = jax.make_jaxpr(lambda d, s=static: f(*eqx.combine(d, s)))(dynamic)
            except Exception:  # not of this kind: what is wrong with it `integrate` will say
                continue
            return f"computes {_hash(traced)}"
        return f"code {hashlib.sha256(_code(f)).hexdigest()[:16]}"


def _required(f: Callable[..., Any]) -> int:
    """How many arguments have no default; others are a way to give a function its constants."""
    try:
        parameters = inspect.signature(f).parameters.values()
    except (TypeError, ValueError):
        return -1
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return sum(p.kind in positional and p.default is p.empty for p in parameters)


def _hash(closed: ClosedJaxpr) -> str:
    hashed = hashlib.sha256()
    for part in _parts(closed):
        hashed.update(_text(part.jaxpr).encode())
        for constant in part.consts:
            if not is_traced(constant):
                hashed.update(json.dumps(_of_array(np.asarray(constant))).encode())
    return hashed.hexdigest()[:16]


def _text(jaxpr: Any) -> str:
    """A jaxpr in words that are the same everywhere: no colours, no addresses."""
    return _COLOUR.sub("", _ADDRESS.sub("", str(jaxpr)))


def _parts(closed: ClosedJaxpr) -> Iterator[ClosedJaxpr]:
    """A jaxpr, and those inside of its loops and calls, with the constants that they hold."""
    yield closed
    for eqn in closed.jaxpr.eqns:
        for body in (*bodies(eqn), *functions_in(eqn)):
            yield from _parts(body)


def _of_array(x: np.ndarray) -> Any:
    if x.size <= 8 and x.dtype.kind in "iufb":
        return {"dtype": x.dtype.name, "values": json.loads(json.dumps(x.tolist()))}
    hashed = hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()
    return {"dtype": x.dtype.name, "shape": list(x.shape), "sha256": hashed}


def _code(f: Callable[..., Any]) -> bytes:
    try:
        return inspect.getsource(f).encode()
    except (OSError, TypeError):
        return _ADDRESS.sub("", repr(f)).encode()


def provenance() -> dict[str, Any]:
    """Where, when and with what: for the attributes of a result."""
    devices = jax.local_devices()
    found = {
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
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "not installed"
    return found | {"git_revision": _git_revision()}


def _git_revision() -> str:
    """The commit of the working directory, with "+" where files differ from it; or nothing."""
    try:
        asked = [
            subprocess.run(["git", *words], capture_output=True, text=True, timeout=5, check=True)
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "-uno"])
        ]
    except (OSError, subprocess.SubprocessError):
        return ""
    return asked[0].stdout.strip() + ("+" if asked[1].stdout.strip() else "")
