"""A network force in the integrator, compared with networks in Runge–Kutta, outside their arc.

    python benchmarks/network_force.py [--seeds 5] [--first-seed 10] [--steps 80] [--out DIR]

The truth is a damped spring that hardens, q̈ = −q − 0.4 q³ − 0.1 q̇, by Runge–Kutta with a small
step. Observed are q and p with 1 % noise at 61 times of the first 6 time units from one start.
Three models are fitted to that, and then run for 40 units more, and for 20 from another start with
an amplitude inside that of the training:

- `ours`: H = (p² + q²)/2 is known; a `NetworkForce` (potential and damping) in Strang's method.
- `RK4, known H`: the same is known; the force is a network of (q, p), under RK4.
- `RK4, general`: nothing is known; (q̇, ṗ) is a network of (q, p), under RK4.

All have about the same number of parameters, the same data, start, step h, prior, horizons and
number of steps of optimistix's Levenberg–Marquardt in the same scaled variables. From several
initial weights each takes those with the least training loss; the reference models also choose
between two activations. The general network has less prior knowledge; the second reference has the
same as the first model, except the structure. The length of the arc, the activation of the first
model and the number of restarts were chosen with noise of the seeds 0 to 4; the table uses other
seeds.
"""

import argparse
import functools
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.fit.optimise import Evaluation, LeastSquaresStage, StageTask
from dvi_jax.fit.solvers import levenberg_marquardt

jax.config.update("jax_enable_x64", True)

H, TRAIN, AFTER, OTHER = 0.1, 60, 400, 200
START, OTHER_START = (1.5, 0.0), (0.4, -0.8)
HORIZONS = (1.5, 3.0)
IN_STAGE = 15
PRIOR = 1.0


def slope(x):
    q, p = x
    return jnp.stack([p, -q - 0.4 * q**3 - 0.1 * p])


def runge_kutta(field, x0, h, num_steps, substeps=1):
    """States (num_steps + 1, 2) of the classical method of order 4."""

    def step(x, _):
        for _ in range(substeps):
            d = h / substeps
            a = field(x)
            b = field(x + d / 2 * a)
            c = field(x + d / 2 * b)
            x = x + d / 6 * (a + 2 * b + 2 * c + field(x + d * c))
        return x, x

    _, xs = jax.lax.scan(step, x0, None, length=num_steps)
    return jnp.concatenate([x0[None], xs])


@functools.cache
def truth(start, num_steps):
    """The observed orbit, cached because every fit uses it."""
    return np.asarray(runge_kutta(slope, jnp.array(start), H, num_steps, substeps=10))


def data(seed):
    """Observations of the training arc."""
    x = truth(START, TRAIN)
    sigma = 0.01 * x.std()
    noisy = x + sigma * np.random.default_rng(seed).normal(size=x.shape)
    return dvi.Observations(H * np.arange(TRAIN + 1), noisy, observe="state", sigma=sigma)


# ---- ours


