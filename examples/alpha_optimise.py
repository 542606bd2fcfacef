"""Fewer losses of alpha particles by gradients of orbits: descent in the spectrum of |B|.

A precisely quasi-axisymmetric reactor field receives a mirror term B_02 cos(2ζ), 2 % of the mean
|B|, which stays fixed (as a ripple of given coils would), and twelve random symmetry-breaking
modes, 1 % each, that may change. Two measures of the field are minimised with optax:

(a) `boozer.symmetry_error`, the distance from quasi-symmetry, a formula of the spectrum;
(b) `boozer.mean_drift`, from the bounce-averaged radial drift of orbits, differentiated through the
    integrator. Each step of the descent has other particles.

(a) has an obvious minimum: all free modes nearly zero. In (b) the free modes can compensate the
drift that the fixed mode causes, as in Mynick, Chu & Boozer 1982, Phys. Rev. Lett. 48, 322.
Afterwards the losses of alpha particles of 3.5 MeV are measured, with other initial conditions.

The orbits of (b) are those of ions of 35 keV, whose bounces and radial drift are similar in shape
and whose orbits are ten times thinner. The drift of 3.5 MeV alphas within the same number of
bounces is so large that its gradient is, probably, dominated by a few chaotic orbits.

The spectrum is free here. That of a real plasma follows from a boundary or from coils: multiply the
gradients of this example by the derivatives of the spectrum with respect to those.

Measured with 1000 particles born at s = 0.25: after 1 ms 9.6 ± 0.9 % are lost at the start of the
descents, 7.0 ± 0.8 % after (a), 3.7 ± 0.6 % after (b); after 10 ms 18.7 ± 1.2, 19.4 ± 1.3 and
14.4 ± 1.1 %. (b) increases the symmetry error by one half: at s = 0.25 its modes (1, ±2) turn the
fixed cos(2ζ) into (1 − 1.1 cos θ) cos(2ζ), which is small on the outboard side.

Run: python examples/alpha_optimise.py [--quick] [DIRECTORY for the picture]
"""

import argparse
import functools
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import optax

from dvi_jax import plot
from dvi_jax.systems import boozer

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

QA = boozer.precise_qa()
ALPHAS = boozer.GuidingCentres(QA)
FIXED = {(0, 2): 0.02}
"""(m, n) of the mode that stays, and its amplitude over the mean |B|."""

FREE = [(m, n) for m in (1, 2, 3) for n in (-4, -2, 2, 4)]
THIN = 3.5e4
"""Energy of the ions whose drift is measured [eV]."""

NAMES = {"start": "start", "a": "after (a), symmetry", "b": "after (b), drift of orbits"}


def with_modes(field, amplitudes):
    """The field with further modes s^{m/2} a_mn cos(mθ − nζ), a_mn over the mean |B|."""
    columns = field.coefficients.shape[2]
    rows = np.array([divmod(field.modes.index(mode), columns) for mode in amplitudes])
    values = jnp.stack([jnp.asarray(a, float) for a in amplitudes.values()]) * field.average
    c = field.coefficients.at[0, rows[:, 0], rows[:, 1], 0].add(values)
    return eqx.tree_at(lambda f: f.coefficients, field, c)


def field_of(a):
    """The field with the free modes a [fraction of the mean |B|]."""
    return with_modes(QA, FIXED | dict(zip(FREE, a, strict=True)))


def starts_of(births, largest_pitch=1.0):
    """s, θ, ζ and v∥/v0 of the particles with |v∥/v0| up to `largest_pitch`, shape (count, 4)."""
    q, p, _ = jax.vmap(lambda i: births.at(i, 0.0, None))(jnp.arange(births.count))
    found = ALPHAS.coordinates_of(q, p)
    pitch = found.v_parallel / ALPHAS.speed
    starts = jnp.stack([found.s, found.theta, found.zeta, pitch], axis=-1)
    return starts[jnp.abs(pitch) <= largest_pitch]


def trapped(count, seed):
    """Initial conditions in the volume s < 0.9: trapped particles, and passing ones near them."""
    inside = boozer.Births(
        3 * count, ALPHAS, rate=lambda s: jnp.where(s < 0.9, 1.0, 0.0), seed=seed
    )
    found = starts_of(inside, largest_pitch=0.55)
    assert len(found) >= count
    return found[:count]


