"""Gradients of a storage ring: matching, errors from orbit responses, larger dynamic aperture.

The ring has 8 double-bend achromats with four families of quadrupoles (Q1, Q2, Q3, QC), two of
chromatic sextupoles (SF, SD) and two of sextupoles without dispersion (S1, S2).

(a) `match`: six strengths for two tunes, the dispersion and β_x in the straight section, and two
    chromaticities.
(b) `loco`: errors of all 56 quadrupoles and the gains of 64 monitors, from a response matrix of
    closed orbits with noise (Safranek 1997, *NIM A* 388, 27), with standard errors, and the
    distribution of the pulls (fitted − true)/(standard error) over noise realisations.
(c) `aperture`: S1 and S2 minimise the oscillation of the linear actions along trajectories, with
    derivatives through tracking; SF and SD keep the chromaticity. Afterwards the dynamic aperture
    is measured, without errors and with random errors that the descent did not use.

Run: python examples/ring_fits.py [DIRECTORY for the pictures] [match loco aperture]
"""

import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import optimistix

import dvi_jax as dvi
from dvi_jax import plot, rings

jax.config.update("jax_enable_x64", True)
mpl.use("Agg")

CELLS = 8
FAMILIES = "Q1", "Q2", "Q3", "QC"
GUESS = {"Q1": -2.1, "Q2": 2.7, "Q3": -2.4, "QC": 2.5}


def cell():
    """One achromat, symmetric about its middle."""
    angle = np.pi / CELLS

    def quad(name, length):
        return rings.quadrupole(name, length, GUESS[name], slices=4)

    def sext(name, length):
        return rings.sextupole(name, length, 0.0, slices=1, scheme=2)

    def monitor(i):
        return rings.corrector(f"COR{i}", 0.0, 0.0, 0.0), rings.marker(f"BPM{i}")

    half = [
        rings.drift("D", 2.0), *monitor(1), quad("Q1", 0.3),
        rings.drift("D", 0.15), sext("S1", 0.2), rings.drift("D", 0.15), quad("Q2", 0.4),
        rings.drift("D", 0.15), sext("S2", 0.2), rings.drift("D", 0.15), quad("Q3", 0.3),
        rings.drift("D", 0.5), *monitor(2),
        rings.bend("B", 1.5, angle, edge_in=angle / 2, edge_out=angle / 2, slices=4),
        rings.drift("D", 0.35), sext("SD", 0.2), rings.drift("D", 0.35), sext("SF", 0.15),
        rings.drift("D", 0.15),
    ]  # fmt: skip
    return [*half, quad("QC", 0.4), *reversed(half)]


# --- (a) matching ---------------------------------------------------------------------------------


def with_strengths(ring, k, sextupoles=None):
    """The ring with the strengths k of the quadrupole families, and b2 of (SF, SD)."""
    for name, value in zip(FAMILIES, k, strict=True):
        ring = ring.set(name, b1=value)
    if sextupoles is not None:
        ring = ring.set("SF", b2=sextupoles[0]).set("SD", b2=sextupoles[1])
    return ring


def match(tunes=(0.76, 0.64), beta=8.0, chromaticity=(0.0, 0.0)):
    """A cell with these tunes, chromaticities and β_x [m] in the straight section."""
    one = rings.Ring(cell())

    @jax.jit
    def missed(strengths, _=None):
        found = rings.optics(with_strengths(one, strengths[:4], 100 * strengths[4:]))
        return jnp.concatenate([
            found.tune - jnp.asarray(tunes),
            found.dispersion[0, :1],
            found.beta[0, :1] / beta - 1,
            found.chromaticity - jnp.asarray(chromaticity),
        ])  # fmt: skip

    began = time.perf_counter()
    guess = jnp.asarray([*GUESS.values(), 0.3, -0.3])
    solver = optimistix.LevenbergMarquardt(rtol=1e-12, atol=1e-12)
    found = optimistix.least_squares(missed, solver, guess)
    ring = with_strengths(one, found.value[:4], 100 * found.value[4:])
    o = rings.optics(ring)
    print(f"(a) {int(found.stats['num_steps'])} steps, {time.perf_counter() - began:.1f} s")
    names = ", ".join(f"{n} {k:.4f}" for n, k in zip(FAMILIES, found.value[:4], strict=True))
    sextupoles = 100 * found.value[4:]
    print(f"    {names} 1/m², SF {sextupoles[0]:.2f}, SD {sextupoles[1]:.2f} 1/m³")
    print(f"    tunes {o.tune}, β_x {o.beta[0, 0]:.6f} m, D {o.dispersion[0, 0]:.1e} m, "
          f"chromaticities {o.chromaticity}")  # fmt: skip
    print(f"    largest residual: {jnp.max(jnp.abs(missed(found.value))):.1e}")
    return ring


