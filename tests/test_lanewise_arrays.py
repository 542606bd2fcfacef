"""Random programs of arrays, compiled, against the same operations one by one in NumPy."""

import itertools

import jax
import numpy as np
import pytest
from random_programs import reference
from random_programs.array_programs import KINDS, SMALL_KINDS, Program
from random_programs.arrays import TOLERANCE, check, difference, search, smaller

from lanewise.evaluator import RULES
from lanewise.jaxprs.jaxapi import ClosedJaxpr, Literal, scan_counts
from lanewise.rules.elementwise import ELEMENTWISE

FOUR = ("in place", "moves", "loops", "branches")
"""Kinds of which there are four short tests, of the others three: 40 programs."""

QUICK = {
    *(("moves", 1000), ("moves", 1002), ("in place", 1000), ("in place", 1001)),
    *(("reductions", 1001), ("reductions", 1002), ("pairs", 1000), ("cumulative", 1002)),
    *(("indices", 1000), ("indices", 1002), ("types", 1001), ("derivatives", 1002)),
    *(("loops", 1000), ("everything", 1001)),
}
"""Those that compile in about a second number by number; the others are in the long tests."""


def short_tests():
    for kind in SMALL_KINDS:
        for seed in range(1000, 1004 if kind in FOUR else 1003):
            marks = () if (kind, seed) in QUICK else pytest.mark.slow
            yield pytest.param(kind, seed, marks=marks)


@pytest.mark.parametrize(("kind", "seed"), list(short_tests()))
def test_a_few_programs(kind, seed):
    outcome = check(Program(seed, kind))
    assert not outcome.failure
    assert not outcome.ill


@pytest.mark.slow
@pytest.mark.parametrize("part", range(2))
@pytest.mark.parametrize("kind", SMALL_KINDS)
def test_programs(kind, part):
    lines = []
    assert search([kind], 21, 2000 + 21 * part, lines.append) == 0, "\n".join(lines)


def test_a_program_is_a_function_of_its_seed_and_kind():
    one, two, other = Program(3, "moves"), Program(3, "moves"), Program(4, "moves")
    assert str(one.jaxpr) == str(two.jaxpr) != str(other.jaxpr)
    for x, y in zip(one.inputs, two.inputs, strict=True):
        np.testing.assert_array_equal(x, y)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["moves", "reductions", "branches", "types", "cumulative"])
def test_the_reference_has_the_values_of_jax(kind):
    """Control: without `jit` JAX computes the operations one by one too."""
    program = Program(5, kind)
    with jax.disable_jit():
        expected = [np.asarray(x) for x in program(*program.lane(0))]
    outs = reference.evaluate(program.jaxpr, *program.lane(0))
    assert not difference(outs, expected, TOLERANCE)


# Controls: mistakes that must be found


def with_wrong_difference(monkeypatch):
    """A program, of which the reference computes differences wrongly."""
    rule = reference.FUNCTIONS["sub"]
    monkeypatch.setitem(reference.FUNCTIONS, "sub", lambda x, y: rule(y, x))
    return Program(1002, "in place")


def test_a_wrong_operation_is_found(monkeypatch):
    assert check(with_wrong_difference(monkeypatch)).failure


@pytest.mark.slow
def test_a_failure_is_made_small(monkeypatch):
    program = with_wrong_difference(monkeypatch)
    small = smaller(program)
    assert len(small.jaxpr.eqns) <= len(program.jaxpr.eqns)
    assert str(small.jaxpr).count(" sub ") >= 1
    assert len(small.removed) > len(program.body) // 2


def _body_of_the_loop(program):
    """Position of the loop over time, name of its parameter, and the carry of its body."""
    for k, eqn in enumerate(program.jaxpr.jaxpr.eqns):
        if eqn.primitive.name == "scan":
            consts, carry = scan_counts(eqn.params)
            return k, "jaxpr", range(consts, consts + carry)
        if eqn.primitive.name == "while":
            body = eqn.params["body_jaxpr"].jaxpr
            first = eqn.params["body_nconsts"]
            return k, "body_jaxpr", range(first, len(body.invars))
    raise AssertionError("no loop")


def _mutants(program):
    """The program with one operand of one operation of a step exchanged: the new value of a carry
    is read instead of the old one, as after a wrong update in place, or the old one instead."""
    k, name, carry = _body_of_the_loop(program)
    loop = program.jaxpr.jaxpr.eqns[k]
    body = loop.params[name].jaxpr
    pairs = [(body.invars[c], body.outvars[c - carry.start]) for c in carry]
    pairs = [(old, new) for old, new in pairs if new not in body.invars and old.aval.shape]
    pairs = [(old, new) for old, new in pairs if not isinstance(new, Literal)]
    used = _needed(body, body.outvars)
    for (old, new), eqn in itertools.product(pairs, body.eqns):
        for before, after in ((old, new), (new, old)):
            needs = _needed(body, [after])
            reads = any(v is before for v in eqn.invars)
            if not reads or id(eqn) not in used or id(eqn) in needs:
                continue
            changed = eqn.replace(invars=[after if v is before else v for v in eqn.invars])
            # What the changed operation needs comes first.
            first = [e for e in body.eqns if id(e) in needs]
            later = [changed if e is eqn else e for e in body.eqns if id(e) not in needs]
            step = ClosedJaxpr(body.replace(eqns=[*first, *later]), loop.params[name].consts)
            eqns = list(program.jaxpr.jaxpr.eqns)
            eqns[k] = loop.replace(params={**loop.params, name: step})
            yield ClosedJaxpr(program.jaxpr.jaxpr.replace(eqns=eqns), program.jaxpr.consts)


def _needed(jaxpr, outputs):
    """The operations that some values need, by their identity."""
    needed, wanted = set(), {id(v) for v in outputs}
    for eqn in reversed(jaxpr.eqns):
        if any(id(v) in wanted for v in eqn.outvars):
            needed.add(id(eqn))
            wanted |= {id(v) for v in eqn.invars}
    return needed


def test_old_and_new_values_of_a_carry_differ_in_the_programs():
    """Nearly each exchange of the old and the new value in a step changes results by more than the
    tolerance: the comparison finds such a mistake of the compiler."""
    seen = missed = 0
    for seed, kind in itertools.product(range(1000, 1010), ["in place", "loops"]):
        program = Program(seed, kind)
        expected = reference.evaluate(program.jaxpr, *program.lane(0))
        if any(np.isnan(x).any() for x in expected):
            continue
        for mutant in itertools.islice(_mutants(program), 5):
            seen += 1
            outs = reference.evaluate(mutant, *program.lane(0))
            missed += not difference(outs, expected, TOLERANCE)
    assert seen > 40
    assert missed <= 0.1 * seen


@pytest.mark.slow
def test_a_wrong_rule_of_the_compiler_is_found(monkeypatch):
    """Control: a difference with its operands exchanged."""
    rule = RULES["sub"]
    monkeypatch.setitem(RULES, "sub", lambda e, eqn, xs, places: rule(e, eqn, xs[::-1], places))
    of_numbers = ELEMENTWISE["sub"]
    monkeypatch.setitem(ELEMENTWISE, "sub", lambda e, params, x, y: of_numbers(e, params, y, x))
    failures = [check(Program(1000 + k, "in place")).failure for k in range(3)]
    assert any(failures)


def test_every_family_is_in_a_kind():
    families = {family for weights in KINDS.values() for family in weights}
    assert families >= {"branches", "derivatives", "pairs", "types", "calls"}
