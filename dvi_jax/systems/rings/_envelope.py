"""The equilibrium of damping and quantum excitation: Ohmi's envelope."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lanewise.jaxprs.jaxapi import is_traced

from ...base.checks import instance, require
from ...base.inputs import real_numbers
from ...base.printing import printable
from ._maps import KICKS, Particle
from ._optics import closed_orbit, maps, normal_modes
from ._ring import Ring


@printable
class Equilibrium(NamedTuple):
    """A beam in the equilibrium of damping and quantum excitation, at n places: the entrance of
    each element and the end. Modes are horizontal, vertical and longitudinal.

    - `orbit`: the closed orbit, shape (n, 6). `sigma`: the covariances of (x, px, y, py, ζ, δ),
      shape (n, 6, 6). `matrix`: the one-turn matrix, shape (6, 6).
    - `loss`: energy that a particle on the closed orbit loses in a turn [eV].
    - `damping_time`: of the amplitudes of the modes [s]; `partition`: the damping partition
      numbers, whose sum is 4. Shapes (3,).
    - `emittance`: of the modes [m], shape (3,). `energy_spread`, `bunch_length` [m]: roots of the
      covariances of δ and ζ at the start.
    """

    orbit: Array
    sigma: Array
    matrix: Array
    loss: Array
    damping_time: Array
    partition: Array
    emittance: Array
    energy_spread: Array
    bunch_length: Array


def equilibrium(ring: Ring, guess: Array | None = None, epsilon: float = 0.0) -> Equilibrium:
    r"""Emittances, energy spread, bunch length and damping times of a ring that radiates.

    Ohmi's envelope: with the derivative M of the one-turn map about the closed orbit in 6D, and
    with the covariance B of the kicks of the photons of one turn, the covariances Σ at the entrance
    of the ring solve

        Σ = M Σ Mᵀ + B,     B = Σ_k T_k g_k g_kᵀ T_kᵀ D |e × B|³ ds,  D = 55 ƛ r γ⁵/(24 √3)

    where the sum is over all kicks of all magnets, g = (0, px/p, 0, py/p, 0, 1) p² is the change
    of a particle by its loss of energy, and T the derivative of the map from there to the end. The
    emittance of a mode is √det of the covariances of its two normal coordinates. The eigenvalues
    of M have the moduli e^{−T/τ_k}, with the period T, and the partition numbers are proportional
    to 1/τ_k.

    **Arguments** `ring`: with radiation (`radiating`) and a cavity with a voltage. `guess`: of the
    closed orbit, shape (6,). `epsilon`: factor of what `Ring.perturbed` set aside.

    The result can be differentiated by the parameters of the ring. The dependence of an emittance
    of zero, in a flat ring, has the derivative zero.

    **Raises** `TypeError` for a ring without radiation or a voltage, `ValueError` if no closed
    orbit is found. If a mode is unstable or not damped there is no equilibrium: the result is NaN.

    **Source** Ohmi, Hirata & Oide 1994, *Phys. Rev. E* 49, 751. Between the kicks of a magnet pyAT
    leaves out the damping of the covariances.

    **Example** The horizontal emittance of a cell with a cavity:

    ```python
    cell = [rings.quadrupole("QF", 0.4, k1=1.3), rings.bend("B", 1.5, np.pi / 16),
            rings.quadrupole("QD", 0.4, k1=-1.3), rings.bend("B", 1.5, np.pi / 16),
            rings.cavity("RF", 0.0, voltage=1e-4, frequency=5e8)]
    ring = rings.in_phase(rings.radiating(rings.Ring(cell, energy=1e9)))
    beam = rings.equilibrium(ring)
    print(f"{1e9 * beam.emittance[0]:.2f} nm, loss {beam.loss:.1f} eV")
    # 125.05 nm, loss 723.7 eV
    ```
    """
    instance("ring", ring, Ring, "a rings.Ring")
    ring, values = ring.at(real_numbers("epsilon", epsilon)), {}
    for name, noun in (("loss", "magnets that radiate"), ("voltage", "a cavity with a voltage")):
        column = ring.columns.get(name)
        is_zero = not is_traced(column) and not np.any(np.asarray(0 if column is None else column))
        values[noun] = None if is_zero else column
    hint = "Use rings.radiating(ring) of a ring with a rings.cavity whose voltage is not zero."
    require("rings.equilibrium(ring)", values, hint=hint)
    return _equilibrium(ring, closed_orbit(ring, guess=guess))


def _moments(ring: Ring, orbit: Array) -> tuple[Array, Array, Array, np.ndarray]:
    """Orbit, matrix from the start and covariance of the kicks of photons before each piece of
    `maps` and at the end; the element of each piece."""
    apply, (table, numbers, steps), rows = maps(ring)
    parts = [ring.program.parts[k] for k, _ in ring.program.rows]
    # The signs of the lengths of the kicks.
    widest = max(steps.shape[1] - 1, *map(len, KICKS.values()))
    signs = np.pad(np.sign(steps[:, :-1]), ((0, 0), (0, widest + 1 - steps.shape[1])))
    for i in np.flatnonzero([parts[row].name == "second_order_bend" for row in rows]):
        kicks = KICKS[parts[rows[i]].scheme]
        signs[i, : len(kicks)] = np.sign(kicks)

    def piece(state, x):
        par, signs, *columns = x

        def image(z, noise):
            z = jnp.stack(apply(Particle(*z), ({**par, "noise": noise}, *columns)))
            return z, z

        z, M, B = state
        (J, G), z = jax.jacfwd(image, (0, 1), has_aux=True)(z, jnp.zeros(len(signs)))
        return (z, J @ M, J @ B @ J.T + (G * signs[None]) @ G.T), state

    begin, columns = (orbit, jnp.eye(6), jnp.zeros((6, 6))), (table, signs, numbers, steps)
    end, states = lax.scan(jax.checkpoint(piece), begin, columns)
    states = jax.tree.map(lambda x, y: jnp.concatenate([x, y[None]]), states, end)
    elements = np.asarray([element for _, element in ring.program.rows])[rows]
    return *states, elements


@eqx.filter_jit
def _equilibrium(ring: Ring, orbit: Array) -> Equilibrium:
    zs, Ms, Bs, elements = _moments(ring, orbit)
    M = Ms[-1]
    start = jnp.linalg.solve(jnp.eye(36) - jnp.kron(M, M), Bs[-1].ravel()).reshape(6, 6)
    v, _ = normal_modes(M, jnp.zeros_like(M))
    eigenvalues = jnp.sum(jnp.conj(v) * (v @ M.T), 1) / jnp.sum(jnp.abs(v) ** 2, 1)
    rates = -jnp.log(jnp.abs(eigenvalues))
    start = jnp.where(jnp.all(rates > 0), (start + start.T) / 2, jnp.nan)
    axes = jnp.stack([v.real, v.imag], 1).reshape(6, 6).T
    normal = jnp.linalg.solve(axes, jnp.linalg.solve(axes, start).T).reshape(3, 2, 3, 2)
    a, b, c = (jnp.einsum("kk->k", normal[:, i, :, j]) for i, j in ((0, 0), (1, 1), (0, 1)))
    mean = (a + b) / 2
    # √(ab − c²), with a derivative where it is zero.
    safe = jnp.where(mean > 0, mean, 1.0)
    emittance = mean * jnp.sqrt(1 - ((a - b) ** 2 / 4 + c * c) / safe**2)
    has_voltage = np.asarray(["voltage" in p for p in ring.program.parameters])[elements]
    index = np.searchsorted(elements, np.arange(len(ring) + 1))
    sigma = Ms @ start @ jnp.swapaxes(Ms, 1, 2) + Bs
    return Equilibrium(
        orbit=zs[index],
        sigma=sigma[index],
        matrix=M,
        loss=-ring.energy * jnp.sum(jnp.where(has_voltage, 0.0, jnp.diff(zs[:, 5]))),
        damping_time=ring.period / rates,
        partition=4 * rates / jnp.sum(rates),
        emittance=emittance,
        energy_spread=jnp.sqrt(start[5, 5]),
        bunch_length=jnp.sqrt(start[4, 4]),
    )
