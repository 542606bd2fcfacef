"""One array program over devices and hosts."""

import contextlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

EXAMPLE = Path(__file__).parents[1] / "examples" / "many_hosts.py"

TWO_DEVICES = """
import sys
sys.path.insert(0, {folder!r})
import jax, jax.numpy as jnp, numpy as np
import dvi_jax as dvi
import many_hosts as example
assert len(jax.devices()) == 2
observed = jnp.asarray([0.1, 0.2])
lanes = jnp.arange(4096)
alone = jax.vmap(example.end, in_axes=(0, None))
print(jax.jit(lambda e: jnp.abs(
    dvi.over_devices(alone, in_axes=(0, None))(lanes, e) - alone(lanes, e)).max())(0.01))
def misfit(e):
    return jnp.sum((jnp.mean(alone(lanes, e), axis=0) - observed) ** 2)
for f in (lambda e: example.misfit(e, observed), misfit):
    print(*jax.jit(jax.value_and_grad(f))(0.01))
placed = jax.jit(dvi.over_devices(alone, in_axes=(0, None)))(lanes, 0.01)
print(len(placed.sharding.device_set))
"""


def run(command, **env):
    env = {**os.environ, "JAX_PLATFORMS": "cpu", **env}
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True, timeout=300)


@pytest.mark.slow
def test_two_devices_give_what_one_does():
    code = TWO_DEVICES.format(folder=str(EXAMPLE.parent))
    flags = "--xla_force_host_platform_device_count=2"
    out = run([sys.executable, "-c", code], XLA_FLAGS=flags).stdout.split()
    difference, *values, devices = map(float, out)
    assert difference < 1e-13
    np.testing.assert_allclose(values[:2], values[2:], rtol=1e-12)  # and their gradients
    assert devices == 2


FOUR_DEVICES = """
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec as P
import dvi_jax as dvi
mesh = Mesh(np.array(jax.devices()), ("x",))
assert len(jax.devices()) == 4
system = dvi.System(
    lambda t0, t1, q, p, a: p @ p / 2 * (1 + 0.3 * q @ q) + a * (q @ q) / 2,
    force=lambda t0, t1, q, p, a: -p,
)
q, k = jnp.linspace(0.5, 1.5, 8)[:, None], jnp.asarray(1.2)
adjoint = ADJOINT
def one(q, k):
    run = {"h": 0.1, "num_steps": 4, "epsilon": 0.1, "adjoint": adjoint}
    return dvi.integrate(system, q, jnp.zeros(1), args=k, **run).qs[-1]
batch = jax.vmap(one, in_axes=(0, None))
alone = jax.jit(batch)(q, k)
def total(of):
    return jax.jit(jax.grad(lambda q, k: jnp.sum(of(q, k) ** 2), argnums=(0, 1)))(q, k)
expected = total(batch)
largest = lambda a, b: float(max(jnp.max(jnp.abs(x - y)) for x, y in zip(a, b)))
for check in (True, False):
    over = jax.shard_map(
        batch, mesh=mesh, in_specs=(P("x"), P()), out_specs=P("x"), check_vma=check
    )
    print(largest([over(q, k)], [alone]), largest([jax.jit(over)(q, k)], [alone]))
    print(largest(total(over), expected))
placed = jax.device_put(q, NamedSharding(mesh, P("x")))
print(largest([jax.jit(batch)(placed, k)], [alone]))
print(largest([jax.pmap(batch, in_axes=(0, None))(q.reshape(4, 2, 1), k).reshape(8, 1)], [alone]))
"""


@pytest.mark.slow
@pytest.mark.parametrize("adjoint", ["Reversible()", "Direct()"])
def test_four_devices_by_shard_map_shardings_and_pmap(adjoint):
    """Numbers and gradients, also by a parameter that all devices share, are those of one."""
    flags = "--xla_force_host_platform_device_count=4"
    code = FOUR_DEVICES.replace("ADJOINT", f"dvi.{adjoint}")
    out = run([sys.executable, "-W", "ignore", "-c", code], XLA_FLAGS=flags, JAX_ENABLE_X64="1")
    differences = list(map(float, out.stdout.split()))
    assert len(differences) == 8
    assert max(differences) < 1e-14


