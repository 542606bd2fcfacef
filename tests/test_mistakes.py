"""After a typical mistake: the right answer, a warning, or an error that helps.

Each row is one mistake. An error names what was seen and what to do. Where the pattern begins with
it, the type of the error is tested as well.
"""

import inspect
import math
import pickle
import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, plot, rings, systems
from dvi_jax.systems import boozer, rigid


def H_D(t0, t1, q0, p1, args):
    return (p1 @ p1 + q0 @ q0) / 2


def H(t, q, p, args):
    return (p @ p + q @ q) / 2


def W(t0, t1, q0, p1, args):
    return -(q0**3)


def energy(q, p):
    return (p @ p + q @ q) / 2


FREE, FORCED = dvi.System(H_D), dvi.System(H_D, force=W)
STEPS = {"h": 0.1, "num_steps": 3}
Q, P = [1.0], [0.0]
MASKED = np.ma.array([1.0, 2.0], mask=[False, True])


def run(system=FREE, q0=Q, p0=P, **how):
    return dvi.integrate(system, q0, p0, **({**STEPS, **how}))


def given(**how):
    return dvi.integrate(FREE, Q, P, lattice=dvi.Given([0.0, 0.1, 0.2]), **how)


def adaptive(speed=lambda t, q, p, args: 1.0, kind=dvi.AdaptiveReversible, **how):
    return run(lattice=kind(speed), **({"method": dvi.Strang(), **how}))


def variational(**how):
    return run(lattice=dvi.Variational(), **how)


def vector(t, q, p, args):
    return q


def negative(t, q, p, args):
    return -1.0


def condition(t, q, p, args):
    return q[0] > 0.1


def integer(t, q, p, args):
    return 1


def of_step(t0, t1, q0, p0, q1, p1, args):
    return q1[0]


def hamiltonian(f, q0=Q, p0=P, **how):
    return run(dvi.System(f), q0, p0, **how)


SAMPLES = np.random.default_rng(0).uniform(-1, 1, (2, 60, 1))


def discover(system=FORCED, basis=dvi.Polynomials(2), **how):
    return dvi.discover_invariants(system, basis, **({"h": 0.1, "samples": SAMPLES, **how}))


def bound(found, **how):
    settings = {"h": 0.1, "epsilon": 0.1, "domain": np.array([0.5]), **how}
    return dvi.bound_drift(found, FORCED, **settings)


def drift(invariant=energy, q0=Q, **how):
    return dvi.drift_order(
        FORCED, invariant, q0, P, **({"epsilons": [0.1, 0.2, 0.4], **STEPS, **how})
    )


TS = np.array([0.1, 0.2, 0.3])
MODEL = dvi.Model(FORCED, h=0.1, q0=Q, p0=P)


def observed(ts=TS, values=np.ones((3, 1)), **how):
    return dvi.Observations(ts, values, **({"sigma": 0.1, "t0": 0.0, **how}))


def fit(data=None, params=None, model=MODEL, **how):
    return dvi.fit(model, data or observed(), params or {"epsilon": 0.1}, progress=False, **how)


def sweep(**how):
    return dvi.sweep(FORCED, Q, P, **({**STEPS, "epsilon": [0.1, 0.2], "progress": False, **how}))


