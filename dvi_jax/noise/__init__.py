"""Noise: what it does to a system, and the Brownian paths that drive it."""

from ._models import (
    Langevin as Langevin,
    Noise as Noise,
    NoiseHamiltonians as NoiseHamiltonians,
    as_noise as as_noise,
)
from ._paths import (
    Brownian as Brownian,
    BrownianPath as BrownianPath,
    NoisePath as NoisePath,
    as_path as as_path,
)
