"""`holds_for`: a certificate is about one program, and about no other."""

import jax.numpy as jnp
import numpy as np
import pytest
from cli import command, found

import dvi_jax as dvi

pytest.importorskip("flint")

STIFFNESS = np.array([1.0, 1.3])


def hamiltonian(t0, t1, q, p, args):
    return (p @ p + (args * q) @ q) / 2 + q[0] ** 2 * q[1] / 3


def energy(q, p, epsilon):
    return hamiltonian(0, 0, q, p, jnp.asarray(STIFFNESS))


SYSTEM = dvi.System(hamiltonian, force=lambda t0, t1, q, p, args: -(q**3))
HOW = {"args": STIFFNESS, "method": dvi.Strang()}


@pytest.fixture(scope="module")
def bound():
    return dvi.bound_drift(
        energy, SYSTEM, h=0.1, epsilon=0.01, domain=np.full(2, 0.2), ratio=4.0, **HOW
    )


OTHERS = {
    "another stiffness": (SYSTEM, energy, HOW | {"args": STIFFNESS * (1 + 1e-15)}, "step"),
    "another method": (SYSTEM, energy, HOW | {"method": dvi.TypeII()}, "step"),
    "another arithmetic": (SYSTEM, energy, HOW | {"arithmetic": dvi.DoubleDouble()}, "arithmetic"),
    "a force of another sign": (
        dvi.System(hamiltonian, force=lambda t0, t1, q, p, args: q**3), energy, HOW, "step"),
    "another invariant": (SYSTEM, lambda q, p, epsilon: p @ p, HOW, "invariants"),
    "a condition": (SYSTEM, energy, HOW | {"inside": lambda q, p: 0.1 - q}, "inside"),
    "slow time": (
        dvi.System(hamiltonian, force=lambda t0, t1, q, p, args: -(q**3), slow_time=True),
        energy, HOW, "slow_time"),
}  # fmt: skip


def test_a_proof_holds_for_its_program(bound, tmp_path):
    assert dvi.holds_for(SYSTEM, bound, energy, **HOW)
    path = tmp_path / "bound.json"
    bound.save(path)
    binding = dvi.holds_for(SYSTEM, path, **HOW)
    assert binding.holds
    assert "not compared" in str(binding)
    # The same equation in other words has the same list of operations.
    same = dvi.System(hamiltonian, force=lambda t0, t1, q, p, args: -q * q * q)
    assert not dvi.holds_for(same, path, **HOW)


@pytest.mark.parametrize("name", OTHERS)
def test_it_does_not_hold_for_another(bound, name):
    system, invariant, how, word = OTHERS[name]
    binding = dvi.holds_for(system, bound, invariant, **how)
    assert not binding
    assert word in str(binding)


@pytest.mark.parametrize("part", ["H_D", "invariant", "inside", "args"])
def test_another_number_of_coordinates_is_a_difference(part):
    free = dvi.System(lambda t0, t1, q, p, args: p @ p / 2)
    bound = dvi.bound_drift(
        lambda q, p, epsilon: p[0], free, h=0.1, epsilon=0.1, domain=np.array([0.5])
    )
    assert dvi.holds_for(free, bound)
    one = lambda q, p, epsilon: p[0]  # noqa: E731
    binding = {
        "H_D": lambda: dvi.holds_for(SYSTEM, bound, **HOW),
        "args": lambda: dvi.holds_for(
            dvi.System(lambda t0, t1, q, p, args: args @ p), bound, args=STIFFNESS),
        "invariant": lambda: dvi.holds_for(free, bound, lambda q, p, epsilon: p @ STIFFNESS),
        "inside": lambda: dvi.holds_for(free, bound, one, inside=lambda q, p: q + STIFFNESS @ p),
    }[part]()  # fmt: skip
    assert not binding
    assert "number of coordinates: q and p of the certificate have the shape (1,)" in str(binding)


def test_other_elementary_functions_are_another_program(bound, monkeypatch):
    from dvi_jax.proof import programs

    monkeypatch.setattr(programs, "digest_of_functions", lambda: "0")
    assert "elementary functions" in dvi.holds_for(SYSTEM, bound, energy, **HOW).differences[0]


def test_a_changed_file_is_refused(bound, tmp_path):
    changed = bound.certificate | {"h": (0.2).hex()}
    with pytest.raises(ValueError, match="unchanged"):
        dvi.holds_for(SYSTEM, changed, **HOW)


def test_what_is_no_certificate_is_refused(tmp_path):
    (tmp_path / "text").write_text("no JSON")
    (tmp_path / "list").write_text("[]")
    for certificate, kind in (("text", ValueError), ("list", TypeError)):
        with pytest.raises(kind, match=certificate):
            dvi.holds_for(SYSTEM, tmp_path / certificate, **HOW)
    with pytest.raises(TypeError, match="got 3"):
        dvi.holds_for(SYSTEM, 3, **HOW)


@pytest.mark.slow
def test_the_command_line_compares_a_system(bound, tmp_path):
    (tmp_path / "model.py").write_text(
        "import dvi_jax as dvi\n"
        "def system(k):\n"
        "    return dvi.System(lambda t0, t1, q, p, args: (p @ p + k * q @ q) / 2)\n"
        "soft, stiff = system(1.0), system(2.0)\n"
        "def exact(q, p, epsilon):\n"
        "    return (p @ p + q @ q - 0.1 * (q @ p)) / 2\n"
        "def other(q, p, epsilon):\n"
        "    return p @ p + q @ q\n"
    )
    soft = dvi.System(lambda t0, t1, q, p, args: (p @ p + 1.0 * q @ q) / 2)
    exact = lambda q, p, epsilon: (p @ p + q @ q - 0.1 * (q @ p)) / 2  # noqa: E731
    path = tmp_path / "bound.json"
    dvi.bound_drift(exact, soft, h=0.1, epsilon=0.1, domain=np.array([0.5])).save(path)
    model = tmp_path / "model.py"
    assert found("verify", path, "--system", f"{model}:soft")["system"]["holds"] is True
    alone = found("verify", path, "--system", f"{model}:soft")["system"]
    assert "give --invariants FILE.py:NAME" in alone["text"]
    with_functions = "--system", f"{model}:soft", "--invariants"
    both = found("verify", path, *with_functions, f"{model}:exact")["system"]
    assert (both["holds"], both["remarks"]) == (True, [])
    assert command("verify", path, *with_functions, f"{model}:other").exit_code == 1
    result = command("verify", path, "--system", f"{model}:stiff")
    assert result.exit_code == 1
    assert "the list of operations of the step" in result.output