ERRORS = [
    # the state
    (lambda: run(p0=[0.0, 1.0]), r"^ValueError.*same shape.*\(1,\).*\(2,\)"),
    (lambda: dvi.integrate(FREE, Q, **STEPS), "p0"),
    (lambda: dvi.integrate(FREE, **STEPS), "q0"),
    (lambda: run(q0=[], p0=[]), "^ValueError.*empty"),
    (lambda: run(q0=[1j], p0=[0j]), "^TypeError.*real"),
    (lambda: run(q0=["a"]), "^TypeError.*real numbers"),
    (lambda: run(q0=[None]), "^TypeError.*real"),
    (lambda: run(q0=np.float16([1]), p0=np.float16([0])), "^TypeError.*float32 or float64"),
    (lambda: run(q0=1.0, p0=0.0), "shape \\(\\)"),
    (lambda: run(q0=np.ones((4, 1)), p0=np.ones((4, 1))), "jax.vmap"),
    (lambda: dvi.integrate(FREE, [1.0, 0.0], **STEPS), "p0"),
    (lambda: without_x64(lambda: run(q0=np.ones(1), p0=np.ones(1))), "jax_enable_x64"),
    # the system
    (lambda: dvi.System(H), r"^TypeError.*\(t0, t1, q0, p1, args\).*dvi.discretise"),
    (lambda: dvi.discretise(H_D), r"^TypeError.*\(t, q, p, args\).*dvi.System"),
    (lambda: run(H_D), r"^TypeError.*dvi.System\(H_D"),
    (lambda: run(dvi.System), "dvi.System"),
    *((lambda name=name: dvi.System(**{"H_D": H_D, name: 3.0}),
     f"^TypeError.*{name} must be a function") for name in ("H_D", "force", "perturbation")),
    *((lambda name=name: dvi.System(**{"H_D": H_D, name: energy}),
     f"^TypeError.*{name} must take") for name in ("H_D", "force", "perturbation")),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: p1**2),
     r"^ValueError.*H_D.*scalar.*shape \(1,\).*jnp.sum"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: None), "^TypeError.*return"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: (p1 @ p1, 0)), "scalar|tuple"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: p1 @ p1 + q0[2] ** 2), "out of bounds"),
    (lambda: run(dvi.System(H_D, force=lambda t0, t1, q0, p1, args: -p1[1:2]), epsilon=0.1),
     "shape|out of bounds"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: np.cos(q0[0]) + p1 @ p1), "jnp"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: math.cos(q0[0]) + p1 @ p1), "jnp"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: float(q0[0])), "jnp"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: p1 @ p1 if q0[0] > 0 else p1 @ p1 / 2),
     "jnp.where"),
    (lambda: hamiltonian(loop), "jnp.where|traced by JAX"),
    (lambda: run(dvi.System(H_D, force=lambda t0, t1, q0, p1, args: q0 if q0[0] > 0 else -q0),
     epsilon=0.1), "jnp.where"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: args["k"] * (p1 @ p1)),
     "^TypeError.*in H_D.*args=None"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: args["k"] * (p1 @ p1), args={"m": 1.0}),
     "args|'k'"),
    (lambda: run(args={"a": [bytearray(3)]}), "^TypeError.*args.*bytearray"),
    (lambda: run(args=np.array(["2020-01-01"], "M8[D]")), "^TypeError.*args"),
    (lambda: run(dvi.System(H_D, force=lambda t0, t1, q0, p1, args: jnp.ones(2)), epsilon=0.1),
     r"^ValueError.*force.*shape \(1,\).*shape \(2,\)"),
    (lambda: run(dvi.System(H_D, perturbation=lambda t0, t1, q0, p1, args: q0), epsilon=0.1),
     "scalar"),
    (lambda: dvi.discretise(H, order=5), "order"),
    # the perturbation
    (lambda: run(FORCED), "epsilon="),
    (lambda: run(dvi.System(H_D, perturbation=lambda t0, t1, q0, p1, args: q0 @ q0)), "epsilon="),
    (lambda: run(FORCED, epsilon=[0.1, 0.2]), "jax.vmap"),
    (lambda: run(FORCED, epsilon=np.nan), "^ValueError: epsilon.*finite"),
    (lambda: run(FORCED, epsilon="0.1"), "^TypeError: epsilon"),
    # steps
    (lambda: dvi.integrate(FREE, Q, P, num_steps=3), "^TypeError.*requires h"),
    (lambda: dvi.integrate(FREE, Q, P, h=0.1), "^TypeError.*requires num_steps"),
    (lambda: run(h=0.0), "^ValueError: h must not be zero"),
    (lambda: run(h=np.nan), "^ValueError: h must be.*finite"),
    (lambda: run(h="0.1"), "^TypeError: h "),
    (lambda: run(h=[0.1, 0.2]), "^ValueError: h .*vmap.*dvi.Given"),
    (lambda: run(num_steps=2.5), "^TypeError: num_steps"),
    (lambda: run(num_steps=-1), "^ValueError: num_steps.*negative h"),
    (lambda: jax.jit(lambda n: run(num_steps=n).qs[-1])(3), "num_steps"),
    (lambda: run(n_steps=3), "num_steps"),
    (lambda: run(steps=3), "num_steps"),
    (lambda: run(dt=0.1), "h"),
    (lambda: run(dt0=0.1), "h"),
    (lambda: run(FORCED, eps=0.1), "epsilon"),
    (lambda: run(solver=dvi.Strang()), "method"),
    (lambda: run(saveat=dvi.Save()), "save"),
    (lambda: run(rtol=1e-9), "rtol"),
    (lambda: run(t1=1.0), "num_steps"),
    (lambda: dvi.integrate(FREE, Q, P, h=0.1, t1=0.25), "multiple|whole number"),
    (lambda: dvi.integrate(FREE, Q, P, h=0.1, t1=-1.0), "t1|negative h"),
    (lambda: dvi.integrate(FREE, Q, P, h=0.1, duration=-1.0), "duration|h"),
    # how
    (lambda: run(method="leapfrgo"), "Leapfrog"),
    (lambda: run(method=dvi.Strang), "^TypeError.*parentheses"),
    (lambda: run(method=dvi.Newton()), "method must be"),
    (lambda: dvi.GaussLegendre(0), "stages"),
    (lambda: run(integrator=dvi.Strang()), "^TypeError.*dvi.Integrator"),
    (lambda: run(integrator=dvi.Integrator(), method=dvi.Strang()),
     "^ValueError: method and integrator"),
    (lambda: run(newton=dvi.Newton(), root_finder=dvi.Newton()),
     "only one of newton and root_finder"),
    (lambda: run(root_finder="newton"), "^TypeError.*instance of dvi.RootSolver, got 'newton'"),
    (lambda: run(root_finder=dvi.Newton), "^TypeError.*parentheses"),
    (lambda: run(lattice=dvi.Uniform), "parentheses|lattice"),
    (lambda: given(h=0.1), "^ValueError.*Given"),
    (lambda: dvi.Given([0.0, 0.2, 0.1]), "^ValueError.*strictly"),
    (lambda: run(arithmetic="compensated"), "arithmetic"),
    (lambda: run(adjoint=dvi.Reversible), "parentheses|adjoint"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: (p1 @ p1) * (q0 @ q0),
     arithmetic=dvi.FixedPoint(2.0**-40)), "explicit|solve|separable"),
    (lambda: run(layout="arrays"), "layout|Layout"),
    # output
    (lambda: run(save=10), r"^TypeError.*dvi.Save\(every=10\)"),
    (lambda: run(save="final"), r"dvi.Save\(final=True\)"),
    (lambda: dvi.Save(every=0), "^ValueError.*at least 1"),
    (lambda: dvi.Save(ts=[0.2, 0.1, 0.3]), "order"),
    (lambda: run(observe=lambda t, q, p: q @ q), "\\(q, p\\).*\\(t, q, p, args\\)"),
    (lambda: run(observe=dvi.MaxDrift), "^TypeError.*class MaxDrift"),
    (lambda: run(observe=dvi.MaxDrift(5)), "^TypeError.*argument of MaxDrift must be a function"),
    (lambda: run(observe="energy"), "^TypeError.*function.*dict"),
    (lambda: run(observe=lambda q, p: (q, p)), "one array"),
    (lambda: run(observe=lambda q, p: q[0] if q[0] > 0 else p[0]), "jnp.where"),
    (lambda: run(stop=energy), "dvi.Stop"),
    (lambda: dvi.Stop(lambda q, p, args: q[0]), "\\(q, p\\) or \\(t, q, p, args\\)"),
    (lambda: run(progress=5), "progress"),
    (lambda: jax.jit(lambda q: run(q0=q, p0=q, progress=True).qs[-1])(jnp.ones(1)), "progress"),
    (lambda: hamiltonian(lambda t0, t1, q0, p1, args: jnp.exp(q0 @ q0) + p1 @ p1, q0=[9.0],
     p0=[9.0], h=1.0, num_steps=20), "step"),
    # names
    (lambda: dvi.plots, "plot"),
    (lambda: dvi.discretize, "discretise"),
    (lambda: dvi.solve, "no attribute"),
    (lambda: dvi.Verlet, "StormerVerlet"),
    (lambda: run().q, "qs"),
    (lambda: run().t, "ts"),
    (lambda: run().ys, "qs"),
    # discovery
    (lambda: discover(samples=np.ones((60, 2))), "samples"),
    (lambda: discover(samples=(np.ones((5, 1)), np.ones((6, 1)))), "samples|shape"),
    (lambda: discover(samples=SAMPLES[:, :4]), "samples"),
    (lambda: discover(samples=SAMPLES * np.nan), "finite"),
    (lambda: dvi.discover_invariants(FORCED, dvi.Polynomials(2), h=0.1), "samples"),
    (lambda: discover(basis=dvi.Polynomials), "basis|Polynomials"),
    (lambda: discover(basis=2), "basis|Polynomials"),
    (lambda: discover(basis=dvi.Polynomials(0)), "degree"),
    (lambda: discover(order=-1), "order"),
    (lambda: discover(h=None), "h"),
    (lambda: drift(epsilons=[-0.1, 0.1, 0.2]), "positive"),
    (lambda: drift(epsilons=[0.1, 0.1, 0.2]), "epsilons"),
    (lambda: drift(epsilons=0.1), "epsilons"),
    # sweeps
    (lambda: sweep(epsilon=np.ones((2, 2))), "one-dimensional|epsilon"),
    (lambda: sweep(epsilon=[]), "empty|epsilon"),
    (lambda: sweep(epsilon=dvi.Axis("a", [0.1, 0.2]), h=dvi.Axis("a", [0.1, 0.2, 0.3])), "'?a'?"),
    (lambda: sweep(epsilon=dvi.Axis("a", ["x"]), observe=dvi.Last(energy)),
     "real numbers|axis 'a'"),
    (sweep, "observe|save"),
    # fits
    (lambda: fit(params={"gamma": 1.0}), "gamma"),
    (lambda: observed(ts=[], values=np.ones((0, 1))), "observ|times|empty"),
    (lambda: observed(values=np.ones((4, 1))), "4"),
    (lambda: observed(sigma=-1.0), "sigma"),
    (lambda: fit(observed(values=np.full((3, 1), np.nan))), "NaN|missing|observ"),
    (lambda: dvi.Bounds(1.0, 0.0), "Bounds|lower|upper"),
    # other functions
    (lambda: dvi.poincare_section(FREE, Q, P, lambda t, q, p, args: q[0], h=0.1, num_steps=9),
     r"q0\[None\], p0\[None\]"),
    (lambda: run(q0=[1.0] * unit()), "unit|interop"),
    (lambda: interop.solve_ivp(FREE, (0.0, 1.0), [1.0, 0.0], h=0.1, rtol=1e-6), "rtol"),
    (lambda: systems.keppler, "keppler"),
]  # fmt: skip


