"""Attributes that a function reads of its arguments, or whose names are values: none is stale."""

import array
import functools
import operator
import types

import pytest

import dvi_jax as dvi
from dvi_jax.base.reads import differences, reads


class Spring:
    def __init__(self):
        self.k = 1.0

    def squared(self, power):
        return self.k**power


def stiffness(spring):
    return spring.k


def energy_of(springs):
    return stiffness(springs[0])


def matched(spring):
    match spring:
        case Spring(k=k):
            return k
    return None


class Doubled:
    k = 1.0

    def product(self, factor, q):
        return factor * self.k * q

    double = functools.partialmethod(product, 2.0)


def indirect_reads():
    """Functions that read an attribute of an object which they do not name, and its change."""
    spring, nested, doubled, plain = Spring(), Spring(), Doubled(), {"k": 1.0}
    nested.inner = types.SimpleNamespace(k=1.0)
    of_k, of_inner = operator.attrgetter("k"), operator.attrgetter("inner.k")
    squared = operator.methodcaller("squared", power=2)
    view, table = types.MappingProxyType(plain), array.array("d", [1.0])
    partial, getters = functools.partial, {"first": [of_k]}
    new_k, new_inner = lambda: setattr(spring, "k", 4.0), lambda: setattr(nested.inner, "k", 4.0)
    return {
        "argument": (lambda q: stiffness(spring) * q, new_k),
        "list": (lambda q, springs=(spring,): energy_of(springs) * q, new_k),
        "namespace": (lambda q: stiffness(nested.inner) * q, new_inner),
        "match": (lambda q: matched(spring) * q, new_k),
        "attrgetter": (lambda q: of_k(spring) * q, new_k),
        "path": (lambda q: of_inner(nested) * q, new_inner),
        "written out": (lambda q: operator.attrgetter("inner.k")(nested) * q, new_inner),
        "getters": (lambda q: getters["first"][0](spring) * q, new_k),
        "methodcaller": (lambda q: squared(spring) * q, new_k),
        "map": (lambda q: sum(map(of_k, [spring])) * q, new_k),
        "partial": (partial(lambda spring, q: spring.k * q, spring), new_k),
        "chain": (partial(partial(lambda s, a, q: stiffness(s) * a * q, spring), 2.0), new_k),
        "partial getter": (lambda q, read=partial(of_k, spring): read() * q, new_k),
        "partial getattr": (lambda q, read=partial(getattr, spring, "k"): read() * q, new_k),
        "partialmethod": (lambda q: 1.0 * doubled.double(q), lambda: setattr(doubled, "k", 4.0)),
        "view": (lambda q: view["k"] * q, lambda: plain.update(k=4.0)),
        "numbers": (lambda q: table[0] * q, lambda: table.__setitem__(0, 4.0)),
    }


@pytest.mark.parametrize("name", list(indirect_reads()))
def test_attributes_that_another_function_reads(name):
    """An attribute of an object that is an argument of a function, or whose name is a value."""
    function, change = indirect_reads()[name]
    earlier, value = reads(function), function(1.0)
    assert reads(function) == earlier
    change()
    assert function(1.0) != value
    assert differences(earlier, reads(function))


def test_a_run_reads_the_new_attribute_of_an_argument():
    spring = Spring()

    def H_D(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 + stiffness(spring) * (q0 @ q0) / 2

    def final(system):
        start = {"q0": [1.0], "p0": [0.0], "h": 0.1, "num_steps": 1}
        return float(dvi.integrate(system, **start, save=dvi.Save(final=True)).p_final[0])

    system = dvi.System(H_D)
    assert final(system) == pytest.approx(-0.1, rel=1e-14)
    spring.k = 4.0
    assert final(dvi.System(H_D)) == pytest.approx(-0.4, rel=1e-14)
    with pytest.raises(ValueError, match=r"spring.k \(value 1.0, now 4.0\)"):
        final(system)
