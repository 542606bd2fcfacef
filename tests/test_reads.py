"""Values that user functions read from outside: a changed one never meets an old program."""

import copy
import functools
import pickle
import types
import warnings
from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.base.reads import reads
from dvi_jax.observe import Reduction, of_steps

STIFFNESS = 1.0
TABLE = np.array([1.0, 2.0])
SETTINGS = {"k": 1.0, "powers": [2]}
MODULE = types.ModuleType("constants_of_a_user")
MODULE.k = 1.0
ARRAY = jnp.ones(2)


def spring(k, q0, p1):
    return p1 @ p1 / 2 + k * (q0 @ q0) / 2


def of_global(t0, t1, q0, p1, args):
    return spring(STIFFNESS, q0, p1)


def stiffness():
    return STIFFNESS


def of_a_function_of_a_global(t0, t1, q0, p1, args):
    return spring(stiffness(), q0, p1)


def of_array(t0, t1, q0, p1, args):
    return spring(TABLE[0], q0, p1)


class Spring:
    k = 1.0

    def H(self, t0, t1, q0, p1, args):
        return spring(self.k, q0, p1)

    def __call__(self, *at):
        return self.H(*at)


def weighted(k, t0, t1, q0, p1, args):
    return spring(k["k"], q0, p1)


class Slotted:
    __slots__ = ("k",)


class Number:
    """A number by its operators only."""

    def __init__(self, k):
        self.value = k

    def __mul__(self, other):
        return self.value * other


RATIO, OPERATION, LINE = Fraction(1), jnp.abs, eqx.nn.Lambda(lambda x: x)
RUN = {"h": 0.1, "num_steps": 3}


def final(H):
    system = H if isinstance(H, dvi.System) else dvi.System(H)
    how = {"method": dvi.TypeII(), "save": dvi.Save(final=True)}
    return float(dvi.integrate(system, [1.0], [0.0], **RUN, **how).qs[-1, 0])


def cases(monkeypatch):
    """A Hamiltonian with the stiffness 1, and the assignment that changes it to 4."""
    bound, called, inside, cell, table = Spring(), Spring(), {"k": 1.0}, [1.0], np.ones(2)
    this = globals()

    def new_global(name, value):
        return lambda: monkeypatch.setitem(this, name, value)

    def in_cell():
        cell[0] = 4.0

    slotted, number, numbers, by_name = Slotted(), Number(1.0), {1.0}, types.SimpleNamespace(k=1.0)
    slotted.k = 1.0

    def potential(q):
        return cell[0] * (q @ q) / 2

    return {
        "global": (of_global, new_global("STIFFNESS", 4.0)),
        "function": (of_a_function_of_a_global, new_global("STIFFNESS", 4.0)),
        "array": (of_array, new_global("TABLE", TABLE * 4.0)),
        "array in place": (lambda t0, t1, q0, p1, args: spring(table[0], q0, p1),
                           lambda: table.__setitem__(0, 4.0)),
        "dictionary": (lambda t0, t1, q0, p1, args: spring(SETTINGS["k"], q0, p1),
                       lambda: monkeypatch.setitem(SETTINGS, "k", 4.0)),
        "module": (lambda t0, t1, q0, p1, args: spring(MODULE.k, q0, p1),
                   lambda: monkeypatch.setattr(MODULE, "k", 4.0)),
        "method": (bound.H, lambda: setattr(bound, "k", 4.0)),
        "object": (called, lambda: setattr(called, "k", 4.0)),
        "closure": (lambda t0, t1, q0, p1, args: spring(cell[0], q0, p1), in_cell),
        "partial": (functools.partial(weighted, inside), lambda: inside.update(k=4.0)),
        "adapter": (dvi.discretise(lambda t, q, p, args: spring(cell[0], q, p)), in_cell),
        # A function without a name of a global or an attribute, which calls another one.
        "inner": (lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + potential(q0), in_cell),
        "class": (lambda t0, t1, q0, p1, args: spring(Spring.k, q0, p1),
                  lambda: monkeypatch.setattr(Spring, "k", 4.0)),
        "slots": (lambda t0, t1, q0, p1, args: spring(slotted.k, q0, p1),
                  lambda: setattr(slotted, "k", 4.0)),
        "operator": (lambda t0, t1, q0, p1, args: spring(1.0, q0 * 0, p1) + number * (q0 @ q0) / 2,
                     lambda: setattr(number, "value", 4.0)),
        "by a string": (lambda t0, t1, q0, p1, args: spring(getattr(by_name, "k"), q0, p1),  # noqa: B009
                        lambda: setattr(by_name, "k", 4.0)),
        "set": (lambda t0, t1, q0, p1, args: spring(sum(numbers), q0, p1),
                lambda: numbers.add(3.0)),
        "fraction": (lambda t0, t1, q0, p1, args: spring(float(RATIO), q0, p1),
                     new_global("RATIO", Fraction(4))),
        "function of JAX": (lambda t0, t1, q0, p1, args: spring(OPERATION(4.0) ** 0.5 / 2, q0, p1),
                            new_global("OPERATION", lambda x: 16 * x)),
        "module of equinox": (lambda t0, t1, q0, p1, args: spring(LINE(1.0), q0, p1),
                              new_global("LINE", eqx.nn.Lambda(lambda x: 4 * x))),
    }  # fmt: skip


