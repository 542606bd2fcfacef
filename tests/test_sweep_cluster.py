"""Sweeps on a Dask cluster: the same bits, whatever is killed."""

import os
import random
import shutil
import signal
import threading

import pytest
from sweep_child import sweep
from test_sweep_store import same

import dvi_jax as dvi
from dvi_jax.sweep.store import Store

distributed = pytest.importorskip("distributed")

pytestmark = pytest.mark.slow

TASKS = 30


@pytest.fixture
def cluster():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    with distributed.Client(cluster) as client:
        yield client


@pytest.fixture(scope="module")
def undisturbed():
    return sweep(None, TASKS)


def pids(store):
    records = (store.record(i) for i in range(store.plan.num_tasks))
    return {r["pid"] for r in records if r is not None}


def test_workers_commit_what_one_process_does(client, tmp_path, undisturbed):
    seen = []
    path = tmp_path / "s.zarr"
    same(sweep(path, TASKS, client=client, progress=seen.append), undisturbed)
    assert seen[-1].lanes_done == seen[-1].num_lanes == 100 * TASKS
    assert seen[-1].failed == 25
    assert os.getpid() not in pids(Store.open(path))
    assert not dvi.open_sweep(path).verify().bad
    same(sweep(None, TASKS, client=client), undisturbed)


def test_workers_are_killed(cluster, client, tmp_path, undisturbed):
    """SIGKILL to a worker every moment or two: the others and its successors go on."""
    path, rng, kills = tmp_path / "s.zarr", random.Random(3), []
    stop = threading.Event()

    def kill():
        while not stop.wait(rng.uniform(1.0, 2.5)) and len(kills) < 8:
            processes = [n.process.process for n in cluster.workers.values() if n.process]
            living = [p.pid for p in processes if p is not None and p.is_alive()]
            if living:
                kills.append(rng.choice(living))
                os.kill(kills[-1], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        found = sweep(path, TASKS, client=client)
        while len(kills) < 3:  # it was faster than the killer: let it do something
            found = sweep(tmp_path / f"s{len(kills)}.zarr", TASKS, client=client)
    finally:
        stop.set()
        killer.join()
    same(found, undisturbed)
    same(dvi.open_sweep(path), undisturbed)
    assert not found.verify().bad


def test_what_a_task_raises_comes_back(client, tmp_path):
    other = Store.open
    path = tmp_path / "s.zarr"
    sweep(path, 2)
    for i in range(2):
        other(path).record_path(i).unlink()
    shutil.rmtree(path / "drift" / "c")
    (path / "drift" / "c").touch()  # no worker can write a shard now
    with pytest.raises(dvi.StoreError, match="cannot be written"):
        sweep(path, 2, client=client)


def test_the_scheduler_is_lost(tmp_path):
    import subprocess
    import sys

    command = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    scheduler_file = tmp_path / "scheduler.json"
    options = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file"]
    scheduler = subprocess.Popen([*command, *options, str(scheduler_file)])
    workers = [
        subprocess.Popen(
            [sys.executable, "-m", "distributed.cli.dask_worker", "--nthreads", "1", "--no-nanny",
             "--no-dashboard", "--death-timeout", "5", "--scheduler-file", str(scheduler_file)],
            env={**os.environ, "PYTHONPATH": os.path.dirname(__file__)},
        )
        for _ in range(2)
    ]  # fmt: skip
    path = tmp_path / "s.zarr"
    try:
        with distributed.Client(scheduler_file=str(scheduler_file), timeout=30) as client:
            client.wait_for_workers(2, timeout=60)

            def kill(p):
                if p.tasks_done == 8:
                    scheduler.kill()

            with pytest.raises(dvi.ClusterError, match="the same call goes on"):
                sweep(path, 60, client=client, progress=kill)
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()
    done = dvi.open_sweep(path).tasks_done
    assert 8 <= done < 60
    before = [Store.open(path).record_path(i).stat().st_mtime_ns
              for i in Store.open(path).done()]  # fmt: skip
    same(sweep(path, 60), sweep(None, 60))
    after = [Store.open(path).record_path(i).stat().st_mtime_ns for i in range(60)]
    assert set(before) <= set(after)


def test_a_client_is_a_client(tmp_path):
    with pytest.raises(TypeError, match=r"distributed\.Client"):
        sweep(None, 2, client=3)
