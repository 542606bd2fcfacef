"""Orders, distributions and speed of the methods for noise.

    python benchmarks/noise.py [--paths 100000] [strong weak canonical chain speed]

prints each measure with its error. The first four take three minutes of one processor core for 10⁵
paths; the slow tests in `tests/test_noise.py` call the same functions. The last one, on one thread,
also times diffrax, if it is installed.
"""

import argparse
import dataclasses
import itertools
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

import dvi_jax as dvi
import lanewise
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)


# --- orders ---------------------------------------------------------------------------------------


def H_D(t0, t1, q0, p1, args):
    """A soft quartic well: no order is higher than it is in general."""
    return jnp.sum(p1**2) / 2 + jnp.sum(q0**4) / 4 - jnp.sum(q0**2) / 2


def bracket(t, q, p, args):
    """One noise Hamiltonian that depends on q and p."""
    return 0.3 * jnp.array([q[0] * p[0] + jnp.sin(q[0])])


def pair(t, q, p, args):
    """Two noise Hamiltonians that do not commute."""
    return 0.3 * jnp.array([q[0] ** 2, p[0] ** 2 / 2 + jnp.sin(p[0])])


class Uncorrected(dvi.StochasticEuler):
    """Without the term of second order in the generating function: it converges to Itô's equation,
    and not to Stratonovich's."""

    def _with_noise(self, equations, interval, q, p):
        noisy = super()._with_noise(equations, interval, q, p)
        return dataclasses.replace(noisy, system=dataclasses.replace(noisy.system, is_map=False))


KINDS = {
    "Langevin": dvi.System(H_D, noise=dvi.Langevin(0.7, 0.5)),
    "σ(q)": dvi.System(H_D, noise=lambda t, q, p, args: 0.5 * jnp.cos(q)),
    "σ(q, p)": dvi.System(H_D, noise=lambda t, q, p, args: 0.5 * jnp.cos(q) * jnp.sqrt(1 + p**2)),
    "h(q, p)": dvi.System(H_D, noise=dvi.NoiseHamiltonians(bracket)),
    "h₁, h₂": dvi.System(H_D, noise=dvi.NoiseHamiltonians(pair)),
}
METHODS = {
    "BAOAB": dvi.BAOAB(),
    "OBABO": dvi.OBABO(),
    "StrongSplitting": dvi.StrongSplitting(),
    "StochasticEuler": dvi.StochasticEuler(),
    "StochasticMidpoint": dvi.StochasticMidpoint(),
    "Uncorrected": Uncorrected(),
}
PUBLIC = list(METHODS)[:5]
ALL = PUBLIC[3:]
USED = {
    "Langevin": PUBLIC,
    "σ(q)": PUBLIC,
    "σ(q, p)": ("StochasticMidpoint",),
    "h(q, p)": [*ALL, "Uncorrected"],
    "h₁, h₂": ALL,
}


