"""Closed orbit, one-turn matrix, tunes, Twiss functions and dispersion of a ring."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, in_range, instance
from ...base.inputs import real_numbers
from ...base.printing import printable
from ._maps import Particle, RingPart, forward
from ._parts import pieces_of
from ._pieces import SLICED_PARTS, padded, pieces_in
from ._ring import Ring
from ._turn import Passage, compiled, coordinates, parameters_of

_MOST_ITERATIONS, _EXTRA_ITERATIONS, _SMALL = 15, 3, 1e-9
"""Newton iterations at most, and after the first correction that is smaller than the last one."""
_EQUAL = 1e-12
"""Difference of two eigenvalues that is round-off."""
_UNSTABLE = 1e-11
"""Area in phase space of an eigenvector of length 1, below which it is round-off."""


@printable
class Optics(NamedTuple):
    r"""Linear motion about the closed orbit, at n places: the entrance of each element and the end.

    - `s` [m], shape (n,); `orbit`, shape (n, 6). `matrix`: from the start, shape (n, 6, 6).
    - `beta` [m], `alpha`: of mode 1 in x and mode 2 in y, shape (n, 2); `mu`: phase advances [rad].
    - `dispersion` of x, px, y, py, shape (n, 4): the derivative of the closed orbit by δ in 4D; in
      6D that of the synchrotron mode, Re(v/v_δ).
    - `modes`: the vectors v of the normal modes, z = Re Σ_k √(2J_k) e^{iφ_k} v_k, shape
      (n, modes, 4 or 6): β_k = \|v_x\|², α_k = −Re v̄_x v_px.
    - `gamma`: γ of Edwards & Teng, shape (n,); their β and α are those here over γ².
    - `tune`, with its whole part, to which a part given as a matrix, such as pyAT's `M66`,
      contributes less than 1; that of the synchrotron motion is positive. `chromaticity`:
      dQ/dδ; in 6D the frequency of the cavities changes δ. Shapes (modes,).
    - `compaction`: momentum compaction, the relative change of the length over δ.
    """

    s: Array
    orbit: Array
    beta: Array
    alpha: Array
    mu: Array
    dispersion: Array
    modes: Array
    gamma: Array
    matrix: Array
    tune: Array
    chromaticity: Array
    compaction: Array


def one_turn(ring: Ring, z: Any, epsilon: Any = 0.0) -> Array:
    """The particle after one turn, without apertures: z and the result have the shape (…, 6).

    `epsilon`: factor of what `Ring.perturbed` set aside. It can be compiled, batched, and
    differentiated repeatedly in every mode. See `track` for the coordinates.
    """
    instance("ring", ring, Ring, "a rings.Ring")
    z, epsilon = coordinates("z", z), jnp.asarray(epsilon, float)
    return _image(Passage.from_ring(ring), z.reshape(-1, 6), epsilon).reshape(z.shape)


@eqx.filter_jit
def _image(passage: Passage, z: Array, epsilon: Array) -> Array:
    def image(passage, z, epsilon):
        return jnp.stack(passage.image(Particle(*z), 0, epsilon))

    return compiled(image, (None, 0, None), (passage, z, epsilon))


def closed_orbit(ring: Ring, dp: Any = None, guess: Any = None, epsilon: Any = 0.0) -> Array:
    """Closed orbit at the entrance of a ring, shape (6,); see `optics`. Also of unstable motion."""
    return _analyse(ring, dp, guess, epsilon, False, False).orbit[0]


def matrix(ring: Ring, dp: Any = None, guess: Any = None, epsilon: Any = 0.0) -> Array:
    """One-turn matrix of (x, px, y, py, ζ, δ) about the closed orbit, shape (6, 6); see `optics`.
    The motion may be unstable."""
    return _analyse(ring, dp, guess, epsilon, False, False).matrix[-1]


def optics(
    ring: Ring, dp: Any = None, guess: Any = None, epsilon: Any = 0.0, chromatic: bool = True
) -> Optics:
    r"""Closed orbit, Twiss functions, tunes, dispersion and chromaticity.

    The closed orbit F(z) = z is the limit of Newton's method with the exact derivative M of the
    one-turn map F. The normal modes are M v_k = e^{2πi Q_k} v_k, v_k† S v_k = 2i, and

        dQ_k/dδ = Im(e^{−2πi Q_k} w_k (dM/dδ) v_k) / 2π,   w_k M = e^{2πi Q_k} w_k, w_k v_k = 1,

    where dM/dδ is the exact derivative along the dispersion.

    **Arguments** `dp`: δ of a 4D analysis, in which the cavities are off and ζ is ignored; None: 6D
    if a cavity has a voltage, otherwise 4D with δ = 0. `guess`: of the closed orbit, shape (6,).
    `epsilon`: factor of what `Ring.perturbed` set aside. `chromatic`: whether to compute the
    chromaticity (otherwise NaN), which takes nearly half of the first call.

    The result can be differentiated twice, in every mode, by the parameters of the ring, dp and
    epsilon: iterations after convergence carry the derivatives. For planes of equal tune those by
    a coupling of the planes do not exist: do not use them.

    **Raises** `ValueError` if Newton's method finds no closed orbit, and if the motion about it is
    unstable; under a transformation of JAX the result is NaN instead.

    **Source** Courant & Snyder 1958; Edwards & Teng 1973; Wolski 2006, *PRSTAB* 9, 024001.

    **Example** Tunes of a FODO cell, matched by least squares:

    ```python
    import optimistix
    cell = rings.Ring([rings.quadrupole("QF", 0.5, k1=0.6), rings.drift("D", 2.0),
                       rings.quadrupole("QD", 0.5, k1=-0.6), rings.drift("D", 2.0)])
    def missed(k, _):
        found = rings.optics(cell.set("QF", b1=k[0]).set("QD", b1=k[1]), chromatic=False)
        return found.tune - jnp.array([0.22, 0.18])
    solver = optimistix.LevenbergMarquardt(1e-12, 1e-12)
    k = optimistix.least_squares(missed, solver, jnp.array([0.6, -0.6])).value
    print(rings.optics(cell.set("QF", b1=k[0]).set("QD", b1=k[1])).tune.round(6))
    # [0.22 0.18]
    ```
    """
    return _analyse(ring, dp, guess, epsilon, chromatic, True)


def _analyse(ring: Ring, dp: Any, guess: Any, epsilon: Any, chromatic: bool, stable: bool):
    instance("ring", ring, Ring, "a rings.Ring").check()
    ring = ring.at(real_numbers("epsilon", epsilon))
    voltage = ring.columns.get("voltage", np.zeros(1))
    six = dp is None and (is_traced(voltage) or bool(np.any(np.asarray(voltage) != 0)))
    z = coordinates("guess", np.zeros(6) if guess is None else guess)
    if dp is not None:
        dp = array("dp", real_numbers("dp", dp), (), hint="For several values use jax.vmap.")
        if not is_traced(dp):
            in_range("dp", dp, -1.0, 1.0, "It is Δp/p, not per cent.")
    if not six:
        xp = jnp if is_traced(z) or is_traced(dp) else np
        z = xp.where(np.arange(6) < 4, z, np.eye(6)[5] * xp.asarray(0.0 if dp is None else dp))
    twiss, change = analysis(ring, z, six, chromatic)
    if is_traced(change):
        return twiss
    if not change < _SMALL:
        raise ValueError(
            f"no closed orbit was found: correction {_MOST_ITERATIONS} of Newton's method is "
            f"{change:.2g}. Give a guess, such as the orbit with half of the errors."
        )
    if stable and np.isnan(twiss.tune).any():
        M = np.asarray(twiss.matrix[-1])[: twiss.modes.shape[-1], : twiss.modes.shape[-1]]
        half = [round(float(np.trace(M[i : i + 2, i : i + 2])) / 2, 4) for i in range(0, len(M), 2)]
        raise ValueError(
            f"the motion is unstable: half of the trace of the one-turn matrix is {half} in x, y "
            "(, ζ), not between −1 and 1, or its eigenvalues have moduli other than 1: "
            f"{np.sort(np.abs(np.linalg.eigvals(M))).round(6).tolist()}."
        )
    return twiss


def four(ring: Ring) -> Ring:
    """The ring with its cavities and its radiation off."""
    columns = dict(ring.columns)
    for name in {"voltage", "loss"} & columns.keys():
        columns[name] = jax.device_put(np.zeros(np.shape(columns[name])))
    return eqx.tree_at(lambda other: other.columns, ring, columns)


@functools.lru_cache(maxsize=64)
def map_of(kinds: tuple[RingPart, ...]) -> Callable:
    """``apply(z, x)`` of `maps`; nothing happens in a piece with the number after the last."""

    def apply(z, columns):
        par, part, steps = columns
        share = {**par, "length": jnp.sum(steps) * par["length"]}

        def kind_map(kind):
            pieces = pieces_of(kind)

            def kick(z, step):
                # The kick and its own drift, then half of the difference to the next one's.
                for piece, share in ((pieces[1], step[0]), (pieces[0], step[1] - step[0])):
                    values = {"noise": step[2:]} if "noise" in par else {}
                    values = {**values, "length": share * par["length"]}
                    z = piece.apply(z, {**par, **values}, 0, 1)
                return z, None

            if kind.name in SLICED_PARTS:
                noises = [par["noise"][: len(steps) - 1]] if "noise" in par else []
                rows = jnp.stack([steps[:-1], steps[1:], *noises], 1)
                return lambda z: lax.scan(kick, z, rows)[0]
            return lambda z: forward(pieces, z, share, 0, 1)

        return lax.switch(part, [*map(kind_map, kinds), lambda z: z], z)

    # Recomputed in reverse mode: otherwise each part stores what every kind of part would need.
    return jax.checkpoint(apply)


def maps(ring: Ring) -> tuple[Callable, Any, np.ndarray]:
    """``apply(z, x)``, the map of a piece of a part of an element, x for all pieces in a row, and
    for each piece the number of its part in `ring.program.rows`."""
    kinds, numbers, steps, rows = pieces_in(ring.program)
    table = parameters_of(ring.columns, ring.program, rows)
    return map_of(kinds), (table, numbers, steps), rows


@functools.partial(jax.jit, static_argnames=("kinds", "chromatic"))
def _passage(kinds: tuple[RingPart, ...], xs: Any, orbit: Any, D: Any, chromatic: bool):
    """The orbit and its derivative M after each piece, and the derivative of M at the end along D
    (NaN if not `chromatic`). A batch of directions of the derivative is one program."""
    apply = map_of(kinds)

    def states(xs, orbit):
        def row(particle, columns):
            particle = apply(particle, columns)
            return particle, jnp.stack(particle)

        end, zs = lax.scan(row, Particle(*orbit), xs)
        return zs, jnp.stack(end)

    def slopes(xs, direction, orbit):
        of_orbit = functools.partial(states, xs)
        (zs, _), (of_zs, of_end) = jax.jvp(of_orbit, (orbit,), (direction,))
        return (of_zs, of_end), zs

    def derivatives(xs, orbit, change, direction):
        of_orbit = functools.partial(slopes, xs, direction)
        if not chromatic:
            (of_zs, _), zs = of_orbit(orbit)
            return zs, of_zs, jnp.full(6, jnp.nan)
        (of_zs, _), (_, of_end), zs = jax.jvp(of_orbit, (orbit,), (change,), has_aux=True)
        return zs, of_zs, of_end

    # Eight directions fill a register.
    zs, Ms, dM = compiled(derivatives, (None, None, None, 0), (xs, orbit, D, np.eye(8, 6)))
    return zs[0], jnp.moveaxis(Ms[:6], 0, 2), dM[:6].T


def analysis(
    ring: Ring, start: Any, six: bool, chromatic: bool, by_part: bool = False
) -> tuple[Optics, Any]:
    """See `optics`; also the last correction of the closed orbit. `by_part`: before each piece of
    `pieces_in` and at the end, not at the elements (but for `s`)."""
    if any(map(is_traced, jax.tree.leaves((ring, start)))):
        return _compiled_analysis(ring, start, six, chromatic, by_part)
    # In NumPy, so that little has to be compiled: nothing for a second ring of the same parts.
    ring, start = jax.tree.map(np.asarray, (ring, start))
    with np.errstate(all="ignore"):
        twiss, size = _analysis(np, ring, start, six, chromatic, by_part)
    return jax.device_put(twiss), size


def _analysis(xp: Any, ring: Ring, z: Any, six: bool, chromatic: bool, by_part: bool):
    """With the functions of NumPy or of JAX, `xp`."""
    c, shift, n, (e_zeta, e_delta) = ring.columns, 0.0, 6 if six else 4, np.eye(6)[4:]
    if six:
        # The change of ζ per turn of a particle that keeps its phase in the cavities.
        active = c["voltage"] != 0
        slip = xp.where(active, c["slip"] / xp.where(active, c["wave_number"], 1.0), 0.0)
        shift = -xp.sum(slip) / xp.sum(active)
    (_, xs, pieces), kinds = maps(ring if six else four(ring)), pieces_in(ring.program).kinds
    rows = len(pieces) + 1
    if xp is np:
        xs = padded(xs, len(kinds), rows - 1)

    def iterate(state):
        z, D, _, count = state
        zs, Ms, dM = map(xp.asarray, _passage(kinds, xs, z, D, chromatic))
        zs = xp.concatenate([z[None], zs[: rows - 1]])
        Ms = xp.concatenate([np.eye(6)[None], Ms[: rows - 1]])
        M = Ms[-1]
        # D: change of the orbit if each turn is longer by the slip, so that δ changes by 1.
        right = xp.stack([zs[-1] - z - shift * e_zeta, e_zeta if six else M[:, 5]], 1)[:n]
        solution = _solve(xp, np.eye(n) - M[:n, :n], right)
        change, D = xp.pad(solution, ((0, 6 - n), (0, 0))).T
        slip = 1 / D[5] if six else -(M @ (D + e_delta))[4]
        D = D * slip if six else D + e_delta
        size = xp.max(xp.abs(change))
        count = xp.where((count > 0) | (size < _SMALL), count + 1, 0)
        return z + change, D, (zs, Ms, dM, D, slip, size), count

    shapes = (rows, 6), (rows, 6, 6), (6, 6), (6,), (), ()
    state = z, xp.asarray(e_delta), tuple(xp.full(x, np.nan) for x in shapes), xp.asarray(0)
    if xp is np:
        for _ in range(_MOST_ITERATIONS):
            state = state if state[3] > _EXTRA_ITERATIONS else iterate(state)
    else:
        state, _ = lax.scan(
            lambda s, _: (lax.cond(s[3] > _EXTRA_ITERATIONS, lambda s: s, iterate, s), None),
            state,
            None,
            _MOST_ITERATIONS,
        )
    *_, (zs, Ms, dM, D, slip, size), _ = state
    zs, Ms, slip = (xp.where(size < _SMALL, x, np.nan) for x in (zs, Ms, slip))
    v, chromaticity = normal_modes(Ms[-1, :n, :n], dM[:n, :n], xp)
    vs = xp.einsum("rij,kj->rki", Ms[:, :n, :n], v)
    upright = _upright(xp, ring, pieces, vs)
    x, px = (xp.diagonal(upright[:, :, i::2], axis1=1, axis2=2) for i in (0, 1))
    mu = xp.angle(x[1:] * xp.conj(x[:-1]))
    mu = xp.where(np.arange(n // 2)[None] < 2, (mu + 0.5) % (2 * np.pi) - 0.5, mu)
    mu = xp.concatenate([xp.zeros((1, n // 2)), xp.cumsum(mu, 0)])
    Ds = xp.real(vs[:, 2] / vs[:, 2, 5:]) if six else Ms @ D
    elements = np.asarray(ring.program.rows)[pieces, 1]
    index = np.searchsorted(elements, np.arange(len(ring) + 1))
    index, tune = np.arange(rows) if by_part else index, mu[-1] / (2 * np.pi)
    places = xp.asarray(ring.places)
    twiss = Optics(
        s=places,
        orbit=zs[index],
        beta=xp.abs(x[index, :2]) ** 2,
        alpha=-xp.real(xp.conj(x) * px)[index, :2],
        mu=mu[index],
        dispersion=Ds[index, :4],
        modes=vs[index],
        gamma=xp.sqrt(xp.imag(xp.conj(x) * px)[index, 0]),
        matrix=Ms[index],
        tune=xp.abs(tune),
        chromaticity=xp.sign(tune) * chromaticity,
        compaction=slip / places[-1],
    )
    return twiss, size


_compiled_analysis = eqx.filter_jit(functools.partial(_analysis, jnp))


def _solve(xp: Any, matrix: Any, right: Any) -> Any:
    """The solution of a linear system; NaN for a singular one, for which NumPy raises an error."""
    try:
        return xp.linalg.solve(matrix, right)
    except np.linalg.LinAlgError:
        return np.full(right.shape, np.nan)


FRAMES: dict[str, Callable] = {
    "placed": lambda c: c["roll"],
    "moved": lambda c: c["roll"],
    "tilted": lambda c: c["tilt"],
    "affine": lambda c: jnp.arctan2(c["matrix_in"][:, 0, 2], c["matrix_in"][:, 0, 0]),
}
"""The angle about the s-axis to the frame inside of these parts, from the columns of a ring."""


def _upright(xp: Any, ring: Ring, pieces: np.ndarray, v: Any) -> Any:
    """Vectors v before each piece and at the end, in axes that are not rolled or tilted: in those
    of a magnet that is rolled by π/2, mode 1 has no component along x, whose phase is measured."""
    part, element = np.asarray(ring.program.rows).T
    names = np.asarray([p.name for p in ring.program.parts])[part]
    angle = np.zeros(len(names))
    for frame, turn in FRAMES.items():
        last = names == f"{frame}_out"
        # A matrix in the place of a magnet has no affine map at its end.
        first = (names == f"{frame}_in") & np.isin(element, element[last])
        if last.any():
            angle = angle + (first * 1.0 - last) * xp.asarray(turn(ring.columns))[element]
    angle = xp.append(xp.zeros(1), xp.cumsum(angle)[pieces])[:, None, None]
    cos, sin, x, y = xp.cos(angle), xp.sin(angle), v[..., :2], v[..., 2:4]
    return xp.concatenate([cos * x - sin * y, cos * y + sin * x, v[..., 4:]], -1)


def normal_modes(M: Any, dM: Any, xp: Any = jnp) -> tuple[Any, Any]:
    """Vectors v_k of the normal modes of M, v_k† S v_k = 2i, in the order of the planes, with a
    real component in their own plane, and the derivative of their tunes by δ; NaN if unstable."""
    n = len(M)

    def area(v):
        """Of x and px, y and py, …"""
        return xp.imag(xp.conj(v[::2]) * v[1::2])

    # NumPy raises an error for NaN.
    V = xp.linalg.eig(xp.nan_to_num(M if xp is np else lax.stop_gradient(M)))[1] + 0j
    areas, order = area(V), []
    penalty = xp.where(xp.sum(areas, 0) > _UNSTABLE, 0.0, np.inf)
    stable = xp.sum(penalty == 0) == n // 2
    for plane in range(n // 2):
        order.append(xp.argmax(areas[plane] - penalty))
        penalty = xp.where(np.arange(n) == order[-1], np.inf, penalty)
    V = xp.where(stable, V[:, xp.stack(order)], xp.nan)
    V = xp.concatenate([V, xp.conj(V)], 1)
    W = xp.linalg.inv(V)
    # Newton's method, W M V diagonal with W V = 1, for the derivatives, which `eig` does not have.
    for _ in range(2):
        R = W @ M @ V
        r = xp.diagonal(R)
        gaps = r[None] - r[:, None]
        equal = xp.abs(gaps) < _EQUAL  # itself, or a mode of equal tune in another plane
        X = xp.where(equal, 0.0, R / xp.where(equal, 1.0, gaps))
        V, W = V + V @ X, W - X @ W + X @ X @ W
    V, W = V[:, : n // 2], W[: n // 2]
    change = xp.sum(W @ dM * V.T, 1) / xp.sum(W @ M * V.T, 1)
    component = xp.diagonal(V[::2])
    size = component / xp.abs(component) * xp.sqrt(xp.sum(area(V), 0))
    return (V / size[None]).T, change.imag / (2 * np.pi)
