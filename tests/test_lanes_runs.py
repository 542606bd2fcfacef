"""Runs by components against runs in arrays: lattices, methods, failures, saves, gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi

COMPONENTS, ARRAYS = dvi.Layout(form="components"), dvi.Layout(form="arrays")
SLOW = pytest.mark.slow


def assert_same(found, expected, rtol=1e-10):
    paths = jax.tree_util.tree_flatten_with_path(expected)[0]
    for (path, b), a in zip(paths, jax.tree.leaves(found), strict=True):
        where = jax.tree_util.keystr(path)
        assert (a.shape, a.dtype) == (b.shape, b.dtype), where
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol, err_msg=where)


def both(run, rtol=1e-10):
    expected = run(ARRAYS)
    assert_same(run(COMPONENTS), expected, rtol)
    return expected


def final(system, q, p, h, layout, args=None, num_steps=20, **settings):
    settings = {"save": dvi.Save(final=True), **settings}
    sol = dvi.integrate(
        system, q, p, h=h, num_steps=num_steps, args=args, layout=layout, **settings
    )
    return jnp.sum(sol.qs[-1] ** 2)


def starts(lanes, *shape, seed=0, size=0.3):
    rng = np.random.default_rng(seed)
    return (jnp.asarray(size * rng.normal(size=(lanes, *shape))) for _ in range(2))


MIXED = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + q0 @ (args @ p1) + jnp.sum(q0**4) / 4)
"""I + h·args is the matrix of its implicit step."""


@pytest.mark.parametrize("pivot", [pytest.param(x, marks=SLOW) for x in (0.0, 1e-11, 1e-8)])
def test_gradients_where_elimination_needs_exchanges(pivot):
    """The first pivot of I + h M is next to nothing: digits without exchanges would be lost."""
    q, p = starts(3, 3)
    M = jnp.array([[-1.0, 0.7, 0.2], [0.9, 0.3, -0.4], [0.1, 0.6, 0.8]])
    h = 1.0 - pivot

    def gradient(layout):
        slope = jax.grad(lambda q, p, M: final(MIXED, q, p, h, layout, M, num_steps=2), (0, 2))
        return jax.jit(jax.vmap(slope, (0, 0, None)))(q, p, M)

    expected = both(gradient, rtol=1e-11)
    assert np.isfinite(expected[1]).all()


TABLE = jnp.array([1.0, 2.0, 3.0, 4.0])
CHOSEN = dvi.System(
    lambda t0, t1, q0, p1, args: (
        p1 @ p1 / 2 * TABLE[args["which"]]
        + jnp.where(args["strong"], 2.0, args["w"]) * (q0 @ q0) / 2
    )
)


@pytest.mark.parametrize("what", ["grad", pytest.param("jvp", marks=SLOW)])
@pytest.mark.parametrize("lanes_of", [pytest.param("state", marks=SLOW), "which"])
@pytest.mark.slow
def test_derivatives_beside_whole_numbers_and_truth_values(what, lanes_of):
    """Integers in args are traced, and vary from lane to lane; they have no derivative."""
    q, p = starts(4, 2)
    on = lanes_of == "state"
    which = jnp.array([0, 3, 1, 2])
    arguments = (q, p, which) if on else (q[0], p[0], which)

    def slopes(layout):
        def loss(q, p, w, which):
            args = {"which": which, "w": w, "strong": which == 1}
            return final(CHOSEN, q, p, 0.02, layout, args)

        def of(q, p, which):
            if what == "grad":
                return jax.grad(loss, (0, 1, 2))(q, p, 1.5, which)
            return jax.jvp(lambda w: loss(q, p, w, which), (1.5,), (1.0,))

        axes = (0, 0, 0) if on else (None, None, 0)
        return jax.jit(jax.vmap(of, axes))(*arguments)

    expected = both(slopes)
    assert len(np.unique(np.round(expected[-1], 12))) > 1  # which of them it is does matter


# --- whole runs, pair by pair ------------------------------------------------------------------

N = 129
"""One step more than a segment on trust."""


def separable(t0, t1, q0, p1, args):
    q, p = q0.ravel(), p1.ravel()
    return p @ p / 2 * args["w"] + jnp.sum(q**4) / 4 - jnp.cos(q[0] * q[-1] + t1)


def coupled(t0, t1, q0, p1, args):
    q, p = q0.ravel(), p1.ravel()
    return (1 + q @ q) * (1 + p @ p) / 2 * args["w"] + 0.1 * q[0] * p[-1] * jnp.cos(t0)


def kepler(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 - args["w"] / jnp.linalg.norm(q0)


def drag(t0, t1, q0, p1, args):
    return -p1 * jnp.cos(t0) * args["w"] + jnp.asarray([1.0, 2.0, 3.0], q0.dtype)[args["k"]]


def seen(t0, t1, q0, p0, q1, p1, args):
    return q1 * p1 + t1 * args["w"]


def whole(t0, t1, q0, p0, q1, p1, args):
    return args["k"] + 1


REDUCED = (dvi.Trend(seen), dvi.Mean(seen), dvi.Last(seen), dvi.MaxDrift(seen), dvi.Range(seen))
SECTION = dvi.Section(lambda t, q, p, args: jnp.sum(q) - 0.5 * jnp.sum(p), max_crossings=3)
STOP = dvi.Stop(lambda t, q, p, args: jnp.sum(q**2) - 1.0)
EVERY = dvi.Save(every=7, final=True)


def given(t0, h):
    k = jnp.arange(N + 1, dtype=h.dtype)
    return dvi.Given(t0 + h * k * (1 + 0.003 * k))


def everything(sol):
    names = ("successful", "not_converged", "not_finite", "bad_step_size", "stopped")
    codes = {name: sol.result == getattr(dvi.RESULTS, name) for name in names}
    parts = {name: getattr(sol, name) for name in ("ts", "qs", "ps", "hs", "observed", "stop")}
    return parts, codes, sol.stats["failed_step"]


def lanes_of(shape, dtype, sign=1, bad=False, lanes=5):
    q, p = (0.3 + 0.3 * x for x in starts(lanes, *shape))
    h = jnp.full(lanes, 0.02 * sign)
    if bad:  # a start that is none, no step, an implicit step that has no root
        q, h = q.at[1].set(jnp.nan), h.at[2].set(0.0)
        p = p.at[3].set(60.0)
    t0, epsilon, w = (jnp.linspace(a, b, lanes) for a, b in ((0, 1), (0, 0.1), (0.9, 1.1)))
    return *(x.astype(dtype) for x in (q, p, h, t0, epsilon, w)), jnp.arange(lanes) % 3


def runner(hamiltonian, shape=(2,), dtype=np.float64, sign=1, bad=False, width=None, **settings):
    """One run as a function of all that has lanes, and the lanes."""
    force = None if settings.pop("unforced", False) else drag
    num_steps, of = settings.pop("num_steps", N), settings.pop("lattice", None)

    def one(q, p, h, t0, epsilon, w, k, layout):
        lattice = {"num_steps": num_steps, "h": h, "t0": t0}
        if of is given:
            lattice = {"lattice": given(t0, h)}
        elif of is not None:
            lattice["lattice"] = of
        options = {"save": EVERY, **settings}
        if options["save"] == "times":
            options["save"] = dvi.Save(
                ts=t0 + h * num_steps * jnp.asarray([0.1, 0.5, 1.0], h.dtype)
            )
        system = dvi.System(hamiltonian, force=force)
        return dvi.integrate(
            system, q, p, epsilon=epsilon, args={"w": w, "k": k}, layout=layout, throw=False,
            **lattice, **options,
        )  # fmt: skip

    return one, lanes_of(shape, dtype, sign, bad)


CASES = {
    "failures": {"hamiltonian": coupled, "bad": True, "observe": REDUCED},
    "failures, explicit": {"hamiltonian": separable, "bad": True, "observe": (*REDUCED, seen)},
    "backwards": {"hamiltonian": separable, "sign": -1, "save": dvi.Save(), "method": dvi.Strang()},
    "given": {"hamiltonian": coupled, "lattice": given, "observe": (seen, whole)},
    "no step": {"hamiltonian": coupled, "num_steps": 0, "observe": (REDUCED, seen)},
    "one step": {"hamiltonian": coupled, "num_steps": 1, "observe": REDUCED},
    "segments": {"hamiltonian": coupled, "num_steps": 127, "save": dvi.Save(every=128, final=True)},
    "long blocks": {
        "hamiltonian": separable,
        "num_steps": 307,
        "save": dvi.Save(every=150, final=True),
    },
    "times": {"hamiltonian": separable, "save": "times", "observe": (seen, REDUCED)},
    "a section": {"hamiltonian": separable, "observe": SECTION},
    "a stop": {"hamiltonian": separable, "stop": STOP, "observe": REDUCED},
    "a number": {"hamiltonian": separable, "shape": (), "observe": REDUCED},
    "a matrix": {"hamiltonian": coupled, "shape": (2, 2), "num_steps": 9},
    "compensated": {"hamiltonian": coupled, "arithmetic": dvi.Compensated(), "num_steps": 40},
    "on a grid": {
        "hamiltonian": separable,
        "unforced": True,
        "arithmetic": dvi.FixedPoint(2.0**-40),
        "num_steps": 9,
    },
    "adapted": {
        "hamiltonian": kepler,
        "lattice": dvi.TimeTransformed(lambda t, q, p, a: 1 + q @ q),
        "num_steps": 20,
    },
    "single precision": {
        "hamiltonian": coupled,
        "dtype": np.float32,
        "observe": REDUCED,
        "rtol": 1e-3,
    },
    "Gauss": {"hamiltonian": coupled, "method": dvi.GaussLegendre(2), "num_steps": 20},
    "Lobatto": {"hamiltonian": coupled, "method": dvi.LobattoIIIAIIIB(3), "num_steps": 20},
    "Kahan-Li": {"hamiltonian": separable, "method": dvi.KahanLi(6), "num_steps": 20},
}


IN_ONE_TILE = ("failures, explicit", "given", "a matrix", "adapted", "Gauss")
ALONE = ("failures", "long blocks", "times", "a section", "a stop", "a number", "compensated")
"""How lanes are put into tiles does not depend on what a run does: a sample of the cases."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_runs(name):
    """By components in tiles, in arrays, and one after the other, lanes that fail included."""
    settings = dict(CASES[name])
    rtol = settings.pop("rtol", 1e-9)
    one, lanes = runner(**settings)

    def batch(layout):
        return jax.jit(jax.vmap(lambda *x: everything(one(*x, layout))))(*lanes)

    expected = batch(ARRAYS)
    tiles = dvi.Layout(form="components", width=3)  # two, the last one not full
    assert_same(batch(tiles), expected, rtol)
    if name in IN_ONE_TILE:
        assert_same(batch(COMPONENTS), expected, rtol)
    if name in ALONE:
        alone = jax.jit(lambda *x: everything(one(*x, COMPONENTS)))
        each = [alone(*(x[i] for x in lanes)) for i in range(len(lanes[0]))]
        assert_same(jax.tree.map(lambda *x: jnp.stack(x), *each), expected, rtol)
    assert np.isfinite(expected[0]["qs"][0, :1]).all()  # there is something to compare


