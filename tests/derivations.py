"""The equations of every system of the library, derived another way.

`DERIVATIONS[name]` is a function ``(t, q, p, args, epsilon)`` → (dq/dt, dp/dt) in NumPy. None of
them retypes a Hamiltonian: they are Lagrangians in Cartesian positions through SymPy and a
Legendre transform, Newton's and Lorentz's forces, equations in other variables.
"""

import functools
import itertools

import numpy as np
import sympy as sp


def lagrangian(n, build, names=()):
    """(dq/dt, dp/dt) = (v, ∂L/∂q) with v from p = ∂L/∂v, for L = ``build(t, q, v, **parameters)``.

    `q` are SymPy functions of t, so that positions made of them differentiate to velocities.
    """

    @functools.cache
    def compiled():
        t = sp.Symbol("t")
        q = [sp.Function(f"q{i}")(t) for i in range(n)]
        parameters = {name: sp.Symbol(name) for name in (*names, "epsilon")}
        L = build(t, q, **parameters)
        x, v = sp.symbols(f"x:{n}"), sp.symbols(f"v:{n}")
        L = L.subs({sp.diff(a, t): b for a, b in zip(q, v, strict=True)})
        L = L.subs(dict(zip(q, x, strict=True)))
        given = [t, x, v, *parameters.values()]
        p = [sp.diff(L, a) for a in v]
        return (
            sp.lambdify(given, p, "numpy", cse=True),
            sp.lambdify(given, [[sp.diff(a, b) for b in v] for a in p], "numpy", cse=True),
            sp.lambdify(given, [sp.diff(L, a) for a in x], "numpy", cse=True),
        )

    def rates(t, q, p, args, epsilon):
        momentum, inertia, push = compiled()
        values = [(args or {}).get(name) for name in names] + [epsilon]
        v = np.zeros(n)
        for _ in range(30):  # Newton's method; one step where L is quadratic in v
            off = p - np.array(momentum(t, q, v, *values), float)
            v = v + np.linalg.solve(np.array(inertia(t, q, v, *values), float), off)
        return v, np.array(push(t, q, v, *values), float)

    return rates


def with_force(rates, force):
    """The same, with ε times a force ``(t, q, v, args)`` added."""

    def forced(t, q, p, args, epsilon):
        v, push = rates(t, q, p, args, epsilon)
        return v, push + epsilon * force(t, q, v, args)

    return forced


def moving(x, t):
    """½|dx/dt|² of a position."""
    return sum(sp.diff(a, t) ** 2 for a in x) / 2


# Oscillators and pendulums


def spring(t, q, **_):
    return moving(q, t) - q[0] ** 2 / 2


def duffing(t, q, alpha, beta, **_):
    return moving(q, t) - alpha * q[0] ** 2 / 2 - beta * q[0] ** 4 / 4


def slow_oscillator(t, q, depth, epsilon):
    return moving(q, t) - ((1 + depth * sp.sin(epsilon * t)) * q[0]) ** 2 / 2


def double_well(t, q, barrier, **_):
    return moving(q, t) - barrier * (1 - q[0] ** 2) ** 2


def bob(angle, length=1):
    return [length * sp.sin(angle), -length * sp.cos(angle)]


def pendulum(t, q, omega, **_):
    x = bob(q[0])
    return moving(x, t) - omega**2 * x[1]


def perturbed_pendulum(t, q, epsilon):
    """p = v + ε q sin t."""
    return (sp.diff(q[0], t) + epsilon * q[0] * sp.sin(t)) ** 2 / 2 + sp.cos(q[0])


def lorentz_pendulum(t, q, mass, g, length, depth, epsilon):
    """With the radial motion of the bob, of which nothing may be left in the equations."""
    x = bob(q[0], length * (1 + depth * sp.sin(epsilon * t)))
    return mass * (moving(x, t) - g * x[1])


def double_pendulum(t, q, m1, m2, l1, l2, g, **_):
    upper = bob(q[0], l1)
    lower = [a + b for a, b in zip(upper, bob(q[1], l2), strict=True)]
    return m1 * (moving(upper, t) - g * upper[1]) + m2 * (moving(lower, t) - g * lower[1])


# Centres of attraction


def newton(acceleration):
    """Unit mass in Cartesian coordinates: p is the velocity."""

    def rates(t, q, p, args, epsilon):
        return p, acceleration(q, args)

    return rates


def to_centre(q, strength, centre=0.0):
    d = q - centre
    return -strength * d / np.linalg.norm(d) ** 3


