"""The description of a sweep: every difference that changes numbers changes it, and no other."""

import errno

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax.sweep import claims, layout
from dvi_jax.sweep.identity import description, differences, digest
from dvi_jax.sweep.request import Request

Q, FINAL = np.asarray([0.5]), dvi.Save(final=True)


def oscillator(k=1.0):
    return dvi.System(lambda t0, t1, q0, p1, a: jnp.sum(p1**2) / 2 + k * jnp.sum(q0**2) / 2)


def identity(system=None, q0=Q, p0=Q, **kw):
    kw = {"h": 0.1, "num_steps": 5, "t0": [0.0, 1.0], "save": FINAL} | kw
    program, arrays, programs = Request(system or oscillator(), q0, p0, **kw).prepare()
    return description(program.sweep, program.plan, arrays, programs)


class Spring(eqx.Module):
    """A function as an object."""

    k: float
    power: int = eqx.field(static=True, default=2)

    def __call__(self, t0, t1, q0, p1, args):
        return jnp.sum(p1**2) / 2 + self.k * jnp.sum(q0**self.power) / 2


def spring_in_closure(c):
    class Inside(eqx.Module):
        k: float

        def __call__(self, t0, t1, q0, p1, args):
            return jnp.sum(p1**2) / 2 + c * self.k * jnp.sum(q0**2) / 2

    return dvi.System(Inside(1.0))


class Constant(dvi.starts.Starts):
    """Initial conditions defined by a user."""

    count: int = 4
    name: str = "start"

    def at(self, index, t0, args):
        return jnp.ones(1) * SCALE["of starts"] + index, jnp.ones(1)


SCALE = {"of starts": 1.0}


@jax.tree_util.register_pytree_node_class
class Parameters:
    """args that are not a dictionary."""

    def __init__(self, k):
        self.k = k

    def tree_flatten(self):
        return (self.k,), None

    @classmethod
    def tree_unflatten(cls, _, leaves):
        return cls(*leaves)


def with_own_derivative(c):
    @jax.custom_jvp
    def potential(q):
        return jnp.sum(q**2)

    potential.defjvp(lambda x, t: (potential(x[0]), c * jnp.sum(2 * x[0] * t[0])))
    return dvi.System(lambda t0, t1, q0, p1, a: jnp.sum(p1**2) / 2 + potential(q0))


def last(c):
    class Last(dvi.Last):
        def finish(self, memory):
            return c * memory[0]

    return Last(lambda t0, t1, q0, p0, q1, p1, args: q1[0])


def position(t0, t1, q0, p0, q1, p1, args):
    return q1[0]


def stop_at(k):
    return dvi.Stop(lambda t, q, p, a, k=k: jnp.sum(q) - k)


OF_ARGS = dvi.System(lambda t0, t1, q0, p1, a: (p1 @ p1 + a.k * q0 @ q0) / 2)
TABLE = [np.arange(20.0), np.arange(20.0)]
TABLE[1][17] += 1e-9

DIFFERENT = {
    "a constant in a closure": [{"system": oscillator(k)} for k in (1.0, 1.0 + 1e-15)],
    "a field of a module": [{"system": dvi.System(Spring(k))} for k in (1.0, 2.0)],
    "a static field of a module": [{"system": dvi.System(Spring(1.0, n))} for n in (2, 4)],
    "the code of a module": [{"system": spring_in_closure(c)} for c in (1.0, 5.0)],
    "a bound method": [{"system": dvi.System(Spring(k).__call__)} for k in (1.0, 2.0)],
    "a rule of differentiation": [{"system": with_own_derivative(c)} for c in (1.0, 2.0)],
    "args of a class": [{"system": OF_ARGS, "args": Parameters(k)} for k in (1.0, 5.0)],
    "a user-defined reduction": [{"observe": last(c)} for c in (1.0, 2.0)],
    "a default of a stop": [{"args": 1.0, "stop": stop_at(k)} for k in (1.2, 1.35)],
    "a lattice's function": [
        {"lattice": dvi.TimeTransformed(lambda t, q, p, a, c=c: c + q @ q)} for c in (1.0, 2.0)
    ],
    "one number of an axis": [{"epsilon": dvi.Axis("e", x), "t0": 0.0} for x in TABLE],
    "the start": [{"q0": Q}, {"q0": Q * 2}],
    "the tolerance": [{"root_finder": dvi.Newton(rtol=r)} for r in (1e-12, 1e-13)],
    "the method": [{"method": dvi.Yoshida(4)}, {"method": dvi.Suzuki(4)}],
    "a box of starts": [
        {"q0": None, "p0": None, "start": dvi.starts.Random(4, ([0.0], [0.0]), ([b], [1.0]))}
        for b in (1.0, 1.5)
    ],
}