NAMES = list(cases(pytest.MonkeyPatch()))


def exact(k):
    q, p = 1.0, 0.0
    for _ in range(3):
        p = p - 0.1 * k * q
        q = q + 0.1 * p
    return q


@pytest.mark.parametrize("name", NAMES)
def test_a_new_system_reads_the_new_value_and_the_old_one_raises(name, monkeypatch):
    H, change = cases(monkeypatch)[name]
    system = dvi.System(H)
    assert final(system) == pytest.approx(exact(1.0), rel=1e-14)
    change()
    assert final(H) == pytest.approx(exact(4.0), rel=1e-14)
    value = r"STIFFNESS \(value 1.0, now 4.0\)" if name in ("global", "function") else ""
    with pytest.raises(ValueError, match=f"have changed since.*{value}"):
        final(system)


@pytest.mark.slow
def test_value_and_gradient_belong_to_one_hamiltonian(monkeypatch):
    def last(x):
        return dvi.integrate(dvi.System(of_global), x[None], jnp.zeros(1), **RUN).qs[-1, 0]

    last(jnp.asarray(1.0))
    monkeypatch.setitem(globals(), "STIFFNESS", 4.0)
    assert float(jax.grad(last)(1.0)) == pytest.approx(float(last(jnp.asarray(1.0))), rel=1e-12)


def test_an_observable_and_a_stop_read_the_new_value():
    limit, system = {"q": 0.5}, dvi.System(of_global)
    how = {
        "observe": lambda t0, t1, q0, p0, q1, p1, args: q1[0] - limit["q"],
        "stop": dvi.Stop(lambda t, q, p, args: limit["q"] - q[0]),
    }

    def found():
        sol = dvi.integrate(system, [1.0], [0.0], h=0.1, num_steps=20, throw=False, **how)
        return float(sol.observed[0]), float(sol.stop.q[0])

    first = found()
    limit["q"] = 0.25
    second = found()
    assert second[0] - first[0] == pytest.approx(0.25, rel=1e-14)
    assert (first[1], second[1]) == pytest.approx((0.5, 0.25), rel=1e-10)


def swept(system, observable):
    how = {"observe": {"end": dvi.Last(observable)}, "epsilon": dvi.Axis("e", [0.0])}
    return float(dvi.sweep(system, [1.0], [0.0], progress=False, **RUN, **how)["end"][0])


def test_a_sweep_reads_the_new_value(monkeypatch):
    def last():
        return swept(dvi.System(of_global), lambda t0, t1, q0, p0, q1, p1, args: q1[0])

    assert last() == pytest.approx(exact(1.0), rel=1e-14)
    monkeypatch.setitem(globals(), "STIFFNESS", 4.0)
    assert last() == pytest.approx(exact(4.0), rel=1e-14)


@pytest.mark.slow
def test_observables_of_a_sweep_and_of_a_drift_read_the_new_value():
    """The system stays the same, and so do the functions."""
    scale = {"s": 1.0}
    system = dvi.System(of_global, force=lambda t0, t1, q0, p1, args: -p1)

    def momentum(t0, t1, q0, p0, q1, p1, args):
        return scale["s"] * p1[0]

    def found():
        order = dvi.drift_order(system, momentum, [1.0], [0.0], epsilons=[1e-3, 1e-2], **RUN)
        return swept(system, momentum), float(order.start_drifts[-1, 0])

    first = found()
    scale["s"] = 3.0
    assert found() == pytest.approx(tuple(3 * x for x in first), rel=1e-12)


@pytest.mark.slow
def test_a_fit_of_a_function_reads_the_new_value():
    mass = {"m": 1.0}
    system = dvi.System(lambda t0, t1, q0, p1, args: spring(args["k"], q0, p1))
    ts = np.linspace(0.5, 3.0, 6)
    data = dvi.Observations(ts, np.cos(ts)[:, None], sigma=0.01, t0=0.0)

    def model(params):
        args = {"k": params["k"] * mass["m"]}
        return {"system": system, "q0": [1.0], "p0": [0.0], "h": 0.1, "args": args}

    def found():
        result = dvi.fit(model, data, {"k": 1.1}, progress=False, check_curvature=False)
        return float(result.params["k"])

    first = found()
    mass["m"] = 2.0
    assert found() == pytest.approx(first / 2, rel=1e-6)