def whole_ring(one):
    """The ring of `CELLS` cells like this one."""
    ring = rings.Ring(cell() * CELLS)
    return with_strengths(
        ring, [one.get(n, "b1")[0] for n in FAMILIES], [one.get(n, "b2")[0] for n in ("SF", "SD")]
    )


# --- (b) errors of quadrupoles --------------------------------------------------------------------

KICK, NOISE = 2e-5, 3e-7
"""Change of a corrector [rad]; standard deviation of a reading of the orbit [m]."""
ERRORS, GAINS = 1e-3, 0.01
"""Standard deviations of the relative errors of quadrupoles, and of the gains of monitors."""
S = np.kron(np.eye(2), [[0, 1], [-1, 0]])


def responses(ring, errors, gains):
    """Changes of the closed orbit at monitors by correctors [m/rad], shape (2, monitors,
    correctors): of x by kick_x, and of y by kick_y.

    With M_s the matrix from the start to s, a kick e at c changes the orbit at the start by
    (1 − M)⁻¹ M M_c⁻¹ e.
    """
    quads = ring.where("quadrupole")
    ring = ring.set(quads, b1=ring.columns["b1"][quads] * (1 + errors))
    M = rings.optics(ring, chromatic=False).matrix[:, :4, :4]
    at, by = M[ring.where("BPM*")], M[ring.where("COR*")]
    kicked = S.T @ jnp.swapaxes(by, 1, 2) @ S  # the inverse of a symplectic matrix
    begin = jnp.linalg.solve(np.eye(4) - M[-1], M[-1] @ kicked)
    behind = ring.where("BPM*")[:, None] > ring.where("COR*")[None]
    moved = begin[None] + behind[:, :, None, None] * kicked[None]
    every = jnp.einsum("mij,mcjk->mcik", at, moved)
    return jnp.stack([every[..., 0, 1], every[..., 2, 3]]) * gains[..., None]


def measured(ring, errors, kick=KICK):
    """The same from closed orbits with kicks of ±`kick`, without noise and with gains of 1."""
    quads, correctors = ring.where("quadrupole"), ring.where("COR*")
    ring = ring.set(quads, b1=ring.columns["b1"][quads] * (1 + errors))

    @jax.jit
    @jax.vmap
    def orbit(kicks):
        kicked = ring.set(correctors, kick_x=kicks[0], kick_y=kicks[1])
        return rings.optics(kicked, chromatic=False).orbit[ring.where("BPM*")][:, (0, 2)]

    both = []
    for plane in (0, 1):
        kicks = np.zeros((len(correctors), 2, len(correctors)))
        kicks[:, plane] = kick * np.eye(len(correctors))
        both.append((orbit(kicks) - orbit(-kicks))[..., plane].T / (2 * kick))
    return jnp.stack(both)


def still(t0, t1, q0, p1, args):
    """H_D of a coordinate that is not used: `dvi.fit` requires a trajectory."""
    return p1 @ p1 / 2


def loco(ring, out, realisations=20, kick=KICK):
    """Fitted errors of all quadrupoles, and pulls over noise realisations."""
    rng = np.random.default_rng(0)
    shape = (2, *[len(ring.where(w)) for w in ("BPM*", "COR*")])
    true = {
        "errors": ERRORS * rng.normal(size=len(ring.where("quadrupole"))),
        "gains": 1 + GAINS * rng.normal(size=shape[:2]),
    }
    exact = np.asarray(measured(ring, true["errors"], kick) * true["gains"][..., None])
    sigma = NOISE / np.sqrt(2) / kick
    nonlinear = np.abs(exact - np.asarray(responses(ring, **true))).max() / sigma
    print(f"(b) {exact.size} responses to kicks of {kick:g} rad; their nonlinear part is at most "
          f"{nonlinear:.2f} standard errors")  # fmt: skip
    system = dvi.System(still)

    def model(params):
        return {"system": system, "q0": [0.0], "p0": [0.0], "h": 1.0, "args": params}

    def observe(t, q, p, args):
        return responses(ring, **args).ravel()

    guess = {"errors": np.zeros(len(true["errors"])), "gains": np.ones(shape[:2])}
    fits = []
    for _ in range(realisations):
        seen = exact + sigma * rng.normal(size=shape)
        data = dvi.Observations([1.0], seen.reshape(1, -1), observe, sigma=sigma, t0=0.0)
        began = time.perf_counter()
        fits.append(dvi.fit(model, data, guess, horizons=None, check_curvature=False))
        if len(fits) in (1, realisations):
            print(f"    fit {len(fits)}: {fits[-1].status}, {time.perf_counter() - began:.1f} s")
    off = np.asarray([f.params["errors"] for f in fits]) - true["errors"]
    sigmas = np.asarray([f.sigma[: off.shape[1]] for f in fits])
    pulls, chi2 = off / sigmas, [f.reduced_chi2 for f in fits]
    before, after = np.std(true["errors"]), np.std(off)
    print(
        f"    relative errors of quadrupoles: rms {before:.1e}, after the fit {after:.1e}; "
        f"standard errors {sigmas.min():.1e} to {sigmas.max():.1e}"
    )
    spread = np.sqrt(2 / (exact.size - 120) / realisations)
    print(f"    reduced χ²: mean {np.mean(chi2):.4f}, expected 1 ± {spread:.4f}")
    print(
        f"    {pulls.size} pulls: mean {pulls.mean():+.3f}, standard deviation {pulls.std():.3f}, "
        f"{100 * np.mean(np.abs(pulls) < 1):.1f} % within 1 (68.3 % expected)"
    )
    # The pulls of one fit are correlated; these combinations of them are independent.
    free = [
        np.linalg.solve(np.linalg.cholesky(np.asarray(f.covariance)[: len(x), : len(x)]), x)
        for f, x in zip(fits, off, strict=True)
    ]
    print(
        f"    uncorrelated combinations: mean {np.mean(free):+.3f} ± {np.size(free) ** -0.5:.3f}, "
        f"standard deviation {np.std(free):.3f} ± {(2 * np.size(free)) ** -0.5:.3f}"
    )
    if out is not None:
        draw_loco(true["errors"], off[0] + true["errors"], sigmas[0], pulls, out)
    return pulls


