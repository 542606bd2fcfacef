"""Values that user functions read from outside: a changed one never meets an old program."""

import copy
import functools
import pickle
import types
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.engine.reads import reads

STIFFNESS = 1.0
TABLE = np.array([1.0, 2.0])
SETTINGS = {"k": 1.0, "powers": [2]}
MODULE = types.ModuleType("constants_of_a_user")
MODULE.k = 1.0
ARRAY = jnp.ones(2)


def of_global(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + STIFFNESS * (q0 @ q0) / 2


def potential(q):
    return STIFFNESS * (q @ q) / 2


def of_a_function_of_a_global(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + potential(q0)


def of_array(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + TABLE[0] * (q0 @ q0) / 2


def of_dictionary(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + SETTINGS["k"] * (q0 @ q0) / 2


def of_module(t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + MODULE.k * (q0 @ q0) / 2


class Spring:
    k = 1.0

    def H(self, t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + self.k * (q0 @ q0) / 2

    def __call__(self, *at):
        return self.H(*at)


def weighted(k, t0, t1, q0, p1, args):
    return p1 @ p1 / 2 + k["k"] * (q0 @ q0) / 2


def position(t0, t1, q0, p0, q1, p1, args):
    return q1[0]


def final(H):
    system = H if isinstance(H, dvi.System) else dvi.System(H)
    how = {"method": dvi.TypeII(), "save": dvi.Save(final=True)}
    return float(dvi.integrate(system, [1.0], [0.0], h=0.1, num_steps=3, **how).qs[-1, 0])


def cases(monkeypatch):
    """A Hamiltonian with the stiffness 1, and what sets the stiffness to 4."""
    spring, called, inside, cell = Spring(), Spring(), {"k": 1.0}, [1.0]

    def of_closure(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + cell[0] * (q0 @ q0) / 2

    table = np.ones(2)

    def of_local(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + table[0] * (q0 @ q0) / 2

    this = globals()
    return {
        "global": (of_global, lambda: monkeypatch.setitem(this, "STIFFNESS", 4.0)),
        "function": (
            of_a_function_of_a_global,
            lambda: monkeypatch.setitem(this, "STIFFNESS", 4.0),
        ),
        "array": (of_array, lambda: monkeypatch.setitem(this, "TABLE", TABLE * 4.0)),
        "array in place": (of_local, lambda: table.__setitem__(0, 4.0)),
        "dictionary": (of_dictionary, lambda: monkeypatch.setitem(SETTINGS, "k", 4.0)),
        "module": (of_module, lambda: monkeypatch.setattr(MODULE, "k", 4.0)),
        "method": (spring.H, lambda: setattr(spring, "k", 4.0)),
        "object": (called, lambda: setattr(called, "k", 4.0)),
        "closure": (of_closure, lambda: cell.__setitem__(0, 4.0)),
        "partial": (functools.partial(weighted, inside), lambda: inside.update(k=4.0)),
        "adapter": (
            dvi.discretise(lambda t, q, p, args: p @ p / 2 + cell[0] * (q @ q) / 2),
            lambda: cell.__setitem__(0, 4.0),
        ),
    }


NAMES = list(cases(pytest.MonkeyPatch()))


def exact(k):
    q, p = 1.0, 0.0
    for _ in range(3):
        p = p - 0.1 * k * q
        q = q + 0.1 * p
    return q


@pytest.mark.parametrize("name", NAMES)
def test_a_new_system_reads_the_new_value_and_the_old_one_is_refused(name, monkeypatch):
    H, change = cases(monkeypatch)[name]
    system = dvi.System(H)
    assert final(system) == pytest.approx(exact(1.0), rel=1e-14)
    change()
    assert final(H) == pytest.approx(exact(4.0), rel=1e-14)
    with pytest.raises(ValueError, match="have changed since"):
        final(system)


def test_the_message_names_the_value(monkeypatch):
    system = dvi.System(of_a_function_of_a_global)
    monkeypatch.setitem(globals(), "STIFFNESS", 4.0)
    with pytest.raises(ValueError, match=r"STIFFNESS \(value 1.0, now value 4.0\). Make a new"):
        final(system)


def test_value_and_gradient_belong_to_one_hamiltonian(monkeypatch):
    def last(x):
        run = {"h": 0.1, "num_steps": 3, "save": dvi.Save(final=True)}
        return dvi.integrate(dvi.System(of_global), x[None], jnp.zeros(1), **run).qs[-1, 0]

    last(jnp.asarray(1.0))
    monkeypatch.setitem(globals(), "STIFFNESS", 4.0)
    assert float(jax.grad(last)(1.0)) == pytest.approx(float(last(jnp.asarray(1.0))), rel=1e-12)


def test_an_observable_and_a_stop_read_the_new_value():
    limit = {"q": 0.5}
    run = {"h": 0.1, "num_steps": 20, "throw": False}
    system = dvi.System(of_global)

    def observable(t0, t1, q0, p0, q1, p1, args):
        return q1[0] - limit["q"]

    def event(t, q, p, args):
        return limit["q"] - q[0]

    def found():
        at = {"observe": observable, "stop": dvi.Stop(event)}
        sol = dvi.integrate(system, [1.0], [0.0], **run, **at)
        return float(sol.observed[0]), float(sol.stop.q[0])

    first = found()
    limit["q"] = 0.25
    second = found()
    assert second[0] - first[0] == pytest.approx(0.25, rel=1e-14)
    assert (first[1], second[1]) == pytest.approx((0.5, 0.25), rel=1e-10)


def test_a_sweep_reads_the_new_value(monkeypatch):
    def last():
        run = {"h": 0.1, "num_steps": 3, "observe": {"end": dvi.Last(position)}, "progress": False}
        found = dvi.sweep(dvi.System(of_global), [1.0], [0.0], epsilon=dvi.Axis("e", [0.0]), **run)
        return float(found["end"][0])

    assert last() == pytest.approx(exact(1.0), rel=1e-14)
    monkeypatch.setitem(globals(), "STIFFNESS", 4.0)
    assert last() == pytest.approx(exact(4.0), rel=1e-14)


def test_observables_of_a_sweep_and_of_a_drift_read_the_new_value():
    """The system stays the same, and so do the functions."""
    scale = {"s": 1.0}
    system = dvi.System(of_global, force=lambda t0, t1, q0, p1, args: -p1)

    def momentum(t0, t1, q0, p0, q1, p1, args):
        return scale["s"] * p1[0]

    def found():
        run = {"h": 0.1, "num_steps": 3, "progress": False}
        of = {"observe": {"end": dvi.Last(momentum)}, "epsilon": dvi.Axis("e", [0.0])}
        swept = float(dvi.sweep(system, [1.0], [0.0], **of, **run)["end"][0])
        run = {"h": 0.1, "num_steps": 3, "epsilons": [1e-3, 1e-2]}
        order = dvi.drift_order(system, momentum, [1.0], [0.0], **run)
        return swept, float(order.start_drifts[-1, 0])

    first = found()
    scale["s"] = 3.0
    assert found() == pytest.approx(tuple(3 * x for x in first), rel=1e-12)


def test_a_fit_of_a_function_reads_the_new_value():
    mass = {"m": 1.0}
    system = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2 + args["k"] * (q0 @ q0) / 2)
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


def test_what_a_function_changes_itself_is_no_change():
    """A counter of calls makes no error, and no new compilation either."""
    calls = []

    def H(t0, t1, q0, p1, args):
        calls.append(1)
        return p1 @ p1 / 2 + q0 @ q0 / 2

    system = dvi.System(H)
    final(system)
    count = len(calls)
    assert count > 0
    final(system)
    assert len(calls) == count


def test_the_same_values_compile_once():
    calls = [0]

    def H(t0, t1, q0, p1, args):
        calls[0] += 1
        return p1 @ p1 / 2 + STIFFNESS * (q0 @ q0) / 2

    final(H)
    final(H)  # from here on it is known that H changes its counter
    count = calls[0]
    final(H)
    assert calls[0] == count


def test_arrays_that_are_arguments_are_not_read():
    class Well(eqx.Module):
        k: jax.Array

        def __call__(self, t0, t1, q0, p1, args):
            return p1 @ p1 / 2 + self.k * (q0 @ q0) / 2

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
    assert read() == before  # every ninth entry is looked at


def test_a_name_of_several_functions_is_kept_for_each():
    first, second = (lambda k: lambda: k)(1.0), (lambda k: lambda: k)(2.0)
    assert [mark for _, mark in reads(first, second)] == [("value", "1.0"), ("value", "2.0")]


def test_no_warning_from_reading():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        reads(lambda: (ARRAY, np, jnp, warnings))