@jax.jit
def symmetry_error(a, _=None):
    """Measure (a)."""
    return boozer.symmetry_error(field_of(a))


@jax.jit
def mean_drift(a, starts):
    """Measure (b), during 2600 m: 2·10⁻⁴ s of an alpha particle of 3.5 MeV."""
    return boozer.mean_drift(boozer.GuidingCentres(field_of(a), energy=THIN), starts)


def descent(measure, a, batches, rate=3e-3):
    """All points of a descent of ln(measure) by Adam, one step for each batch."""
    gradient = jax.jit(jax.grad(lambda a, batch: jnp.log(measure(a, batch))))
    schedule = optax.cosine_decay_schedule(rate, len(batches))
    optimiser = optax.chain(optax.clip_by_global_norm(50.0), optax.adam(schedule))
    state, points = optimiser.init(a), [a]
    for batch in batches:
        changes, state = optimiser.update(gradient(a, batch), state)
        a = optax.apply_updates(a, changes)
        points.append(a)
    return jnp.stack(points)


@functools.partial(jax.jit, static_argnums=2)
def loss_times(a, starts, num_steps):
    """Times [s] at which alpha particles of 3.5 MeV are lost; infinite for those that stay."""
    particles = boozer.GuidingCentres(field_of(a))
    return jax.vmap(lambda x: boozer.lost_at(particles, x, num_steps=num_steps))(starts)


def steps_for(seconds):
    """Number of steps of 4 m of an alpha particle."""
    return round(float(ALPHAS.step(seconds)) / 4.0)


def share(lost):
    """Share of lost particles and its standard error."""
    f = np.mean(lost)
    return f, np.sqrt(f * (1 - f) / len(lost))


def cost(a, starts):
    """Seconds of the value of (b), and of value and gradient."""
    seconds = []
    for f in (mean_drift, jax.jit(jax.value_and_grad(mean_drift))):
        jax.block_until_ready(f(a, starts))
        began = time.perf_counter()
        jax.block_until_ready(f(a, starts))
        seconds.append(time.perf_counter() - began)
    return seconds


def draw(curves, times, times_of, points):
    """Losses against time; measures along the descents; measures against losses."""
    figure, axes = plt.subplots(1, 3, figsize=(13.2, 4.2), layout="constrained")
    for name, colour, dash in zip(NAMES, plot.COLOURS, plot.DASHES, strict=False):
        f = np.array([share(times_of[name] < t) for t in times])
        style = {"color": colour, "ls": dash, "label": NAMES[name]}
        axes[0].plot(times, 100 * f[:, 0], **style)
        axes[0].fill_between(times, *(100 * (f[:, 0] + k * f[:, 1]) for k in (-1, 1)),
                             color=colour, alpha=0.2, lw=0)  # fmt: skip
    axes[0].set(xscale="log", xlabel="time [s]", ylabel="lost alpha particles [%]", ylim=(0, None),
                title="Losses, band: standard error")  # fmt: skip
    axes[0].legend(loc="upper left")
    for name, colour, dash in zip("ab", plot.COLOURS[1:], plot.DASHES[1:], strict=False):
        for measure, label in ((0, "symmetry error"), (1, "mean drift")):
            y = curves[name][:, measure] / curves[name][0, measure]
            axes[1].plot(y, color=colour, ls=dash, marker="os"[measure], markevery=0.2,
                         mfc="white", label=f"{label} along ({name})")  # fmt: skip
    axes[1].set(xlabel="step of the descent", ylabel="measure over its value at the start",
                ylim=(0, None), title="Measures along the descents")  # fmt: skip
    axes[1].legend()
    for name, colour, marker in zip("ab", plot.COLOURS[1:], "os", strict=False):
        at = points[name]
        axes[2].errorbar(at[:, 1], 100 * at[:, 2], 100 * at[:, 3], ls="-", lw=0.7, color=colour,
                         marker=marker, mfc="white", label=f"along ({name})")  # fmt: skip
    axes[2].plot(
        points["a"][0, 1], 100 * points["a"][0, 2], "D", color="black", label="start", zorder=5
    )
    axes[2].set(xlabel="mean drift", ylabel="lost after 1 ms [%]", ylim=(0, None),
                title="Mean drift and losses")  # fmt: skip
    axes[2].legend(loc="upper left")
    return figure