def draw_loco(true, found, sigma, pulls, out):
    """Errors of one fit, and the histogram of all pulls."""
    with plot.style():
        figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), width_ratios=[2, 1])
        n = np.arange(len(true))
        axes[0].plot(n, 1e3 * true, "_", ms=9, mew=2, label="true")
        axes[0].errorbar(n, 1e3 * found, 1e3 * sigma, fmt=".", label="fitted, ± 1 standard error")
        axes[0].axhline(0, lw=0.6, color="grey")
        axes[0].set(xlabel="quadrupole", ylabel="relative error of the gradient [10⁻³]")
        axes[0].legend(loc="upper center", ncols=2)
        axes[0].set_ylim(-3.2, 4)
        x = np.linspace(-4, 4, 161)
        axes[1].hist(pulls.ravel(), np.linspace(-4, 4, 33), density=True, alpha=0.6)
        axes[1].plot(x, np.exp(-x * x / 2) / np.sqrt(2 * np.pi), label="standard normal")
        axes[1].set(xlabel="(fitted − true)/standard error", ylabel="density", ylim=(0, 0.52))
        axes[1].legend(loc="upper center")
        print(f"    written: {plot.save(figure, out / 'ring_loco.png')}")


# --- (c) dynamic aperture -------------------------------------------------------------------------

PASSAGES, TURNS = 128, 512
"""Passages of a cell in the proxy; turns of the ring for the dynamic aperture."""
LARGEST = 0.08, 0.04
"""Ends (x, y) of the rays of the dynamic aperture [m]."""
ANGLES = np.linspace(0, np.pi, 13)
SCALE = 2.0


def with_harmonic(ring, s):
    """The ring with the strengths of S1 and S2 [units of `SCALE`/m³]."""
    return ring.set("S1", b2=SCALE * s[0]).set("S2", b2=SCALE * s[1])


def oscillations(one, xy):
    """Function of s: changes of (J_x, J_y) over J_x + J_y, of particles that start at x, y [m], in
    passages of a cell. They are the drift of the invariants of order 0 in the sextupoles."""
    o = rings.optics(one, chromatic=False)
    S = np.kron(np.eye(2), [[0, 1], [-1, 0]])
    to_modes = jnp.conj(o.modes[0, :, :4]) @ S
    start = jnp.zeros((len(xy), 6)).at[:, (0, 2)].set(xy)

    def changes(s, _=None):
        z = rings.track(with_harmonic(one, s), start, PASSAGES, every=1).z
        J = jnp.abs(jnp.einsum("ki,pti->ptk", to_modes, z[..., :4])) ** 2 / 2
        mean = jnp.mean(J, axis=1, keepdims=True)
        return ((J - mean) / jnp.sum(mean, axis=2, keepdims=True)).ravel() / np.sqrt(PASSAGES)

    return changes


