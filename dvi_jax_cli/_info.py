"""Versions, devices, flags and extras of this machine."""

import importlib.util
import os
import platform
import sys
from contextlib import suppress
from importlib import metadata
from typing import Any

from ._names import EXTRAS, VERSION
from ._show import TextTable

PACKAGES = (
    *("jax", "jaxlib", "equinox", "optax", "optimistix"),
    *("numpy", "matplotlib", "xarray", "zarr", "pydantic"),
)
_FLAGS = ("JAX_", "XLA_", "CUDA_VISIBLE", "NVIDIA_VISIBLE", "OMP_", "TF_CPP")
"""Beginnings of the environment's names that change what JAX does."""


def gather() -> dict[str, Any]:
    """Everything, for `tables` and for programs; `failed` says why JAX cannot be started, or ""."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    information: dict[str, Any] = {
        "versions": {"dvi-jax": VERSION, **{name: _version(name) for name in PACKAGES}},
        "python": platform.python_version(),
        "executable": sys.executable,
        "platform": platform.platform(),
        "processors": {"machine": os.cpu_count(), "usable": usable},
        "flags": {k: v for k, v in sorted(os.environ.items()) if k.startswith(_FLAGS)},
        "extras": {name: _extra(name) for name in EXTRAS},
        "failed": "",
    }
    try:
        import jax
        import jax.numpy as jnp

        information |= {
            "backend": jax.default_backend(),
            "devices": [_device(d) for d in jax.local_devices()],
            "x64_of_this_process": jnp.result_type(float) == jnp.float64,
            "x64_of_commands": True,
        }
    except Exception as error:  # a driver that does not fit, a flag that XLA does not know
        information["failed"] = f"JAX cannot be started: {type(error).__name__}: {error}"
    return information


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _device(device: Any) -> dict[str, Any]:
    entry = {"id": device.id, "kind": device.device_kind, "platform": device.platform}
    stats: dict[str, Any] = {}
    with suppress(Exception):  # not every backend counts
        stats = device.memory_stats() or {}
    return entry | {"bytes": stats.get("bytes_limit"), "bytes_in_use": stats.get("bytes_in_use")}


def _extra(name: str) -> dict[str, Any]:
    modules = [m for m in EXTRAS[name] if importlib.util.find_spec(m) is None]
    return {"missing": modules, "install": f'pip install "dvi-jax[{name}]"' if modules else None}


def tables(information: dict[str, Any]) -> list[TextTable]:
    """The collected information as tables."""
    versions = [[name, v or "not installed"] for name, v in information["versions"].items()]
    versions.append(["python", f"{information['python']} ({information['executable']})"])
    processors = f"{information['processors']['machine']}"
    if information["processors"]["usable"] is not None:
        processors += f", {information['processors']['usable']} usable"
    machine = [["platform", information["platform"]], ["processors", processors]]
    if not information["failed"]:
        state = "on" if information["x64_of_this_process"] else "off, to be turned on"
        machine.append(["backend of JAX", information["backend"]])
        machine.append(["double precision", f"commands turn it on; in a script: {state}"])
    devices = []
    for d in information.get("devices", []):
        size = d["bytes"]
        memory = "that of the machine" if size is None else f"{size / 2**30:.1f} GiB"
        devices.append([str(d["id"]), d["kind"], d["platform"], memory])
    extras = []
    for name, extra in information["extras"].items():
        status = f"missing: {', '.join(extra['missing'])}" if extra["missing"] else "installed"
        extras.append([name, status, extra["install"] or ""])
    candidates = [
        TextTable("Versions", ["package", "version"], versions),
        TextTable("Machine", ["", ""], machine),
        TextTable("Devices", ["number", "kind", "platform", "memory"], devices),
        TextTable("Environment", ["name", "value"], [*map(list, information["flags"].items())]),
        TextTable("Extras", ["name", "", "to install it"], extras),
    ]
    return [table for table in candidates if table.rows]