DEFAULT, AT_TIMES, DEFECT = dvi.Integrator(), dvi.Save(ts=[0.1]), dvi.Reversible(report_defect=True)
GRIDS = (dvi.AdaptiveReversible, dvi.TimeTransformed)
EVENTS = (lambda g: run(observe=dvi.Section(g)), lambda g: run(stop=dvi.Stop(g)))
REFUSALS = [
    (lambda: run(q0=[np.nan]), r"^ValueError: q0.*index \[0\]"),
    (lambda: run(p0=[np.inf]), r"^ValueError: p0.*index \[0\]"),
    (lambda: run(q0=MASKED, p0=MASKED), r"^ValueError: q0.*mask.*index \[1\]"),
    (lambda: run(q0=[1.0, 2.0], p0=MASKED), "^ValueError: p0.*mask"),
    (lambda: run(t0=np.ma.masked), "^ValueError: t0.*mask"),
    (lambda: run(h=np.ma.array(0.1, mask=True)), "^ValueError: h.*mask"),
    (lambda: run(args={"k": MASKED}), "^ValueError: args.*mask"),
    (lambda: run(args={"k": {1, 2}}), "^TypeError.*args.*set"),
    (lambda: run(args={"k": np.array([1.0], object)}), "^TypeError.*args"),
    (lambda: run(t0=np.datetime64("2000")), "^TypeError: t0"),
    (lambda: run(FORCED, epsilon=1j), "^TypeError: epsilon"),
    (lambda: run(h=np.inf), "^ValueError: h must be.*finite"),
    (lambda: run(num_steps=2**31), "^ValueError: num_steps"),
    (lambda: run(integrator=DEFAULT, newton=dvi.Newton()), "^ValueError: newton and integrator"),
    (lambda: given(num_steps=3), "^ValueError.*Given"),
    (lambda: given(t0=1.0), "^ValueError.*Given"),
    (lambda: dvi.Given([0.0, 0.1, 0.1]), "^ValueError.*strictly"),
    (lambda: dvi.Given([0.0, np.nan]), "^ValueError.*finite"),
    (lambda: dvi.Given([[0.0, 1.0]]), "^ValueError.*shape"),
    (lambda: dvi.Given("abc"), "^TypeError.*real numbers"),
    (lambda: dvi.Given(MASKED), "^ValueError.*ts.*mask"),
    (lambda: adaptive(method=dvi.TypeII()), "^ValueError.*symmetric method.*TypeII"),
    (lambda: adaptive(method=dvi.RungeKutta4()), "^ValueError.*symmetric method.*RungeKutta4"),
    (lambda: adaptive(arithmetic=dvi.FixedPoint(2.0**-40)), "AdaptiveReversible.*rounded"),
    (lambda: adaptive(num_steps=None, t1=3.0), "^ValueError: t1"),
    (lambda: adaptive(kind=dvi.TimeTransformed, num_steps=None, t1=3.0), "^ValueError: t1"),
    (lambda: adaptive(kind=dvi.TimeTransformed, observe=dvi.Trend(of_step)),
     "^ValueError.*fictitious time"),
    (lambda: dvi.Variational("halve"), "^ValueError: on_no_root"),
    (lambda: dvi.Variational(reach=1.0), "^ValueError: reach"),
    (lambda: dvi.Variational(bounds=(2.0, 3.0)), "^ValueError.*≤ 1 ≤"),
    (lambda: variational(method=dvi.Strang()), "^ValueError.*TypeII"),
    (lambda: variational(arithmetic=dvi.FixedPoint(2.0**-40)), "^ValueError.*sizes are rounded"),
    (lambda: dvi.Save(every=2.0), "^ValueError.*at least 1"),
    (lambda: dvi.Save(every=True), "^ValueError.*at least 1"),
    (lambda: dvi.Save(ts=MASKED), "^ValueError.*ts.*mask"),
    (lambda: run(observe=3.0), "^TypeError.*function.*dict"),
    (lambda: run(observe=lambda *a: None), "^TypeError.*one array"),
    (lambda: run(observe=dvi.Range(lambda q, p: q[0] * 1j)), "^TypeError.*real"),
    (lambda: run(observe=lambda q, p: q @ p @ p), "in the observable"),
    (lambda: dvi.Save(ts=[0.1], final=True), "^ValueError.*ts, every and final"),
    (lambda: dvi.Save(ts=0.1), "^ValueError.*shape"),
    (lambda: dvi.Save(clock=vector), "^ValueError.*requires ts"),
    (lambda: dvi.Save(ts=[0.1], clock=3), "^TypeError.*the clock of Save"),
    (lambda: run(save=dvi.Save(ts=[0.1], clock=vector)), "^ValueError: the clock.*real scalar"),
    (lambda: dvi.Section(lambda q: q), "^TypeError: g of Section.*p, args"),
    (lambda: dvi.Section(condition, 2), "^ValueError: direction"),
    (lambda: dvi.Section(condition, max_crossings=0), "^ValueError: max_crossings"),
    (lambda: dvi.Stop(3.0), "^TypeError: g of Stop"),
    (lambda: dvi.LyapunovSpectrum(0), "^ValueError.*at least 1, got 0"),
    (lambda: dvi.GALI(1), "^ValueError.*at least 2, got 1"),
    (lambda: dvi.GALI(2.0), "^ValueError.*got 2.0"),
    (lambda: run(q0=[1.0, 0.0], p0=[0.0, 1.0], observe=dvi.GALI(5)), "^ValueError.*from 1 to 4"),
    (lambda: dvi.MEGNO(seed=-1), "^ValueError.*seed of MEGNO.*-1"),
    (lambda: dvi.SALI(scale=1.0), "^TypeError.*scale of SALI.*pair"),
    (lambda: dvi.MEGNO(scale=(0.0, 1.0)), "^ValueError.*scale of q in MEGNO"),
    (lambda: dvi.MEGNO(scale=(1.0, np.nan)), "^ValueError.*scale of p in MEGNO"),
    (lambda: dvi.GALI(2, scale=("a", 1.0)), "^ValueError.*scale of q in GALI"),
    (lambda: dvi.SALI(scale=(1j, 1.0)), "^ValueError.*scale of q in SALI"),
    (lambda: run(observe=dvi.MEGNO(scale=(np.ones(3), 1.0))), "^ValueError.*scale of q.*3"),
    (lambda: dvi.Running(energy), "^TypeError.*of Running"),
    (lambda: dvi.Running(dvi.Section(vector)), "^TypeError.*dvi.Section"),
    (lambda: run(observe=dvi.Running(dvi.MEGNO()), save=AT_TIMES), "^ValueError.*Running.*every"),
    (lambda: run(observe=dvi.Running), "^TypeError.*class Running"),
    (lambda: dvi.Reversible(0), "^ValueError.*at least 1"),
    (lambda: dvi.Reversible(1.5), "^ValueError.*at least 1"),
    (lambda: dvi.Checkpointed(-1), "^ValueError.*at least 1"),
    (lambda: dvi.Reversible(report_defect=1), "^TypeError: report_defect"),
    (lambda: run(adjoint=DEFECT, method=dvi.RungeKutta4()), "^ValueError.*no inverse step"),
    (lambda: run(adjoint=DEFECT, progress=print), "^ValueError.*report_defect.*progress"),
    *((lambda k=kind: adaptive(lambda t, q, p, args: -1.0, k), "^ValueError: speed.* -1")
     for kind in GRIDS),
    *((lambda k=kind: adaptive(vector, k), "^ValueError: speed.*an array") for kind in GRIDS),
    *((lambda k=kind: k(0.5), "^TypeError.*must be a function") for kind in GRIDS),
    *((lambda k=kind: k(lambda t, q, p: 1.0), "^TypeError.*must take") for kind in GRIDS),
    *((lambda k=kind: adaptive(kind=k, observe=dvi.MEGNO()), "not depend on the")
     for kind in GRIDS),
    (lambda: variational(observe=dvi.SALI()), "^ValueError: SALI.*does not depend on the state"),
    *((lambda run=run: run(vector), "^ValueError.*real scalar") for run in EVENTS),
    *((lambda run=run: run(condition), "^ValueError.*take the difference") for run in EVENTS),
    *((lambda run=run: run(integer), "^ValueError.*take the difference") for run in EVENTS),
]  # fmt: skip
"""(call with a mistake, what the type and the message of its error contain)."""


