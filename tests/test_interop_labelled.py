"""Results with labels, in files and for ArviZ; and what is imported when."""

import subprocess
import sys
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import dvi_jax as dvi
from dvi_jax import interop, systems

KEPLER = systems.kepler()
ENERGY = KEPLER.observables["energy"]
OBSERVE = {"E": ENERGY, "kept": {"drift": dvi.MaxDrift(ENERGY)}}


def run(q0=KEPLER.q0, epsilon=0.0, **options):
    options = {"h": 0.1, "num_steps": 6, "observe": OBSERVE, **options}
    return dvi.integrate(
        KEPLER.system, q0, jnp.asarray(KEPLER.p0), epsilon=epsilon, args=KEPLER.args, **options
    )


def test_one_trajectory():
    sol, units = run(), {**KEPLER.units, "E": "J", "t": "s"}
    labels = {"observe": OBSERVE, "components": ["x", "y"], "units": units}
    data = sol.to_xarray(attrs={"method": dvi.TypeII(), "h": 0.1}, **labels)
    assert dict(data.sizes) == {"time": 7, "component": 2, "step": 6}
    assert np.array_equal(data.q.sel(component="y"), sol.qs[:, 1])
    assert np.array_equal(data.time, sol.ts)
    assert (data.E.dims, data.h.dims) == (("time",), ("step",))
    assert data["kept.drift"].dims == ()
    assert float(data["kept.drift"]) == float(sol.observed["kept"]["drift"]) > 1e-3
    assert (data.E.attrs["units"], data.time.attrs["units"]) == ("J", "s")
    assert (data.attrs["h"], data.attrs["num_steps"]) == (0.1, 6)
    assert data.attrs["method"] == "TypeII()"
    assert int(data.status) == 0
    assert data.status.attrs["flag_meanings"].split()[2] == "not_finite"


@pytest.mark.parametrize("save", [dvi.Save(every=4, final=True), dvi.Save(ts=[0.05, 0.2])], ids=str)
def test_what_is_saved_is_labelled_by_its_time(save):
    sol = run(save=save)
    data = sol.to_xarray(observe=OBSERVE)
    assert np.array_equal(data.time, sol.ts)
    assert data.E.dims == ("time",)
    assert np.array_equal(data.E, sol.observed["E"])


@pytest.mark.slow
def test_a_batch_goes_to_a_file_and_comes_back(tmp_path):
    epsilon, starts = jnp.array([0.0, 0.1, 0.2]), jnp.array([[0.0, 1.2], [0.1, 1.0]])

    def one(e, q):
        return run(q, e, stop=dvi.Stop(lambda t, q, p, args: -0.2 - q[0]), throw=False)

    sols = jax.vmap(jax.vmap(one, (None, 0)), (0, None))(epsilon, starts)
    data = sols.to_xarray(
        dims=("epsilon", "start"), coords={"epsilon": np.asarray(epsilon)}, observe=OBSERVE
    )
    assert dict(data.sizes)["start"] == 2
    assert data.q.dims == ("epsilon", "start", "time", "component")
    assert data.status.dims == data["stop_t"].dims == ("epsilon", "start")
    assert (data.status == 6).all()  # they stopped
    assert data["stop_q"].dims == ("epsilon", "start", "component")
    np.testing.assert_allclose(data["stop_q"][..., 0], -0.2, rtol=1e-12)
    assert np.isnan(data.q[..., -1, :]).all()
    path = tmp_path / "batch.nc"
    data.to_netcdf(path, engine="h5netcdf")
    with xr.open_dataset(path, engine="h5netcdf") as read:
        xr.testing.assert_identical(read.load(), data)
        assert not read.identical(data.assign_attrs(software="another"))


def test_times_of_their_own_and_failures():
    sols = jax.vmap(lambda h: run(h=h, observe=None))(jnp.array([0.1, 0.2]))
    data = sols.to_xarray(dims="h_size")
    assert data.q.dims == ("h_size", "save", "component")
    assert np.array_equal(data.t, sols.ts)
    assert "time" not in data.dims
    sol = run(h=1e200, throw=False, observe=None)
    data = sol.to_xarray()
    assert int(data.status) in (1, 2)
    assert int(data.failed_step) >= 0
    assert np.isnan(data.q[-1]).all()


def test_names_of_components_and_observables():
    problem = systems.n_body()
    steps = {"h": 0.01, "num_steps": 2, "args": problem.args}
    sol = dvi.integrate(problem.system, problem.q0, problem.p0, **steps)
    data = sol.to_xarray(components={"body": ["a", "b", "c"], "axis": ["x", "y"]})
    assert np.array_equal(data.p.sel(body="b", axis="y"), sol.ps[:, 1, 1])
    assert sol.to_xarray().q.dims == ("time", "component_0", "component_1")
    assert run(observe=ENERGY).to_xarray(observe=ENERGY).observed.dims == ("time",)
    listed = [dvi.TangentMap(), ENERGY]
    data = run(observe=listed).to_xarray(observe=listed)
    assert data["observed.0"].shape == (4, 4)
    assert data["observed.1"].dims == ("time",)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"dims": ("batch",)}, "dims must have 0 names"),
        ({"components": ["x"]}, r"shape \(2,\), got \(1,\)"),
        ({"observe": {"E": ENERGY}}, "observe must be the same as for integrate"),
        ({"observe": {"E": ENERGY, "kept": {"drift": ENERGY}}}, "kept.drift"),
    ],
    ids=lambda x: "",
)
def test_labels_that_do_not_fit(options, words):
    with pytest.raises(ValueError, match=words):
        run().to_xarray(**options)


