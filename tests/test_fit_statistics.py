"""Fits over many problems: how often the truth is within the errors, and what memory they need."""

import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

PROBLEMS = 200
NOISE = 2e-3


SYSTEM = dvi.System(
    lambda t0, t1, q0, p1, args: p1 @ p1 / 2 - args["mu"] / jnp.linalg.norm(q0),
    force=lambda t0, t1, q0, p1, args: -p1,
)
MODEL = dvi.Model(SYSTEM, h=0.05, method=dvi.Strang())
TS = np.arange(1, 41) * 0.5


def one(random):
    """Truth and estimate of a random orbit: (x − truth) / sigma for its six parameters."""
    truth = {
        "epsilon": random.uniform(0, 0.01),
        "args": {"mu": random.uniform(0.8, 1.2)},
        "q0": random.uniform([0.9, -0.2], [1.1, 0.2]),
        "p0": random.uniform([-0.1, 0.9], [0.1, 1.1]),
    }
    exact = dvi.integrate(
        SYSTEM, truth["q0"], truth["p0"], h=0.05, num_steps=400, epsilon=truth["epsilon"],
        args=truth["args"], method=dvi.Strang(), save=dvi.Save(every=10),
    )  # fmt: skip
    y = np.asarray(exact.qs)[1:] + NOISE * random.normal(size=(40, 2))
    start = {
        "epsilon": 0.0,
        "args": {"mu": truth["args"]["mu"] * random.uniform(0.95, 1.05)},
        "q0": truth["q0"] + random.normal(size=2) * 0.03,
        "p0": truth["p0"] + random.normal(size=2) * 0.03,
    }
    data = dvi.Observations(TS, y, sigma=NOISE, t0=0.0)
    found = dvi.fit(MODEL, data, start, check_curvature=False)
    right = [truth["args"]["mu"], truth["epsilon"], *truth["p0"], *truth["q0"]]
    assert found.names == ["args.mu", "epsilon", "p0[0]", "p0[1]", "q0[0]", "q0[1]"]
    return (found.x - right) / found.sigma, found.reduced_chi2


@pytest.mark.slow
def test_truth_within_the_errors():
    """99 % of the estimates within three standard errors, which are those of their scatter."""
    random = np.random.default_rng(0)
    found = [one(random) for _ in range(PROBLEMS)]
    off = np.array([z for z, _ in found])
    within = np.mean(np.abs(off) <= 3)
    scatter = off.std(axis=0)
    print(f"within three sigma {within:.4f}, scatter over sigma {np.round(scatter, 3)}")
    assert within >= 0.99
    assert (np.abs(scatter - 1) < 0.2).all()
    # The mean is not biased by more than chance, and chi² is what it should be.
    assert (np.abs(off.mean(axis=0)) < 4 / np.sqrt(PROBLEMS)).all()
    assert abs(np.mean([c for _, c in found]) - 1) < 0.05
    # Errors taken for half or for twice of what they are would be seen.
    assert not (np.abs(2 * scatter - 1) < 0.2).any()
    assert np.mean(np.abs(2 * off) <= 3) < 0.99


_PROGRAM = """
import resource, sys
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import optax
import dvi_jax as dvi
sys.path.insert(0, {here!r})
from test_fit_statistics import SYSTEM
steps, how = {steps}, {how!r}
h, arcs, count = 200.0 / steps, 64, 50
random = np.random.default_rng(0)
q0 = np.array([1.0, 0.0]) + 0.05 * random.normal(size=(arcs, 2))
p0 = np.array([0.0, 1.0]) + 0.05 * random.normal(size=(arcs, 2))
ts = np.linspace(4.0, 200.0, count)
run = jax.vmap(lambda q, p: dvi.integrate(SYSTEM, q, p, h=h, num_steps=steps, epsilon=1e-4,
    args={{"mu": 1.0}}, method=dvi.Strang(), save=dvi.Save(every=steps // count)).qs[1:])
y = np.asarray(run(jnp.asarray(q0), jnp.asarray(p0)))
data = [dvi.Observations(ts, y[i], sigma=1e-3, t0=0.0) for i in range(arcs)]
model = dvi.Model(SYSTEM, h=h, q0=q0, p0=p0, method=dvi.Strang())
options = dict(optimiser=optax.adam(1e-6), max_steps=3) if how == "adam" else {{}}
found = dvi.fit(model, data, {{"epsilon": 0.9e-4, "args": {{"mu": 1.00001}}}}, **options,
    check_curvature=False)
assert how == "adam" or abs(found.x[1] - 1e-4) < 1e-9, found
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def memory(steps, how):
    """Largest resident memory of a fit of 64 trajectories in a process of its own [MiB]."""
    program = _PROGRAM.format(steps=steps, how=how, here=str(__file__).rsplit("/", 1)[0])
    out = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert out.returncode == 0, out.stderr
    return float(out.stdout.split()[-1])


@pytest.mark.slow
@pytest.mark.parametrize("how", ["levenberg-marquardt", "adam"])
def test_memory_is_flat_in_the_number_of_steps(how):
    """10⁵ steps × 64 trajectories against 10⁴: states alone would be 205 MB more in each pass."""
    few, many = memory(10_000, how), memory(100_000, how)
    print(f"{how}: {few:.0f} MiB for 10^4 steps, {many:.0f} MiB for 10^5")
    assert many - few < 60
