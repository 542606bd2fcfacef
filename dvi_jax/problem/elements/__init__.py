r"""Orbital elements: Kepler orbits as numbers that stay constant, and back to positions.

    kepler = dvi.elements.Keplerian.from_state(q, v, mu=1.0)     # a, e, inc, Omega, omega, M
    q, v = kepler.state(mu=1.0)

Every kind of elements has the two functions ``from_state(q, v, mu)`` and ``state(mu, dim=3)``:

- `Keplerian` and `Delaunay` have the angles of textbooks. The node is undefined at inclination 0
  and the pericentre at e = 0: these angles are 0 there, and their derivatives NaN.
- `Equinoctial`, `ModifiedEquinoctial` and `Poincare` and their derivatives are regular there; they
  are singular at inclination π (also for a plane orbit with negative angular momentum).
- Hyperbolas have a < 0 and M = e sinh F − F. A parabola has `ModifiedEquinoctial` only.

Positions q [length] and velocities v [length/time] have the shape (…, 2) or (…, 3), and `mu`
(G times both masses, [length³/time²]) is a number or has the shape (…). Each element has the shape
(…). Angles are in radians, between −π and π, except M of a hyperbola. All functions can be
differentiated in every order, batched and compiled. A state at the centre, a motion along a
line through it, an unbound orbit of `Delaunay` or `Poincare` and elements of no orbit give NaN.

**N bodies** have the elements of all but the first:

    dvi.elements.of_bodies(sol.qs, sol.ps, masses).e      # (times, bodies − 1)
    q0, p0 = dvi.elements.to_bodies(elements, masses)

`frame` says what the orbits of the others are relative to:

- "jacobi": the centre of mass of the bodies before it, with μ = G times the mass of these and its
  own. It suits planets, the inner ones first.
- "heliocentric": the first body, with μ = G (m_0 + m_i).
- "barycentric": the centre of mass of all, with μ = G times the mass of all.

q and p have the shape (…, bodies, 2 or 3). Bodies after the last entry of `masses` are test
particles: their mass is 0 and their row of p is the velocity, as in `systems.n_body`.

**Source** Broucke & Cefola 1972, *Celest. Mech.* 5, 303 (equinoctial); Walker, Ireland & Owens
1985, *Celest. Mech.* 36, 409 (modified); Murray & Dermott 1999, *Solar System Dynamics*, 2.8, 9.1;
Laskar & Robutel 1995, *Celest. Mech. Dyn. Astron.* 62, 193 (Poincaré).
"""

from ._bodies import Elements as Elements, of_bodies as of_bodies, to_bodies as to_bodies
from ._orbit import (
    Delaunay as Delaunay,
    Equinoctial as Equinoctial,
    Keplerian as Keplerian,
    ModifiedEquinoctial as ModifiedEquinoctial,
    Poincare as Poincare,
)