def relativistic(t, q, K, c, **_):
    speed = sum(sp.diff(a, t) ** 2 for a in q)
    return -(c**2) * sp.sqrt(1 - speed / c**2) + K**2 / sp.sqrt(sum(a**2 for a in q))


def oblate(q, args):
    """Acceleration as printed in textbooks (Vallado 2013, *Fundamentals of Astrodynamics*)."""
    r = np.linalg.norm(q)
    size, tilt = 1.5 * args["J2"] * (args["R"] / r) ** 2, 5 * (q[2] / r) ** 2
    return -args["mu"] / r**3 * q * (1 - size * (tilt - np.array([1.0, 1.0, 3.0])))


def two_centres(q, args):
    top = np.array([0.0, 0.0, args["d"]])
    return to_centre(q, args["mu1"], top) + to_centre(q, args["mu2"], -top)


def restricted(t, q, mu, **_):
    """In a frame that does not turn, with the two bodies on their circles, then in q."""
    c, s = sp.cos(t), sp.sin(t)

    def at_rest(x, y, z=0):
        return [c * x - s * y, s * x + c * y, z]

    X = at_rest(*q)
    L = moving(X, t)
    for mass, x in ((1 - mu, -mu), (mu, 1 - mu)):
        body = at_rest(x, 0)
        L += mass / sp.sqrt(sum((a - b) ** 2 for a, b in zip(X, body, strict=True)))
    return L


def hill(t, q, p, args, epsilon):
    """x″ − 2y′ = 3x − x/r³, y″ + 2x′ = −y/r³, z″ = −z − z/r³, and p = (x′ − y, y′ + x, z′)."""
    v = p + np.array([q[1], -q[0], 0.0])
    pull = to_centre(q, 1.0)
    a = pull + np.array([3 * q[0] + 2 * v[1], -2 * v[0], -q[2]])
    return v, a + np.array([-v[1], v[0], 0.0])


def field(slope):
    """du/dt = p/dx^d and dp/dt = dx^d (Δu − V′(u)), each site with its neighbours, one by one.

    On rings; ends with args["left"] and args["right"] along the first axis if there are such.
    """

    def rates(t, q, p, args, epsilon):
        dx, push = args["dx"], np.zeros_like(q)
        for site in np.ndindex(q.shape):
            for axis, step in itertools.product(range(q.ndim), (-1, 1)):
                place = list(site)
                place[axis] += step
                if 0 <= place[axis] < q.shape[axis] or axis or "left" not in args:
                    place[axis] %= q.shape[axis]
                    other = q[tuple(place)]
                else:
                    other = args["left" if step < 0 else "right"]
                push[site] += (other - q[site]) / dx**2
            push[site] -= slope(q[site], args)
        return p / dx**q.ndim, push * dx**q.ndim

    return rates


def lennard_jones(t, q, p, args, epsilon):
    """Forces of all pairs, the nearest of 27 images, less the force at the cut-off."""
    push = np.zeros_like(q)
    box, c, sigma = args["box"], args["cutoff"], args["sigma"]
    cells = box * np.array(list(itertools.product((-1, 0, 1), repeat=3)))

    def strength(r):
        return 24 * args["depth"] / r * (2 * (sigma / r) ** 12 - (sigma / r) ** 6)

    for i, j in itertools.permutations(range(len(q)), 2):
        images = np.mod(q[i], box) - np.mod(q[j], box) + cells
        d = images[np.argmin(np.sum(images**2, axis=1))]
        r = np.sqrt(d @ d)
        if r < c:
            push[i] += (strength(r) - strength(c)) * d / r
    return p / args["mass"], push


def n_body(t, q, p, args, epsilon):
    masses, push = args["masses"], np.zeros_like(q)
    for i, m in enumerate(masses):
        for j, other in enumerate(masses):
            if i != j:
                push[i] += to_centre(q[i], args["G"] * m * other, q[j])
    return p / masses[:, None], push


# Chains and lattices


def henon_heiles(t, q, p, args, epsilon):
    """x²y − y³/3 = Im z³/3, z = x + iy."""
    square = complex(*q) ** 2
    return p, -q - np.array([square.imag, square.real])