RING = rings.Ring([rings.quadrupole("QF", 0.5, 0.6), rings.drift("D", 2.0),
                   rings.quadrupole("QD", 0.5, -0.6), rings.drift("D", 2.0)])  # fmt: skip
TURN = rings.problem(RING, planes="x")
X, PX = [1e-3], [0.0]
NEAR = {"samples": 1e-3 * SAMPLES, "h": 1.0, "args": TURN.args}


def lens(potential, **values):
    return rings.lens("L", potential, **values)


CALLS = [
    # arguments that do not exist, are missing, or too many
    (lambda: rings.quadrupole("Q", 0.5, K1=0.6), "^TypeError: quadrupole.*'K1'.*mean 'k1'"),
    (lambda: rings.drift(1.0), "^TypeError: drift requires length. Its arguments are name, length"),
    (lambda: rings.drift("D", L=1.0), "'L'. Did you mean 'length'"),
    (lambda: rings.aperture(0.02, 0.02), "^TypeError: aperture takes 1.*got 2.*rectangle, ellipse"),
    (lambda: dvi.AdaptiveReversible(rtol=1e-6), "'rtol'.*choose h"),
    (dvi.Given, "^TypeError: Given requires ts"),
    (lambda: dvi.Newton(tol=1e-9), "^TypeError: Newton.*mean 'rtol'"),
    (lambda: dvi.System(H_D, W=W), "^TypeError: System.*mean 'force'"),
    (lambda: dvi.Integrator(solver=dvi.Strang()), "^TypeError: Integrator.*mean 'method'"),
    (lambda: dvi.frequencies(1, 2, 3), "^TypeError: frequencies takes 2.*got 3.*ts, signal"),
    (lambda: systems.kepler(mu=1.0), "^TypeError: kepler.*'mu'. It has no arguments"),
    (lambda: plot.conserved([0.0], [1.0]), "^TypeError: conserved requires time and title"),
    (lambda: boozer.from_near_axis(None), "^TypeError: from_near_axis requires minor_radius"),
    # names
    (lambda: systems.keppler, "mean kepler"),
    (lambda: rings.quad, "mean quadrupole"),
    (lambda: dvi.kepler, "'dvi_jax.systems.kepler'"),
    (lambda: run()["q"], "^TypeError.*no items.*qs, ps"),
    # rings
    *((lambda m=m: dvi.integrate(TURN, X, PX, num_steps=2, method=m),
     "^ValueError.*method=rings.Turn") for m in ("Strang", dvi.TypeII(), dvi.GaussLegendre(2))),
    (lambda: dvi.sweep(TURN, X, PX, num_steps=2, method="Strang", epsilon=[0.0, 0.1],
     observe=dvi.Last(energy), progress=False), "^ValueError.*method=rings.Turn"),
    (lambda: dvi.discover_invariants(TURN.system, dvi.Polynomials(2), method="Strang", **NEAR),
     "^ValueError.*method=rings.Turn"),
    (lambda: dvi.poincare_section(TURN.system, np.array([X]), np.array([PX]), lambda q, p: q[0],
     h=1.0, num_steps=5, args=TURN.args, method="Strang"), "^ValueError.*method=rings.Turn"),
    (lambda: rings.optics(TURN), "^TypeError: ring must be a rings.Ring"),
    (lambda: dvi.integrate(TURN.system, X, PX, h=1.0, num_steps=2), "args=problem.args"),
    (lambda: dvi.discover_invariants(TURN.system, dvi.Polynomials(2), **{**NEAR, "args": None}),
     "args=problem.args"),
    (lambda: rings.load("no such file.mat"), "^FileNotFoundError.*no such file"),
    (lambda: rings.load(3), "path"),
    (lambda: boozer.from_near_axis("precise QA", 1.0), "^TypeError: stellarator.*Qsc"),
    (lambda: boozer.GuidingCentres(boozer.precise_qa(), energy=3.5), "^ValueError.*1 MeV is 1e6"),
    (lambda: rings.Ring([rings.drift("D", 1.0)], energy=6.0), "^ValueError.*1 GeV is 1e9"),
    (lambda: rings.Ring(rings.drift("D", 1.0)), "^TypeError: elements must be a list"),
    (lambda: rings.marker(0.5), "^TypeError: name of an element must be text"),
    (lambda: rings.solenoid("S", 1.0, "0.1"), "^ValueError: ks of element 'S'"),
    (lambda: rings.aperture("A", ellipse=0.02), r"^ValueError: ellipse.*\(radius_x, radius_y\)"),
    (lambda: rings.aperture("A", rectangle="abcd"), "^ValueError: rectangle"),
    (lambda: rings.track(RING, "abc", 2), "^TypeError: z must be.*real numbers"),
    (lambda: rings.optics(RING, dp="0"), "^TypeError: dp must be.*real numbers"),
    (lambda: lens(lambda x, y, par: np.log(1 + x)), "lens 'L'.*jnp"),
    (lambda: lens(lambda x, y, par: x if x > 0 else y), "jnp.where"),
    (lambda: lens(lambda x, y, par: par["k"] * x), "^KeyError: 'k'.*par = {}"),
    (lambda: lens(lambda x, y, par: None), "^TypeError.*a return missing"),
    (lambda: lens(lambda x: x), r"^TypeError: potential must take.*\(x, y, par\)"),
    # a state that is one number
    (lambda: run(q0=1.0, p0=0.0), r"q0=\[1.0\] of shape \(1,\)"),
    (lambda: discover(samples=SAMPLES[:, :, 0]), r"samples of shape \(2, N, 1\)"),
    # functions
    (lambda: run(observe=lambda q, p: q[3]), "^IndexError: the observable.*index 3"),
    (lambda: run(observe=dvi.Section(lambda q, p: q[3])), "^IndexError: the observable Section"),
    (lambda: run(stop=dvi.Stop(lambda q, p: q[3])), "^IndexError: g.*Stop.*index 3"),
    (lambda: adaptive(lambda q, p: q[3]), "^IndexError: speed.*index 3"),
    (lambda: run(stop=dvi.Stop(lambda q, p: None)), "^TypeError: g.*a return missing"),
    (lambda: adaptive(lambda q, p: None), "^TypeError: speed.*a return missing"),
    (lambda: adaptive(lambda t, q, p, args: args["k"]), "if speed uses args, pass args"),
    (lambda: run(observe=lambda t, q: q[0]), r"^TypeError: an observable.*\(q, p\)"),
    (lambda: dvi.Stop(lambda t, q: q[0]), r"^TypeError: g of Stop must take.*\(q, p\) or"),
    (lambda: dvi.System(dict), "^TypeError: H_D must be a function"),
    (lambda: dvi.Split(H_D), "^TypeError: parts of Split must be a list"),
    # numbers
    (lambda: systems.double_well(temperature=-0.5), "^ValueError: temperature must be"),
    (lambda: dvi.Langevin("a", 1.0), "^ValueError: friction"),
    (lambda: dvi.integrate(FREE, Q, P, h=0.1, t1="1"), "^TypeError.*t1='1'"),
    (lambda: run(throw="no"), "^TypeError: throw must be True or False"),
    # a flag that is not True or False, in functions, classes and settings
    (lambda: dvi.MaxDrift(energy, relative=1e-3), "^TypeError: relative must be True or False"),
    (lambda: rings.quadrupole("Q", 0.5, 0.6, fringe="no"), "^TypeError: fringe must be True or"),
    (lambda: dvi.GALI(2, log10=2), "^TypeError: log10 must be True or False"),
    # values that are traced where they must be known
    (lambda: traced(lambda x: rings.Ring([rings.drift("D", 1.0)], energy=x)),
     "^TypeError: energy of a ring.*is traced by JAX"),
    (lambda: traced(lambda x: dvi.Newton(rtol=x)), "^TypeError: rtol.*is traced by JAX"),
    (lambda: traced(lambda x: rings.track(RING, np.zeros(6), x)), "^ValueError: turns.*is traced"),
    (lambda: traced(lambda x: dvi.Composition([x, 1.0 - x])), "^TypeError: coeff.*is traced by"),
    (lambda: traced(lambda x: sweep(h=x, observe=dvi.Last(energy))), "each value of a.*is traced"),
    (lambda: traced(lambda x: plot.orbit((x, x))), "^TypeError: an orbit.*is traced by JAX"),
    # units, and values out of range
    (lambda: boozer.GuidingCentres(boozer.precise_qa(), mass=4.0), "^ValueError: mass.*is kg"),
    (lambda: boozer.GuidingCentres(boozer.precise_qa(), charge=3e-19), "charge.*The unit is e"),
    (lambda: boozer.well(boozer.precise_qa(), 2.0, 0.0, 0.0, 0.5), "^ValueError: s must be betw"),
    (lambda: rings.cavity("C", 0.0, 2e6, 5e8), "^ValueError: voltage.*over the energy"),
    (lambda: rings.optics(RING, dp=5.0), "^ValueError: dp must be.*not per cent"),
    (lambda: rings.optics(RING, dp=[0.0, 1e-3]), "^ValueError: dp must be.*scalar.*jax.vmap"),
    (lambda: rings.dynamic_aperture(RING, largest=(40.0, 30.0)), "^ValueError: largest.*is m"),
    (lambda: rings.dynamic_aperture(RING, largest=0.04), r"^ValueError: largest.*\(x_max, y_max\)"),
    (lambda: rings.aperture("A", ellipse=(-0.02, 0.02)), "^ValueError: each width of the ellip"),
    (lambda: rings.aperture("A", rectangle=(0.1, -0.1, -0.1, 0.1)), "^ValueError: each width"),
    (lambda: dvi.flows.Kepler(mass=0.0), "^ValueError: mass of flows.Kepler must be positive"),
    (lambda: dvi.flows.Harmonic(omega=np.nan), "^ValueError: omega of flows.Harmonic"),
    (lambda: dvi.integrate(systems.kepler(), [1.0], [0.0], h=0.1, num_steps=2), "in the plane"),
    (lambda: dvi.integrate(systems.kepler(), h=0.1, num_steps=2, args={"k": 1.0}),
     "^ParameterError.*K is missing"),
    (lambda: dvi.explore(systems.kepler(), h=0.0), "^ValueError: h must not be zero"),
    # objects of another kind
    (lambda: dvi.System(H_D, noise=dvi.Langevin), "^TypeError: noise must be a function"),
    (lambda: dvi.Polynomials(2) + 1, "^TypeError: the second part of a sum of bases"),
    (lambda: rings.multipole("M", 0.5, 3.0), "^TypeError: b of element 'M' must be a list"),
    (lambda: RING.set("QF", b1="1"), "^TypeError: b1 must be.*real numbers"),
    (lambda: plot.work_precision([1, 2]), "^TypeError: results must be a dict"),
    (lambda: plot.drift_orders(3.0), "^TypeError: results must be one dvi.DriftOrder"),
    (lambda: plot.twiss(RING, RING), "^TypeError: optics must be the result of rings.optics"),
    (lambda: dvi.lattice_defect(FREE, [0.0]), "^ValueError: number of points.*got 1"),
    (lambda: boozer.loss_fraction([1.0], "a"), "^TypeError: times must be.*real numbers"),
    (lambda: rings.frequency_map(RING, [1e-3, 2e-3], np.ones(3)), "^ValueError: y.*np.meshgrid"),
    # a user's function that JAX traces: in a proof, a basis, observations, noise, a clock, a model
    *((lambda f=f, call=call: call(f), words) for call in (
        lambda f: bound(energy, inside=f), bound, lambda f: discover(basis=dvi.Basis([f])),
        lambda f: fit(dvi.Observations(TS, np.ones(3), f, sigma=0.1, t0=0.0)),
        lambda f: run(dvi.System(H_D, noise=lambda t, q, p, args: f(q, p) * q), path=1,
                      method=dvi.StochasticEuler()),
        lambda f: run(save=dvi.Save(ts=[0.1], clock=f)))
     for f, words in ((lambda q, p: np.sin(q[0]) + 0 * p[0], "is traced by JAX: use jnp.cos"),
                      (lambda q, p: q[0] if q[0] > 0 else p[0], "Use jnp.where"),
                      (lambda q, p: q[3] + p[0], "^IndexError.*uses the index 3"))),
    (lambda: fit(model=lambda params: {"system": FREE, "h": 0.1, "q0": [np.sin(params["epsilon"])],
     "p0": P}), "a function that fit calls is traced by JAX: use jnp"),
    (lambda: traced(lambda x: drift(q0=x[None])), "An argument of drift_order is traced by JAX"),
    (lambda: bound(lambda q, p: None), "^TypeError.*a return missing"),
    # names of tables
    (lambda: systems.kepler().observables["energi"], "^UnknownName: there is no 'energi'. Did you "
     "mean 'energy'. Allowed: energy, "),
    (lambda: systems.LIBRARY["Kepler"], "there is no 'Kepler'. Did you mean 'kepler'"),
    (lambda: systems.kepler().units["mass"], "there is no 'mass'. Allowed: q, p, t, energy"),
    (lambda: systems.magnetic_mirror().adiabatic["moment"], "there is no 'moment'. Allowed: magn"),
    (lambda: sweep(observe={"a": dvi.Last(energy)})["b"], "there is no 'b'.*Allowed: .*a"),
    # methods
    (lambda: run().save(), "^TypeError: Solution.save requires path"),
    (lambda: boozer.GuidingCentres.start(None, 0.5, 0.0, 0.0),
     "^TypeError: GuidingCentres.start requires pitch. Its arguments are s, theta, zeta, pitch"),
    (lambda: dvi.Discovery.evaluate(None, jnp.ones(1), jnp.ones(1), eps=0.1),
     "^TypeError: Discovery.evaluate has no argument 'eps'. Did you mean 'epsilon'"),
    (lambda: dvi.Discovery.load("found.npz"), "^TypeError: Discovery.load requires basis"),
    (lambda: RING.get("QF"), "^TypeError: Ring.get requires parameter"),
    # a prior and bounds, before they are used
    (lambda: dvi.Prior(0, 0), "^ValueError: sigma of dvi.Prior must be positive.*Leave the prior"),
    (lambda: dvi.Prior(0.0, [1.0, -1.0]), r"^ValueError: sigma of dvi.Prior.*index \[1\]"),
    (lambda: dvi.Prior(0.0, np.inf), "^ValueError: sigma of dvi.Prior"),
    (lambda: dvi.Prior(None, 1.0), "^ValueError: mean of dvi.Prior must be finite, got None"),
    (lambda: dvi.Bounds(np.nan, 1.0), "^ValueError: lower must be less than upper"),
    *((lambda f=f, V=V: rings.cavity("C", 0.0, V, f), "^ValueError: frequency of a cavity must be")
     for f, V in ((-5e8, 1e-3), (0.0, 1e-3), (np.nan, 0.0))),
    (lambda: rings.bend("B", 1.0, 11.25), "^ValueError: angle of a bend.*The unit is rad"),
    (lambda: dvi.Brownian(1.5), "^ValueError: the key of a path must be an integer.*got 1.5"),
    (lambda: dvi.Model(systems.kepler(), h=0.1), "^TypeError: system must.*is problem.system"),
    # more deviation vectors than a manifold has directions
    *((lambda kind=kind: dvi.integrate(systems.spherical_pendulum(), num_steps=2, observe=kind),
     "^ValueError: (count|k) of .* from . to 4, got 5. With a constraint")
     for kind in (dvi.LyapunovSpectrum(5), dvi.Running(dvi.GALI(5)))),
    # rigid bodies
    (lambda: rigid.momentum(np.ones(3), np.ones(3), np.ones(3)), r"^ValueError: R must.*\(3, 3\)"),
    (lambda: rigid.momentum(np.eye(3), 1.0, np.ones(3)), r"^ValueError: pi must.*\(3,\)"),
    (lambda: rigid.second_moments(2.0), r"^ValueError: I must.*\(3,\)"),
    (lambda: rigid.quaternion(np.ones(3)), r"^ValueError: R must.*3, 3\), got \(3,\)"),
    (lambda: rigid.euler_angles(np.ones((5, 3, 3))), "^ValueError: R must.*jax.vmap"),
    (lambda: rigid.rotation(np.ones(3), 0.0, 0.0), "^ValueError: phi of a rotation must.*scalar"),
]  # fmt: skip


