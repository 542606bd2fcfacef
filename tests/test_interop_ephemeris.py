"""Paths from files of ephemerides as third bodies."""

import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial import chebyshev

import dvi_jax as dvi
from dvi_jax import forces, interop

START = 2460000.5
MOON = 4902.8


class Segment:
    """An ellipse in the plane with a slow third component, as a segment of jplephem."""

    def __init__(self, size, period, phase=0.0):
        self.size, self.period, self.phase = size, period, phase

    def compute(self, date, days=0.0):
        angle = 2 * np.pi * (date - START + np.asarray(days)) / self.period + self.phase
        return self.size * np.array([np.cos(angle), 0.9 * np.sin(angle), 0.1 * np.sin(2 * angle)])


class Kernel:
    def __init__(self, pairs):
        self.pairs = pairs


SUN, BARYCENTRE = Segment(1e6, 4000.0), Segment(1.5e8, 365.25)
EARTH, TO_MOON = Segment(4670.0, 27.3, np.pi), Segment(379_700.0, 27.3)
KERNEL = Kernel({(0, 10): SUN, (0, 3): BARYCENTRE, (3, 399): EARTH, (3, 301): TO_MOON})
DATES = START, START + 90


@pytest.mark.parametrize(("target", "centre", "signs"), [
    (301, 399, {TO_MOON: 1, EARTH: -1}),
    (10, 399, {SUN: 1, BARYCENTRE: -1, EARTH: -1}),
    (399, 3, {EARTH: 1}),
    (3, 399, {EARTH: -1}),
])  # fmt: skip
def test_the_path_is_that_of_the_segments(target, centre, signs):
    path = interop.ephemeris_path(
        KERNEL, target, centre, DATES, epoch=START + 10, km=1e-3, day=24.0
    )
    days = np.random.default_rng(1).uniform(0, 90, 200)
    wanted = 1e-3 * sum(sign * x.compute(START, days) for x, sign in signs.items()).T
    ours = jax.jit(jax.vmap(path))((days - 10) * 24)
    size = np.abs(wanted).max()
    assert np.abs(ours - wanted).max() < 2e-12 * size
    assert path.error < 1e-12 * size
    edges = jax.vmap(path)(jnp.array([-241.0, -240.0, 80 * 24.0, 80 * 24.1]))
    assert np.isnan(edges).all(axis=1).tolist() == [1, 0, 0, 1]


@pytest.mark.slow
def test_velocities_and_a_run_with_a_third_body():
    path = interop.ephemeris_path(KERNEL, 301, 399, DATES, epoch=START)
    t, step = 1e6, 10.0
    rate = jax.jacfwd(path)(t)
    np.testing.assert_allclose(rate, (path(t + step) - path(t - step)) / 20, rtol=1e-5)

    def exact(t, args):
        angle = 2 * jnp.pi * t / (86400 * 27.3)
        size, other = 379_700.0 + 4670.0, 379_700.0 - 4670.0
        plane = size * jnp.stack([jnp.cos(angle), 0.9 * jnp.sin(angle)])
        return jnp.append(plane, other * 0.1 * jnp.sin(2 * angle))

    def H_D(t0, t1, q0, p1, args):
        return p1 @ p1 / 2 - args["mu"] / jnp.sqrt(q0 @ q0)

    q, v = np.array([26560.0, 0.0, 0.0]), np.array([0.0, 3.0, 2.4])

    def end(path):
        system = dvi.System(H_D, force=forces.ThirdBody(path, MOON), epsilon=1.0)
        run = {"h": 600.0, "num_steps": 400, "save": dvi.Save(final=True)}
        return dvi.integrate(system, q, v, args={"mu": 398600.4}, method=dvi.Strang(), **run).qs[-1]

    np.testing.assert_allclose(end(path), end(exact), atol=1e-7)


def test_bad_input(tmp_path):
    def path(target=301, centre=399, dates=DATES, kernel=KERNEL, **options):
        return interop.ephemeris_path(kernel, target, centre, dates, **{"epoch": START} | options)

    rough = Kernel({(399, 301): Segment(1.0, 0.01)})
    apart = Kernel({(0, 10): SUN, (399, 301): TO_MOON})
    for wrong, text in [
        (lambda: path(target=5), "target must be one of"),
        (lambda: path(centre="Earth"), "centre must be one of"),
        (lambda: path(10, 399, kernel=apart), "origin of target in the file"),
        (lambda: path(dates=(START, START)), "dates must be finite and in strictly"),
        (lambda: path(day=0.0), "day must be a positive"),
        (lambda: path(epoch=np.nan), "epoch must be a finite"),
        (lambda: path(kernel=rough), "relative error of the series"),
    ]:
        with pytest.raises(ValueError, match=text):
            wrong()
    with pytest.raises(FileNotFoundError, match="no file at the path"):
        path(kernel=tmp_path / "none.bsp")


def test_an_spk_file(tmp_path):
    """A file of type 2 with one segment, written here byte by byte, and read by jplephem."""
    count, terms, width = 12, 16, 8.0
    nodes = chebyshev.chebpts1(terms)
    inverse = np.linalg.inv(chebyshev.chebvander(nodes, terms - 1))
    seconds = (START - 2451545.0) * 86400
    records = []
    for i in range(count):
        middle = START + width * (i + 0.5)
        terms_of = inverse @ TO_MOON.compute(middle, width / 2 * nodes).T
        records += [(middle - 2451545.0) * 86400, width / 2 * 86400, *terms_of.T.ravel()]
    data = [*records, seconds, width * 86400, 2 + 3 * terms, count]
    last = seconds + count * width * 86400
    start, stop = 385, 384 + len(data)
    head = struct.pack("<8sii60siii8s603s28s297s", b"DAF/SPK ", 2, 6, b"test".ljust(60), 2, 2,
                       stop + 1, b"LTL-IEEE", b"", b"FTPSTR:\r:\n:\r\n:\r\x00:\x81:\x10\xce:ENDFTP",
                       b"")  # fmt: skip
    summary = struct.pack("<3d2d6i", 0, 0, 1, seconds, last, 301, 399, 1, 2, start, stop)
    file = tmp_path / "small.bsp"
    blocks = head, summary, b"test".ljust(1024), np.array(data).tobytes()
    file.write_bytes(b"".join(x.ljust(1024, b"\0") for x in blocks))
    try:
        import jplephem  # noqa: F401
    except ImportError:
        with pytest.raises(ImportError, match=r"jplephem: pip install .dvi-jax.ephemeris"):
            interop.ephemeris_path(file, 301, 399, DATES, epoch=START)
        pytest.skip("jplephem is not installed")
    path = interop.ephemeris_path(str(file), 301, 399, DATES, epoch=START)
    days = np.linspace(0, 90, 50)
    ours = jax.vmap(path)(days * 86400)
    np.testing.assert_allclose(ours, TO_MOON.compute(START, days).T, atol=4e5 * 2e-12)
    from jplephem.spk import SPK

    with SPK.open(file) as kernel:
        theirs = kernel[399, 301].compute(START, days)
    np.testing.assert_allclose(ours, theirs.T, atol=4e5 * 2e-12)
