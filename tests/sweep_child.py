"""A process that runs the sweep of `test_sweep_store` and logs what it does; it gets killed."""

import os
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.sweep import store as stores
from dvi_jax.sweep.store import Store

jax.config.update("jax_enable_x64", True)


def hamiltonian(t0, t1, q0, p1, args):
    return 0.5 * p1 @ p1 + 0.5 * q0 @ q0 + args["k"] * 0.25 * jnp.sum(q0**4)


def energy(t0, t1, q0, p0, q1, p1, args):
    return hamiltonian(t0, t1, q1, p1, args)


def friction(t0, t1, q0, p1, args):
    return -p1


SYSTEM = dvi.System(hamiltonian, force=friction)


def sweep(path, tasks=12, k=1.0, **kw):
    """100 trajectories a task, some of which fail."""
    epsilon = np.linspace(0, 0.1, 4 * tasks)
    epsilon[5] = 1e200
    low, high = ([-1.0, -1.0], [-1.0, -1.0]), ([1.0, 1.0], [1.0, 1.0])
    return dvi.sweep(
        SYSTEM,
        start=dvi.starts.Random(25, low, high),
        epsilon=epsilon,
        args={"k": k},
        h=0.1,
        num_steps=25,
        observe={"drift": dvi.MaxDrift(energy), "end": dvi.Last(energy)},
        save=dvi.Save(final=True),
        lanes_per_task=100,
        store=path,
        **kw,
    )


def logged(path: str, pause: float):
    """Writes "task begin" and "task end" around each commit, which waits before every file."""
    commit, publish = Store.commit, stores.publish
    log = os.open(f"{path}.log", os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def slow(self, task, results, facts):
        os.write(log, f"{task.number} begin\n".encode())
        commit(self, task, results, facts)
        os.write(log, f"{task.number} end\n".encode())

    def slow_publish(file, content):
        time.sleep(pause / 8)
        publish(file, content)

    Store.commit, stores.publish = slow, slow_publish


if __name__ == "__main__":
    where, tasks, pause = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    logged(where, pause)
    sweep(where, tasks)