@pytest.mark.filterwarnings("ignore:epsilon = ")
@pytest.mark.parametrize("what", DIFFERENT)
def test_what_changes_numbers_changes_the_description(what):
    a, b = (identity(**kw) for kw in DIFFERENT[what])
    assert digest(a) != digest(b)
    assert differences(a, b)
    assert digest(identity(**DIFFERENT[what][0])) == digest(a)


@pytest.mark.slow
def test_the_code_of_generated_initial_conditions_is_part_of_it(monkeypatch):
    """And a program that was compiled with another value is not used again."""

    def run():
        return dvi.sweep(oscillator(), start=Constant(), h=1e-9, num_steps=1, save=FINAL)

    kw = {"q0": None, "p0": None, "start": Constant()}
    before, one = identity(**kw), run()
    monkeypatch.setitem(SCALE, "of starts", 2.0)
    assert differences(before, identity(**kw)) == [
        "program: a function, or a part of the packages, computes something else"
    ]
    two = run()
    np.testing.assert_allclose(two["q"] - one["q"], 1.0)
    np.testing.assert_allclose(two["q0"] - one["q0"], 1.0)


SAME = {
    "another function with the same result": [{"system": oscillator()}, {"system": oscillator()}],
    "numbers of NumPy": [{"h": 0.1, "epsilon": 0}, {"h": np.float64(0.1), "epsilon": 0.0}],
    "a lambda": [{"observe": {"x": position}}, {"observe": {"x": lambda *a: a[4][0]}}],
}


@pytest.mark.parametrize("what", SAME)
def test_what_does_not_change_numbers_does_not_change_it(what):
    a, b = (identity(**kw) for kw in SAME[what])
    assert differences(a, b) == []


def test_unsigned_integers_booleans_and_unknown_names(tmp_path):
    late = lambda t, q, p, args: t > 0.15  # noqa: E731
    observe = {"count": lambda *a: jnp.uint8(3), "x": dvi.Last(position), "late": late}
    found = dvi.sweep(oscillator(), Q, Q, h=0.1, num_steps=2, t0=[0.0, 1.0], observe=observe,
                      store=tmp_path / "s.zarr")  # fmt: skip
    assert found["count"].dtype == np.uint8
    assert (found["count"] == 3).all()
    np.testing.assert_array_equal(found["t0"], [0.0, 1.0])
    for flags in (found["late"], dvi.open_sweep(found.path).to_xarray()["late"]):
        assert flags.dtype == bool
        np.testing.assert_array_equal(flags, [[False, True], [True, True]])
    with pytest.raises(KeyError, match="Did you mean 'count'"):
        found["cuont"]


@pytest.mark.slow
def test_generated_initial_conditions_have_the_first_time_of_a_given_lattice():
    def H(t, q, p, args):
        return p @ p / 2 + 0.1 * t

    start = dvi.starts.EnergyShell(3, H, 1.0, [-1.0], [1.0])
    found = dvi.sweep(
        oscillator(), start=start, lattice=dvi.Given(np.linspace(5.0, 6.0, 3)), save=FINAL
    )
    np.testing.assert_allclose(found["p"][:, 0, 0] ** 2 / 2 + 0.5, 1.0, rtol=1e-14)


def test_float32_takes_lists_of_numbers():
    with jax.enable_x64(False):
        q, options = jnp.asarray([0.5], jnp.float32), {"num_steps": 4, "save": FINAL}
        found = dvi.sweep(oscillator(), q, q, h=[0.1, 0.05], **options)
        assert found["q"].dtype == np.float32
        with pytest.raises(TypeError, match="float64"):
            dvi.sweep(oscillator(), q, q, h=np.asarray([0.1, 0.05]), **options)


def small(path):
    return dvi.sweep(oscillator(), Q, Q, h=0.1, num_steps=3, t0=[0.0, 1.0, 2.0], lanes_per_task=1,
                     save=FINAL, store=path)  # fmt: skip


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def lockf(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(claims.fcntl, "lockf", lockf)
    with pytest.warns(UserWarning, match="files cannot be locked here"):
        assert small(tmp_path / "s.zarr").is_complete


def test_links_and_relative_paths(tmp_path, monkeypatch):
    (tmp_path / "there").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "there")
    found = small(tmp_path / "link")
    monkeypatch.chdir(tmp_path)
    relative = dvi.open_sweep("there")
    monkeypatch.chdir("/")
    np.testing.assert_array_equal(relative["q"], found["q"])
    (tmp_path / "there" / ".tasks").rename(tmp_path / "elsewhere")
    with pytest.raises(dvi.StoreError, match="names begin with a dot"):
        dvi.open_sweep(tmp_path / "there")


def test_lengths_without_divisors_do_not_give_tiny_chunks():
    variable = layout.Variable("float64", (30,), ("x",))
    inner = layout.layout((32749,), variable)["chunks"]
    assert np.prod(inner) * 8 > layout.CHUNK_BYTES / 16
    inner = layout.layout((2**15, 4), variable)["chunks"]
    assert np.prod(inner) * 8 <= layout.CHUNK_BYTES
