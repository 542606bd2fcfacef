"""Closed orbit, one-turn matrix, tunes, Twiss functions and dispersion of a ring."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

import lanewise
from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import array, in_range, instance
from ...base.inputs import real_numbers
from ...base.printing import printable
from ._maps import KICKS, Particle, RingPart, distinct, forward
from ._parts import pieces_of
from ._ring import Ring
from ._turn import Passage, coordinates

SLICED_PARTS = "straight", "bend", "exact_straight", "exact_bend", "at_exact_bend"
_MOST_ITERATIONS, _EXTRA_ITERATIONS, _SMALL = 15, 3, 1e-9
"""Newton iterations at most, and after the first correction that is smaller than the last one."""
_EQUAL = 1e-12
"""Difference of two eigenvalues that is round-off."""
_KICKS = 12
"""Most kicks in a piece of a magnet, so that its phase advance is less than 2π."""
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
    passage = Passage.from_ring(ring)

    def image(passage, z, epsilon):
        return jnp.stack(passage.image(Particle(*z), 0, epsilon))

    def turn_map(z):
        return lanewise.call(image, passage, z, jnp.asarray(epsilon, float))

    z = coordinates("z", z)
    return jax.vmap(turn_map)(z.reshape(-1, 6)).reshape(z.shape) if z.ndim > 1 else turn_map(z)


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
        z = z.at[4].set(0.0).at[5].set(0.0 if dp is None else dp)
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
    """The ring with its cavities off."""
    columns = dict(ring.columns)
    if "voltage" in columns:
        columns["voltage"] = jnp.zeros_like(columns["voltage"])
    return eqx.tree_at(lambda other: other.columns, ring, columns)


def _kick_shares(part: RingPart) -> list[np.ndarray]:
    """The pieces of a part, as kicks over its length: their sums are shares of its length."""
    if part.name in SLICED_PARTS:
        kicks, n = KICKS[part.scheme], part.slices
        limit = max(1, _KICKS // len(kicks))
        return [np.array([0.0, *kicks * min(limit, n - i)]) / n for i in range(0, n, limit)]
    count = {"solenoid": 8, "second_order_bend": part.slices}.get(part.name, 1)
    return [np.array([1 / count])] * count


def maps(ring: Ring) -> tuple[Callable, Any, np.ndarray]:
    """``apply(z, x)``, the map of a piece of a part of an element, x for all pieces in a row, and
    for each piece the number of its part in `ring.program.rows`.

    Less code is compiled than for tracking: magnets in slices of any number and scheme are one
    sequence of kicks, with drifts between them.
    """
    passage = Passage.from_ring(ring)
    parts, thick = passage.parts, {"scheme": 2, "slices": 1}
    order = max(p.order for p in parts)
    changes = {**dict.fromkeys(SLICED_PARTS, thick), "second_order_bend": {"slices": 1}}
    kinds = [p._replace(order=order, **changes.get(p.name, {})) for p in parts]
    all_kinds = distinct(kinds)
    numbers = np.asarray([all_kinds.index(kind) for kind in kinds], np.int32)
    pieces = [_kick_shares(p) for p in parts]
    part, width = passage.numbers["part"], max(len(k) for p in pieces for k in p)
    steps = np.stack([np.pad(k, (0, width + 1 - len(k))) for i in part for k in pieces[i]])
    rows = np.repeat(np.arange(len(part)), [len(pieces[i]) for i in part])

    def apply(z, columns):
        par, part, steps = columns
        share = {**par, "length": jnp.sum(steps) * par["length"]}

        def kind_map(kind):
            pieces = pieces_of(kind)

            def kick(z, step):
                # The kick and its own drift, then half of the difference to the next one's.
                for piece, share in ((pieces[1], step[0]), (pieces[0], step[1] - step[0])):
                    z = piece.apply(z, {**par, "length": share * par["length"]}, 0, 1)
                return z, None

            if kind.name in SLICED_PARTS:
                return lambda z: lax.scan(kick, z, jnp.stack([steps[:-1], steps[1:]], 1))[0]
            return lambda z: forward(pieces, z, share, 0, 1)

        return lax.switch(part, [kind_map(kind) for kind in all_kinds], z)

    # Recomputed in reverse mode: otherwise each part stores what every kind of part would need.
    table = jax.tree.map(lambda column: column[rows], passage.rows)
    return jax.checkpoint(apply), (table, numbers[part][rows], steps), rows


@eqx.filter_jit
def analysis(
    ring: Ring, z: Array, six: bool, chromatic: bool, by_part: bool = False
) -> tuple[Optics, Array]:
    """See `optics`; also the last correction of the closed orbit. `by_part`: before each piece of
    `maps` and at the end, not at the elements (but for `s`)."""
    c, shift, n, (e_zeta, e_delta) = ring.columns, 0.0, 6 if six else 4, np.eye(6)[4:]
    if six:
        # The change of ζ per turn of a particle that keeps its phase in the cavities.
        active = c["voltage"] != 0
        slip = jnp.where(active, c["slip"] / jnp.where(active, c["wave_number"], 1.0), 0.0)
        shift = -jnp.sum(slip) / jnp.sum(active)
    apply, xs, pieces = maps(ring if six else four(ring))

    def states(z):
        zs = lax.scan(lambda z, x: (apply(z, x),) * 2, Particle(*z), xs)[1]
        zs = jnp.concatenate([z[None], jnp.stack(zs, 1)])
        return zs, zs

    linear = jax.jacfwd(states, has_aux=True)

    def iterate(state):
        z, D, _, count = state
        if chromatic:
            (Ms, zs), (dMs, _) = jax.jvp(linear, (z,), (D,))
        else:
            (Ms, zs), dMs = linear(z), jnp.full((1, 6, 6), jnp.nan)
        M = Ms[-1]
        # D: change of the orbit if each turn is longer by the slip, so that δ changes by 1.
        right = jnp.stack([zs[-1] - z - shift * e_zeta, e_zeta if six else M[:, 5]], 1)[:n]
        change, D = jnp.pad(jnp.linalg.solve(np.eye(n) - M[:n, :n], right), ((0, 6 - n), (0, 0))).T
        slip = 1 / D[5] if six else -(M @ (D + e_delta))[4]
        D = D * slip if six else D + e_delta
        size = jnp.max(jnp.abs(change))
        count = jnp.where((count > 0) | (size < _SMALL), count + 1, 0)
        return z + change, D, (zs, Ms, dMs[-1], D, slip, size), count

    shapes = (rows := len(xs[-1]) + 1, 6), (rows, 6, 6), (6, 6), (6,), (), ()
    begin = z, jnp.asarray(e_delta), tuple(jnp.full(x, jnp.nan) for x in shapes), jnp.asarray(0)
    (*_, (zs, Ms, dM, D, slip, size), _), _ = lax.scan(
        lambda s, _: (lax.cond(s[3] > _EXTRA_ITERATIONS, lambda s: s, iterate, s), None),
        begin,
        None,
        _MOST_ITERATIONS,
    )
    zs, Ms, slip = (jnp.where(size < _SMALL, x, jnp.nan) for x in (zs, Ms, slip))
    v, chromaticity = _modes(Ms[-1, :n, :n], dM[:n, :n])
    vs = jnp.einsum("rij,kj->rki", Ms[:, :n, :n], v)
    upright = _upright(ring, pieces, vs)
    x, px = (jnp.diagonal(upright[:, :, i::2], axis1=1, axis2=2) for i in (0, 1))
    mu = jnp.angle(x[1:] * jnp.conj(x[:-1]))
    mu = jnp.where(np.arange(n // 2)[None] < 2, (mu + 0.5) % (2 * np.pi) - 0.5, mu)
    mu = jnp.concatenate([jnp.zeros((1, n // 2)), jnp.cumsum(mu, 0)])
    Ds = jnp.real(vs[:, 2] / vs[:, 2, 5:]) if six else Ms @ D
    elements = np.asarray([element for _, element in ring.program.rows])[pieces]
    index = np.searchsorted(elements, np.arange(len(ring) + 1))
    index, tune = np.arange(rows) if by_part else index, mu[-1] / (2 * np.pi)
    twiss = Optics(
        s=ring.places,
        orbit=zs[index],
        beta=jnp.abs(x[index, :2]) ** 2,
        alpha=-jnp.real(jnp.conj(x) * px)[index, :2],
        mu=mu[index],
        dispersion=Ds[index, :4],
        modes=vs[index],
        gamma=jnp.sqrt(jnp.imag(jnp.conj(x) * px)[index, 0]),
        matrix=Ms[index],
        tune=jnp.abs(tune),
        chromaticity=jnp.sign(tune) * chromaticity,
        compaction=slip / ring.places[-1],
    )
    return twiss, size


FRAMES: dict[str, Callable] = {
    "placed": lambda c: c["roll"],
    "moved": lambda c: c["roll"],
    "tilted": lambda c: c["tilt"],
    "affine": lambda c: jnp.arctan2(c["matrix_in"][:, 0, 2], c["matrix_in"][:, 0, 0]),
}
"""The angle about the s-axis to the frame inside of these parts, from the columns of a ring."""


def _upright(ring: Ring, pieces: np.ndarray, v: Array) -> Array:
    """Vectors v before each piece and at the end, in axes that are not rolled or tilted: in those
    of a magnet that is rolled by π/2, mode 1 has no component along x, whose phase is measured."""
    part, element = np.asarray(ring.program.rows).T
    names = np.asarray([p.name for p in ring.program.parts])[part]
    angle = jnp.zeros(len(names))
    for frame, turn in FRAMES.items():
        last = names == f"{frame}_out"
        # A matrix in the place of a magnet has no affine map at its end.
        first = (names == f"{frame}_in") & np.isin(element, element[last])
        if last.any():
            angle += (first * 1.0 - last) * turn(ring.columns)[element]
    angle = jnp.append(jnp.zeros(1), jnp.cumsum(angle)[pieces])[:, None, None]
    cos, sin, x, y = jnp.cos(angle), jnp.sin(angle), v[..., :2], v[..., 2:4]
    return jnp.concatenate([cos * x - sin * y, cos * y + sin * x, v[..., 4:]], -1)


def _modes(M: Array, dM: Array) -> tuple[Array, Array]:
    """Vectors v_k of the normal modes of M, v_k† S v_k = 2i, in the order of the planes, with a
    real component in their own plane, and the derivative of their tunes by δ; NaN if unstable."""
    n = len(M)

    def area(v):
        """Of x and px, y and py, …"""
        return jnp.imag(jnp.conj(v[::2]) * v[1::2])

    _, V = jnp.linalg.eig(lax.stop_gradient(M))
    areas, order = area(V), []
    penalty = jnp.where(jnp.sum(areas, 0) > _UNSTABLE, 0.0, np.inf)
    stable = jnp.sum(penalty == 0) == n // 2
    for plane in range(n // 2):
        order.append(jnp.argmax(areas[plane] - penalty))
        penalty = penalty.at[order[-1]].set(np.inf)
    V = jnp.where(stable, V[:, jnp.stack(order)], jnp.nan)
    V = jnp.concatenate([V, jnp.conj(V)], 1)
    W = jnp.linalg.inv(V)
    # Newton's method, W M V diagonal with W V = 1, for the derivatives, which `eig` does not have.
    for _ in range(2):
        R = W @ M @ V
        r = jnp.diagonal(R)
        gaps = r[None] - r[:, None]
        equal = jnp.abs(gaps) < _EQUAL  # itself, or a mode of equal tune in another plane
        X = jnp.where(equal, 0.0, R / jnp.where(equal, 1.0, gaps))
        V, W = V + V @ X, W - X @ W + X @ X @ W
    V, W = V[:, : n // 2], W[: n // 2]
    change = jnp.sum(W @ dM * V.T, 1) / jnp.sum(W @ M * V.T, 1)
    component = jnp.diagonal(V[::2])
    size = component / jnp.abs(component) * jnp.sqrt(jnp.sum(area(V), 0))
    return (V / size[None]).T, change.imag / (2 * np.pi)