REVERSIBLE = dvi.Reversible(20)
GRADIENTS = {
    "explicit": {"hamiltonian": separable, "num_steps": 45, "adjoint": REVERSIBLE},
    "implicit": {"hamiltonian": coupled, "num_steps": 45, "save": dvi.Save(every=25, final=True)},
    "given": {"hamiltonian": separable, "lattice": given, "adjoint": REVERSIBLE},
    "compensated": {"hamiltonian": separable, "num_steps": 45, "arithmetic": dvi.Compensated()},
    "times": {"hamiltonian": separable, "num_steps": 45, "save": "times"},
    "forwards": {
        "hamiltonian": separable,
        "num_steps": 45,
        "mode": "forwards",
        "method": dvi.Yoshida(4),
    },
    "twice": {"hamiltonian": separable, "num_steps": 5, "mode": "twice"},
    "checkpointed": {
        "hamiltonian": separable,
        "num_steps": 45,
        "adjoint": dvi.Checkpointed(),
        "method": dvi.RungeKutta4(),
    },
    "direct": {"hamiltonian": coupled, "num_steps": 9, "adjoint": dvi.Direct(), "mode": "twice"},
    "no step": {"hamiltonian": coupled, "num_steps": 0},
    "one step": {"hamiltonian": coupled, "num_steps": 1},
}


