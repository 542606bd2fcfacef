"""Alpha particles in a quasi-axisymmetric stellarator, for alpha_losses.toml next to this file."""

from dvi_jax import systems
from dvi_jax.systems import boozer

alphas = boozer.GuidingCentres(boozer.precise_qa())
q0, p0, args = alphas.start(s=0.25, theta=0.2, zeta=0.4, pitch=-0.25)
alpha = systems.Problem("alpha", alphas.system, q0, p0, alphas.h, args)
births = boozer.Births(1000, alphas, seed=1)
loss = alphas.loss


def energy(t0, t1, q0, p0, q1, p1, args):
    """2H, which is 1 for all particles."""
    return 2 * alphas.system.hamiltonian(t1, t1, q1, p1, 0.0, args)