def main(arguments=None):
    """Two descents, measured losses, a table and a picture."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true", help="a few particles and steps: a test")
    parser.add_argument("directory", nargs="?", type=Path, default=Path("."))
    given = parser.parse_args(arguments)
    # Particles of a step, steps of both descents, alphas measured and their time, alphas along the
    # descents and their time.
    size, of_a, of_b, alphas, longest, on_path, shorter = (
        (32, 4, 4, 32, 1e-4, 16, 5e-5) if given.quick else (256, 60, 60, 1000, 1e-2, 1000, 1e-3)
    )
    a0 = jnp.asarray(0.01 * np.random.default_rng(0).normal(size=len(FREE)))
    batches = trapped(size * of_b, seed=1).reshape(of_b, size, 4)
    held_out = trapped(4 * size, seed=2)
    paths = {"a": descent(symmetry_error, a0, [None] * of_a), "b": descent(mean_drift, a0, batches)}
    measure = jax.jit(lambda a: jnp.stack([symmetry_error(a), mean_drift(a, held_out)]))
    curves = {name: np.stack([measure(a) for a in path]) for name, path in paths.items()}
    value, both = cost(a0, batches[0])
    print(
        f"(b) with {size} particles: value {value:.2f} s, with its gradient {both:.2f} s "
        f"({both / value:.1f} times)"
    )

    births = starts_of(boozer.Births(alphas, ALPHAS, surface=0.25, seed=3))
    last = {"start": a0, "a": paths["a"][-1], "b": paths["b"][-1]}
    times_of = {n: np.asarray(loss_times(a, births, steps_for(longest))) for n, a in last.items()}
    print(
        f"\n{alphas} alpha particles born at s = 0.25, lost up to the time [%]\n"
        f"{'field':28}{'symmetry':>10}{'drift':>8}"
        + "".join(f"{x:>10.0e} s" for x in longest * np.array([0.03, 0.1, 0.3, 1]))
    )
    for name, a in last.items():
        lost = [share(times_of[name] <= x * longest) for x in (0.03, 0.1, 0.3, 1)]
        columns = "".join(f"{100 * f:>6.1f} ± {100 * e:.1f}" for f, e in lost)
        of_a_and_b = measure(a)
        print(f"{NAMES[name]:28}{of_a_and_b[0]:>10.1e}{of_a_and_b[1]:>8.3f}{columns}")
    before, after = (np.isfinite(times_of[x]) for x in ("a", "b"))
    print(
        f"lost after (a) and not after (b): {np.sum(before & ~after)}, "
        f"the other way round: {np.sum(after & ~before)}"
    )

    along = starts_of(boozer.Births(on_path, ALPHAS, surface=0.25, seed=4))
    points = {}
    for name, path in paths.items():
        chosen = np.unique(np.linspace(0, len(path) - 1, 7).astype(int) ** 2 // (len(path) - 1))
        lost = [share(np.isfinite(loss_times(path[i], along, steps_for(shorter)))) for i in chosen]
        points[name] = np.column_stack([curves[name][chosen], lost])
    everything = np.concatenate([points["a"], points["b"][1:]])
    for name, rows in {**points, "both": everything}.items():
        with np.errstate(invalid="ignore", divide="ignore"):  # no loss at all, if quick
            r = np.corrcoef(rows[:, :3].T)[2]
        print(
            f"correlation with losses after {shorter:.0e} s, {len(rows)} fields, descent {name}: "
            f"symmetry {r[0]:.2f}, drift {r[1]:.2f}"
        )
    print("\nfree modes (m, n) [% of the mean |B|]: start, after (a), after (b)")
    for mode, *row in zip(FREE, *last.values(), strict=True):
        print(f"{mode!s:>8}" + "".join(f"{100 * float(x):8.2f}" for x in row))
    given.directory.mkdir(parents=True, exist_ok=True)
    with plot.style():
        times = np.geomspace(longest / 300, longest, 120)
        figure = draw(curves, times, times_of, points)
        print(f"written: {plot.save(figure, given.directory / 'alpha_optimise.png')}")


if __name__ == "__main__":
    main()
