"""Detuning with amplitude, driving terms, dynamic and momentum aperture, frequency maps."""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, finite, in_range, known, positive, whole
from ...base.inputs import real_numbers
from ...base.printing import printable
from ...base.progress import bar_of, reporter
from ...dynamics.frequencies import frequencies, frequency_diffusion
from ._maps import Particle
from ._optics import SLICED_PARTS, Optics, analysis, four, maps, optics
from ._ring import Ring, Where
from ._track import track
from ._turn import Passage, start

Report = bool | Callable[[tuple[int, int]], None] | None
"""A function of (particles done, all particles of this round), or as in `dvi.integrate`."""
_GEOMETRIC = "h21000", "h30000", "h10110", "h10020", "h10200"
_CHROMATIC = "h11001", "h00111", "h20001", "h00201", "h10002"
_XY = np.eye(6)[[0, 2]]
_BATCH = 4096
"""Particles tracked in one call: more do not become faster, and progress is reported between."""


@printable
class FrequencyMap(NamedTuple):
    """Tunes of particles: `tune`, the fractional parts in the first half of the turns, and `second`
    in the second half, shape (…, 2); `diffusion`, log10 of the length of their difference, shape
    (…). NaN for particles that were lost, and for motion without a leading frequency."""

    tune: Array
    second: Array
    diffusion: Array


def detuning(ring: Ring, dp: float = 0.0, action: float = 1e-9, turns: int = 1024) -> Array:
    r"""Change of the tunes with the actions, ((dQx/dJx, dQx/dJy), (dQy/dJx, dQy/dJy)) [1/m].

    Q(J) − Q(0) of 16 particles with actions from one to four times `action` [m] is a polynomial of
    order 3 in the actions. Q and J are frequency and amplitude of the leading line (NAFF) of the
    normal modes, so that the result has an error of order `action`³, and round-off of
    10⁻¹³/action. In 4D. **Raises** as `optics`.
    """
    o, ring = optics(ring, finite("dp", dp), chromatic=False), four(ring)
    size = np.sqrt(2 * positive("action", action) * np.mgrid[1:5, 1:5].reshape(2, 16).T)
    z = o.orbit[:1] + jnp.pad(jnp.real(size @ o.modes[0]), ((0, 0), (0, 2)))
    lines = frequencies(np.arange(turns), _signal(o, track(ring, z, turns, every=1).z), count=2)
    x, y = jnp.abs(lines.amplitudes[..., 0].T) ** 2 / 2 / action
    terms = jnp.stack([x, y, x * x, x * y, y * y, x**3, x * x * y, x * y * y, y**3], 1)
    change = lines.frequencies[..., 0] / (2 * np.pi) - 0.25
    return jnp.linalg.lstsq(terms, change)[0][:2].T / action


