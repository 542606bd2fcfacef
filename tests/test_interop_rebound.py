"""Simulations of REBOUND as problems of the library, and back."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, systems
from dvi_jax.interop import rebound_side

rebound = pytest.importorskip("rebound")


def three_bodies(**options):
    sim = rebound.Simulation()
    sim.units = ("AU", "yr", "Msun")
    sim.add(m=1.0, name="Sun")
    sim.add(m=1e-3, a=1.0, e=0.1, r=5e-4, name="giant")
    sim.add(m=1e-4, a=2.1, e=0.05, inc=0.1)
    sim.move_to_com()
    sim.t, sim.dt = 3.0, 0.01
    for name, value in options.items():
        setattr(sim, name, value)
    return sim


def numbers(sim):
    fields = ("m", "x", "y", "z", "vx", "vy", "vz", "r")
    return [[getattr(b, x) for x in fields] for b in sim.particles]


def advanced(problem, time, method, h=0.01):
    run = {"t0": problem.t0, "h": h, "num_steps": round(time / h), "args": problem.args}
    run |= {"method": method, "save": dvi.Save(final=True)}
    return dvi.integrate(problem.system, problem.q0, problem.p0, **run)


def at_start(problem, name, **args):
    q, p = jnp.asarray(problem.q0), jnp.asarray(problem.p0)
    return problem.observables[name](0.0, 0.0, q, p, q, p, {**problem.args, **args})


@pytest.mark.slow
def test_the_problem_of_a_simulation():
    """Names, units, times; energy and angular momentum are those of REBOUND."""
    sim = three_bodies()
    problem = interop.from_rebound(sim)
    assert isinstance(problem, systems.Problem)
    assert problem.names == ("Sun", "giant", None)
    assert (problem.t0, problem.h, problem.integrator) == (3.0, 0.01, "ias15")
    assert problem.units["p"] == "Msun au/yr"
    assert problem.q0.shape == problem.p0.shape == (3, 3)
    assert problem.radii[1] == 5e-4
    assert problem.system.H_D is systems.n_body().system.H_D
    np.testing.assert_allclose(at_start(problem, "energy"), sim.energy(), rtol=1e-14)
    momentum = np.asarray(list(sim.angular_momentum()))
    found = np.asarray(at_start(problem, "angular_momentum"))
    np.testing.assert_allclose(found, momentum, rtol=0, atol=1e-14 * np.abs(momentum).max())
    assert abs(at_start(problem, "energy", G=1.0) / sim.energy() - 1) > 0.5  # G is of the units
    sim = three_bodies(softening=0.3)
    problem = interop.from_rebound(sim)
    assert sim.energy() == three_bodies().energy()
    assert at_start(problem, "energy") > 0.9 * sim.energy() > sim.energy()


@pytest.mark.parametrize("softening", [0.0, 0.3])
@pytest.mark.slow
def test_the_same_orbit(softening):
    sim = three_bodies(softening=softening)
    problem = interop.from_rebound(sim)
    sol = advanced(problem, 2.0, dvi.KahanLi(8))
    sim.integrate(5.0)
    found = interop.from_rebound(sim)
    np.testing.assert_allclose(sol.qs[-1], found.q0, rtol=0, atol=3e-12)
    np.testing.assert_allclose(sol.ps[-1], found.p0, rtol=0, atol=3e-12)
    if softening == 0:
        return
    # The controls: without softening another orbit; and `Strang` differs with its order 2.
    hard = advanced(interop.from_rebound(three_bodies()), 2.0, dvi.KahanLi(8))
    assert np.abs(hard.qs[-1] - found.q0).max() > 0.01
    ends = [advanced(problem, 2.0, dvi.Strang(), h).qs[-1] for h in (0.01, 0.005)]
    errors = [np.abs(q - found.q0).max() for q in ends]
    assert 1e-4 < errors[1] < errors[0] < 0.05
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.1


def test_there_and_back():
    sim = three_bodies(softening=0.125)
    back = interop.to_rebound(interop.from_rebound(sim))
    assert numbers(back) == numbers(sim)
    for name in ("t", "dt", "G", "softening", "N", "units"):
        assert getattr(back, name) == getattr(sim, name)
    assert [b.name for b in back.particles] == [b.name for b in sim.particles]
    assert np.array_equal(interop.from_rebound(back).p0, interop.from_rebound(sim).p0)
    # p = m v and v = p/m are each rounded: the velocities differ by one unit of round-off.
    sim, random = rebound.Simulation(), np.random.default_rng(0)
    for x in range(20):
        vx, vy, vz = random.normal(size=3)
        sim.add(m=random.uniform(), x=x, vx=vx, vy=vy, vz=vz)
    problem = interop.from_rebound(sim)
    back = interop.from_rebound(interop.to_rebound(problem, problem.q0, problem.p0))
    off = np.abs(back.velocities / problem.velocities - 1)
    assert 0 < off.max() <= np.finfo(float).eps
    assert numbers(interop.to_rebound(problem)) == numbers(sim)  # the control


def test_another_state_goes_back():
    problem = interop.from_rebound(three_bodies())
    sol = advanced(problem, 2.0, dvi.KahanLi(8))
    sim = interop.to_rebound(problem, sol.qs[-1], sol.ps[-1], sol.ts[-1])
    assert sim.t == 5.0
    found = interop.from_rebound(sim)
    assert np.array_equal(found.q0, sol.qs[-1])
    np.testing.assert_allclose(found.p0, sol.ps[-1], rtol=4e-16)
    np.testing.assert_allclose(sim.energy(), at_start(problem, "energy"), rtol=1e-12)
    # A problem whose start or masses have been replaced goes back as it is now.
    masses = {**problem.args, "masses": 2 * problem.args["masses"]}
    for changed, factor in (({"p0": 2 * problem.p0}, 2.0), ({"args": masses}, 0.5)):
        there = interop.to_rebound(dataclasses.replace(problem, **changed))
        v = [[b.vx, b.vy, b.vz] for b in there.particles]
        np.testing.assert_allclose(v, factor * problem.velocities, rtol=1e-15)


def test_problems_of_the_library():
    problem = systems.n_body()  # in the plane
    sim = interop.to_rebound(problem)
    assert sim.G == 1.0
    np.testing.assert_allclose(sim.energy(), at_start(problem, "energy"), rtol=1e-14)
    with pytest.raises(ValueError, match="another Hamiltonian"):
        interop.to_rebound(systems.kepler())
    with pytest.raises(TypeError, match="give both"):
        interop.to_rebound(problem, q=problem.q0)
    with pytest.raises(ValueError, match="q must be finite, got nan"):
        interop.to_rebound(problem, np.nan * problem.q0, problem.p0)
    u = pytest.importorskip("astropy.units")
    with pytest.raises(TypeError, match="p has the unit 'km'"):
        interop.to_rebound(problem, problem.q0, problem.p0 * u.km)


def test_a_file(tmp_path):
    path, sim = tmp_path / "archive.bin", three_bodies()
    sim.save_to_file(str(path))
    sim.integrate(4.0)
    sim.save_to_file(str(path))
    last, first = interop.from_rebound(path), interop.from_rebound(str(path), snapshot=0)
    assert (first.t0, last.t0) == (3.0, 4.0)
    assert np.array_equal(last.q0, interop.from_rebound(sim).q0)
    assert not np.array_equal(first.q0, last.q0)
    with pytest.raises(TypeError, match=r"archive\[i\]"):
        interop.from_rebound(rebound.Simulationarchive(str(path)))
    with pytest.raises(FileNotFoundError, match=r"no file at the path: .*none\.bin'"):
        interop.from_rebound(tmp_path / "none.bin")
    with pytest.raises(ValueError, match="cannot read snapshot 7 of"):
        interop.from_rebound(path, snapshot=7)


def test_names_are_those_on_which_two_readings_agree(tmp_path, monkeypatch):
    """REBOUND may give a body the name of another one: here it does in the first reading."""
    three_bodies().save_to_file(str(tmp_path / "archive.bin"))
    name, wrong = rebound_side._name, iter(["giant", "Sun", None])
    monkeypatch.setattr(rebound_side, "_name", lambda body: next(wrong, name(body)))
    problem = interop.from_rebound(tmp_path / "archive.bin")
    assert next(wrong, "all were read") == "all were read"
    assert problem.names == ("Sun", "giant", None)


# --- archives


def archive_of(path, sim, times, between=None):
    """A file with a snapshot at each time; `between` is called after each."""
    for i, t in enumerate(times):
        sim.integrate(t)
        sim.save_to_file(str(path))
        if between is not None:
            between(i, sim)
    return path


def as_read(path, name):
    """A field of the particles of all snapshots, as REBOUND reads it, in its order of bodies."""
    rows = []
    for sim in rebound.Simulationarchive(str(path)):
        sim.synchronize()
        rows.append([getattr(b, name) for b in sim.particles])
    return rows


@pytest.mark.filterwarnings("ignore:The simulation might not be synchronized:RuntimeWarning")
@pytest.mark.parametrize("options", [{}, {"integrator": "whfast"}], ids=["ias15", "whfast"])
def test_an_archive_as_a_time_series(tmp_path, options):
    """The bits of REBOUND, also from snapshots between half steps; names, units, elements."""
    sim, path = three_bodies(**options), tmp_path / "archive.bin"
    if options:
        sim.integrator.safe_mode = 0
        sim.save_to_file(str(path), step=100)
        sim.integrate(7.5)
    else:
        archive_of(path, sim, np.arange(3.0, 8.0))
    archive = rebound.Simulationarchive(str(path))
    assert archive[3].is_synchronized == (not options)
    data = interop.from_archive(path, elements="jacobi")
    assert data.sizes == {"time": 5, "body": 3, "component": 3}
    assert list(data.body.values) == ["Sun", "giant", "body 2"]
    np.testing.assert_array_equal(data.time, [archive.t[i] for i in range(5)])
    for k, component in enumerate("xyz"):
        np.testing.assert_array_equal(data.q[..., k], as_read(path, component))
        np.testing.assert_array_equal(data.v[..., k], as_read(path, f"v{component}"))
    for name in ("m", "r"):
        np.testing.assert_array_equal(data[name], as_read(path, name))
    assert (data.q.units, data.v.units, data.m.units) == ("au", "au/yr", "Msun")
    assert (data.time.units, data.a.units, data.M.units) == ("yr", "au", "rad")
    assert "units" not in data.e.attrs
    assert data.attrs["G"] == sim.G
    np.testing.assert_array_equal(data["count"], 3)
    for kind, primary in (("jacobi", None), ("heliocentric", 0)):
        data = interop.from_archive(archive, elements=kind)
        assert np.isnan(data.a.sel(body="Sun")).all()
        for i in range(5):
            body = archive[i]
            body.synchronize()
            origin = {} if primary is None else {"primary": body.particles[primary]}
            for row, orbit in enumerate(body.orbits(**origin), start=1):
                theirs = [orbit.a, orbit.e, orbit.inc]
                ours = [data[name][i, row] for name in ("a", "e", "inc")]
                np.testing.assert_allclose(ours, theirs, rtol=1e-11, atol=1e-10)
                angle = data.M[i, row] - orbit.M
                np.testing.assert_allclose(np.exp(1j * angle), 1.0, atol=1e-8)
    # The control: the other kind of elements differs.
    assert np.abs(data.a - interop.from_archive(path, elements="jacobi").a).max() > 1e-4


def test_bodies_of_an_archive_that_come_and_go(tmp_path):
    """Bodies with names are identified by them; of others it may not be known which was removed."""

    def change(i, sim):
        if i == 0:
            sim.remove("giant")
        if i == 1:
            sim.add(m=1e-6, a=5.0, name="comet")
        if i == 2:
            sim.add(m=1e-3, a=1.2, name="giant")

    # Of several files, since REBOUND itself reads names of some of them wrongly in this process.
    for k in range(8):
        times = [3.0, 3.5, 4.0, 4.5]
        path = archive_of(tmp_path / f"named{k}.bin", three_bodies(), times, change)
        assert list(interop.from_archive(path).body.values) == ["Sun", "giant", "body 2", "comet"]
        names = [interop.from_rebound(path, snapshot=i).names for i in range(4)]
        assert names[0] == ("Sun", "giant", None)
        assert names[1:3] == [("Sun", None), ("Sun", None, "comet")]
        assert names[3] == interop.from_rebound(path).names == ("Sun", None, "comet", "giant")
    data = interop.from_archive(path, elements="jacobi")
    assert list(data.body.values) == ["Sun", "giant", "body 2", "comet"]
    np.testing.assert_array_equal(data["count"], [3, 2, 3, 4])
    exists = [[1, 1, 1, 0], [1, 0, 1, 0], [1, 0, 1, 1], [1, 1, 1, 1]]
    for name in ("q", "v"):
        np.testing.assert_array_equal(np.isfinite(data[name]).all("component"), exists)
    np.testing.assert_array_equal(np.isfinite(data.a), np.array(exists) * [0, 1, 1, 1])
    np.testing.assert_array_equal(data.m.sel(body="body 2"), 1e-4)
    of_second = [row[1] for row in as_read(path, "x")]
    assert of_second[1] == float(data.q.sel(body="body 2")[1, 0])

    def remove(i, sim):
        if i == 0:
            sim.add(m=1e-6, a=5.0)
        if i == 1:
            sim.remove(2)

    path = archive_of(tmp_path / "unnamed.bin", three_bodies(), [3.0, 3.5, 4.0], remove)
    with pytest.warns(UserWarning, match="number of bodies with the same name .None. changes"):
        data = interop.from_archive(path)
    np.testing.assert_array_equal(data["count"], [3, 4, 3])
    assert np.isnan(data.q[2, 3]).all()
    assert "a" not in data


def test_variations_and_no_units_in_an_archive(tmp_path):
    sim = three_bodies()
    sim.add_variation()
    data = interop.from_archive(archive_of(tmp_path / "variation.bin", sim, [3.0, 3.1]))
    assert data.sizes["body"] == 3
    sim = rebound.Simulation()
    sim.add(m=1.0)
    sim.add(a=1.0)
    data = interop.from_archive(archive_of(tmp_path / "plain.bin", sim, [0.0]))
    assert "units" not in data.q.attrs
    assert list(data.body.values) == ["body 0", "body 1"]


def test_files_that_are_no_archives(tmp_path):
    with pytest.raises(FileNotFoundError, match="no file at the path"):
        interop.from_archive(tmp_path / "none.bin")
    bad = tmp_path / "bad.bin"
    for content in (b"", b"no archive of REBOUND" * 100):
        bad.write_bytes(content)
        with pytest.raises(ValueError, match=r"cannot read the archive .*bad\.bin"):
            interop.from_archive(bad)
    with pytest.raises(TypeError, match="the path of a Simulationarchive"):
        interop.from_archive(three_bodies())
    path = archive_of(tmp_path / "archive.bin", three_bodies(), [3.0, 3.5])
    with pytest.raises(ValueError, match="elements must be"):
        interop.from_archive(path, elements="democratic")
    # A file that was cut: REBOUND reads the snapshots before the cut, and warns.
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.warns(RuntimeWarning, match="corrupt"):
        assert interop.from_archive(path).sizes["time"] == 1


@pytest.mark.parametrize("name", ["x", "vz", "m", "t", "G"])
def test_numbers_that_are_not_finite(name):
    sim = three_bodies()
    of_body = hasattr(sim.particles[1], name)
    where = f"{name} of giant" if of_body else f"{name} of the simulation"
    for value in (np.nan, np.inf):
        setattr(sim.particles[1] if of_body else sim, name, value)
        with pytest.raises(ValueError, match=f"{where} must be finite, got {value}"):
            interop.from_rebound(sim)


def push(_):
    pass


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"additional_forces": push}, "additional_forces"),
        ({"heartbeat": push}, "heartbeat"),
        ({"post_timestep_modifications": push}, "post_timestep"),
        ({"boundary": "open", "root_size": 10.0}, "boundary"),
        ({"collision": "direct"}, "collision"),
        ({"gravity": "none"}, "gravity"),
        ({"integrator": "sei"}, "shearing"),
        ({"exit_max_distance": 10.0}, "exit_max_distance"),
        ({"N_active": 2}, "N_active"),
        ({"is_synchronized": 0}, "synchronize"),  # as within a step of WHFast, for speed
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_features_that_cannot_be_converted(options, words):
    with pytest.raises(ValueError, match=words):
        interop.from_rebound(three_bodies(**options))


@pytest.mark.filterwarnings("ignore:You have to reset function pointers:RuntimeWarning")
def test_variations_and_callbacks():
    sim = three_bodies()
    sim.add_variation()
    with pytest.raises(ValueError, match="variational"):
        interop.from_rebound(sim)
    sim = three_bodies(additional_forces=push).copy()  # leaves callbacks out
    assert interop.from_rebound(sim).q0.shape == (3, 3)
    sim = three_bodies(integrator="bs")  # has equations of its own, which are not the user's
    sim.integrate(0.1)
    assert interop.from_rebound(sim).integrator == "bs"


def test_bodies_without_mass_are_test_particles():
    sim = three_bodies()
    sim.N_active = 3
    sim.add(a=3.0, e=0.2)
    problem = interop.from_rebound(sim)
    assert problem.args["masses"].shape == (3,)
    np.testing.assert_array_equal(problem.p0[3], problem.velocities[3])
    sol = advanced(problem, 2.0, dvi.KahanLi(8))
    assert numbers(interop.to_rebound(problem)) == numbers(sim)
    back = interop.to_rebound(problem, sol.qs[-1], sol.ps[-1], t=sol.ts[-1])
    sim.integrate(5.0)
    np.testing.assert_allclose(numbers(back), numbers(sim), rtol=0, atol=3e-12)
    sim = three_bodies()
    sim.add(a=3.0)
    sim.add(m=1e-6, a=4.0)
    with pytest.raises(ValueError, match=r"must be last.*index 3"):
        interop.from_rebound(sim)


def test_other_objects():
    with pytest.raises(TypeError, match=r"rebound\.Simulation"):
        interop.from_rebound(systems.n_body())
    with pytest.raises(ValueError, match="no bodies"):
        interop.from_rebound(rebound.Simulation())
    with pytest.raises(ValueError, match="snapshot"):
        interop.from_rebound(three_bodies(), snapshot=2)
    sim = three_bodies()
    sim.add(m=1e-5, x=sim.particles[1].x, y=sim.particles[1].y, z=sim.particles[1].z)
    with pytest.raises(ValueError, match="giant and body 3 must have different positions"):
        interop.from_rebound(sim)
