"""The φ⁴ field in one to three dimensions: kinks, domain walls, waves at a temperature."""

import numpy as np

from ..base.checks import one_of, positive, whole
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
from ._problem import Problem, interval, library_problem


def _hamiltonian(ends, t0, t1, q0, p1, args):
    r"""H_D = Σ p1²/(2 dx^d) + dx^d [Σ (difference of neighbours)²/(2 dx²) + Σ (q0² − 1)²/4]."""
    return field_energy(q0, p1, args, ends, (q0**2 - 1) ** 2 / 4)


def kink(t, x, velocity=0.0):
    r"""u and ∂u/∂t of a kink of the field equation, which goes from −1 to 1.

        u = tanh(γ (x − vt)/√2),    γ = 1/√(1 − v²)

    Its energy is γ √8/3, and its momentum γ v √8/3.
    """
    width = np.sqrt(2 * (1 - velocity**2))
    u = np.tanh((np.asarray(x) - velocity * np.asarray(t)) / width)
    return u, -velocity / width * (1 - u**2)


def phi4(
    shape: int | tuple[int, ...] = 64, dx: float = 0.5,
    ends: str | tuple[str, ...] | None = None, start: str = "kink", *,
    velocity: float = 0.3, temperature: float = 0.05, seed: int = 0,
) -> Problem:  # fmt: skip
    r"""The φ⁴ field on a lattice of one to three dimensions: a moving kink, or waves.

        ∂²u/∂t² = ∇²u + u − u³

    Dimensionless. The differences in space have order 2 in dx; q = u, shape `shape`, and
    p = ∂u/∂t dx^d.

    - `ends`: "periodic", "fixed" or "free", or one of them for each axis. If left out: fixed along
      the first axis with a kink, which goes from −1 to 1, and periodic for all others. Beyond fixed
      ends u is ``args["left"]`` and ``args["right"]``, −1 and 1 with a kink, else 1.
    - `start`: "kink" with this velocity along the first axis, a plane wall in more dimensions; or
      "thermal", u = 1 and random velocities with this `temperature` (k_B T) and `seed`.

    The observables are `energy`, `field_momentum`, and `topological_charge` at free ends.

    **Raises** `ValueError` for fewer than three sites in a direction, unknown `ends` or `start`, a
    kink on a ring, a velocity not between −1 and 1, and a temperature that is negative.

    **Source** Campbell, Schonfeld & Wingate 1983, *Physica D* 9, 1.
    """
    sizes = shape_of("shape", shape)
    interval(-1.0, 1.0)("velocity", velocity)
    positive("temperature", temperature, zero=True)
    is_kink = one_of("start", start, ("kink", "thermal")) == "kink"
    first = ("fixed",) if is_kink else ("periodic",)
    kinds = ends_of(first + ("periodic",) * (len(sizes) - 1) if ends is None else ends, len(sizes))
    if is_kink:
        hint = "The field after a kink has the opposite sign."
        one_of("ends of the first axis with start='kink'", kinds[0], ("fixed", "free"), hint)
    x = places(sizes[0], dx).reshape(-1, *[1] * (len(sizes) - 1))
    u, rate = (np.broadcast_to(v, sizes).copy() for v in kink(0.0, x, velocity))
    cell = dx ** len(sizes)
    p = rate * cell
    if not is_kink:
        random = np.random.default_rng(whole("seed", seed, 0))
        u, p = np.ones(sizes), random.normal(size=sizes) * np.sqrt(temperature * cell)
    return library_problem(
        hamiltonian_of(_hamiltonian, kinds),
        start_of("the φ⁴ lattice", len(sizes)),
        parameters_of(dx, kinds, -1.0 if is_kink else 1.0, 1.0),
        observables_of(kinds, 2.0),
        name="phi4",
        q0_p0_h=(u, p, step_size(dx, len(sizes))),
        source="Campbell, Schonfeld & Wingate 1983, Physica D 9, 1",
    )
