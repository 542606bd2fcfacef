"""One array program over several hosts, which survives the loss of any of them.

    python examples/many_hosts.py --launch 2

The strength ε of the perturbation is fitted to the mean of a set of Kepler orbits by a damped
Gauss–Newton iteration. The mean is over all trajectories. Therefore all hosts run one program,
`dvi.over_devices`, and the trajectories are divided between them. If a host is lost, the other
hosts cannot continue. The launcher then starts all of them again, and they continue after the last
finished iteration, which host 0 has stored in a file.

`--launch N` starts N processes on this machine in place of a cluster. On a cluster the scheduler
starts the processes (Slurm: srun), each without --launch; see docs/clusters.md.
"""

import argparse
import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

KEPLER = systems.LIBRARY["kepler"]()
START = dvi.starts.Halton(4096, ([0.8, -0.1], [-0.1, 0.8]), ([1.2, 0.1], [0.1, 1.2]))
TRUE_EPSILON = 0.02


def end(i, epsilon):
    """The last position of trajectory number i."""
    q0, p0 = START.at(i, 0.0, None)
    sol = dvi.integrate(
        KEPLER.system,
        q0,
        p0,
        h=0.02,
        num_steps=100,
        epsilon=epsilon,
        args=KEPLER.args,
        save=dvi.Save(final=True),
        throw=False,
    )
    return sol.qs[-1]


def mean_end(epsilon):
    ends = dvi.over_devices(jax.vmap(end, in_axes=(0, None)), in_axes=(0, None))
    return jnp.mean(ends(jnp.arange(START.count), epsilon), axis=0)


def misfit(epsilon, observed):
    return jnp.sum((mean_end(epsilon) - observed) ** 2)


def fit(state_file: Path, iterations: int) -> dict:
    """Newton's iteration in ε, Gauss's Hessian; goes on from `state_file`."""
    state = {"iteration": 0, "epsilon": 0.0}
    if state_file.exists():
        state = json.loads(state_file.read_text())
    observed = jax.jit(mean_end)(TRUE_EPSILON)
    slope = jax.jit(jax.jacfwd(mean_end))
    value_and_grad = jax.jit(jax.value_and_grad(misfit))
    while state["iteration"] < iterations:
        epsilon = state["epsilon"]
        value, gradient = value_and_grad(epsilon, observed)
        hessian = 2 * jnp.sum(slope(epsilon) ** 2)
        state = {
            "iteration": state["iteration"] + 1,
            "epsilon": epsilon - 0.5 * float(gradient / hessian),
            "misfit": float(value),
        }
        if jax.process_index() == 0:
            print(json.dumps(state), flush=True)
            temporary = state_file.with_suffix(".tmp")
            temporary.write_text(json.dumps(state))
            os.replace(temporary, state_file)
    return state


def launch(count: int, arguments: list[str], times: int = 20) -> None:
    """Start `count` processes; when one dies, stop the others and start all of them again."""
    for _ in range(times):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            address = f"127.0.0.1:{free.getsockname()[1]}"
        common = ["--coordinator", address, "--hosts", str(count)]
        hosts = [
            subprocess.Popen([sys.executable, __file__, *arguments, *common, "--host", str(i)])
            for i in range(count)
        ]
        print("hosts:", *(h.pid for h in hosts), flush=True)
        while all(h.poll() is None for h in hosts):
            time.sleep(0.1)
        while any(h.poll() is None for h in hosts) and all(h.poll() in (None, 0) for h in hosts):
            time.sleep(0.1)
        if all(h.poll() == 0 for h in hosts):
            return
        for h in hosts:
            h.kill()
            h.wait()
        print("a host was lost: starting again", flush=True)
    raise SystemExit(f"hosts were lost {times} times: giving up")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--launch", type=int, help="play a cluster of so many hosts")
    parser.add_argument("--coordinator", help="address:port of host 0")
    parser.add_argument("--hosts", type=int, default=1)
    parser.add_argument("--host", type=int, default=0)
    parser.add_argument("--state", type=Path, default=Path("many_hosts.json"))
    parser.add_argument("--iterations", type=int, default=12)
    options = parser.parse_args()
    if options.launch:
        launch(
            options.launch, ["--state", str(options.state), "--iterations", str(options.iterations)]
        )
        return
    if options.coordinator:
        if jax.config.jax_platforms == "cpu":
            jax.config.update("jax_cpu_collectives_implementation", "gloo")
        jax.distributed.initialize(options.coordinator, options.hosts, options.host)
    state = fit(options.state, options.iterations)
    if jax.process_index() == 0:
        print(f"ε = {state['epsilon']:.12f} on {len(jax.devices())} devices", flush=True)


if __name__ == "__main__":
    main()
