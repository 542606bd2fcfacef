"""A solution as a file and as a table."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import systems

KEPLER = systems.kepler()
OBSERVE = {
    "E": KEPLER.observables["energy"],
    "r": lambda q, p: jnp.sqrt(q @ q),
    "list": [dvi.Last(lambda q, p: q), (dvi.MaxDrift(KEPLER.observables["energy"]), None)],
}


def run(q0=KEPLER.q0, **options):
    options = {"h": 0.1, "num_steps": 6, "args": KEPLER.args, "throw": False, **options}
    return dvi.integrate(KEPLER.system, q0, jnp.asarray(KEPLER.p0), **options)


@pytest.mark.parametrize(
    "options",
    [
        {"observe": OBSERVE, "stop": dvi.Stop(lambda t, q, p, args: 0.25 - t)},
        {"observe": KEPLER.observables["energy"], "save": dvi.Save(ts=[0.05, 0.2, 7.0])},
        {"h": 1e200},
    ],
    ids=["stopped, nested", "a time that is not reached", "failed"],
)
def test_a_file_has_every_digit_and_every_status(options, tmp_path):
    sol = run(**options)
    assert sol.status != "successful"
    sol.save(tmp_path / "orbit.npz")
    again = dvi.Solution.load(tmp_path / "orbit.npz")
    assert jax.tree.structure(again) == jax.tree.structure(sol)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(sol), strict=True):
        assert np.asarray(a).dtype == np.asarray(b).dtype
        np.testing.assert_array_equal(a, b)
    assert again.status == sol.status
    assert repr(again) == repr(sol)


def test_a_batch_in_a_file_and_in_a_table(tmp_path):
    starts = jnp.array([[0.4, 0.0], [0.0, 0.0], [0.5, 0.1]])
    sols = jax.vmap(lambda q: run(q, observe=OBSERVE))(starts)
    sols.save(tmp_path / "orbits.npz")
    again = dvi.Solution.load(tmp_path / "orbits.npz")
    assert list(again.status) == list(sols.status) == ["successful", "not_finite", "successful"]
    table = sols.to_dataframe(
        dims="start", coords={"start": [4, 5, 6]}, observe=OBSERVE, components=["x", "y"]
    )
    assert list(table.columns) == ["t", "q_x", "q_y", "p_x", "p_y", "h", "E", "r", "status"]
    assert table.index.names == ["start", "save"]
    row = table.loc[(6, 3)]
    np.testing.assert_array_equal(row[["q_x", "q_y"]].astype(float), sols.qs[2, 3])
    assert sols.observed["E"][2, 3] == row.E
    assert row.r == sols.observed["r"][2, 3]
    assert np.isnan(table.loc[(4, 0)].h)
    assert set(table.loc[5].status) == {"not_finite"}
    np.testing.assert_array_equal(table.loc[4].t, sols.ts[0])


def test_integers_and_booleans_of_steps_have_no_value_at_the_start_of_a_table():
    """A NaN became True, 0 or the smallest integer there."""

    def of_step(value):
        return lambda t0, t1, q0, p0, q1, p1, args: value(q1)

    observe = {
        "is_left": of_step(lambda q: q[0] < 9),
        "sides": of_step(lambda q: q > 0.1),
        "small": of_step(lambda q: jnp.uint8(7)),
        "large": dvi.Running(dvi.Last(lambda q, p: jnp.int64(2**53 + 1))),
        "of_state": lambda q, p: q[0] < 9,
    }
    starts = jnp.array([[0.4, 0.0], [0.5, 0.1]])
    sols = jax.vmap(lambda q: run(q, observe=observe))(starts)
    sol = run(starts[0], observe=observe)
    for table in (sols.to_dataframe(observe=observe), sol.to_dataframe(observe=observe)):
        of_steps = table[["is_left", "sides_0", "sides_1", "small", "large"]]
        is_start = table.h.isna()
        assert of_steps[is_start].isna().all(axis=None)
        assert not of_steps[~is_start].isna().any(axis=None)
        assert set(table.large[~is_start]) == {2**53 + 1}
        assert table.of_state.dtype == bool
        assert set(table.small[~is_start]) == {7}


def test_a_table_of_bodies_and_of_requested_times():
    problem = systems.n_body()
    sol = dvi.integrate(problem, h=0.01, num_steps=4, save=dvi.Save(ts=[0.01, 0.025]))
    table = sol.to_dataframe(components={"body": ["a", "b", "c"], "axis": ["x", "y"]})
    assert list(table.t) == [0.01, 0.025]
    np.testing.assert_array_equal(table["p_b_y"], sol.ps[:, 1, 1])
    np.testing.assert_array_equal(table["h"], sol.hs)
    assert "q_2_1" in sol.to_dataframe().columns


def test_what_cannot_be_saved_or_read(tmp_path):
    path = tmp_path / "orbit.npz"
    with pytest.raises(FileNotFoundError, match=r"other\.npz"):
        dvi.Solution.load(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError, match="there is no directory"):
        run().save(tmp_path / "no" / "orbit.npz")
    with pytest.raises(TypeError, match="outside of jit"):
        jax.jit(lambda h: run(h=h).save(path))(0.1)
    with pytest.raises(TypeError, match="text as keys"):
        run(observe={1: OBSERVE["E"]}).save(path)
    assert not path.exists()
    run().save(path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="damaged"):
        dvi.Solution.load(path)
    np.savez(path, about=np.array('{"format": 1}'))
    with pytest.raises(ValueError, match="not the file of a solution"):
        dvi.Solution.load(path)