def toda(t, q, p, args, epsilon):
    """Flaschka's a and b: da_i/dt = a_i (b_{i+1} − b_i), db_i/dt = 2 (a_i² − a_{i−1}²)."""
    a, b = np.exp((q - np.roll(q, -1)) / 2) / 2, -p / 2
    spread = 2 * (np.roll(b, -1) - b)  # of d(ln a_i)/dt = (dq_i/dt − dq_{i+1}/dt)/2
    rate = np.append(0, np.cumsum(-spread[:-1])) + p[0]
    return rate, -4 * (a**2 - np.roll(a, 1) ** 2)


def fput(t, q, p, args, epsilon):
    d = np.diff([0.0, *q, 0.0])
    tension = d + args["alpha"] * d**2 + args["beta"] * d**3
    return p, tension[1:] - tension[:-1]


def thermal_chain(t, q, p, args, epsilon):
    d = np.diff([0.0, *q])
    tension = np.append(d + args["beta"] * d**3, 0.0)
    return p, tension[1:] - tension[:-1]


def stiff_fput(t, q, p, args, epsilon):
    """2m unit masses: x = (Q_2i + Q_2i−1)/√2, y = (Q_2i − Q_2i−1)/√2, soft springs of d⁴."""
    m = q.shape[1]
    Q = np.stack([q[0] - q[1], q[0] + q[1]], axis=1).ravel() / np.sqrt(2)
    walls = np.concatenate([[0.0], Q, [0.0]])
    push = np.zeros(2 * m)
    for left in range(2 * m + 1):
        d = walls[left + 1] - walls[left]
        tension = args["omega"] ** 2 * d / 2 if left % 2 else 4 * d**3
        if left > 0:
            push[left - 1] += tension
        if left < 2 * m:
            push[left] -= tension
    odd, even = push.reshape(m, 2).T
    return p, np.stack([even + odd, even - odd]) / np.sqrt(2)


def nls(t, q, p, args, epsilon):
    psi = (q + 1j * p) / np.sqrt(2)
    laplacian = np.roll(psi, 1) - 2 * psi + np.roll(psi, -1)
    rate = 1j * (args["kappa"] * laplacian + args["gamma"] * np.abs(psi) ** 2 * psi)
    return np.sqrt(2) * rate.real, np.sqrt(2) * rate.imag


# Charged particles: the Lorentz force, and p = mv + eA carried along


def lorentz(potential, field, electric=None):
    """dp/dt = e (E + v × B) + e (v·∇)A for A of SymPy and B by hand."""

    @functools.cache
    def compiled(names):
        x, args = sp.symbols("x:3"), {name: sp.Symbol(name) for name in names}
        A = potential(sp.Matrix(x), args)
        given = [x, *args.values()]
        return sp.lambdify(given, A), sp.lambdify(given, A.jacobian(x))

    def rates(t, q, p, args, epsilon):
        numbers = {name: x for name, x in args.items() if np.ndim(x) == 0}
        A, slopes = compiled(tuple(numbers))
        e, m, given = args["charge"], args["mass"], (q, *numbers.values())
        v = (p - e * np.ravel(A(*given))) / m
        push = e * np.cross(v, field(q, args)) + e * np.array(slopes(*given)) @ v
        return v, push + (0.0 if electric is None else e * electric(args))

    return rates


def uniform_potential(x, args):
    return sp.Matrix([0, 0, args["B"]]).cross(x) / 2


def mirror_potential(x, args):
    """Of a flux function ψ = B0 ρ²(1 + z²/ℓ²)/2: A = ψ φ̂/ρ."""
    flux = args["B0"] * (x[0] ** 2 + x[1] ** 2) * (1 + (x[2] / args["length"]) ** 2) / 2
    return sp.Matrix([-x[1], x[0], 0]) * flux / (x[0] ** 2 + x[1] ** 2)


def mirror_field(q, args):
    """B_z = (1/ρ) ∂ψ/∂ρ, B_ρ = −(1/ρ) ∂ψ/∂z."""
    square = args["length"] ** 2
    radial = -args["B0"] * q[2] / square
    return np.array([radial * q[0], radial * q[1], args["B0"] * (1 + q[2] ** 2 / square)])


def dipole_potential(x, args):
    """A = M × x/r³."""
    moment = sp.Matrix([0, 0, -args["B0"] * args["radius"] ** 3])
    return moment.cross(x) / sp.sqrt(x.dot(x)) ** 3


def dipole_field(q, args):
    """B = (3 (M·n) n − M)/r³."""
    r = np.linalg.norm(q)
    moment, n = np.array([0.0, 0.0, -args["B0"] * args["radius"] ** 3]), q / r
    return (3 * (moment @ n) * n - moment) / r**3