def descend(one):
    """s that minimises the oscillations, at amplitudes that grow in three stages."""
    s = jnp.zeros(2)
    for amplitude in (0.5, 0.5, 0.5):
        aperture = rings.dynamic_aperture(
            with_harmonic(one, s), 8 * TURNS, largest=LARGEST, angles=ANGLES, dp=0.0
        )
        changes = jax.jit(oscillations(one, amplitude * aperture))
        solver = optimistix.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
        found = optimistix.least_squares(
            changes, solver, s, options={"jac": "fwd"}, max_steps=40, throw=False
        )
        rms = [float(jnp.sqrt(jnp.mean(changes(x) ** 2) * PASSAGES)) for x in (s, found.value)]
        print(f"    amplitude {1e3 * amplitude * aperture[0, 0]:.1f}, "
              f"{1e3 * amplitude * aperture[6, 1]:.1f} mm: rms change of J/(J_x + J_y) "
              f"{rms[0]:.4f} → {rms[1]:.4f}, S1, S2 = {SCALE * found.value} 1/m³")  # fmt: skip
        s = found.value
    return s


def with_errors(ring, seed):
    """Relative errors 10⁻³ and rolls 0.2 mrad of quadrupoles, and shifts of sextupoles by 50 µm.

    A shift d = dx + i dy gives a sextupole the further field b2 (−2 d z + d²).
    """
    rng = np.random.default_rng(seed)
    quads, sexts = ring.where("quadrupole"), ring.where("sextupole")
    gradient, roll = rng.normal(size=(2, len(quads)))
    d = 5e-5 * (rng.normal(size=(2, len(sexts))).T @ [1, 1j])
    b1, b2 = ring.columns["b1"][quads], ring.columns["b2"][sexts]
    ring = ring.set(quads, b1=b1 * (1 + 1e-3 * gradient), a1=4e-4 * roll * b1)
    return ring.set(
        sexts, b1=b2 * np.real(-2 * d), a1=b2 * np.imag(-2 * d),
        b0=b2 * np.real(d * d), a0=b2 * np.imag(d * d),
    )  # fmt: skip


def area(xy):
    """Area inside the rays [mm²]."""
    x, y = 1e3 * np.asarray(xy).T
    return float(np.sum(x[:-1] * y[1:] - x[1:] * y[:-1]) / 2)


def aperture(one, ring, out, seeds=6):
    """True dynamic aperture before and after the descent."""
    print("(c) descent")
    began = time.perf_counter()
    s = descend(one)
    print(f"    {time.perf_counter() - began:.1f} s")
    both = {"before": with_harmonic(ring, jnp.zeros(2)), "after": with_harmonic(ring, s)}

    def reached(ring, dp=0.0):
        return np.asarray(rings.dynamic_aperture(
            ring, TURNS, largest=LARGEST, angles=ANGLES, dp=dp))  # fmt: skip

    found = {}
    for name, r in both.items():
        print(f"    {name}: chromaticities {rings.optics(r).chromaticity.round(6)}")
        found[name] = [reached(r), *[reached(with_errors(r, seed)) for seed in range(seeds)]]
        areas = [area(x) for x in found[name]]
        print(f"    {name}: area {areas[0]:.1f} mm² without errors; with errors "
              f"{np.round(areas[1:], 1)}, mean {np.mean(areas[1:]):.1f}")  # fmt: skip
        off = [round(area(reached(r, dp)), 1) for dp in (-0.01, 0.01)]
        print(f"    {name}: area {off} mm² at δ = −1 %, 1 % without errors")
    ratios = [area(b) / area(a) for a, b in zip(found["before"], found["after"], strict=True)]
    print(
        f"    after/before: {ratios[0]:.2f} without errors, {np.round(ratios[1:], 2)} with errors"
    )
    print(f"    {time.perf_counter() - began:.1f} s in all")
    if out is not None:
        draw_aperture(found, out)
    return s, found


def draw_aperture(found, out):
    """The dynamic aperture with and without errors."""
    with plot.style():
        figure, axes = plt.subplots(figsize=(6.5, 4))
        for (name, many), colour in zip(found.items(), plot.COLOURS, strict=False):
            for i, xy in enumerate(many):
                label = (
                    f"{name}, without errors" if i == 0 else f"{name}, errors" if i == 1 else None
                )
                axes.plot(*(1e3 * xy.T), color=colour, lw=2 if i == 0 else 0.7,
                          ls="-" if i == 0 else "--", label=label)  # fmt: skip
        axes.set(xlabel="x [mm]", ylabel="y [mm]", ylim=(0, None))
        axes.set_title(f"Dynamic aperture, {TURNS} turns, δ = 0")
        figure.legend(loc="outside lower center", ncols=2)
        print(f"    written: {plot.save(figure, out / 'ring_aperture.png')}")


if __name__ == "__main__":
    given = sys.argv[1:]
    known = "match", "loco", "aperture"
    parts = [x for x in given if x in known] or known
    out = Path(next((x for x in given if x not in known), "."))
    out.mkdir(parents=True, exist_ok=True)
    one = match()
    ring = whole_ring(one)
    if "loco" in parts:
        loco(ring, out)
        print("    control, with kicks so large that sextupoles matter:")
        loco(ring, None, 2, kick=1e-4)
    if "aperture" in parts:
        aperture(one, ring, out)
