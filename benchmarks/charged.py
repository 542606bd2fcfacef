"""Energy and magnetic moment of charged particles over up to 10⁷ gyrations.

    python benchmarks/charged.py [--gyrations 1e7] [--cases mirror potential] [--methods Boris ...]

Two fields: the magnetic mirror of the library (ℓ = 20), whose particle has only a magnetic field;
and the field B = (0, 0, r) with the potential x³ − y³ + x⁴/5 + y⁴ + z⁴ (compare Hairer & Lubich
2018, *BIT* 58, 969), which has no symmetry. One row for each method. Errors are those of 2000
states at equal distances in the run: in its first tenth and in all of it.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

METHODS = {
    "Boris": dvi.Boris(),
    "MagneticSplitting": dvi.MagneticSplitting(),
    "MagneticSplitting(BlanesMoan(4))": dvi.MagneticSplitting(dvi.BlanesMoan(4)),
    "GaussLegendre(2)": dvi.GaussLegendre(2),
}


def in_a_potential(t, q, p, args):
    x, y, z = q
    A = jnp.sqrt(x * x + y * y) / 3 * jnp.stack([-y, x, 0 * z])
    return jnp.sum((p - A) ** 2) / 2 + x**3 - y**3 + x**4 / 5 + y**4 + z**4


def without_symmetry():
    """System, initial conditions (0, 1, 0.1), v = (0.09, 0.55, 0.30), args, observables."""
    system = dvi.System(dvi.discretise(in_a_potential))
    return system, [0.0, 1.0, 0.1], [0.09 - 1 / 3, 0.55, 0.30], None


def mirror():
    problem = systems.magnetic_mirror()
    return problem.system, problem.q0, problem.p0, problem.args


CASES = {"mirror": (mirror, 0.5), "potential": (without_symmetry, 0.05)}
"""Name → system, step in units of 1/gyrofrequency at B = 1."""


def moments(sol, args):
    """The magnetic moment with its first correction, at the states of a run in the mirror."""
    moment = systems.magnetic_mirror().observables["corrected_moment"]
    return np.asarray(jax.vmap(lambda q, p: moment(0.0, q, p, args))(sol.qs, sol.ps))


def row(case, name, gyrations):
    make, h = CASES[case]
    system, q, p, args = make()
    samples = 2000
    each = max(1, round(2 * np.pi * gyrations / h / samples))
    run = jax.jit(
        lambda q, p: dvi.integrate(
            system, q, p, h=h, num_steps=samples * each, args=args, method=METHODS[name],
            save=dvi.Save(every=each), throw=False,
        )
    )  # fmt: skip
    compiled = run.lower(jnp.asarray(q), jnp.asarray(p)).compile()
    start = time.process_time()
    sol = jax.block_until_ready(compiled(jnp.asarray(q), jnp.asarray(p)))
    seconds = time.process_time() - start
    energy = jax.vmap(lambda q, p: system.hamiltonian(0.0, 0.0, q, p, 0.0, args))(sol.qs, sol.ps)
    error = np.abs(np.asarray(energy - energy[0]))
    tenth = samples // 10
    text = f"| {case} | {name} | {2 * np.pi / h:.0f} | {samples * each * h / (2 * np.pi):.1e} | "
    text += f"{error[:tenth].max():.0e} | {error.max():.0e} | "
    if case == "mirror":
        mu = moments(sol, args)
        change = mu[-tenth:].mean() / mu[:tenth].mean() - 1
        text += f"{np.ptp(mu[:tenth]) / mu.mean():.4f} | {np.ptp(mu) / mu.mean():.4f} | "
        text += f"{change:+.0e} | "
    else:
        text += "| | | "
    return text + f"{seconds:.0f} s | {sol.status} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gyrations", type=float, default=1e7)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    options = parser.parse_args()
    print("| field | method | steps per gyration | gyrations | energy error, first tenth | all | "
          "range/mean of μ, first tenth | all | change of mean μ | time | status |")  # fmt: skip
    print("|" + "---|" * 11)
    for case in options.cases:
        for name in options.methods:
            print(row(case, name, options.gyrations), flush=True)


if __name__ == "__main__":
    main()
