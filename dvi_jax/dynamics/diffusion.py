"""Diffusion of an adiabatic invariant by noise, measured and predicted."""

import dataclasses
from collections.abc import Callable
from typing import Any, Unpack

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.checks import array, whole
from ..base.keywords import checked_keywords
from ..base.printing import printable
from ..base.signature import with_time
from ..integration.integrate import integrate
from ..integration.keywords import IntegrationSettings
from ..observe import Mean
from ..observe.solution import Save
from ..problem.paths import Brownian
from ..problem.system import System, check_system, of_problem


@printable
class InvariantDiffusion(eqx.Module):
    """Drift and diffusion of an invariant I: coefficients A and B of the Fokker–Planck equation
    ∂f/∂t = −∂(A f)/∂I + ½ ∂²(B f)/∂I².

    - `drift`: A [I/time], and `diffusion`: B [I²/time], from paths, with their standard errors
      `drift_error` and `diffusion_error`.
    - `predicted_drift`, `predicted_diffusion`: averages along the orbit without noise.
    - `changes`: I at the end of each path minus that of the orbit without noise, (num_paths,).
    """

    drift: Any
    drift_error: Any
    diffusion: Any
    diffusion_error: Any
    predicted_drift: Any
    predicted_diffusion: Any
    changes: Any


@checked_keywords
def invariant_diffusion(
    system: System,
    q0: Any = None,
    p0: Any = None,
    *,
    invariant: Callable[..., Any],
    num_paths: int = 1000,
    seed: int = 0,
    **settings: Unpack[IntegrationSettings],
) -> InvariantDiffusion:
    r"""Drift and diffusion of an adiabatic invariant I by noise, over many paths, next to the
    averaged coefficients of Fokker and Planck.

        A = ⟨b·∇I + ½ Σ_m g_m·∇(g_m·∇I)⟩,    B = ⟨Σ_m (g_m·∇I)²⟩

    for dz = … + b dt + Σ_m g_m ∘ dB_m in phase space, z = (q, p), with b the friction of a
    `Langevin`; for momentum noise σ(t, q) these are ⟨½ tr(σσᵀ ∂²I/∂p²)⟩ and ⟨|σᵀ ∂I/∂p|²⟩. ⟨·⟩ is
    the time average along the orbit without noise and without b, computed by the same method. With
    δ = I(path) − I(that orbit) at the end of a run over the time τ, the measured coefficients are
    mean(δ)/τ and var(δ)/τ.

    **Arguments** as for `integrate`, with one initial condition and a method for noise, and

    - `invariant`: I, a function ``(q, p)`` or ``(t, q, p, args)`` → number, such as
      ``lambda q, p: found.evaluate(q, p, epsilon)[0]`` of a `Discovery`.
    - `num_paths`: number of paths. `seed`: of the key that is split into those of the paths.

    **Accuracy** τ must be long compared with the periods of the orbit, and so short that I changes
    little. The errors are those of the number of paths alone.

    **Raises** `ValueError` for a system without noise or with a constraint; errors of `integrate`
    if a path fails.

    **Source** averaging: Khasminskii 1968, *Kybernetika* 4, 260; Freidlin & Wentzell 2012, *Random
    Perturbations of Dynamical Systems*, 8.
    """
    system, q0, p0, h, args = of_problem(system, q0, p0, settings.get("h"), settings.get("args"))
    check_system(system, "invariant_diffusion", noise_allowed=True)
    whole("num_paths", num_paths, 2)
    noise = system.noise
    if noise is None:
        raise ValueError("system must have noise, such as dvi.System(H_D, noise=...).")
    value = with_time("invariant", invariant)
    epsilon = system.strength(settings.get("epsilon"))
    options: dict[str, Any] = {**settings, "h": h, "args": args, "epsilon": epsilon}

    def coefficients(t0, t, q0, p0, q, p, args):
        """(b·∇I + ½ Σ_m g_m·∇(g_m·∇I), Σ_m (g_m·∇I)²) at the end of a step."""
        s, _ = system.times(t, t, epsilon)
        none = jnp.zeros(noise.count(s, q, p, args), q.dtype)

        def derivative_along(f):
            """(Ḃ, q, p) → the derivative of f along b + Σ_m g_m Ḃ_m."""

            def derivative(rates, *z):
                q, p = z
                by_q, by_p = jax.grad(noise.energy, (1, 2))(s, q, p, args, rates)
                return jax.jvp(f, z, (by_p, noise.force(s, q, p, args, rates) - by_q))[1]

            return derivative

        def by_noise(*z):
            """g_m·∇I, shape (m,)."""
            return jax.grad(rate)(none, *z)

        def number(q, p):
            return array("invariant", value(t, q, p, args), (), verb="return")

        rate = derivative_along(number)
        second = jnp.trace(jax.jacfwd(derivative_along(by_noise))(none, q, p))
        return jnp.stack([rate(none, q, p) + second / 2, jnp.sum(by_noise(q, p) ** 2)])

    def end(system, **keywords):
        solution = integrate(system, q0, p0, save=Save(final=True), **options, **keywords)
        return value(solution.ts[-1], solution.qs[-1], solution.ps[-1], args), solution

    # Without noise the same methods are deterministic ones.
    reference, orbit = end(dataclasses.replace(system, noise=None), observe=Mean(coefficients))
    keys = jax.random.split(jax.random.key(seed, impl="threefry2x32"), num_paths)
    changes = jax.jit(jax.vmap(lambda key: end(system, path=Brownian(key))[0]))(keys) - reference
    duration = orbit.ts[-1] - orbit.ts[0]
    variance = jnp.var(changes, ddof=1)
    spread = (changes - jnp.mean(changes)) ** 2
    return InvariantDiffusion(
        drift=jnp.mean(changes) / duration,
        drift_error=jnp.sqrt(variance / num_paths) / duration,
        diffusion=variance / duration,
        diffusion_error=jnp.std(spread, ddof=1) / jnp.sqrt(num_paths) / duration,
        predicted_drift=orbit.observed[0],
        predicted_diffusion=orbit.observed[1],
        changes=changes,
    )