def H_D(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


METHOD = dvi.Strang()


def model(network):
    return {
        "system": dvi.System(H_D, force=network),
        "q0": [START[0]],
        "p0": [START[1]],
        "h": H,
        "epsilon": 1.0,
        "method": METHOD,
    }


def fit_ours(seed, key, steps):
    """The network, and its loss."""
    network = dvi.NetworkForce(1, key=key, width=6, depth=1)
    found = dvi.fit(
        model,
        data(seed),
        network,
        priors=dvi.Prior(0.0, PRIOR),
        horizons=list(HORIZONS),
        max_steps=steps,
        check_curvature=False,
        throw=False,
        progress=False,
    )
    return found.params, found.loss


@eqx.filter_jit
def run_ours(network, start, num_steps):
    q, p = (jnp.array([x]) for x in start)
    spec = {**model(network), "q0": q, "p0": p}
    sol = dvi.integrate(**spec, num_steps=num_steps, throw=False)
    return jnp.concatenate([sol.qs, sol.ps], axis=1)


# ---- the reference models


class General(eqx.Module):
    """(q̇, ṗ) = network of (q, p)."""

    net: eqx.nn.MLP

    def __init__(self, key, activation):
        self.net = eqx.nn.MLP(2, 2, 7, 1, activation=activation, key=key)

    def __call__(self, x):
        return self.net(x)


class KnownH(eqx.Module):
    """q̇ = p, ṗ = −q + network of (q, p)."""

    net: eqx.nn.MLP

    def __init__(self, key, activation):
        net = eqx.nn.MLP(2, 1, 9, 1, activation=activation, key=key)
        self.net = eqx.tree_at(lambda m: m.layers[-1].weight, net, replace_fn=lambda w: 0.3 * w)

    def __call__(self, x):
        return jnp.stack([x[1], -x[0] + self.net(x)[0]])


@eqx.filter_jit
def run_reference(field, start, num_steps):
    return runge_kutta(field, jnp.array(start), H, num_steps)


@eqx.filter_jit
def _evaluate(static, tree, u, horizon, values, sigma):
    def residual(u):
        leaves, at = [], 0
        for shape in tree[1]:
            count = int(np.prod(shape, dtype=int))
            leaves.append(u[at : at + count].reshape(shape))
            at += count
        field = eqx.combine(jax.tree.unflatten(tree[0], leaves), static)
        xs = runge_kutta(field, jnp.array(START), H, TRAIN)
        inside = (H * np.arange(TRAIN + 1) <= horizon * (1 + 1e-12))[:, None]
        off = jnp.where(inside, (xs - values) / sigma, 0.0)
        return jnp.concatenate([off.ravel(), u / PRIOR])

    return Evaluation(residual(u), jax.jacfwd(residual)(u))


def fit_reference(kind, seed, key, steps):
    """The same stages, steps and scaled Levenberg–Marquardt as `dvi.fit` takes, for the better of
    two activations."""
    both = [_fit_reference(kind(key, a), seed, steps) for a in (jnp.tanh, jax.nn.softplus)]
    return min(both, key=_loss)


def _fit_reference(field, seed, steps):
    numbers, static = eqx.partition(field, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(numbers)
    u = np.concatenate([np.ravel(x) for x in leaves])
    shapes, seen = tuple(x.shape for x in leaves), data(seed)
    values, sigma = jnp.asarray(seen.values), jnp.asarray(seen.sigma)
    stage = LeastSquaresStage(
        lambda u, horizon, extra: _evaluate(static, (tree, shapes), u, horizon, values, sigma),
        levenberg_marquardt(),
    )
    left = steps
    for number, horizon in enumerate((*HORIZONS, np.inf)):
        last = horizon == np.inf
        taken = []
        task = StageTask(
            number,
            horizon,
            max_steps=left if last else min(IN_STAGE, left),
            tolerance=1e-4 if last else 1e-2,
            watch=lambda record, position: taken.append(record),  # noqa: B023
        )
        u, best, _ = stage.run(u, task, values.size)
        left -= len(taken)
    ends = np.cumsum([x.size for x in leaves])[:-1]
    new = [jnp.asarray(x).reshape(s) for x, s in zip(np.split(u, ends), shapes, strict=True)]
    loss = float(best.residual @ best.residual) / 2
    return eqx.combine(jax.tree.unflatten(tree, new), static), loss


def best_of(fit, seed, restarts):
    """The fit of least loss among several initial weights; that of the training data alone."""
    keys = [jax.random.key(1000 * seed + i) for i in range(restarts)]
    return min((fit(key) for key in keys), key=_loss)[0]


def _loss(pair):
    """The loss of a fit, infinite if it is no number."""
    return pair[1] if pair[1] >= 0 else np.inf


def count(field):
    return sum(x.size for x in jax.tree.leaves(eqx.filter(field, eqx.is_inexact_array)))


def rms(x, y):
    """Root mean square of the difference; infinite for a run that leaves the numbers."""
    off = np.sqrt(np.mean((np.asarray(x) - y) ** 2))
    return float(off) if np.isfinite(off) else np.inf


def compare(seed, steps, restarts):
    """{name: (rms in training, after it, from another start)}, the runs, numbers of parameters."""
    fits = {
        "ours": (run_ours, lambda key: fit_ours(seed, key, steps)),
        "RK4, known H": (run_reference, lambda key: fit_reference(KnownH, seed, key, steps)),
        "RK4, general": (run_reference, lambda key: fit_reference(General, seed, key, steps)),
    }
    fitted = {name: (run, best_of(fit, seed, restarts)) for name, (run, fit) in fits.items()}
    true, other = truth(START, TRAIN + AFTER), truth(OTHER_START, OTHER)
    found, runs = {}, {"truth": true}
    for name, (run, field) in fitted.items():
        xs = np.asarray(run(field, START, TRAIN + AFTER))
        ys = run(field, OTHER_START, OTHER)
        cut = TRAIN + 1
        found[name] = rms(xs[:cut], true[:cut]), rms(xs[cut:], true[cut:]), rms(ys, other)
        runs[name] = xs
    return found, runs, {name: count(field) for name, (_, field) in fitted.items()}


def draw(runs, out):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, layout="constrained")
    ts = H * np.arange(TRAIN + AFTER + 1)
    names = [name for name in runs if name != "truth"]
    for axis, name, colour in zip(axes, names, ("C0", "C1", "C3"), strict=True):
        axis.plot(ts, runs["truth"][:, 0], color="0.6", lw=3, label="truth")
        axis.plot(ts, runs[name][:, 0], color=colour, lw=1.2, label=name)
        axis.axvspan(0, H * TRAIN, color="0.93", zorder=0)
        axis.set(ylabel="q", ylim=(-1.7, 1.7))
        axis.legend(loc="upper right", ncols=2, frameon=False)
    axes[0].set_title("grey band: the arc that was observed; after it nobody helps")
    axes[-1].set_xlabel("t")
    Path(out).mkdir(parents=True, exist_ok=True)
    path = Path(out) / "network_force.png"
    figure.savefig(path, dpi=120)
    return path


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first-seed", type=int, default=10)
    parser.add_argument("--steps", type=int, default=80)
    parser.add_argument("--restarts", type=int, default=4)
    parser.add_argument("--out")
    given = parser.parse_args()
    print("rms of (q, p): on the observed arc / after it / from another start")
    every, runs = [], None
    for seed in range(given.first_seed, given.first_seed + given.seeds):
        began = time.monotonic()
        found, those, sizes = compare(seed, given.steps, given.restarts)
        runs = runs or those
        every.append(found)
        if len(every) == 1:
            print("parameters: " + ", ".join(f"{name} {n}" for name, n in sizes.items()))
        for name, values in found.items():
            print(f"seed {seed}  {name:14}" + "".join(f"  {v:9.4f}" for v in values))
        print(f"        {time.monotonic() - began:.0f} s", flush=True)
    for name in every[0]:
        middle = np.median([[*found[name]] for found in every], axis=0)
        print(f"median  {name:14}" + "".join(f"  {v:9.4f}" for v in middle))
    if given.out:
        print(draw(runs, given.out))


if __name__ == "__main__":
    main()