def traced(call):
    return jax.eval_shape(call, jnp.ones(()))


def loop(t0, t1, q0, p1, args):
    while q0[0] > 1:
        q0 = q0 / 2
    return p1 @ p1 + q0 @ q0


def unit():
    return pytest.importorskip("astropy.units").m


def without_x64(call):
    jax.config.update("jax_enable_x64", False)
    try:
        return call()
    finally:
        jax.config.update("jax_enable_x64", True)


@pytest.mark.parametrize(("call", "words"), [*ERRORS, *REFUSALS, *CALLS])
def test_an_error_helps(call, words):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        text = message_of(call)
    assert re.search(words, text, re.DOTALL), text


def message_of(call):
    """Type and message of the error that the call raises, with its notes."""
    try:
        call()
    except Exception as error:
        text = f"{type(error).__name__}: {error}"
        return "\n".join([text, *getattr(error, "__notes__", [])])
    raise AssertionError("no error")


WARNINGS = [
    (lambda: run(epsilon=0.1), "epsilon.*no effect"),
    (lambda: fit(dvi.Observations(TS, np.ones(3), sigma=0.1)), "t0 is not given.*t=?"),
    (lambda: dvi.System(lambda t0, t1, p1, q0, args: p1 @ p1 / 2 + jnp.cos(q0[0])),
     "exchange them"),
    (lambda: dvi.discretise(lambda t, p, q, args: p @ p), "exchange them"),
    (lambda: run(observe=lambda p, q: p @ p), "exchange them"),
    (lambda: dvi.System(H_D, force=lambda t0, t1, p, q, args: -q), "exchange them"),
    (lambda: rings.aperture("A", ellipse=(40.0, 30.0)), "no effect.*The unit is m"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "words"), WARNINGS)