@pytest.mark.parametrize("name", ["q", "failed_step"])
def test_names_in_use(name):
    observe = {name: dvi.MaxDrift(ENERGY)}
    with pytest.raises(ValueError, match=f"'{name}', which is already in use"):
        run(observe=observe).to_xarray(observe=observe)


def test_wrong_arguments():
    with pytest.raises(TypeError, match="outside of jit"):
        jax.jit(lambda h: run(h=h).to_xarray().q.values)(0.1)
    with pytest.raises(TypeError, match="to_xarray"):
        interop.to_inference_data(run())
    u = pytest.importorskip("astropy.units")
    with pytest.raises(TypeError, match="coords time has the unit 'km'"):
        run().to_xarray(coords={"time": np.arange(7) * u.km})


def draws(seed=0, chains=4, count=250):
    x = np.random.default_rng(seed).normal([1.0, -2.0], [0.1, 0.3], (chains, count, 2))
    diverging = np.zeros((chains, count), bool)
    diverging[1, 3] = True
    return dvi.Samples(
        names=["epsilon", "K"],
        x=x,
        params={"epsilon": x[..., 0], "K": x[..., 1]},
        potential=(((x - [1.0, -2.0]) / [0.1, 0.3]) ** 2).sum(-1) / 2,
        diverging=diverging,
        steps=np.full((chains, count), 7),
        acceptance=np.linspace(0.8, 0.9, chains),
        r_hat={"epsilon": 1.0, "K": 1.0},
        ess={"epsilon": 900.0, "K": 900.0},
    )


SEEN = dvi.Observations(ts=[0.0, 0.5, 1.0], values=np.arange(6.0).reshape(3, 2), sigma=0.1)


def check_groups(found, group):
    names = "posterior", "sample_stats", "observed_data"
    posterior, stats, seen = (group(found, name) for name in names)
    assert posterior["K"].dims == ("chain", "draw")
    assert int(stats["diverging"].sum()) == 1
    assert int(stats["tree_depth"].max()) == 3  # 7 = 2³ − 1 leapfrog steps
    assert stats["acceptance_rate"].dims == ("chain",)
    np.testing.assert_allclose(stats["lp"], -draws().potential)
    assert np.array_equal(seen["ts"], [0.0, 0.5, 1.0])
    assert np.array_equal(seen["values"], SEEN.values)


@pytest.mark.slow
def test_samples_in_arviz():
    arviz = pytest.importorskip("arviz")
    found = interop.to_inference_data(draws(), SEEN)
    if hasattr(arviz, "InferenceData"):
        assert isinstance(found, arviz.InferenceData)
    check_groups(found, lambda data, name: data[name])
    summary = arviz.summary(found)
    np.testing.assert_allclose(summary.loc["K", "mean"], -2.0, atol=0.05)
    assert float(summary.loc["epsilon", "r_hat"]) < 1.02
    apart = draws()
    apart.x[0] += 1.0  # a chain elsewhere
    assert float(arviz.summary(interop.to_inference_data(apart)).loc["K", "r_hat"]) > 1.1


def test_newer_arviz_takes_a_tree(monkeypatch):
    monkeypatch.setitem(sys.modules, "arviz", types.ModuleType("arviz"))  # 1.x has no such class
    tree = interop.to_inference_data(draws(), [SEEN])
    assert isinstance(tree, xr.DataTree)
    check_groups(tree, lambda tree, name: tree[name].to_dataset())


def test_arviz_base_takes_the_tree():
    arviz_base = pytest.importorskip("arviz_base")
    sample = arviz_base.extract(interop.to_inference_data(draws(), SEEN))
    assert sample.sizes["sample"] == 1000
    assert float(sample["K"].mean()) == pytest.approx(-2.0, abs=0.05)


THEIRS = ("diffrax", "astropy", "arviz", "arviz_base", "rebound", "scipy", "xarray")


@pytest.mark.slow
def test_importing_interop_imports_none_of_them():
    """And the package imports neither `interop` nor `testing`."""
    code = (
        "import sys, dvi_jax\n"
        "print({'pytest', 'dvi_jax.testing', 'dvi_jax.interop'} & set(sys.modules))\n"
        "from dvi_jax import interop\n"
        f"print([m for m in {THEIRS} if m in sys.modules], 'interop' in dir(interop))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert out.returncode == 0, out.stderr
    assert out.stdout.splitlines() == ["set()", "[] False"]


@pytest.mark.parametrize(
    ("package", "call"),
    [
        ("diffrax", lambda: interop.diffrax_term(KEPLER)),
        ("diffrax", interop.diffrax_solver),
        ("rebound", lambda: interop.from_rebound("file.bin")),
        ("rebound", lambda: interop.to_rebound(systems.n_body())),
        ("astropy", lambda: interop.UnitSystem("m", "s", "kg")),
        ("astropy", lambda: interop.integrate(KEPLER, h=0.1, num_steps=1)),
        ("scipy", lambda: interop.solve_ivp(KEPLER, (0, 1), [0.0, 1.0, 1.0, 0.0], h=0.1)),
        ("arviz", lambda: interop.to_inference_data(draws())),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_the_error_without_a_package_says_how_to_install_it(package, call, monkeypatch):
    names = {"arviz": ("arviz", "arviz_base"), "scipy": ("scipy.optimize",)}
    names["astropy"] = ("astropy.units",)
    for name in names.get(package, (package,)):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=rf'{package}.*pip install "dvi-jax\[interop\]"'):
        call()