@jax.jit
def _signal(o: Optics, z: Array) -> Array:
    """√(2J_k) e^{iφ_k} of the first two modes from z (particles, turns, 6) as (particles, 2,
    turns), where the linear motion has the tune 1/4: far from 0 and 1/2, where lines coincide."""
    v, n = o.modes[0, :2], o.modes.shape[-1]
    S = np.kron(np.eye(n // 2), [[0, 1], [-1, 0]])
    w = -1j * jnp.conj(v) @ S
    carrier = jnp.exp(2j * np.pi * jnp.outer(0.25 - o.tune[:2], jnp.arange(z.shape[1])))
    return jnp.einsum("ki,pti,kt->pkt", w, z[..., :n] - o.orbit[:1, None, :n], carrier)


def resonance_driving_terms(
    ring: Ring, terms: Sequence[str] = (*_GEOMETRIC, *_CHROMATIC), dp: float = 0.0
) -> dict[str, Array]:
    r"""Driving terms of first order in the multipoles: coefficients of the perturbation

        ∫ Re Σ_N (b_N + i a_N)(x + iy)^{N+1}/(N + 1) ds/(1 + δ) = Σ h_jkmnp A^j Ā^k B^m B̄^n δ^p

    in A = √(2J_1) e^{iφ_1} and B = √(2J_2) e^{iφ_2} at the entrance of the ring, about the closed
    orbit: (x, y) = (x₀, y₀) + Re(v_1 A + v_2 B) + (D_x, D_y) δ in the frame of each magnet. Rolls,
    displacements, the orbit in a magnet and a coupling of the planes are thus part of the terms.
    Gauss quadrature inside each magnet, with the optics there, in 4D. The perturbation includes
    quadrupoles in terms with δ; it does not include bends, fringe fields, solenoids and matrices.

    **Arguments** `terms`: names "hjkmnp", such as "h21000", or "h22000" of octupoles.

    **Returns** name → complex number [m^{1−(j+k+m+n)/2}], differentiable by the parameters of the
    ring. **Raises** `ValueError` for another name and for a ring with a `lens`; as `optics`.

    **Source** Bengtsson 1997, SLS note 9/97, with the signs of pyAT, which uses the
    mean of β in a magnet, and the phase in its middle.
    """
    for name in terms:
        if len(name) != 6 or name[0] != "h" or not name[1:].isdigit():
            raise ValueError(f"terms must be names such as 'h21000', got {name!r}.")
    if any(part.name in ("lens", "beam", "beam_slices") for part in ring.program.parts):
        raise ValueError(
            "the ring must not contain a lens or the field of a beam, whose potentials are not in "
            "the driving terms: use rings.multipole with length 0 where it is a polynomial."
        )
    optics(ring, dp, chromatic=False)
    o, _ = analysis(ring, real_numbers("dp", dp) * np.eye(6)[5], False, False, True)
    return _driving_terms(ring, o, tuple(terms))


@eqx.filter_jit
def _driving_terms(ring: Ring, o: Optics, terms: tuple[str, ...]) -> dict[str, Array]:
    apply, xs, pieces = maps(four(ring))
    names = np.asarray([ring.program.parts[part].name for part, _ in ring.program.rows])[pieces]
    mine = np.flatnonzero(np.isin(names, (*SLICED_PARTS, "thin", "second_order_bend")))
    points, weights = np.polynomial.legendre.leggauss(5)

    def point_optics(x, share):
        """w = x + iy on the orbit, and its derivatives by A, Ā, B, B̄ and δ."""
        (par, *tail), z, v, D = x
        part = {**par, "length": share * par["length"]}

        def end(z):
            z = jnp.stack(apply(Particle(*z), (part, *tail)))
            return z, z

        M, z = jax.jacfwd(end, has_aux=True)(z)
        u, D = M[0] + 1j * M[2], jnp.append(D, jnp.zeros(1))
        slopes = [(u[:4] @ mode) / 2 for k in (0, 1) for mode in (v[k], jnp.conj(v[k]))]
        return z[0] + 1j * z[2], jnp.stack([*slopes, u[:5] @ D + u[5]])

    magnets = jax.tree.map(lambda a: a[mine], (xs, o.orbit, o.modes, o.dispersion))
    w, slopes = lax.map(lambda s: lax.map(lambda e: point_optics(e, s), magnets), (1 + points) / 2)
    par, steps = magnets[0][0], magnets[0][-1]
    length = jnp.where(names[mine] == "thin", 1.0, par["length"] * jnp.sum(steps, 1))
    length = np.outer(weights / 2, 1.0) * length[None]
    orders = itertools.takewhile(lambda n: f"b{n}" in par, itertools.count())
    field = [(par[f"b{n}"] + 1j * par[f"a{n}"])[None] for n in orders]

    def product(powers):
        return math.prod(slopes[..., i] ** n for i, n in enumerate(powers))

    totals = {}
    for name in terms:
        j, k, m, n, p = map(int, name[1:])
        totals[name] = jnp.zeros((), complex)
        for q in range(p + 1):
            powers, mirror = (j, k, m, n, q), (k, j, n, m, q)
            N = sum(powers)
            if not 1 < N <= len(field):
                continue
            # The coefficient of order N - 1 of the field about the orbit.
            coefficient = sum(math.comb(i, N - 1) * c * w ** (i - N + 1)
                        for i, c in enumerate(field) if i >= N - 1)  # fmt: skip
            count = (-1) ** (p - q) * math.factorial(N - 1) / math.prod(map(math.factorial, powers))
            term = coefficient * product(powers) + jnp.conj(coefficient * product(mirror))
            totals[name] += count / 2 * jnp.sum(length * term)
    return totals


def dynamic_aperture(
    ring: Ring,
    turns: int = 1024,
    *,
    largest: tuple[float, float] = (0.05, 0.05),
    angles: Any = 19,
    steps: int = 16,
    rounds: int = 2,
    dp: float | None = None,
    progress: Report = None,
) -> Array:
    """Largest stable amplitudes (x, y) along rays from the closed orbit [m], shape (angles, 2).

    A ray is r (x_max cos θ, y_max sin θ), `largest` = (x_max, y_max), with θ from 0 to π or the
    given `angles` [rad]. The result is the last r before the first lost particle, among `steps`
    values up to 1; each further round divides the last interval by `steps`. `dp`: δ, in 4D. For a
    grid: ``rings.track(ring, z, turns).lost``. **Raises** as `optics`; `ValueError`.
    """
    angles = np.linspace(0, np.pi, angles) if np.ndim(angles) == 0 else np.asarray(angles)
    limits = array("largest", known("largest", largest, float), (2,), hint="It is (x_max, y_max).")
    in_range("largest", limits, 1e-9, 1.0, "The unit is m.")
    rays = np.stack([limits[0] * np.cos(angles), limits[1] * np.sin(angles)], 1)
    o, ring = optics(ring, dp, chromatic=False), ring if dp is None else four(ring)
    orbit = _in_numpy(o.orbit)[:1, None]

    def survive(r):
        z = (1e-6 + r[..., None] * rays[:, None]) @ _XY + orbit
        return _pieces(lambda z: ~track(ring, z, turns).lost, progress, z)

    return jax.device_put(_first_loss(survive, len(rays), steps, rounds)[:, None] * rays)


def momentum_aperture(
    ring: Ring,
    turns: int = 1024,
    where: Where | None = None,
    *,
    largest: float = 0.1,
    steps: int = 16,
    rounds: int = 2,
    progress: Report = None,
) -> Array:
    """Largest stable changes of δ, negative and positive, of a particle on the closed orbit at the
    entrance of elements, shape (elements, 2), as needed for the lifetime by Touschek scattering.

    `where`: see `Ring.where`; None: all elements. Other arguments and errors as for
    `dynamic_aperture`. The particle finishes its first turn, followed by `turns` turns.
    """
    orbit = _in_numpy(optics(ring, chromatic=False).orbit)
    first = np.repeat(np.arange(len(ring)) if where is None else ring.where(where), 2)
    in_range("largest", largest, 1e-9, 1.0, "It is Δp/p, not per cent.")
    side = largest * np.resize([-1.0, 1.0], len(first))
    begins, passage = orbit[first] + 1e-6 * _XY.sum(0)[None], Passage.from_ring(ring)

    def end_of_turn(passage, z, first):
        def row(flight, columns):
            numbers, rows, slopes = jax.tree.map(lambda column: column[None], columns)
            continuation = Passage(rows, slopes, numbers, passage.parts).fly(flight, 0, 0.0)
            skips = columns[0]["element"] < first
            select = functools.partial(jnp.where, skips)
            return jax.tree.map(select, flight, continuation), None

        return jnp.stack(lax.scan(row, start(Particle(*z)), passage.tables)[0].z)

    finish = jax.jit(jax.vmap(lambda z, first: lanewise.call(end_of_turn, passage, z, first)))

    def survive(r):
        z = (r * side[:, None])[..., None] * np.eye(6)[None, 5:] + begins[:, None]
        begin = np.broadcast_to(first[:, None], r.shape)
        return _pieces(lambda z, i: ~track(ring, finish(z, i), turns).lost, progress, z, begin)

    return jax.device_put((_first_loss(survive, len(first), steps, rounds) * side).reshape(-1, 2))


def frequency_map(
    ring: Ring, x: Any, y: Any, turns: int = 1024, dp: float | None = None, progress: Report = None
) -> FrequencyMap:
    """Tunes of particles that start at x, y [m] from the closed orbit, and how much they change.

    `x`, `y`: arrays of one shape (…), such as those of `np.meshgrid`; 1 nm is added to both. NAFF
    of the normal modes in the two halves of `turns`, see `dvi.frequency_diffusion`. `dp`: δ, in 4D.
    **Raises** `ValueError` for shapes that do not match; as `optics`. **Source** Laskar 2003.
    """
    o, ring = optics(ring, dp, chromatic=False), ring if dp is None else four(ring)
    x, y = known("x", x, float), known("y", y, float)
    if x.ndim and y.ndim:
        array("y", y, x.shape, hint="x and y are arrays of one shape: use np.meshgrid.")
    xy = 1e-9 + np.stack(np.broadcast_arrays(x, y), -1).reshape(-1, 2)
    whole("turns", turns, 64)

    def tunes_of_halves(z):
        signal = _signal(o, track(ring, z, turns, every=1).z)
        halves = frequency_diffusion(np.arange(turns), signal, throw=False)
        return _module_of(halves.first).stack([halves.first, halves.second], 1)

    begins = _in_numpy(o.orbit)[:1] + xy @ _XY
    tunes = _pieces(tunes_of_halves, progress, begins) / (2 * np.pi) - 0.25
    tunes = tunes.reshape(*np.broadcast_shapes(np.shape(x), np.shape(y)), 2, 2)
    xp = _module_of(tunes)
    change = xp.linalg.norm(tunes[..., 1, :] - tunes[..., 0, :], axis=-1)
    tune = (tunes + _in_numpy(o.tune)[:2].reshape((1,) * (tunes.ndim - 1) + (2,))) % 1
    diffusion = xp.log10(xp.maximum(change, 1e-16))
    return jax.device_put(FrequencyMap(tune[..., 0, :], tune[..., 1, :], diffusion))


# JAX would compile each operation for each shape; it is needed for what is traced only.


def _in_numpy(array: Any) -> Any:
    return array if is_traced(array) else np.asarray(array)


def _module_of(array: Any) -> Any:
    """`jax.numpy` for what is traced, otherwise NumPy."""
    return jnp if is_traced(array) else np


def _first_loss(survive: Callable, rays: int, steps: int, rounds: int) -> Any:
    """The last r of each ray before the first loss, in (0, 1]."""
    low, width = np.zeros((rays, 1)), np.ones((rays, 1))
    for _ in range(whole("rounds", rounds)):
        shares = np.arange(1, whole("steps", steps, 2) + 1)[None] / steps
        survives = survive(low + width * shares)
        xp = _module_of(survives)
        survivals = xp.sum(xp.cumprod(survives, 1), 1, keepdims=True)
        low = low + width * survivals / steps
        width = xp.where(survivals == steps, 0.0, width / steps)
    return low[:, 0]


def _pieces(function: Callable, progress: Report, *arrays: Any) -> Any:
    """`function` of particles, arrays (…, 6) and (…), in batches of one size, with progress."""
    shape = arrays[0].shape[:-1]
    flat = [a.reshape(-1, *a.shape[len(shape) :]) for a in arrays]
    size = -(-len(flat[0]) // -(-len(flat[0]) // _BATCH))
    outs = []

    def columns(p: tuple[int, int]) -> dict[str, Any]:
        return {"completed": p[0], "total": p[1]}

    with reporter(progress, bar_of("particles", (), columns)) as report:
        for i in range(0, N := len(flat[0]), size):
            indices = np.minimum(np.arange(i, i + size), N - 1)
            outs.append(_in_numpy(function(*(a[indices] for a in flat))))
            if report:
                report((min(i + size, N), N))
    out = _module_of(outs[0]).concatenate(outs)[:N]
    return out.reshape(*shape, *out.shape[1:])