@pytest.mark.parametrize("again", [False, True])
def test_values_that_a_function_changes_itself_are_no_change(again):
    """A counter of calls raises no error, and causes no new compilation, of a new system either."""
    calls = [0]

    def H(t0, t1, q0, p1, args):
        calls[0] += 1
        return spring(STIFFNESS, q0, p1)

    system = dvi.System(H)
    final(system)
    final(H) if again else None  # from here on it is known that H changes its counter
    count = calls[0]
    assert count > 0
    final(H if again else system)
    assert calls[0] == count


def test_arrays_that_are_arguments_are_not_read():
    class Well(eqx.Module):
        k: jax.Array

        def __call__(self, t0, t1, q0, p1, args):
            return spring(self.k, q0, p1)

    system = dvi.System(Well(jnp.asarray(1.0)))
    other = eqx.tree_at(lambda s: s.H_D.k, system, jnp.asarray(4.0))
    assert final(other) == pytest.approx(exact(4.0), rel=1e-14)


def test_copies_of_a_system():
    system = dvi.System(of_array)
    final(copy.deepcopy(system))
    final(pickle.loads(pickle.dumps(system)))


def test_large_arrays_are_compared_in_part():
    table = np.zeros(1 << 20)
    read = functools.partial(reads, lambda: table[0])
    before = read()
    table[0] = 1.0
    assert read() != before
    table[0] = 0.0
    table[1] = 1.0
    assert read() == before  # only every ninth entry is compared


def test_one_name_in_several_functions_is_stored_for_each():
    first, second = (lambda k: lambda: k)(1.0), (lambda k: lambda: k)(2.0)
    assert [mark for _, mark in reads(first, second)] == [("value", "1.0"), ("value", "2.0")]


def test_no_warning_from_reading():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reads(lambda: (ARRAY, np, jnp, warnings))


class Path(dvi.BrownianPath):
    def increments(self, k, interval, parts, count):
        return jnp.full((parts, count), STIFFNESS) * jnp.sqrt(interval.h)


class Mine(dvi.TypeII):
    factor = STIFFNESS

    def step(self, equations, interval, q0, p0):
        return super().step(equations, interval, q0 * STIFFNESS * self.factor, p0)


class Largest(Reduction):
    function: object

    def start(self, value):
        return value

    def update(self, memory, k, t, value):
        return jnp.maximum(memory, STIFFNESS * value)

    def finish(self, memory):
        return memory


def free(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + q0 @ q0 / 2


PLAIN = dvi.System(free)
NOISY = dvi.System(free, noise=lambda t, q, p, args: jnp.ones(1))
TWO = dvi.systems.n_body([1.0, 1e-3], [[0.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [0.0, 1e-3]])


def run(system=PLAIN, q0=(1.0,), p0=(0.0,), **options):
    return dvi.integrate(system, np.array(q0), np.array(p0), h=0.1, num_steps=9, **options)


def clock(t, q, p, args):
    return STIFFNESS * t


WHAT_A_RUN_CALLS = {
    "clock": lambda: run(save=dvi.Save(ts=[0.2, 0.3], clock=clock)).qs,
    "path": lambda: run(NOISY, path=Path(), method=dvi.BAOAB()).qs,
    "method": lambda: run(method=Mine()).qs,
    "base of a method": lambda: run(method=dvi.Strang(base=Mine())).qs,
    "reduction": lambda: run(observe=Largest(of_steps(lambda q, p: q[0]))).observed,
    "initial value": lambda: run(observe=lambda q, p: STIFFNESS * q[0]).observed[:1],
    "gravity": lambda: run(
        TWO.system, TWO.q0, TWO.p0, args=TWO.args, method=dvi.WisdomHolman(G=lambda args: STIFFNESS)
    ).qs,
    "section": lambda: dvi.poincare_section(
        PLAIN, [[1.0]], [[0.5]], lambda t, q, p, args: q[0] - 0.1 * STIFFNESS, h=0.1, num_steps=99,
        crossings=1, method=dvi.Strang(),
    ).ts,
}  # fmt: skip


SLOW = ("gravity", "section")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in SLOW else n for n in WHAT_A_RUN_CALLS],
)
def test_all_that_a_run_calls_reads_the_new_value(name, monkeypatch):
    f = WHAT_A_RUN_CALLS[name]
    monkeypatch.setitem(globals(), "STIFFNESS", 1.0)
    first = np.asarray(f())
    monkeypatch.setitem(globals(), "STIFFNESS", 2.0)
    second = np.asarray(f())
    assert not np.array_equal(first, second, equal_nan=True)
    jax.clear_caches()
    np.testing.assert_array_equal(second, f())


def test_a_constant_of_a_class_is_read(monkeypatch):
    first = np.asarray(run(method=Mine()).qs)
    monkeypatch.setattr(Mine, "factor", 2.0)
    assert not np.array_equal(first, run(method=Mine()).qs)
