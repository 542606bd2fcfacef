"""Collisions of alpha particles: scattering of the pitch angle, and the radial diffusion it causes.

In an axisymmetric field the momentum p_ζ is conserved without collisions. Scattering by the angle
changes v∥ at constant energy and position, and so p_ζ and the magnetic moment μ:

    dξ = −ν ξ dt + √(ν (1 − ξ²)) dB (Itô),    ξ = v∥/v,    dp_ζ = (G/B) dv∥,    dμ = −(v∥/B) dv∥

which is −νξ/2 dt + √(ν (1 − ξ²)) ∘ dB in the sense of Stratonovich. The gyrophase φ and μ are here
a third pair of coordinates of the guiding centre, so that μ can change: noise on the momenta that
depends on them. The measured diffusion of p_ζ is compared with its average along the orbit without
collisions, for passing and trapped particles of 100 keV.

Run: python examples/alpha_collisions.py
"""

import jax
import jax.numpy as jnp
import numpy as np

import dvi_jax as dvi
from dvi_jax.systems import boozer

jax.config.update("jax_enable_x64", True)

RATE = 40.0
"""ν [1/s]."""

SECONDS = 1e-3
FIELD = boozer.from_modes([0, 1], [0, 0], [[5.0], [-0.3]], psi_edge=8.0, iota=[0.42, 0.02], G=50.0)


def point(q, p, args):
    """(u, B) with u = v∥/v0 at q = (θ, ζ, φ), p = (p_θ, p_ζ, μ)."""
    s = args["rho"] * p[0] / FIELD.psi_edge
    B = FIELD.strength(s, q[0], q[1])
    return (p[1] + FIELD.poloidal_flux(s) / args["rho"]) * B / FIELD.G[0], B


def energy(t, q, p, args):
    """H = u²/2 + μB; φ does not enter."""
    u, B = point(q, p, args)
    return u**2 / 2 + p[2] * B


def along(u, B):
    """The change of the momenta by a change of u at constant energy and position."""
    return jnp.stack([jnp.zeros_like(u), FIELD.G[0] / B, -u / B])


def scattering(t, q, p, args):
    """√(ν (1 − ξ²)) v = √(2 ν μ B), times the direction: one noise for all momenta."""
    u, B = point(q, p, args)
    # At ξ = ±1, μ = 0, the root has no derivative; the drift moves μ away from there.
    size = jnp.sqrt(args["nu"] * jnp.maximum(2 * p[2] * B, 1e-10))
    return (size * along(u, B))[:, None]


def friction(t0, t1, q0, p1, args):
    """−νu/2, times the direction."""
    u, B = point(q0, p1, args)
    return -args["nu"] * u / 2 * along(u, B)


def main():
    alphas = boozer.GuidingCentres(FIELD, 1e5, coordinates="angles")
    system = dvi.System(dvi.discretise(energy), force=friction, noise=scattering, epsilon=1.0)
    run = {"h": alphas.h / 2, "num_steps": 2 * alphas.steps(SECONDS)}
    run |= {"method": dvi.StochasticMidpoint()}
    print(f"{run['num_steps']} steps of {alphas.seconds(run['h']) * 1e9:.0f} ns, ν = {RATE:g}/s")
    for kind, pitch in (("passing", 0.8), ("trapped", 0.2)):
        q, p, start = alphas.start(0.3, 0.0, 0.0, pitch)
        args = {"nu": RATE / alphas.speed, "rho": alphas.rho}
        state = jnp.append(q, 0.0), jnp.append(p, start["mu"])
        found = dvi.invariant_diffusion(
            system, *state, invariant=lambda q, p: p[1], num_paths=2000, args=args, **run
        )
        print(
            f"{kind}: B of p_ζ = {found.diffusion:.3e} ± {found.diffusion_error:.0e} from paths, "
            f"{found.predicted_diffusion:.3e} from averaging [m]"
        )

        def ends(key, state=state, args=args):
            sol = dvi.integrate(
                system, *state, args=args, path=dvi.Brownian(key), save=dvi.Save(final=True),
                observe=dvi.MaxDrift(energy), **run,
            )  # fmt: skip
            return sol.observed, point(sol.qs[-1], sol.ps[-1], args)[0]

        drift, u = jax.jit(jax.vmap(ends))(jax.random.split(jax.random.key(1), 500))
        print(f"  largest change of the energy {np.max(drift) / 0.5:.0e} of it; "
              f"pitch at the end {np.mean(u):.2f} ± {np.std(u):.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