def test_a_warning_helps(call, words):
    with pytest.warns(UserWarning, match=words):
        call()


SPACES = {"dvi": dvi, "rings": rings, "systems": systems, "boozer": boozer, "plot": plot,
          "interop": interop, "flows": dvi.flows, "starts": dvi.starts}  # fmt: skip


def explained():
    for space, module in SPACES.items():
        for name in dir(module):
            thing = getattr(module, name)
            if name.startswith("_") or not thing.__class__.__module__.startswith(
                ("abc", "builtins")
            ):
                continue
            init = vars(thing).get("__init__") if isinstance(thing, type) else thing
            home = str(getattr(thing, "__module__", ""))
            own = home.startswith((module.__name__, "lanewise"))
            is_error = isinstance(thing, type) and issubclass(thing, BaseException)
            if own and not is_error and inspect.isfunction(init):
                yield f"{space}.{name}", thing, init


def test_every_public_function_and_class_explains_a_wrong_argument():
    count = 0
    for label, thing, init in explained():
        kinds = [p.kind for p in inspect.signature(init).parameters.values()]
        text = message_of(lambda thing=thing: thing(no_such_argument=1))
        is_abstract = "abstract" in text
        if inspect.Parameter.VAR_KEYWORD in kinds:
            assert "no_such_argument" in text, (label, text)
        elif not is_abstract:
            assert re.search(r"has no argument 'no_such_argument'\. (Its|It|Did)", text), (
                label,
                text,
            )
        count += not is_abstract
    assert count > 150


