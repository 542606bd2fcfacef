"""The check of a certificate of `bound_drift`, in a process with limits of time and memory."""

import importlib
import subprocess
import sys
from pathlib import Path
from typing import Any

from .._errors import require, user_path

CHECKER = Path(__file__).parents[2] / "dvi_jax" / "proof" / "checker.py"

_LIMITED = """
import json, runpy, sys
try:
    import resource
    resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
except (ImportError, OSError, ValueError):
    pass  # not on every system
sys.argv = sys.argv[1:]
try:
    with open(sys.argv[1], encoding="utf-8") as file:
        is_certificate = {"format", "boxes", "hash"} <= json.load(file).keys()
except (AttributeError, RecursionError, ValueError):
    is_certificate = False
if not is_certificate:
    sys.exit(2)
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def verify_certificate(path: Path, max_seconds: float) -> tuple[dict[str, Any], str]:
    """What a certificate proves, and why it proves nothing, or "".

    The checker runs alone, without this package, in at most `max_seconds` and 1 GiB: whatever a
    file contains, it can neither stop this process nor occupy the machine.

    **Raises** `InputError` for a file that is not a certificate, `ModuleNotFoundError` without
    python-flint.
    """
    importlib.import_module("flint")
    command = [sys.executable, "-P", "-X", "utf8", "-c", _LIMITED, str(CHECKER), str(path)]
    try:
        done = subprocess.run(
            command, capture_output=True, timeout=max_seconds, check=False, encoding="utf-8"
        )
        rule = "a JSON file that DriftBound.save or dvi-jax bound wrote"
        require(done.returncode != 2, "CERTIFICATE", f"{path} is not a certificate", rule)
        first, _, text = done.stdout.strip().partition(": ")
        is_proof = done.returncode == 0 and first == "proved"
    except subprocess.TimeoutExpired:
        is_proof, text = False, f"the check takes longer than {max_seconds:g} s (--max-seconds)"
    if is_proof:
        return {"certificate": str(path), "proved": text}, ""
    text = text or "the system ended the check, which needs more than 1 GiB or makes FLINT fail"
    return {"certificate": str(path), "proved": None}, f"not proved: {text}"


def compare_system(
    certificate: Path, system: str, method: str, invariants: str
) -> tuple[dict[str, Any], str]:
    """Whether a certificate is about the system ``file.py:name`` and, if given, the invariants
    ``file.py:name``; and the message if it is not."""
    from dvi_jax import holds_for

    from .loader import Loader

    def load(option, text):
        path, _, name = text.rpartition(":")
        file = user_path(option, path)
        return Loader(file.parent).load(option, f"{file.name}:{name}")

    functions = load("--invariants", invariants) if invariants else None
    binding = holds_for(load("--system", system), certificate, functions, method=method or None)
    remarks = [x.replace("found=...", "--invariants FILE.py:NAME") for x in binding.remarks]
    binding = binding._replace(remarks=tuple(remarks))
    contents = {"system": system, "text": str(binding), **binding._asdict()}
    return contents, "" if binding else f"the certificate is not about {system}"
