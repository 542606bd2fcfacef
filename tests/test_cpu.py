"""Flags of XLA for the CPU: set on request, before JAX starts, and not by the import."""

import os
import subprocess
import sys

import jax.numpy as jnp
import pytest

import dvi_jax as dvi


def run(code, **environment):
    keep = {k: v for k, v in os.environ.items() if k != "XLA_FLAGS"}
    command = [sys.executable, "-c", code]
    env = {**keep, **environment}
    return subprocess.run(command, env=env, capture_output=True, text=True, check=False)


CONFIGURE = """
import os, jax, jax.numpy as jnp, dvi_jax as dvi
jax.config.update("jax_enable_x64", True)
dvi.configure_cpu()
print(os.environ["XLA_FLAGS"])
system = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)
sol = dvi.integrate(system, jnp.ones(1), jnp.ones(1), h=0.1, num_steps=3)
print(sol.status)
"""


@pytest.mark.slow
@pytest.mark.parametrize("own", ["", "--xla_cpu_prefer_vector_width=128 --xla_cpu_max_isa=AVX2"])
def test_configured_process_runs(own):
    """Flags that the user has set are not changed."""
    done = run(CONFIGURE, **({"XLA_FLAGS": own} if own else {}))
    flags, status = done.stdout.splitlines()
    assert status == "successful", done.stderr
    assert flags.startswith(own)
    assert "small_while_loop" in flags
    assert flags.count("vector_width") == 1
    assert ("vector_width=512" in flags) == (not own)


def test_too_late_is_refused_with_what_to_do():
    jnp.ones(1).block_until_ready()
    before = os.environ.get("XLA_FLAGS")
    with pytest.raises(RuntimeError, match=r"XLA_FLAGS=.*small_while_loop"):
        dvi.configure_cpu()
    assert os.environ.get("XLA_FLAGS") == before


IMPORT = """
import os, sys, dvi_jax, lanewise
print(os.environ.get("XLA_FLAGS"), "llvmlite" in sys.modules)
lanewise.set_threads(1)
print("llvmlite" in sys.modules)
"""


def test_importing_changes_no_flag_and_does_not_import_llvmlite():
    assert run(IMPORT).stdout.split() == ["None", "False", "True"]
