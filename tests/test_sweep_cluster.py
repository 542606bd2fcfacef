"""Sweeps on a Dask cluster: the same bits when workers or the scheduler are killed."""

import os
import random
import shutil
import signal
import subprocess
import sys
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
    options = {"threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with distributed.LocalCluster(n_workers=2, **options) as cluster:
        yield cluster


@pytest.fixture
def client(cluster):
    with distributed.Client(cluster) as client:
        yield client


@pytest.fixture(scope="module")
def expected():
    return sweep(None, TASKS)


def pids(store):
    records = (store.record(i) for i in range(store.plan.num_tasks))
    return {r["pid"] for r in records if r is not None}


def test_workers_commit_what_one_process_does(client, tmp_path, expected):
    seen = []
    path = tmp_path / "s.zarr"
    same(sweep(path, TASKS, client=client, progress=seen.append), expected)
    assert seen[-1].lanes_done == seen[-1].num_lanes == 100 * TASKS
    assert seen[-1].failed == 25
    assert os.getpid() not in pids(Store.open(path))
    assert not dvi.open_sweep(path).verify().bad
    same(sweep(None, TASKS, client=client), expected)


def test_workers_are_killed(cluster, client, tmp_path, expected):
    """SIGKILL to a worker every one to two seconds: the others and its successors go on."""
    path, rng, kills = tmp_path / "s.zarr", random.Random(3), []
    stop = threading.Event()

    def kill():
        while not stop.wait(rng.uniform(1.0, 2.5)) and len(kills) < 8:
            processes = [n.process.process for n in cluster.workers.values() if n.process]
            living = [p.pid for p in processes if p is not None and p.is_alive()]
            if living and cluster.scheduler.workers:  # not all of them are still starting
                kills.append(rng.choice(living))
                os.kill(kills[-1], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    try:
        found = sweep(path, TASKS, client=client)
        while len(kills) < 3:  # the sweep was over before there were enough kills
            found = sweep(tmp_path / f"s{len(kills)}.zarr", TASKS, client=client)
    finally:
        stop.set()
        killer.join()
    same(found, expected)
    same(dvi.open_sweep(path), expected)
    assert not found.verify().bad


def test_the_error_of_a_task_is_raised(client, tmp_path):
    path = tmp_path / "s.zarr"
    sweep(path, 2)
    for i in range(2):
        Store.open(path).record_path(i).unlink()
    shutil.rmtree(path / "drift" / "c")
    (path / "drift" / "c").touch()  # no worker can write a shard now
    with pytest.raises(dvi.StoreError, match="cannot be written"):
        sweep(path, 2, client=client)


def test_the_scheduler_is_lost(tmp_path):
    path, file = tmp_path / "s.zarr", str(tmp_path / "scheduler.json")

    def start(program, options):
        words = [f"distributed.cli.{program}", *options.split(), "--scheduler-file", file]
        paths = f"{os.path.dirname(__file__)}:{os.environ.get('PYTHONPATH', '')}"
        env = {**os.environ, "PYTHONPATH": paths}
        return subprocess.Popen([sys.executable, "-m", *words, "--no-dashboard"], env=env)

    scheduler = start("dask_scheduler", "--host 127.0.0.1 --port 0")
    workers = [start("dask_worker", "--nthreads 1 --no-nanny --death-timeout 5") for _ in (1, 2)]
    try:
        with distributed.Client(scheduler_file=file, timeout=30) as client:
            client.wait_for_workers(2, timeout=60)

            def kill(p):
                if p.tasks_done == 8:
                    scheduler.kill()

            with pytest.raises(dvi.ClusterError, match="the same call continues"):
                sweep(path, 60, client=client, progress=kill)
    finally:
        for process in (scheduler, *workers):
            process.kill()
            process.wait()
    done = dvi.open_sweep(path).tasks_done
    assert 8 <= done < 60
    files = [Store.open(path).record_path(i) for i in Store.open(path).done_tasks()]
    before = [file.stat().st_mtime_ns for file in files]
    same(sweep(path, 60), sweep(None, 60))
    assert [file.stat().st_mtime_ns for file in files] == before