HOST_FIRST = """
import socket, sys
import jax
from dvi_jax import generators, systems
for make in systems.LIBRARY.values():
    try:
        make()
    except ImportError:  # `EphemerisMissing`
        pass
generators.boost([1.0, 0.0], 2.0)
if sys.argv[1] == "touched":
    jax.device_count()
with socket.socket() as free:
    free.bind(("127.0.0.1", 0))
    address = f"127.0.0.1:{free.getsockname()[1]}"
jax.distributed.initialize(address, 1, 0)  # raises once JAX has a backend
print("together")
"""


@pytest.mark.slow
def test_the_library_can_be_made_before_the_hosts_are_joined():
    """Importing the package and making its problems starts no device."""
    out = run([sys.executable, "-c", HOST_FIRST, "not touched"], JAX_ENABLE_X64="1")
    assert out.stdout.split() == ["together"]
    with pytest.raises(subprocess.CalledProcessError) as failed:
        run([sys.executable, "-c", HOST_FIRST, "touched"], JAX_ENABLE_X64="1")
    assert "must be called before" in failed.value.stderr


def test_one_device_and_what_is_refused():
    x, c = jnp.arange(6.0).reshape(2, 3), jnp.asarray(2.0)
    doubled = dvi.over_devices(lambda x, c: c * x, in_axes=(-1, None), out_axes=1)
    np.testing.assert_array_equal(doubled(x, c), 2 * x)
    with pytest.raises(TypeError, match="argument of over_devices must be a function"):
        dvi.over_devices(3)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="number of devices must be an integer of at least 1"):
        dvi.over_devices(jnp.sin, devices=[])
    with pytest.raises(ValueError, match=r"2 arguments, got \[0\]"):
        dvi.over_devices(jnp.add, in_axes=[0])(x, x)
    with pytest.raises(ValueError, match=r"shape \(\)"):
        dvi.over_devices(jnp.add)(x, c)
    assert jax.device_count() == 1
    for form in ("gpu", "components", "kernel"):
        with pytest.raises(ValueError, match='"auto" or "arrays"'):
            dvi.Layout(form=form)  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_hosts_are_killed_and_the_fit_is_the_same(tmp_path):
    """Two hosts, one of them killed now and then; the launcher starts them again."""
    command = [sys.executable, str(EXAMPLE), "--iterations", "30", "--launch", "2", "--state"]
    undisturbed = run([*command, str(tmp_path / "a.json")]).stdout
    env = {**os.environ, "JAX_PLATFORMS": "cpu"}
    command.append(str(tmp_path / "b.json"))
    launcher = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)
    rng, kills, lines, pids = random.Random(1), 0, [], []
    assert launcher.stdout is not None
    for line in launcher.stdout:
        lines.append(line)
        if line.startswith("hosts:"):
            pids = [int(p) for p in line.split()[1:]]
        elif '"iteration"' in line and kills < 3 and json.loads(line)["iteration"] >= 5 * kills + 3:
            time.sleep(rng.uniform(0, 0.02))
            with contextlib.suppress(ProcessLookupError):  # it is gone already: try another time
                os.kill(rng.choice(pids), signal.SIGKILL)
                kills += 1
    assert launcher.wait(120) == 0
    assert kills == 3
    assert sum("a host was lost" in line for line in lines) >= 2
    last = [re.findall(r"ε = (\S+) on (\d+)", text)[-1] for text in (undisturbed, "".join(lines))]
    assert last[0] == last[1]
    assert last[0][1] == "2"
    assert abs(float(last[0][0]) - 0.02) < 1e-9
    a, b = (json.loads((tmp_path / f"{n}.json").read_text()) for n in "ab")
    assert a == b