# Rigid bodies


def _about(axis, angle):
    c, s = np.cos(angle), np.sin(angle)
    i, j = [k for k in range(3) if k != axis]
    R = np.eye(3, dtype=np.result_type(angle))
    R[i, i], R[j, j], R[i, j], R[j, i] = c, c, -s, s
    return R


def rigid_body(t, q, p, args, epsilon):
    """Euler's equations dM/dt = M × ω and dR/dt = R ω̂, carried to (l, g, k, L, G, K).

    Twelve linear equations for six rates, by derivatives of a complex step.
    """

    def body(z):
        (ell, g, k), (L, G, K) = z[:3], z[3:]
        across = np.sqrt(G**2 - L**2)
        R = _about(2, k) @ _about(0, np.arccos(K / G)) @ _about(2, g) @ _about(0, np.arccos(L / G))
        M = np.array([across * np.sin(ell), across * np.cos(ell), L])
        return np.concatenate([(R @ _about(2, ell)).ravel(), M])

    z = np.concatenate([q, p]).astype(complex)
    slopes = np.array([body(z + 1e-30j * e).imag / 1e-30 for e in np.eye(6)]).T
    values = body(z).real
    R, M = values[:9].reshape(3, 3), values[9:]
    w = M / np.array([args["I1"], args["I2"], args["I3"]])
    hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    wanted = np.concatenate([(R @ hat).ravel(), np.cross(M, w)])
    rates = np.linalg.lstsq(slopes, wanted, rcond=None)[0]
    assert np.max(np.abs(slopes @ rates - wanted)) < 1e-13
    return rates[:3], rates[3:]


def spinning_top(t, q, A, C, w, **_):
    """ω on the body's axes from RᵀdR/dt, R = R_z(φ) R_x(θ) R_z(ψ)."""

    def about_z(a):
        return sp.Matrix([[sp.cos(a), -sp.sin(a), 0], [sp.sin(a), sp.cos(a), 0], [0, 0, 1]])

    def about_x(a):
        return sp.Matrix([[1, 0, 0], [0, sp.cos(a), -sp.sin(a)], [0, sp.sin(a), sp.cos(a)]])

    R = about_z(q[0]) * about_x(q[1]) * about_z(q[2])
    hat = R.T * sp.diff(R, t)
    one, two, three = hat[2, 1], hat[0, 2], hat[1, 0]
    return (A * (one**2 + two**2) + C * three**2) / 2 - w * R[2, 2]


# With constraints: without their forces, as H alone gives them


def weights(t, q, p, args, epsilon):
    """Free fall of equal masses along the last coordinate."""
    fall = np.zeros_like(q)
    fall[..., -1] = -args["m"] * args["g"]
    return p / args["m"], fall


def slider_crank(t, q, m1, m2, m3, g, **_):
    """Uniform rods: integrals over their points."""
    A, B = sp.Matrix(q[:2]), sp.Matrix(q[2:])
    s = sp.Symbol("s")
    L = m3 * (moving(B, t) - g * B[1])
    for mass, point in ((m1, s * A), (m2, A + s * (B - A))):
        density = moving(point, t) - g * point[1]
        L += mass * sp.integrate(sp.expand(density), (s, 0, 1))
    return L


def in_shape(shape, rates):
    """A derivation of vectors, for arrays."""

    def shaped(t, q, p, args, epsilon):
        return tuple(x.reshape(shape) for x in rates(t, q.ravel(), p.ravel(), args, epsilon))

    return shaped


def dumbbell(t, q, p, args, epsilon):
    m = np.array([[args["m1"]], [args["m2"]]])
    return p / m, -args["mu"] * m * q / np.linalg.norm(q, axis=1, keepdims=True) ** 3


def body(pull):
    """A body of six point masses on its axes with these moments; `pull`: force on a mass."""

    def rates(t, q, p, args, epsilon):
        I1, I2, I3 = args["I"]
        d = np.array([I2 + I3 - I1, I3 + I1 - I2, I1 + I2 - I3]) / 2
        force = np.zeros((3, 3))
        for k, sign in ((k, s) for k in range(3) for s in (-1, 1)):
            X = sign * np.eye(3)[k]  # unit distance: the mass is d_k/2
            force += np.outer(d[k] / 2 * pull(t, q @ X, args), X)
        return p / d, force

    return rates


def in_orbit(t, x, args):
    """The part of the gravity gradient along the radius."""
    e = np.array([np.cos(args["omega"] * t), np.sin(args["omega"] * t), 0])
    return 3 * args["omega"] ** 2 * e * (e @ x)


