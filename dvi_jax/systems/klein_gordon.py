"""The Klein–Gordon field in one to three dimensions: waves with dispersion, solved exactly."""

import jax.numpy as jnp
import numpy as np

from ..base.checks import finite, positive
from ._fields import (
    ends_of,
    field_energy,
    hamiltonian_of,
    observables_of,
    parameters_of,
    places,
    shape_of,
    start_of,
    step_size,
)
from ._problem import Parameter, Problem, library_problem, over_times


def _hamiltonian(ends, t0, t1, q0, p1, args):
    r"""H_D = Σ p1²/(2 dx^d) + dx^d [Σ (difference of neighbours)²/(2 dx²) + m² Σ q0²/2]."""
    return field_energy(q0, p1, args, ends, args["mass"] ** 2 * q0**2 / 2)


def frequency(k, args):
    """ω = √(m² + Σ_i (2/dx)² sin²(k_i dx/2)) of a wave on the lattice; k: shape (..., dim)."""
    dx = args["dx"]
    sines = (2 / dx * jnp.sin(jnp.asarray(k) * dx / 2)) ** 2
    return jnp.sqrt(args["mass"] ** 2 + jnp.sum(sines, axis=-1))


@over_times()
def _exact(t, q0, p0, args):
    """Each wave of a ring turns with its own frequency."""
    dx, shape = args["dx"], q0.shape
    numbers = [*map(np.fft.fftfreq, shape[:-1]), np.fft.rfftfreq(shape[-1])]
    k = np.stack(np.meshgrid(*numbers, indexing="ij"), axis=-1) * 2 * np.pi
    omega = frequency(jnp.asarray(k, q0.dtype) / dx, args)
    u, v = jnp.fft.rfftn(q0), jnp.fft.rfftn(p0 / dx**q0.ndim)
    # sin(ωt)/ω, also for the uniform wave of a field without mass
    small = jnp.where(omega > 0, omega, 1)
    ratio = jnp.where(omega > 0, jnp.sin(omega * t) / small, t)
    turned = jnp.cos(omega * t) * u + ratio * v, jnp.cos(omega * t) * v - omega**2 * ratio * u
    q, rate = (jnp.fft.irfftn(wave, shape) for wave in turned)
    return q, rate * dx**q0.ndim


def klein_gordon(
    shape: int | tuple[int, ...] = 64, dx: float = 0.5, ends: str | tuple[str, ...] = "periodic",
    *, mass: float = 1.0, wave_number: float = 1.0, width: float = 4.0,
) -> Problem:  # fmt: skip
    r"""The Klein–Gordon field on a lattice of one to three dimensions: a packet of waves.

        ∂²u/∂t² = ∇²u − m²u

    Dimensionless. The differences in space have order 2 in dx; q = u, shape `shape`, and
    p = ∂u/∂t dx^d. A wave exp(i(k·x − ωt)) has the frequency ω² = m² + Σ_i (2/dx)² sin²(k_i dx/2).

    - `ends`: "periodic", "fixed" or "free", or one of them for each axis. Beyond fixed ends u is
      ``args["left"]`` and ``args["right"]``, 0 by default. The exact solution is for rings.
    - `mass`: m, or 0 for the wave equation. `wave_number` k and `width` w of the packet
      exp(−x²/(2w²)) cos(kx), which moves along the first axis.

    The observables are `energy` and `field_momentum`, which is conserved on rings.

    **Raises** `ValueError` for fewer than three sites in a direction, unknown `ends`, a negative
    mass, and a width that is not positive.

    **Source** Morse & Feshbach 1953, *Methods of Theoretical Physics*, 2.1.
    """
    sizes = shape_of("shape", shape)
    kinds = ends_of(ends, len(sizes))
    parameters = parameters_of(dx, kinds, 0.0, 0.0)
    parameters["mass"] = Parameter(mass, "smallest frequency m of a wave [1/time]", _not_negative)
    _not_negative("mass", mass)
    axes = np.meshgrid(*(places(size, dx) for size in sizes), indexing="ij")
    envelope = np.exp(-sum(x**2 for x in axes) / (2 * positive("width", width) ** 2))
    phase = finite("wave_number", wave_number) * axes[0]
    omega = np.sqrt(mass**2 + (2 / dx * np.sin(wave_number * dx / 2)) ** 2)
    q0, p0 = envelope * np.cos(phase), dx ** len(sizes) * omega * envelope * np.sin(phase)
    is_ring = set(kinds) == {"periodic"}
    return library_problem(
        hamiltonian_of(_hamiltonian, kinds),
        start_of("the Klein–Gordon lattice", len(sizes)),
        parameters,
        observables_of(kinds),
        name="klein_gordon",
        q0_p0_h=(q0, p0, step_size(dx, len(sizes))),
        source="Morse & Feshbach 1953, Methods of Theoretical Physics, 2.1",
        invariants=("field_momentum",) * is_ring,
        exact=_exact if is_ring else None,
    )


def _not_negative(name, value):
    positive(name, value, zero=True)
