"""Figures of indicators, sections, frequencies and adiabatic moments, and their required values.

    python benchmarks/dynamics.py [--quick] [--check]

Each row is a number that docs/chaos.md, docs/frequencies.md or docs/systems.md rest on: what was
measured, and the bound that it is held to. `--quick` leaves out what takes over ten seconds;
`--check`: exit status 1 where a bound is not kept. A minute on two cores.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax import systems

jax.config.update("jax_enable_x64", True)

HENON = systems.henon_heiles()
CHAOTIC = ([0.0, -0.25], [0.42, 0.0])
"""Skokos, Bountis & Antonopoulos 2007: energy 0.125."""

Row = tuple[str, str, str, bool]
"""What, measured, asked, whether it holds."""


def along(q0, p0, observe, num_steps, method=dvi.Strang(), **options):
    """Observables along an orbit of Hénon and Heiles, or of another system."""
    system = options.pop("system", HENON.system)
    options = {"h": 0.05, "save": dvi.Save(final=True)} | options
    return dvi.integrate(
        system, q0, p0, num_steps=num_steps, method=method, observe=observe, **options
    ).observed


def lyapunov() -> Iterator[Row]:
    """The spectrum at the published start: the mean over copies that are 1e-12 apart."""
    rng = np.random.default_rng(0)
    q = jnp.asarray(np.array(CHAOTIC[0]) + 1e-12 * rng.normal(size=(512, 2)))
    run = jax.jit(jax.vmap(lambda x: along(x, CHAOTIC[1], dvi.LyapunovSpectrum(), 80_000)))
    mean = np.asarray(run(q)).mean(0)
    off = np.abs(mean - [0.052, 0, 0, -0.052]).max()
    yield (
        "Lyapunov spectrum, t = 4000",
        np.array2string(mean, precision=4),
        ("within 0.003 of [0.052, 0, 0, −0.052]"),
        off < 0.003,
    )


def megno() -> Iterator[Row]:
    """⟨Y⟩ → 2 on a torus, λt/2 in the chaotic sea."""
    regular = float(along(HENON.q0, HENON.p0, dvi.MEGNO(), 400_000))
    yield "MEGNO of a regular orbit, t = 2e4", f"{regular:.3f}", "2 ± 0.02", abs(regular - 2) < 0.02
    chaotic = float(along(*CHAOTIC, dvi.MEGNO(), 80_000))
    yield "MEGNO of a chaotic orbit, t = 4000", f"{chaotic:.0f}", "over 20", chaotic > 20


def tangent() -> Iterator[Row]:
    """MᵀJM = J of one step; friction breaks it."""
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])
    damped = dvi.System(HENON.system.H_D, force=lambda t0, t1, q0, p1, args: -p1)
    methods = (dvi.TypeII(), dvi.Strang(), dvi.Yoshida(4), dvi.GaussLegendre(2))
    for name, system, epsilon in (("conservative", HENON.system, 0.0), ("damped", damped, 0.3)):
        defects = []
        for method in methods:
            M = along(*CHAOTIC, dvi.TangentMap(), 1, method, system=system, epsilon=epsilon, h=0.1)
            defects.append(np.abs(np.asarray(M).T @ J @ np.asarray(M) - J).max())
        worst, least = max(defects), min(defects)
        if name == "damped":
            yield "MᵀJM − J with friction (control)", f"{least:.1e}", "over 1e-3", least > 1e-3
        else:
            yield "MᵀJM − J of a step, four methods", f"{worst:.1e}", "1e-13", worst < 1e-13


def moment() -> Iterator[Row]:
    """Oscillation of μ0 and μ0 + μ1 in a mirror, as a power of gyroradius / scale length."""
    lengths, seen = (20.0, 40.0, 80.0), []
    for length in lengths:
        made = systems.magnetic_mirror(length, length / 2)
        found = along(
            made.q0,
            made.p0,
            [dvi.Range(made.observables[k]) for k in ("magnetic_moment", "corrected_moment")],
            round(30 * length),
            dvi.RungeKutta4(),
            system=made.system,
            args=made.args,
        )
        seen.append([float(x) for x in found])
    slopes = np.polyfit(np.log(lengths), np.log(seen), 1)[0]
    for name, slope, power in zip(("μ0", "μ0 + μ1"), -slopes, (1, 2), strict=True):
        yield (
            f"power of the oscillation of {name}",
            f"{slope:.2f}",
            f"{power} ± 0.15",
            (abs(slope - power) < 0.15),
        )


def frequencies() -> Iterator[Row]:
    """Frequencies of a torus that is known, over 1024 units of time."""
    ts = 3.0 + 0.5 * np.arange(2048)
    omega = np.array([1.0, -0.61803398875, 2.3456, 0.0703])
    signal = np.exp(1j * np.outer(ts, omega)) @ np.array([1.0, 0.3j, 0.1 + 0.05j, 1e-3])
    for name, refine, window in (("refined", True, 2), ("Laskar's, window 1", False, 1)):
        found = dvi.frequencies(ts, signal, count=4, window=window, refine=refine)
        off = np.abs(np.sort(np.asarray(found.frequencies)) - np.sort(omega)).max()
        yield f"frequencies of a torus, {name}", f"{off:.1e}", "1e-9", off < 1e-9


def section() -> Iterator[Row]:
    """10⁴ crossings of 64 orbits, together."""
    y = np.linspace(-0.25, 0.3, 64)
    px = np.sqrt(2 * 0.1 - y**2 + 2 * y**3 / 3)
    began = time.perf_counter()
    found = dvi.poincare_section(
        HENON.system,
        np.stack([0 * y, y], 1),
        np.stack([px, 0 * y], 1),
        lambda t, q, p, args: q[0],
        h=0.05,
        num_steps=1_600_000,
        crossings=10_000,
        throw=False,
    )
    off = float(np.abs(found.qs[..., 0]).max())
    taken = time.perf_counter() - began
    ended = sorted({str(s) for s in np.ravel(found.status)})
    yield (
        f"64 × 10⁴ crossings, {taken:.0f} s, {', '.join(ended)}",
        f"{off:.1e}",
        ("1e-12 off the plane"),
        off < 1e-12 and ended == ["successful"],
    )


def first_calls() -> Iterator[Row]:
    """First calls of sections with 200 crossings, in processor time, which compilation is."""
    for form, limit in ((None, 60), ("arrays", 10)):
        began = time.process_time()
        y = np.linspace(-0.25, 0.3, 20)
        dvi.poincare_section(
            HENON.system,
            np.stack([0 * y, y], 1),
            np.stack([np.sqrt(2 * 0.1 - y**2 + 2 * y**3 / 3), 0 * y], 1),
            lambda t, q, p, args: q[0],
            h=0.05,
            num_steps=16_000,
            crossings=200,
            throw=False,
            integrator=form and dvi.Integrator(layout=dvi.Layout(form=form)),
        )
        taken = time.process_time() - began
        name = f"first call, 20 × 200 crossings, layout {form or 'default'}"
        yield name, f"{taken:.1f} s", f"{limit} s", taken < limit


ROWS: dict[str, Callable[[], Iterator[Row]]] = {
    f.__name__: f for f in (first_calls, tangent, megno, moment, frequencies, lyapunov, section)
}
LONG = {"lyapunov", "section", "first_calls"}


def main(arguments: list[str] | None = None) -> int:
    """Measure, print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--check", action="store_true")
    options = parser.parse_args(arguments)
    print("| | measured | asked | |\n| --- | --- | --- | --- |", flush=True)
    kept = True
    for name, rows in ROWS.items():
        if options.quick and name in LONG:
            continue
        for what, measured, asked, holds in rows():
            print(
                f"| {what} | {measured} | {asked} | {'holds' if holds else 'MISSED'} |", flush=True
            )
            kept &= bool(holds)
    return 1 if options.check and not kept else 0


if __name__ == "__main__":
    sys.exit(main())
