"""What there is on this machine: versions, devices, flags, extras."""

import importlib.util
import os
import platform
import sys
from importlib import metadata
from typing import Any

from ._names import EXTRAS
from ._session import version
from ._show import Table

PACKAGES = (
    "jax", "jaxlib", "equinox", "optax", "optimistix", "numpy", "matplotlib", "xarray", "zarr",
    "pydantic",
)  # fmt: skip
_FLAGS = ("JAX_", "XLA_", "CUDA_VISIBLE", "NVIDIA_VISIBLE", "OMP_", "TF_CPP")
"""Beginnings of the environment's names that change what JAX does."""


def gather() -> dict[str, Any]:
    """Everything, for `tables` and for programs; `failed` says why JAX cannot be started, or ""."""
    versions = {"dvi-jax": version(), **{name: _version(name) for name in PACKAGES}}
    found: dict[str, Any] = {
        "versions": versions,
        "python": platform.python_version(),
        "executable": sys.executable,
        "platform": platform.platform(),
        "processors": _processors(),
        "flags": {k: v for k, v in sorted(os.environ.items()) if k.startswith(_FLAGS)},
        "extras": {name: _extra(name) for name in EXTRAS},
        "failed": "",
    }
    try:
        import jax
        import jax.numpy as jnp

        found |= {
            "backend": jax.default_backend(),
            "devices": [_device(d) for d in jax.local_devices()],
            "x64_of_this_process": jnp.result_type(float) == jnp.float64,
            "x64_of_commands": True,
        }
    except Exception as error:  # a driver that does not fit, a flag that XLA does not know
        found["failed"] = f"JAX cannot be started: {type(error).__name__}: {error}"
    return found


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _processors() -> dict[str, int | None]:
    """Of the machine, and those that this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    return {"machine": os.cpu_count(), "usable": usable}


def _device(device: Any) -> dict[str, Any]:
    try:
        stats = device.memory_stats() or {}
    except Exception:  # not every backend counts
        stats = {}
    return {
        "id": device.id,
        "kind": device.device_kind,
        "platform": device.platform,
        "bytes": stats.get("bytes_limit"),
        "bytes_in_use": stats.get("bytes_in_use"),
    }


def _extra(name: str) -> dict[str, Any]:
    missing = [m for m in EXTRAS[name] if importlib.util.find_spec(m) is None]
    return {"missing": missing, "install": f'pip install "dvi-jax[{name}]"' if missing else None}


def tables(found: dict[str, Any]) -> list[Table]:
    """What was gathered, for the reader."""
    versions = [[name, v or "not installed"] for name, v in found["versions"].items()]
    versions.append(["python", f"{found['python']} ({found['executable']})"])
    usable, machine = found["processors"]["usable"], found["processors"]["machine"]
    about = [
        ["platform", found["platform"]],
        ["processors", f"{machine}, {usable} usable" if usable is not None else str(machine)],
    ]
    if not found["failed"]:
        on = "on" if found["x64_of_this_process"] else "off, to be turned on"
        about += [
            ["backend of JAX", found["backend"]],
            ["double precision", f"commands turn it on; in a script: {on}"],
        ]
    made = [Table("Versions", ["package", "version"], versions),
            Table("Machine", ["", ""], about)]  # fmt: skip
    devices = [
        [str(d["id"]), d["kind"], d["platform"], _room(d["bytes"])]
        for d in found.get("devices", [])
    ]
    if devices:
        made.append(Table("Devices", ["number", "kind", "platform", "memory"], devices))
    flags = [[name, value] for name, value in found["flags"].items()]
    if flags:
        made.append(Table("Environment", ["name", "value"], flags))
    extras = [
        [name, "there" if not e["missing"] else f"missing: {', '.join(e['missing'])}",
         e["install"] or ""]
        for name, e in found["extras"].items()
    ]  # fmt: skip
    made.append(Table("Extras", ["name", "", "to install it"], extras))
    return made


def _room(size: int | None) -> str:
    return "that of the machine" if size is None else f"{size / 2**30:.1f} GiB"