def test_an_error_inside_of_a_function_stays_itself():
    def f(q, p):
        return len(q, p)

    assert message_of(lambda: run(observe=f)).startswith("TypeError: len() takes exactly one")


def test_functions_and_objects_can_be_pickled():
    library = systems.LIBRARY.values()
    for thing in (dvi.integrate, dvi.sweep, rings.drift, plot.orbit, *library):
        assert pickle.loads(pickle.dumps(thing)) is thing
    assert pickle.loads(pickle.dumps(dvi.Yoshida(4))) == dvi.Yoshida(4)


def test_tables_of_names_are_dicts():
    table = pickle.loads(pickle.dumps(systems.kepler())).observables
    assert isinstance(table, dict)
    assert "energi" not in table
    assert table.get("energi") is None
    with pytest.raises(KeyError, match="Did you mean 'energy'"):
        table["energi"]
    sol = dvi.integrate(systems.kepler(), num_steps=2, observe=table)
    plain = dvi.integrate(systems.kepler(), num_steps=2, observe=dict(table))
    assert sol.observed.keys() == plain.observed.keys() == table.keys()
    np.testing.assert_array_equal(sol.observed["energy"], plain.observed["energy"])


def test_a_warning_shows_the_line_of_the_user():
    for call, words in WARNINGS[:3]:
        with pytest.warns(UserWarning, match=words) as record:
            call()
        assert record[0].filename == __file__