WITH_REDUCTIONS = ("explicit", "implicit", "forwards", "direct")
"""Five reductions take twice as long to compile."""


@pytest.mark.slow
@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients_of_runs(name):
    """By the start, h, t0, ε and args, of saved states, times and what is reduced."""
    settings = {"observe": (REDUCED if name in WITH_REDUCTIONS else (), seen), **GRADIENTS[name]}
    if settings.get("num_steps", N) < 2:
        settings["observe"] = None  # no Trend yet
    mode = settings.pop("mode", "backwards")
    one, lanes = runner(**settings)

    def slopes(layout):
        def loss(*x):
            sol = one(*x, layout)
            watched = [jnp.sum(jnp.sin(v)) for v in jax.tree.leaves(sol.observed)]
            return jnp.sum(sol.qs**2 * jnp.cos(sol.ps)) + sum(watched) + jnp.sum(sol.ts)

        def of(*x):
            *smooth, k = x

            def forwards(*x):
                return jax.jvp(lambda *x: loss(*x, k), x, tuple(map(jnp.ones_like, x)))[1]

            if mode == "forwards":
                return forwards(*smooth)
            if mode == "twice":
                return jax.grad(forwards, (0, 2, 5))(*smooth)
            return jax.grad(loss, tuple(range(6)))(*x)

        axes = (0, 0, None, 0, None, None, 0)
        mine = [x if a == 0 else x[1] for x, a in zip(lanes, axes, strict=True)]
        return jax.jit(jax.vmap(of, axes))(*mine)

    expected = both(slopes, 1e-8)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(expected))
