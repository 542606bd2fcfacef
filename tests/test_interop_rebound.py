"""Simulations of REBOUND as problems of the library, and back."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import interop, systems

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
    return [[getattr(b, x) for x in ("m", "x", "y", "z", "vx", "vy", "vz", "r")]
            for b in sim.particles]  # fmt: skip


def advanced(problem, time, method, h=0.01):
    return dvi.integrate(
        problem.system, problem.q0, problem.p0, t0=problem.t0, h=h, num_steps=round(time / h),
        args=problem.args, method=method, save=dvi.Save(final=True),
    )  # fmt: skip


def at_start(problem, name):
    q, p = jnp.asarray(problem.q0), jnp.asarray(problem.p0)
    return problem.observables[name](0.0, 0.0, q, p, q, p, problem.args)


def test_energy_and_angular_momentum_agree():
    sim = three_bodies()
    problem = interop.from_rebound(sim)
    np.testing.assert_allclose(at_start(problem, "energy"), sim.energy(), rtol=1e-14)
    momentum = np.asarray(list(sim.angular_momentum()))
    found = np.asarray(at_start(problem, "angular_momentum"))
    np.testing.assert_allclose(found, momentum, rtol=0, atol=1e-14 * np.abs(momentum).max())
    wrong = {**problem.args, "G": 1.0}
    q, p = jnp.asarray(problem.q0), jnp.asarray(problem.p0)
    energy = problem.observables["energy"](0.0, 0.0, q, p, q, p, wrong)
    assert abs(energy / sim.energy() - 1) > 0.5  # G is that of the units


def test_their_energy_leaves_softening_out():
    sim = three_bodies(softening=0.3)
    problem = interop.from_rebound(sim)
    assert sim.energy() == three_bodies().energy()
    assert at_start(problem, "energy") > 0.9 * sim.energy() > sim.energy()


def test_what_is_known_of_the_bodies():
    problem = interop.from_rebound(three_bodies())
    assert isinstance(problem, systems.Problem)
    assert problem.names == ("Sun", "giant", None)
    assert (problem.t0, problem.h, problem.integrator) == (3.0, 0.01, "ias15")
    assert problem.units["p"] == "Msun au/yr"
    assert problem.q0.shape == problem.p0.shape == (3, 3)
    assert problem.radii[1] == 5e-4
    assert problem.system.H_D is systems.n_body().system.H_D


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
    # order 2 is seen, and without softening another orbit: the agreement is none of chance
    hard = advanced(interop.from_rebound(three_bodies()), 2.0, dvi.KahanLi(8))
    assert np.abs(hard.qs[-1] - found.q0).max() > 0.01
    errors = [
        np.abs(advanced(problem, 2.0, dvi.Strang(), h).qs[-1] - found.q0).max()
        for h in (0.01, 0.005)
    ]
    assert 1e-4 < errors[1] < errors[0] < 0.05
    assert abs(np.log2(errors[0] / errors[1]) - 2) < 0.1


def test_the_same_orbit_as_whfast():
    sim = three_bodies(integrator="whfast", dt=0.0005)
    problem = interop.from_rebound(sim)
    sol = advanced(problem, 1.0, dvi.KahanLi(8))
    sim.integrate(4.0)
    apart = np.abs(sol.qs[-1] - interop.from_rebound(sim).q0).max()
    assert 1e-10 < apart < 1e-6  # its own error, of order h²; ours is below 1e-12


def test_there_and_back_bit_for_bit():
    sim = three_bodies(softening=0.125)
    back = interop.to_rebound(interop.from_rebound(sim))
    assert numbers(back) == numbers(sim)
    for name in ("t", "dt", "G", "softening", "N", "units"):
        assert getattr(back, name) == getattr(sim, name)
    assert [b.name for b in back.particles] == [b.name for b in sim.particles]
    again = interop.from_rebound(back)
    assert np.array_equal(again.p0, interop.from_rebound(sim).p0)


def test_the_velocities_of_a_given_state_are_rounded():
    """p = m v and v = p/m are each rounded: the velocities differ by one unit of round-off."""
    sim, random = rebound.Simulation(), np.random.default_rng(0)
    for x in range(20):
        vx, vy, vz = random.normal(size=3)
        sim.add(m=random.uniform(), x=x, vx=vx, vy=vy, vz=vz)
    problem = interop.from_rebound(sim)
    back = interop.from_rebound(interop.to_rebound(problem, problem.q0, problem.p0))
    off = np.abs(back.velocities / problem.velocities - 1)
    assert 0 < off.max() <= np.finfo(float).eps
    assert numbers(interop.to_rebound(problem)) == numbers(sim)  # the control


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["x", "vz", "m", "r", "t", "dt", "G", "softening"])
def test_numbers_that_are_not_finite_are_refused(name, value):
    sim = three_bodies()
    of_body = hasattr(sim.particles[1], name)
    setattr(sim.particles[1] if of_body else sim, name, value)
    where = f"{name} of giant" if of_body else f"{name} of the simulation"
    with pytest.raises(ValueError, match=f"{where} is {value}"):
        interop.from_rebound(sim)


def test_another_state_goes_back():
    problem = interop.from_rebound(three_bodies())
    sol = advanced(problem, 2.0, dvi.KahanLi(8))
    sim = interop.to_rebound(problem, sol.qs[-1], sol.ps[-1], sol.ts[-1])
    assert sim.t == 5.0
    found = interop.from_rebound(sim)
    assert np.array_equal(found.q0, sol.qs[-1])
    np.testing.assert_allclose(found.p0, sol.ps[-1], rtol=4e-16)
    np.testing.assert_allclose(sim.energy(), at_start(problem, "energy"), rtol=1e-12)


def test_problems_of_the_library_go_there():
    problem = systems.n_body()  # in the plane
    sim = interop.to_rebound(problem)
    assert sim.G == 1.0
    np.testing.assert_allclose(sim.energy(), at_start(problem, "energy"), rtol=1e-14)
    with pytest.raises(ValueError, match="another Hamiltonian"):
        interop.to_rebound(systems.kepler())
    with pytest.raises(TypeError, match="together"):
        interop.to_rebound(problem, q=problem.q0)


def test_a_file_is_read(tmp_path):
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
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_what_would_be_lost_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        interop.from_rebound(three_bodies(**options))


@pytest.mark.filterwarnings("ignore:You have to reset function pointers:RuntimeWarning")
def test_callbacks_can_be_left_out_knowingly():
    sim = three_bodies(additional_forces=push)
    assert interop.from_rebound(sim.copy()).q0.shape == (3, 3)


def test_variations_and_half_steps_are_refused():
    sim = three_bodies()
    sim.add_variation()
    with pytest.raises(ValueError, match="variational"):
        interop.from_rebound(sim)
    sim = three_bodies(is_synchronized=0)  # as within a step of WHFast, for speed
    with pytest.raises(ValueError, match="synchronize"):
        interop.from_rebound(sim)
    sim.is_synchronized = 1
    assert interop.from_rebound(sim).q0.shape == (3, 3)


def test_bodies_without_mass_need_one():
    sim = three_bodies()
    sim.N_active = 3
    sim.add(a=3.0, e=0.2)
    with pytest.raises(ValueError, match="number 3"):
        interop.from_rebound(sim)
    problem = interop.from_rebound(sim, massless=1e-20)
    assert problem.args["masses"][3] == 1e-20
    sol = advanced(problem, 2.0, dvi.KahanLi(8))
    sim.integrate(5.0)
    last = interop.from_rebound(sim, massless=1e-20)
    np.testing.assert_allclose(sol.qs[-1], last.q0, rtol=0, atol=3e-12)
    with pytest.raises(ValueError, match="positive"):
        interop.from_rebound(sim, massless=0.0)


def test_other_objects_are_refused():
    with pytest.raises(TypeError, match=r"rebound\.Simulation"):
        interop.from_rebound(systems.n_body())
    with pytest.raises(ValueError, match="no bodies"):
        interop.from_rebound(rebound.Simulation())
    with pytest.raises(ValueError, match="snapshot"):
        interop.from_rebound(three_bodies(), snapshot=2)
    sim = three_bodies()
    sim.add(m=1e-5, x=sim.particles[1].x, y=sim.particles[1].y, z=sim.particles[1].z)
    with pytest.raises(ValueError, match="giant and body 3 are on top"):
        interop.from_rebound(sim)


def test_a_replaced_start_goes_back_as_it_is_now():
    problem = interop.from_rebound(three_bodies())
    faster = dataclasses.replace(problem, p0=2 * problem.p0)
    heavier = dataclasses.replace(
        problem, args={**problem.args, "masses": 2 * problem.args["masses"]}
    )
    for changed, factor in ((faster, 2.0), (heavier, 0.5)):
        v = [[b.vx, b.vy, b.vz] for b in interop.to_rebound(changed).particles]
        np.testing.assert_allclose(v, factor * problem.velocities, rtol=1e-15)


def test_a_failed_state_does_not_go_there():
    problem = interop.from_rebound(three_bodies())
    with pytest.raises(ValueError, match=r"q holds values that are not finite.*failing step"):
        interop.to_rebound(problem, np.nan * problem.q0, problem.p0)
    u = pytest.importorskip("astropy.units")
    with pytest.raises(TypeError, match="p has the unit 'km'"):
        interop.to_rebound(problem, problem.q0, problem.p0 * u.km)


def test_a_simulation_by_bulirsch_and_stoer_has_no_equations_of_the_users():
    simulation = three_bodies()
    simulation.integrator = "bs"
    simulation.integrate(0.1)
    assert interop.from_rebound(simulation).integrator == "bs"


def test_a_file_that_is_none_is_told(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no Simulationarchive"):
        interop.from_rebound(tmp_path / "none.bin")
    three_bodies().save_to_file(str(tmp_path / "one.bin"))
    with pytest.raises(ValueError, match="cannot read snapshot 7 of"):
        interop.from_rebound(tmp_path / "one.bin", snapshot=7)
