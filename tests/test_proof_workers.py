"""The search for a proof in several processes: the same result, and no process remains."""

import signal
import subprocess
import time
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

pytest.importorskip("flint")
from dvi_jax.proof import workers
from dvi_jax.proof.workers import Workers

HENON_HEILES = dvi.System(
    lambda t0, t1, q, p, args: (p @ p + q @ q) / 2,
    force=lambda t0, t1, q, p, args: -jnp.array([2 * q[0] * q[1], q[0] ** 2 - q[1] ** 2]),
)


def energy(q, p, epsilon):
    return (p @ p + q @ q - 0.1 * (p @ q)) / 2 + epsilon * (q[0] ** 2 * q[1] - q[1] ** 3 / 3)


def bound_with(count):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dvi_jax.proof.bound.processors", lambda: count)
        return dvi.bound_drift(
            energy, HENON_HEILES, h=0.1, epsilon=0.01, domain=np.full(2, 0.4), ratio=1.2,
            max_boxes=60,
        )  # fmt: skip


@pytest.fixture(scope="module")
def one():
    """The bound that one process finds."""
    return bound_with(1)


@pytest.fixture
def started(monkeypatch):
    """The processes that are started, at once and not after a second. All must have ended."""
    found, start = [], subprocess.Popen

    def popen(*args, **kwargs):
        found.append(start(*args, **kwargs))
        return found[-1]

    monkeypatch.setattr(subprocess, "Popen", popen)
    monkeypatch.setattr(workers, "_SECONDS", -1.0)
    yield found
    assert all(process.returncode is not None for process in found)


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_processes(one, started):
    assert one.boxes > 30
    assert one.certificate["shell"]
    two = bound_with(2)
    assert len(started) == 2
    assert two.certificate == one.certificate
    assert two.seen == one.seen  # at random points, which depend on the box only


def test_a_small_search_starts_no_process(one, started, monkeypatch):
    monkeypatch.setattr(workers, "_SECONDS", 60.0)
    assert bound_with(2).certificate == one.certificate
    assert started == []


@pytest.mark.slow
def test_a_killed_process(one, started, monkeypatch):
    """The search continues in this process, with the same result."""
    send = workers._send

    def kill(pipe, message):
        send(pipe, message)
        if isinstance(message, tuple):  # a box, and not the first message
            started[0].kill()

    monkeypatch.setattr(workers, "_send", kill)
    with pytest.warns(RuntimeWarning, match=r"ended early \(exit statuses .*-9"):
        two = bound_with(2)
    assert len(started) == 2
    assert two.certificate == one.certificate


def test_processes_that_cannot_be_started(monkeypatch):
    def popen(*args, **kwargs):
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", popen)
    monkeypatch.setattr(workers, "_SECONDS", -1.0)
    with Workers(2) as alone, pytest.warns(RuntimeWarning, match="not start .no more processes"):
        assert list(alone.map(53, partial(pow, 2), [1, 2, 3])) == [2, 4, 8]
    assert alone.count == 1


def test_what_a_process_imports(started):
    """Neither JAX nor the main module of the user, which need not have a guard."""
    name = "__import__('__main__').__file__"
    loaded = "sorted({'jax', 'lanewise', '__mp_main__'} & {*__import__('sys').modules})"
    loaded = f"__import__('dvi_jax.proof.search') and {loaded}"
    bits = "__import__('flint').ctx.prec"
    with Workers(2) as two:
        names, modules, precision = two.map(77, eval, [name, loaded, bits])
    assert names == workers.__file__
    assert modules == []
    assert precision == 77
    assert "jax" in eval(loaded)  # the control: it would be found


def interrupted():
    with Workers(2) as two:
        for _ in two.map(53, eval, ["1", "__import__('time').sleep(60)"]):
            raise KeyboardInterrupt


def test_errors_and_interruptions(started):
    with Workers(2) as two:
        values = two.map(53, partial(divmod, 1), [1, 0])
        assert next(values) == (1, 0)
        with pytest.raises(ZeroDivisionError):  # of this process, although another one has it first
            next(values)
        for process in started:
            process.send_signal(signal.SIGINT)  # as Ctrl-C in a terminal does
        assert list(two.map(53, partial(pow, 2), [1, 2, 3])) == [2, 4, 8]
        assert [process.poll() for process in started] == [None, None]
    assert [process.returncode for process in started] == [-signal.SIGKILL] * 2
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - began < 20
    assert len(started) == 4


def test_a_process_ends_with_the_one_that_started_it(started):
    with Workers(2) as two:
        assert list(two.map(53, partial(pow, 2), [1, 2])) == [2, 4]
        for process in started:
            process.stdin.close()
        assert [process.wait(timeout=20) for process in started] == [0, 0]
