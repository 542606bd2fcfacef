"""Files of the command line for systems with a slow time τ = εt, which receive τ in place of t."""

import numpy as np
import pytest
from cli import command, read, refuses, write

import dvi_jax as dvi

STATE = "[state]\nq0 = [1.0]\np0 = [0.0]\n"
SLOW = """
import jax.numpy as jnp
import dvi_jax as dvi
from dvi_jax.systems import InSlowTime, Problem

def H_D(tau0, tau1, q0, p1, args):
    return p1 @ p1 / 2 + (1 + tau0) * (q0 @ q0) / 2

def force(tau0, tau1, q0, p1, args):
    return tau0 * p1

system = dvi.System(H_D, force=force, slow_time=True)
position = lambda q, p: q[0]
time = lambda t, q, p, args: t
bare = lambda tau, q, p, args: (1 + tau) * q[0]
of_tau, of_q = InSlowTime(bare), InSlowTime(position)
of_step = InSlowTime(lambda tau0, tau1, q0, p0, q1, p1, args: tau1 - tau0)
stop, slow_stop = dvi.Stop(lambda t, q, p, args: t - 1.95), dvi.Stop(of_tau)
known = {"of_tau": of_tau, "of_q": of_q, "position": position, "time": time}
problem = lambda: Problem("slow", system, q0=[1.0], p0=[0.0], h=0.1, observables=known)
"""


@pytest.mark.parametrize("system", [pytest.param("system", marks=pytest.mark.slow), "problem"])
def test_functions_of_the_slow_time_in_a_file(tmp_path, monkeypatch, system):
    """The system and InSlowTime receive τ = εt, other functions t, as in Python."""
    monkeypatch.chdir(tmp_path)
    write(tmp_path, SLOW, "slow.py")
    head = f'system = "slow.py:{system}"\nh = 0.1\nmethod = "Strang"\nepsilon = 0.3\n{STATE}'
    names = ["of_tau", "of_q", "position", "time"]
    if system == "system":
        names += ["of_step"]
        lines = [f'{name} = "slow.py:{name}"' for name in names]
        lines += ['largest = "MaxDrift(slow.py:of_tau)"', 'crossed = "Section(slow.py:position)"']
        head += "\n".join(["[observables]", *lines, ""])
    # Pictures have a curve for each observable.
    text = f"steps = 20\n{head}[output]\nevery = 2\nplots = true\n"
    result = command("run", write(tmp_path, text), "--out", "out")
    assert result.exit_code == 0, result.output
    slow: dict = {}
    exec(SLOW, slow)
    start = {"q0": [1.0], "p0": [0.0], "h": 0.1, "method": dvi.Strang(), "epsilon": 0.3}
    observe = {"crossed": dvi.Section(slow["position"])}
    alone = dvi.integrate(slow["system"], **start, num_steps=20, observe=observe)
    t, q = alone.ts[::2], alone.qs[::2, 0]
    assert abs(q[-1] - np.cos(2.0)) > 0.05  # τ matters
    expected = dict(zip(names, [(1 + 0.3 * t) * q, q, q, t, np.full(10, 0.03)], strict=False))
    with np.load("out/trajectory.npz") as saved:
        for name, values in expected.items():
            np.testing.assert_allclose(saved[f"observed/{name}"], values, rtol=1e-12, atol=1e-13)
        if system == "system":
            crossings = alone.observed["crossed"]
            np.testing.assert_allclose(saved["observed/crossed.ts"], crossings.ts, rtol=1e-12)
            report = read("out/report.json")["results"]
            assert report["crossed"]["value"] == saved["observed/crossed.count"] == crossings.count
    assert command("report", "out").exit_code == 0
    assert (tmp_path / "out.html").exists()


def test_functions_of_the_slow_time_that_would_receive_t_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, SLOW, "slow.py")
    head = f'system = "slow.py:system"\nh = 0.1\nsteps = 20\n{STATE}'
    for text, cause in (
        ("slow.py:bare", "is the time t, not τ"),
        ("MaxDrift(slow.py:bare)", "is the time t, not τ"),
        ("Section(slow.py:of_tau)", "do not receive ε"),
    ):
        run = f'epsilon = 0.3\n{head}[observables]\nx = "{text}"\n'
        refuses(command("run", write(tmp_path, run)), cause)
    sweep = f'method = "Strang"\nsave = "final"\n{head}[epsilon]\nlinspace = [0.1, 0.3, 2]\n'
    stopped = write(tmp_path, f'stop = "slow.py:slow_stop"\n{sweep}')
    refuses(command("sweep", stopped, "--store", "s"), "do not receive ε")
    # With t it ends at one time for every ε.
    result = command("sweep", write(tmp_path, f'stop = "slow.py:stop"\n{sweep}'), "--store", "t")
    assert result.exit_code == 0, result.output
    np.testing.assert_allclose(dvi.open_sweep("t")["stop_t"], 1.95, rtol=1e-12)