def heavy_top(t, q, p, args, epsilon):
    rate, _ = body(lambda t, x, args: np.zeros(3))(t, q, p, args, epsilon)
    return rate, np.outer([0.0, 0.0, -1.0], args["c"])  # a weight of one at the point c


# Others


def polar_motion(t, q, p, args, epsilon):
    """dm/dt = iσ_c (m − χ) of m = x − iy: Liouville's equation; at ε = 0 without loss and drive."""
    assert epsilon in (0, 1)
    sigma = 2 * np.pi / args["period"] * (1 + 0.5j * args["inverse_Q"] * epsilon)
    turn = np.exp(2j * np.pi * t / 365.25)
    x, y = args["mean"] + args["drift"] * t / 365.25
    driven = complex(*args["prograde"]) * turn + complex(*args["retrograde"]) / turn
    chi = x - 1j * y + epsilon * driven
    rate = 1j * sigma * (q - 1j * p - chi)
    return rate.real, -rate.imag


def lotka_volterra(t, q, p, args, epsilon):
    """d ln x/dt = (dx/dt)/x of the numbers."""
    x, y = np.exp(q), np.exp(p)
    dx = args["alpha"] * x - args["beta"] * x * y
    dy = args["delta"] * x * y - args["gamma"] * y
    return dx / x, dy / y


PENDULUM = lagrangian(1, pendulum, ("omega",))
DERIVATIONS = {
    "oscillator": with_force(lagrangian(1, spring), lambda t, q, v, args: -q),
    "double_well": lagrangian(1, double_well, ("barrier",)),
    "duffing": with_force(
        lagrangian(1, duffing, ("alpha", "beta")),
        lambda t, q, v, args: -args["delta"] * v + args["gamma"] * np.cos(args["omega"] * t),
    ),
    "van_der_pol": with_force(lagrangian(1, spring), lambda t, q, v, args: (1 - q**2) * v),
    "slow_oscillator": lagrangian(1, slow_oscillator, ("depth",)),
    "pendulum": with_force(PENDULUM, lambda t, q, v, args: -v),
    "perturbed_pendulum": lagrangian(1, perturbed_pendulum),
    "lorentz_pendulum": lagrangian(1, lorentz_pendulum, ("mass", "g", "length", "depth")),
    "double_pendulum": lagrangian(2, double_pendulum, ("m1", "m2", "l1", "l2", "g")),
    "kepler": with_force(
        newton(lambda q, args: to_centre(q, args["K"] ** 2)), lambda t, q, v, args: -q
    ),
    "relativistic_kepler": lagrangian(2, relativistic, ("K", "c")),
    "oblate_kepler": newton(oblate),
    "two_centres": newton(two_centres),
    "restricted_three_body": lagrangian(3, restricted, ("mu",)),
    "hill": hill,
    "n_body": n_body,
    "figure_eight": n_body,
    "pythagorean": n_body,
    "outer_solar_system": n_body,
    "solar_system": n_body,
    "henon_heiles": henon_heiles,
    "toda": toda,
    "fput": fput,
    "thermal_chain": thermal_chain,
    "stiff_fput": stiff_fput,
    "nls_lattice": nls,
    "klein_gordon": field(lambda u, args: args["mass"] ** 2 * u),
    "sine_gordon": field(lambda u, args: np.sin(u)),
    "phi4": field(lambda u, args: u**3 - u),
    "lennard_jones": lennard_jones,
    "uniform_field": lorentz(
        uniform_potential,
        lambda q, args: np.array([0.0, 0.0, args["B"]]),
        lambda args: args["E"],
    ),
    "magnetic_mirror": lorentz(mirror_potential, mirror_field),
    "dipole_field": lorentz(dipole_potential, dipole_field),
    "rigid_body": rigid_body,
    "spinning_top": lagrangian(3, spinning_top, ("A", "C", "w")),
    "spherical_pendulum": weights,
    "chain": weights,
    "slider_crank": in_shape((2, 2), lagrangian(4, slider_crank, ("m1", "m2", "m3", "g"))),
    "dumbbell": dumbbell,
    "heavy_top": heavy_top,
    "satellite": body(in_orbit),
    "polar_motion": polar_motion,
    "lotka_volterra": lotka_volterra,
}
EPSILON = {"polar_motion": (0.0, 1.0)}
"""Where a derivation holds at some ε only; 0.3 elsewhere."""