def ends(system, method, steps, finest, keys, duration=1.0):
    """(q, p) at the end of each path, shape (paths, 2), from one path for every number of steps."""

    @jax.jit
    def all_of(keys):
        def one(key):
            path = dvi.Brownian(key, substeps=finest // (steps * method.increments))
            sol = dvi.integrate(
                system, [1.0], [0.2], h=duration / steps, num_steps=steps, method=method,
                path=path, save=dvi.Save(final=True),
            )  # fmt: skip
            return jnp.concatenate([sol.qs[-1], sol.ps[-1]])

        return jax.vmap(one)(keys)

    return np.asarray(all_of(keys))


def slope(steps, errors, spread):
    """Order by weighted regression of log error on log h, and its standard error."""
    x, y, s = -np.log(steps), np.log(errors), spread / errors
    w = 1 / s**2
    mean = np.sum(w * x) / np.sum(w)
    return np.sum(w * (x - mean) * y) / np.sum(w * (x - mean) ** 2), np.sum(
        w * (x - mean) ** 2
    ) ** -0.5


def strong_order(kind, name, paths, seed=0):
    """Order, and its standard error, of the rms distance from the finest solution."""
    keys = jax.random.split(jax.random.key(seed), paths)
    # Where noise terms do not commute, the order 1/2 is that of small steps.
    steps, finest = ((64, 128, 256), 2048) if kind == "h₁, h₂" else ((8, 16, 32), 256)
    # The method of the highest order that takes this noise.
    reference = "StrongSplitting" if "StrongSplitting" in USED[kind] else "StochasticMidpoint"
    best = ends(KINDS[kind], METHODS[reference], finest, finest, keys)
    found = []
    for n in steps:
        square = np.sum((ends(KINDS[kind], METHODS[name], n, finest, keys) - best) ** 2, 1)
        root = np.sqrt(square.mean())
        found.append((root, square.std() / (2 * root * np.sqrt(paths))))
    return slope(np.array(steps), *np.array(found).T)


def weak_order(kind, name, paths, seed=0):
    """Order, and its standard error, of the mean of q² + p.

    From the changes of the mean when h is halved, which scale as the error. They are taken on the
    same paths, so that the error of a difference of means is that of the difference.
    """
    keys = jax.random.split(jax.random.key(seed), paths)
    # Errors of order 2 are below those of the means at small steps; two errors of opposite sign
    # cancel in the midpoint rule at large ones.
    steps, duration = (8, 16, 32, 64), 1.0
    if name in ("BAOAB", "OBABO", "StrongSplitting"):
        steps, duration = (4, 8, 16, 32), 2.0
    elif name == "StochasticMidpoint" and kind.startswith("σ"):
        steps = (32, 64, 128, 256)

    def values(n):
        q, p = ends(KINDS[kind], METHODS[name], n, 2 * steps[-1], keys, duration).T
        return q**2 + p

    found = [values(n) for n in steps]
    moved = [a - b for a, b in itertools.pairwise(found)]
    means = np.array([(abs(x.mean()), x.std() / np.sqrt(paths)) for x in moved])
    return slope(np.array(steps[:-1]), *means.T)


# --- canonical distributions ----------------------------------------------------------------------


def distribution(energy, temperature, low=-4.0, high=4.0, count=20_001):
    """The cumulative distribution function of exp(−energy(x)/T) by quadrature."""
    x = np.linspace(low, high, count)
    weight = np.exp(-energy(x) / temperature)
    total = np.concatenate([[0.0], np.cumsum((weight[1:] + weight[:-1]) / 2)])
    return lambda y: np.interp(y, x, total / total[-1])


class Mistaken(dvi.Langevin):
    """Langevin's noise with the coefficient of Euler–Maruyama next to the exact friction."""

    def kick(self, t, q, p, args, h, dB):
        friction, temperature, mass = self._values(args, p)
        noise = jnp.sqrt(2 * friction * temperature * mass) * dB.reshape(p.shape)
        return jnp.expm1(-friction * h) * p + noise


def samples(problem, system, method, paths, steps, h, seed=0):
    """Final states of independent paths, and the means of |∂V/∂q|² and ∂²V/∂q·∂q of each."""

    @jax.jit
    def all_of(keys):
        def one(key):
            common = {"h": h, "method": method, "args": problem.args, "save": dvi.Save(final=True)}
            burnt = dvi.integrate(system, problem.q0, problem.p0, num_steps=steps,
                                  path=dvi.Brownian(key), **common)  # fmt: skip
            sol = dvi.integrate(
                system, burnt.qs[-1], burnt.ps[-1], num_steps=steps // 2,
                path=dvi.Brownian(key, first_step=steps),
                observe=dvi.Mean(problem.observables["configurational"]), **common,
            )  # fmt: skip
            return sol.qs[-1], sol.ps[-1], sol.observed

        return jax.vmap(one)(keys)

    return [np.asarray(x) for x in all_of(jax.random.split(jax.random.key(seed), paths))]


def temperature(means):
    """Configurational temperature from the means of each path, and its standard error."""
    top, below = means.T
    ratio = top.mean() / below.mean()
    return ratio, np.std(top - ratio * below) / (below.mean() * np.sqrt(len(top)))


def canonical(paths, method=None, mistaken=False, T=0.5, h=0.1, steps=2000):
    """p-values of q and p of the double well by Kolmogorov and Smirnov; (T, error) of positions."""
    problem = systems.double_well(T)
    method = dvi.BAOAB() if method is None else method
    system = problem.system
    if mistaken:
        system = dvi.System(system.H_D, noise=Mistaken(1.0, T))
    q, p, means = samples(problem, system, method, paths, steps, h)
    in_wells = distribution(lambda x: (x**2 - 1) ** 2, T)
    return (
        stats.kstest(q[:, 0], in_wells).pvalue,
        stats.kstest(p[:, 0], stats.norm(scale=np.sqrt(T)).cdf).pvalue,
        temperature(means),
    )


def chain(paths, mistaken=False, T=0.5, h=0.1, steps=4000):
    """The same for all springs and all momenta of ten particles, which are independent."""
    problem = systems.thermal_chain(10, T)
    system = problem.system
    if mistaken:
        system = dvi.System(system.H_D, noise=Mistaken(1.0, T))
    q, p, means = samples(problem, system, dvi.BAOAB(), paths, steps, h, seed=1)
    springs = distribution(lambda d: d**2 / 2 + d**4 / 4, T)
    return (
        stats.kstest(np.diff(q, prepend=0).ravel(), springs).pvalue,
        stats.kstest(p.ravel(), stats.norm(scale=np.sqrt(T)).cdf).pvalue,
        temperature(means),
    )


# --- speed ----------------------------------------------------------------------------------------


def nanoseconds(of_key, steps, paths=1024):
    """Processor time of a step of one path in a batch."""
    keys = jax.random.split(jax.random.key(0), paths)
    run = jax.jit(jax.vmap(of_key))
    jax.block_until_ready(run(keys))
    taken = []
    for _ in range(5):
        begin = time.process_time()
        jax.block_until_ready(run(keys))
        taken.append(time.process_time() - begin)
    return min(taken) / (paths * steps) * 1e9


def show_speed(steps=1000):
    lanewise.set_threads(1)
    print("nanoseconds of a step of one path, 1024 paths of a double well on one thread")
    quiet, well = systems.double_well(), systems.double_well(0.5)

    def strang(key):
        # From another start on each path, so that there is a batch.
        q0 = jnp.array([1.2]) + 1e-12 * jax.random.uniform(key)
        return dvi.integrate(quiet, q0, num_steps=steps, method=dvi.Strang(),
                             save=dvi.Save(final=True)).qs[-1]  # fmt: skip

    print(f"  {'Strang, without noise':34} {nanoseconds(strang, steps):8.1f}")
    for name in PUBLIC:

        def noisy(key, method=METHODS[name]):
            return dvi.integrate(well, num_steps=steps, method=method, path=dvi.Brownian(key),
                                 save=dvi.Save(final=True)).qs[-1]  # fmt: skip

        print(f"  {name:34} {nanoseconds(noisy, steps):8.1f}")
    try:
        import diffrax
    except ImportError:
        return
    span = 0.0, 0.1 * steps
    drift = diffrax.ODETerm(lambda t, z, _: jnp.stack([z[1], -4 * z[0] * (z[0] ** 2 - 1) - z[1]]))

    def heun(key, path):
        along = diffrax.ControlTerm(lambda t, z, _: jnp.array([[0.0], [1.0]]), path(key))
        terms = diffrax.MultiTerm(drift, along)
        start = jnp.array([1.2, 0.2])
        return diffrax.diffeqsolve(
            terms,
            diffrax.Heun(),
            *span,
            0.1,
            start,
            max_steps=steps + 1,
            adjoint=diffrax.ForwardMode(),
        ).ys

    for name, path in (
        ("UnsafeBrownianPath", lambda key: diffrax.UnsafeBrownianPath((1,), key)),
        (
            "VirtualBrownianTree",
            lambda key: diffrax.VirtualBrownianTree(*span, tol=0.05, shape=(1,), key=key),
        ),
    ):
        found = nanoseconds(lambda key, path=path: heun(key, path), steps)
        print(f"  {'diffrax, Heun, ' + name:34} {found:8.1f}")


# --- the table ------------------------------------------------------------------------------------


def show_orders(paths, which):
    measure = strong_order if which == "strong" else weak_order
    print(f"{which} orders, {paths} paths")
    for kind, names in USED.items():
        for name in names:
            order, error = measure(kind, name, paths)
            print(f"  {kind:9} {name:19} {order:6.3f} ± {error:.3f}", flush=True)


def show_distribution(what, measure, paths):
    print(f"{what}, {paths} independent paths, T = 0.5: p-values above 0.01")
    for label, mistaken in (("BAOAB", False), ("wrong coefficient", True)):
        of_q, of_p, (T, error) = measure(paths, mistaken=mistaken)
        print(f"  {label:18} q {of_q:.3g}, p {of_p:.3g}, configurational T {T:.5f} ± {error:.5f}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--paths", type=int, default=100_000)
    parser.add_argument("what", nargs="*", default=["strong", "weak", "canonical", "chain"])
    given = parser.parse_args()
    for what in given.what:
        begin = time.process_time()
        if what in ("strong", "weak"):
            show_orders(given.paths, what)
        elif what == "canonical":
            show_distribution("Double well", canonical, given.paths)
        elif what == "chain":
            show_distribution("Chain of ten particles", chain, given.paths // 10)
        elif what == "speed":
            show_speed()
        print(f"  {time.process_time() - begin:.0f} s of processor time\n")


if __name__ == "__main__":
    main()
