"""Particles with Lennard-Jones forces: a fluid in a periodic box, or a cluster."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import in_range, one_of, positive, whole
from ..discover.symmetries.library import rotation, space_translation
from ._problem import Parameter, Problem, Start, library_problem
from .n_body import angular_momentum, check_apart, linear_momentum

_CLOSEST = 0.8
"""Least distance of neighbours at the start [σ], where the energy of a pair is 43 depths."""


def pair_energy(r, args):
    r"""Energy of a pair at the distance r, without the cut-off: 4 depth [(σ/r)¹² − (σ/r)⁶]."""
    attraction = (args["sigma"] / r) ** 6
    return 4 * args["depth"] * (attraction**2 - attraction)


def _pair_force(r, args):
    """−dV/dr of `pair_energy`."""
    attraction = (args["sigma"] / r) ** 6
    return 24 * args["depth"] * (2 * attraction**2 - attraction) / r


def hamiltonian(t0, t1, q0, p1, args):
    r"""H_D = Σ_i |p1_i|²/(2m) + Σ_{i<j} V(r_ij),    V(r) = U(r) − U(c) − (r − c) U′(c) for r < c.

    U is `pair_energy`. V and the force are continuous at the cut-off c = ``args["cutoff"]``, and
    zero beyond it. Without that parameter V = U at all distances.

    With ``args["box"]``, the side of a cubic box, r_ij is the distance to the nearest periodic
    image of particle j; the positions themselves stay unbounded.
    """
    # All pairs, twice: dense arrays with a mask, since a list of pairs would gather and scatter.
    apart = q0[:, None, :] - q0[None, :, :]
    if "box" in args:
        apart = apart - args["box"] * jnp.round(apart / args["box"])
    square = jnp.sum(apart**2, axis=-1)
    active = ~jnp.eye(q0.shape[0], dtype=bool)
    if "cutoff" in args:
        active = active & (square < args["cutoff"] ** 2)
    # At a constant distance where there is no force, so that no derivative is infinite.
    r = jnp.sqrt(jnp.where(active, square, args["sigma"] ** 2))
    energy = pair_energy(r, args)
    if "cutoff" in args:
        c = args["cutoff"]
        energy = energy - pair_energy(c, args) + (r - c) * _pair_force(c, args)
    kinetic = jnp.sum(p1**2) / (2 * args["mass"])
    return kinetic + jnp.sum(jnp.where(active, energy, 0.0)) / 2


def temperature(t0, t1, q0, p0, q1, p1, args):
    """k_B T = Σ_i |p_i − ⟨p⟩|²/(d m (n − 1)) at t1: of the motion about the centre of mass."""
    n, dim = q1.shape
    relative = p1 - jnp.mean(p1, axis=0, keepdims=True)
    return jnp.sum(relative**2) / (dim * args["mass"] * (n - 1))


def centre_of_mass(t0, t1, q0, p0, q1, p1, args):
    """⟨q⟩ − t1 ⟨p⟩/m, shape (3,): the centre of mass at t = 0, which is constant."""
    return jnp.mean(q1, axis=0) - t1 * jnp.mean(p1, axis=0) / args["mass"]


def crystal(n, spacing):
    """The first n sites of a cubic face-centred lattice [unit of spacing], shape (n, 3)."""
    side = int(np.ceil((n / 4) ** (1 / 3) - 1e-9))
    cells = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 1, 3)
    basis = np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]]) / 2
    return spacing * (cells + basis).reshape(-1, 3)[:n]


def lennard_jones(
    n: int = 32, box: float | None = None, periodic: bool = True, *, cutoff: float | None = None,
    temperature: float = 1.0, density: float = 0.5, seed: int = 0,
) -> Problem:  # fmt: skip
    r"""n particles with Lennard-Jones forces in a periodic box, or a free cluster of them.

        H = Σ_i |p_i|²/(2m) + Σ_{i<j} V(r_ij),    U(r) = 4 depth [(σ/r)¹² − (σ/r)⁶]

    In reduced units: mass, depth and σ are 1. The particles begin on a cubic face-centred lattice,
    with random velocities of the given `temperature` (k_B T) and `seed`, and total momentum zero.
    q and p have shape (n, 3); positions are not reduced to the box.

    - `box`: side of the cubic box [σ]; the default has this `density` [1/σ³]. Each pair interacts
      through the nearest image.
    - `cutoff` c [σ]: 2.5, or half of the box if that is smaller. There, energy and force of a pair
      are continuous: V(r) = U(r) − U(c) − (r − c) U′(c).
    - `periodic`: False for a cluster in free space; its default is no cut-off, and its sites are
      those of the ground state of a large crystal at pressure zero.

    The observables are `energy`, `linear_momentum`, `centre_of_mass` (at t = 0), `temperature`, and
    `angular_momentum` of a cluster. All pairs are evaluated: the time of a step grows with n².

    **Raises** `ValueError` for fewer than two particles, those that overlap (closer than 0.8 σ), a
    cut-off above half of the box, and sizes, temperatures and densities that are not positive.

    **Source** Lennard-Jones 1931, *Proc. Phys. Soc.* 43, 461; cut-off: Toxvaerd & Dyre 2011,
    *J. Chem. Phys.* 134, 081102.
    """
    n = whole("n", n, 2, hint="A gas has at least two particles.")
    positive("temperature", temperature, zero=True)
    cells = int(np.ceil((n / 4) ** (1 / 3) - 1e-9))
    parameters = {
        "mass": Parameter(1.0, "of a particle [mass]"),
        "depth": Parameter(1.0, "depth of the minimum of U [energy]"),
        "sigma": Parameter(1.0, "distance at which U is zero [length]"),
    }
    if periodic:
        side = (n / positive("density", density)) ** (1 / 3) if box is None else box
        parameters["box"] = Parameter(positive("box", side), "side of the cubic box [length]")
        cutoff = min(2.5, side / 2) if cutoff is None else cutoff
        _check_cutoff(cutoff, side)
        spacing = side / cells
    else:
        one_of("box with periodic=False", box, (None,))
        spacing = 1.542  # [σ] of the crystal at rest without pressure
    if cutoff is not None:
        parameters["cutoff"] = Parameter(cutoff, "distance without force [length]")
    distance = np.sqrt(0.5) * spacing
    if distance < _CLOSEST:
        raise ValueError(
            f"box must be at least {cells * _CLOSEST / np.sqrt(0.5):.4g} for n = {n}, so that the "
            f"particles begin {_CLOSEST} σ apart or more, got box = {cells * spacing:.4g}, where "
            f"they are {distance:.3g} σ apart. Give a larger box or fewer particles."
        )
    q0, p0 = crystal(n, spacing), np.random.default_rng(seed).normal(size=(n, 3))
    p0 -= p0.mean(axis=0)
    p0 *= np.sqrt(3 * (n - 1) * temperature / np.sum(p0**2))
    axes = "xyz"
    symmetries = {f"translation_{x}": space_translation(np.eye(3)[i]) for i, x in enumerate(axes)}
    observables = [linear_momentum, centre_of_mass, _TEMPERATURE]
    if not periodic:
        pairs = ((0, 1), (0, 2), (1, 2))
        symmetries |= {f"rotation_{axes[i]}{axes[j]}": rotation(i, j) for i, j in pairs}
        observables.append(angular_momentum)
    return library_problem(
        hamiltonian,
        Start("particles in space", (None, 3), check=_check, smallest=2),
        parameters,
        observables,
        name="lennard_jones",
        q0_p0_h=(q0, p0, 0.005),
        source="Lennard-Jones 1931, Proc. Phys. Soc. 43, 461",
        invariants=("linear_momentum", "centre_of_mass", *["angular_momentum"] * (not periodic)),
        symmetries=symmetries,
    )


_TEMPERATURE = temperature
"""The observable, for the function in which this name is an argument."""


def _check_cutoff(cutoff, box):
    hint = "It is at most half of the box, because each pair interacts through one image."
    in_range("cutoff", cutoff, 0.0, box / 2 * (1 + 1e-12), hint)


def _check(q, p, args):
    apart, box = q[:, None] - q[None], args.get("box")
    if box is not None:
        _check_cutoff(args.get("cutoff", 0.0), box)
        apart = apart - box * np.round(apart / box)
    check_apart(np.triu(np.max(np.abs(apart), axis=-1) == 0, k=1), q, "particle {}".format)
