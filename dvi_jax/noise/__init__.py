"""Noise: what it does to a system, and the Brownian paths that drive it."""

from ._models import (
    Langevin as Langevin,
    MomentumNoise as MomentumNoise,
    Noise as Noise,
    NoiseHamiltonians as NoiseHamiltonians,
    as_noise as as_noise,
)
from ._paths import (
    Brownian as Brownian,
    Increments as Increments,
    NoisePath as NoisePath,
    Path as Path,
    as_path as as_path,
)