def test_lyapunov_exponents_with_a_constraint_are_those_of_the_manifold():
    sphere, save = systems.spherical_pendulum(), dvi.Save(final=True)
    kinds = [dvi.LyapunovSpectrum(), dvi.LyapunovSpectrum(4)]
    found = dvi.integrate(sphere, num_steps=20, observe=kinds, save=save).observed
    np.testing.assert_array_equal(*found)
    assert run(observe=dvi.LyapunovSpectrum()).observed.shape == (2,)


def planets(h, **how):
    outer = systems.outer_solar_system()
    return dvi.integrate(outer, h=h, num_steps=1, method=dvi.WisdomHolman(**how))


def test_too_few_steps_in_a_revolution_warn():
    with pytest.warns(UserWarning, match=r"h = 2000 .* body 1 has the period 4332, .* 2.2 steps"):
        planets(2000.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        planets(100.0)
        planets(2000.0, scheme=(10, 6, 4))


def test_a_close_pericentre_warns_and_an_orbit_that_is_not_bound_does_not():
    def go(speed):
        args = {"masses": np.array([1.0, 1e-6]), "G": 1.0}
        q0, p0 = [[0.0, 0.0], [2.0, 0.0]], [[0.0, 0.0], [0.0, 1e-6 * speed]]
        method = dvi.WisdomHolman()
        return dvi.integrate(systems.n_body(), q0, p0, args=args, h=0.1, num_steps=1, method=method)

    with pytest.warns(UserWarning, match="67 steps, or 1.1 at the angular velocity of its peri"):
        go(0.2)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        go(9.0)


def final(**how):
    return float(run(FORCED, epsilon=0.1, **how).q_final[0])


ANSWERS = [
    lambda: (run(FORCED, epsilon=0.0).qs, run().qs),
    lambda: (run(q0=[1], p0=[0]).qs, run().qs),
    lambda: (run(q0=(1.0,)).qs, run().qs),
    lambda: (run(num_steps=3.0).qs, run().qs),
    lambda: (final(method="strang"), final(method=dvi.Strang())),
    lambda: (final(method="leapfrog"), final(method=dvi.Strang())),
    lambda: (final(method="yoshida(4)"), final(method=dvi.Yoshida(4))),
    lambda: (final(method="KahanLi8"), final(method=dvi.KahanLi(8))),
    lambda: (dvi.integrate(FREE, Q, P, h=0.1, t1=0.3).qs, run().qs),
    lambda: (dvi.integrate(FREE, Q, P, h=0.1, t0=1.0, t1=1.3).ts, run(t0=1.0).ts),
    lambda: (dvi.integrate(FREE, Q, P, h=0.1, duration=0.3).qs, run().qs),
    lambda: (dvi.integrate(FREE, Q, P, h=-0.1, t1=-0.3).qs, run(h=-0.1).qs),
    lambda: (dvi.integrate(systems.kepler(), h=0.1, num_steps=3).qs, kepler_by_hand()),
    lambda: (run(observe=energy).observed, jax.vmap(energy)(run().qs, run().ps)),
    lambda: (run(observe=lambda t, q, p, args: t).observed, run().ts),
    lambda: (run(observe=dvi.MaxDrift(lambda q, p: q[0])).observed,
     abs(run().qs[:, 0] - 1.0).max()),
    lambda: (run(q0=[2.0], observe=dvi.MaxDrift(lambda q, p: q[0], relative=True)).observed,
     abs(run(q0=[2.0]).qs[:, 0] / 2.0 - 1.0).max()),
    lambda: (run(progress=True).qs, run().qs),
    lambda: (fit(observed(values=np.ones(3))).x, fit(observed()).x),
    lambda: (final(method=dvi.Leapfrog()), final(method=dvi.Strang())),
    lambda: (run().p_final, run().ps[-1]),
]  # fmt: skip
"""(Result of what people write, what it must equal)."""


def kepler_by_hand():
    k = systems.kepler()
    return dvi.integrate(k.system, k.q0, k.p0, args=k.args, h=0.1, num_steps=3, epsilon=0.0).qs


@pytest.mark.parametrize("habit", ANSWERS)
def test_a_habit_gives_the_right_answer(habit):
    found, expected = habit()
    np.testing.assert_allclose(np.asarray(found), np.asarray(expected), rtol=1e-14, atol=1e-15)


def test_states_of_the_library_are_arrays():
    for make in (systems.kepler, systems.henon_heiles, systems.oscillator):
        assert isinstance(make().q0, np.ndarray)
        assert isinstance(make().p0 @ make().p0, float)
