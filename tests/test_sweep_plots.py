"""Maps of sweeps: what is drawn, where there is no number, and how little is read at a time."""

import tracemalloc

import matplotlib.pyplot as plt
import numpy as np
import pytest
import xarray as xr
from matplotlib.colors import LogNorm, Normalize, to_hex
from pictures import closed, legend as texts, lies_within, refuses  # noqa: F401
from xarray.backends import BackendArray
from xarray.core import indexing

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.base.results import STATUS_NAMES
from dvi_jax.plot import blocks, grid
from dvi_jax.plot.style import SHADES
from dvi_jax.sweep import lazy

EPS = np.geomspace(1e-4, 1e-1, 7)
X = np.asarray([0.1, 0.2, 0.4, 0.5, 0.9])
FLAGS = {
    "flag_values": [-1, *range(len(STATUS_NAMES))],
    "flag_meanings": " ".join(("not_computed", *STATUS_NAMES)),
}
RNG = np.random.default_rng(1)
same, close = np.testing.assert_array_equal, np.testing.assert_allclose


def drift(order=1.0):
    """ε^order (1 + x), shape (7, 5), with names and units."""
    values = EPS[:, None] ** order * (1 + X)
    coords = {"epsilon": EPS, "x": ("x", X, {"units": "kg"})}
    return xr.DataArray(values, coords, ("epsilon", "x"), "drift", {"units": "J"})


def with_status(values=None):
    """A sweep with one failure of each of two kinds, and a corner that is not computed."""
    data = drift() if values is None else values
    status = np.zeros(data.shape, np.int8)
    status[2, 1], status[3, 1], status[5:, 3:] = 1, 2, -1
    data = data.where(status == 0)
    status = xr.DataArray(status, dims=data.dims, attrs=FLAGS)
    return xr.Dataset({"drift": data, "status": status})


def array_of(axis, which=0):
    return axis.collections[which].get_array()


def colour_at(axis, x, y):
    """The colour that is drawn at a place, as three bytes."""
    axis.figure.canvas.draw()
    picture = np.asarray(axis.figure.canvas.buffer_rgba())
    column, row = axis.transData.transform((x, y))
    return picture[picture.shape[0] - 1 - round(row), round(column), :3]


def test_the_numbers_and_their_places():
    axis = plot.sweep_map(drift())
    same(array_of(axis), drift().values.T)
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "linear")
    assert (axis.get_ylabel(), axis.figure.axes[1].get_ylabel()) == ("x [kg]", "drift [J]")
    edges = axis.collections[0].get_coordinates()
    close(edges[0, 1:-1, 0], np.sqrt(EPS[1:] * EPS[:-1]))
    close(edges[:, 0, 1], [0.05, 0.15, 0.3, 0.45, 0.7, 1.1])
    same(array_of(plot.sweep_map(drift(), x="x")), drift().values)
    # The lightest colour is not the yellow of viridis, which is invisible on paper.
    assert to_hex(axis.collections[0].cmap(1.0)) == to_hex(SHADES(1.0))


def test_scales_are_logarithmic_over_decades_and_centred_for_both_signs():
    narrow = drift(0.2)

    def norm(data, **options):
        return plot.sweep_map(data, **options).collections[0].norm

    assert type(norm(narrow)) is type(norm(drift(), log=False)) is Normalize
    assert type(norm(drift())) is type(norm(narrow, log=True)) is LogNorm
    centred = norm(drift() - 0.05)
    assert centred.vmin == -centred.vmax
    limited = norm(drift() - 0.05, limits=(-0.01, 0.2))
    assert (limited.vmin, limited.vmax) == (-0.01, 0.2)


def test_places_along_the_axes():
    """Values out of order, a coordinate along a dimension, names, and a place for 0."""
    mixed = drift().isel(epsilon=[3, 0, 5, 1, 6, 2, 4])
    same(array_of(plot.sweep_map(mixed)), drift().values.T)
    case = drift().rename(epsilon="case").drop_vars("case").assign_coords(epsilon=("case", EPS))
    axes = plot.sweep_map(case, x="epsilon"), plot.sweep_map(case)
    same(array_of(axes[0]), drift().values.T)
    assert [axis.get_xscale() for axis in axes] == ["log", "linear"]
    methods = ["TypeII()", "Strang()", "Yoshida()"]
    axis = plot.sweep_map(drift().isel(x=slice(3)).assign_coords(x=methods).rename(x="method"))
    assert [t.get_text() for t in axis.get_yticklabels()] == methods
    axis = plot.sweep_map(drift().reindex(epsilon=[0, *EPS], fill_value=1e-9))
    edges = axis.collections[0].get_coordinates()[0, :, 0]
    assert edges[0] < axis.get_xticks()[0] < edges[1] < EPS[0]


def test_exact_zeros_on_a_logarithmic_scale_are_black():
    data = drift()
    data[2, 1] = 0
    axis = plot.sweep_map(data)
    assert array_of(axis).mask.sum() == 1
    assert texts(axis) == ["exactly 0"]
    assert tuple(colour_at(axis, EPS[2], X[1])) == (0, 0, 0)
    assert colour_at(axis, EPS[3], X[1]).max() > 0


def test_one_dimension_is_a_line():
    data = drift()[:, 2].copy()
    data[3] = np.nan
    axis = plot.sweep_map(data)
    same(axis.lines[0].get_data(), [EPS, data])
    same(axis.lines[1].get_xdata(), EPS[3:4])
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "log")
    assert texts(axis) == ["no number: 1 of 7 (14.3 %)"]


def test_facets_share_their_colours():
    data = xr.concat([drift(), 100 * drift()], xr.IndexVariable("h", [0.1, 0.05], {"units": "s"}))
    axes = plot.sweep_map(data, facet="h")
    assert axes[1].get_title(loc="left") == "step size h = 0.05 s"  # where the style puts it
    for axis, scale in zip(axes, (1, 100), strict=True):
        same(array_of(axis), scale * drift().values.T)
        norm = axis.collections[0].norm
        assert (norm.vmin, norm.vmax) == (drift().min(), 100 * drift().max())


@pytest.mark.parametrize("layout", ["constrained", "none"])
def test_maps_on_given_axes_have_their_legends_below_the_labels(layout):
    """A legend does not cover a map; without a layout that makes space below, it is inside."""
    figure, axis = plt.subplots(layout=layout, figsize=(5, 4))
    plot.failure_map(with_status(), ax=axis)
    figure.canvas.draw()
    box, map_ = axis.get_legend().get_window_extent(), axis.get_window_extent()
    if layout == "none":
        assert map_.y0 <= box.y0 < box.y1 <= map_.y1
    else:
        assert box.y1 <= axis.xaxis.label.get_window_extent().y0
        assert lies_within(axis.get_legend(), figure)


@pytest.mark.slow
def test_cells_without_a_number_are_grey_and_counted():
    """With a status, those that are not computed are white."""
    data = with_status()
    axis = plot.sweep_map(data.drift)
    same(array_of(axis).mask, np.isnan(data.drift.values.T))
    assert texts(axis) == ["no number: 6 of 35 (17.1 %)"]
    grey, good = (colour_at(axis, EPS[2], x).astype(int) for x in X[1:3])
    assert np.ptp(grey) == 0 < 20 < np.ptp(good)
    assert grey[0] < 220
    axis = plot.sweep_map(data.drift, status=data.status)
    assert texts(axis) == ["no number: 2 of 35 (5.71 %)", "not computed: 4 of 35 (11.4 %)"]
    assert tuple(colour_at(axis, EPS[6], X[4])) == (255, 255, 255)
    assert colour_at(axis, EPS[2], X[1]).max() < 220


def test_the_failures_of_a_real_sweep():
    data = small_sweep().to_xarray()
    axis = plot.failure_map(data)
    same(array_of(axis), data.status.values.T)
    assert texts(axis) == ["successful: 15 of 20 (75 %)", "not finite: 5 of 20 (25 %)"]
    bad = colour_at(axis, *(data[n].values[-1] for n in ("epsilon", "k")))
    same(bad, [0xD5, 0x5E, 0x00])
    status = with_status().status.assign_coords(epsilon=EPS)[:, 1]
    same(array_of(plot.failure_map(status)), status.values[None])


def test_a_single_failure_is_not_hidden_in_its_pixel():
    status = xr.DataArray(np.zeros((40, 60), np.int8), dims=("a", "b"), attrs=FLAGS)
    status[7, 11], status[20:24, 30:36], status[21, 33] = 4, 1, 2
    status[39] = 6  # stopped: no failure
    status[0] = -1
    axis = plot.failure_map(status, pixels=(10, 10))
    shown = array_of(axis).T
    assert shown[1, 1] == 4
    assert shown[5, 5] == 1
    assert (shown > 0).sum() == 2
    axis = plot.failure_map(status, reduce="fraction", pixels=(10, 10))
    values = array_of(axis).T
    close(values[5, 5], 1.0)
    close(values[1, 1], 1 / 24)
    assert (values > 0).sum() == 2
    assert texts(axis) == ["not computed: 60 of 2400 (2.5 %)"]


def test_fitted_slopes_against_polyfit():
    noisy = drift(2) * np.exp(0.3 * RNG.normal(size=drift().shape))
    noisy[1, 2], noisy[4, 2], noisy[2, 0] = np.nan, 0.0, -1.0
    noisy[1:, 4] = np.nan
    axis = plot.slope_map(noisy)
    slopes = axis.lines[0].get_ydata()
    for slope, y in zip(slopes[:4], noisy.values.T, strict=False):
        good = y > 0
        close(slope, np.polyfit(np.log(EPS[good]), np.log(y[good]), 1)[0], rtol=1e-12)
    assert np.isnan(slopes[4])
    assert texts(axis) == ["no slope: 1 of 5 (20 %)"]
    assert axis.get_ylabel() == "exponent s in drift ∝ ε^s"


def test_local_slopes_lie_between_the_points():
    data = drift(1) + 1e3 * drift(3)
    axis = plot.slope_map(data, x="epsilon", y="x")
    want = np.diff(np.log(data.values), axis=0) / np.diff(np.log(EPS))[:, None]
    close(array_of(axis), want.T, rtol=1e-12)
    assert 1 < want.min() < 2 < want.max() < 3
    edges = axis.collections[0].get_coordinates()[0, :, 0]
    close(edges, EPS)
    other = plot.slope_map(data, local=True, y="x")
    same(array_of(other), array_of(axis))


def test_slopes_leave_out_0_and_numbers_below_the_floor():
    data = (drift(2) + 1e-5).reindex(epsilon=[0, *EPS], fill_value=1e-5)
    with_floor, without = (plot.slope_map(data, floor=f).lines[0].get_ydata() for f in (1e-4, 0))
    assert np.abs(with_floor - 2).max() < 0.1
    assert np.abs(without - 2).min() > 0.5


def test_slopes_over_two_dimensions():
    orders = np.asarray([1.0, 2.0, 3.0])
    data = xr.concat([drift(k) for k in orders], xr.IndexVariable("k", [0, 1, 2]))
    close(array_of(plot.slope_map(data)), np.broadcast_to(orders, (5, 3)))
    axis = plot.slope_map(data, x="k", over="x", reduce="median")
    close(axis.lines[0].get_ydata(), orders)


class Counted(BackendArray):
    """An array that is made where it is read, and counts what is read at a time."""

    def __init__(self, shape, function):
        self.shape, self.dtype, self.function = shape, np.dtype(float), function
        self.largest = self.total = 0

    def __getitem__(self, key):
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER, self.made
        )

    def made(self, key):
        index = [
            np.arange(n)[k] if isinstance(k, slice) else np.asarray(k)
            for k, n in zip(key, self.shape, strict=True)
        ]
        count = int(np.prod([np.size(i) for i in index]))
        self.largest, self.total = max(self.largest, count), self.total + count
        return self.function(*np.ix_(*(np.atleast_1d(i) for i in index))).reshape(
            [len(i) for i in index if np.ndim(i)]
        )


def lazily(shape, dims, function, coords=None):
    source = Counted(shape, function)
    return source, xr.DataArray(
        xr.Variable(dims, indexing.LazilyIndexedArray(source)), coords, name="drift"
    )


def rough(i, j, k=0):
    """Numbers over some decades, some of them NaN; the whole as a function of the place."""
    x = np.sin(12.9898 * i + 78.233 * j + 37.719 * k) * 43758.5453
    x = 10.0 ** (3 * (x - np.floor(x)))
    return np.where(np.asarray(i + 3 * j + 5 * k) % 11 == 0, np.nan, x)


REDUCED = {"max": np.nanmax, "min": np.nanmin, "mean": np.nanmean, "median": np.nanmedian}


@pytest.mark.parametrize("reduce", REDUCED)
@pytest.mark.parametrize("block", [3777, 2**21])
def test_a_reduced_map_is_the_reduction_of_the_whole(monkeypatch, reduce, block):
    monkeypatch.setattr(blocks, "BLOCK", block)
    _, data = lazily((60, 5, 41), ("a", "k", "b"), lambda i, k, j: rough(i, j, k))
    axis = plot.sweep_map(data, over="k", reduce=reduce, pixels=(12, 7))
    whole = data.values.transpose(2, 0, 1)
    ends = np.arange(8) * 41 // 7
    want = [
        [REDUCED[reduce](whole[ends[y] : ends[y + 1], 5 * x : 5 * x + 5]) for x in range(12)]
        for y in range(7)
    ]
    close(array_of(axis), want, rtol=1e-13)
    assert texts(axis) == [f"no number: {np.isnan(whole).sum()} of 12300 (9.1 %)"]


def test_reduced_points_out_of_order(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 700)
    values = RNG.permutation(np.linspace(0.0, 1.0, 90))
    _, data = lazily((90, 40), ("a", "b"), rough, {"a": values})
    whole = data.values[np.argsort(values)].reshape(9, 10, 40)
    for name, reduce in REDUCED.items():
        axis = plot.sweep_map(data, reduce=name, pixels=(9, 40))
        close(array_of(axis), reduce(whole, axis=1).T, rtol=1e-13)


def test_memory_is_one_block_however_large_the_grid(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 2**18)
    source, data = lazily((2000, 10_000), ("a", "b"), lambda i, j: (i + 1.0) * (j + 1.0))
    tracemalloc.start()
    axis = plot.sweep_map(data, pixels=(50, 40))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert source.total == 2e7
    assert source.largest <= 2**18
    assert peak < 12 * 2**18 * 8 < source.total * 8 / 6
    want = 40 * np.arange(1, 51) * 250 * np.arange(1, 41)[:, None]
    same(array_of(axis), want)


def test_a_dimension_without_values_costs_nothing_for_its_length(monkeypatch):
    """10¹² points: their axis, pixels and selections are made without a list of them."""
    source, data = lazily((3, 10**12), ("a", "b"), lambda i, j: (i + 1.0) * (j + 1.0))
    arranged = grid.arrange(data, "b", "a", {"pixels": (400, 300)})
    assert arranged.x.edges[-1] == 10**12 - 0.5
    same(arranged.x.bins.pixels(slice(10**11, 10**11 + 5)), [40] * 5)
    assert source.total == 0


def test_what_lies_in_chunks_is_read_in_chunks(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 1000)
    source, data = lazily((10, 2500), ("a", "b"), rough)
    plain = array_of(plot.sweep_map(data, pixels=(5, 50)))
    source.largest = source.total = 0
    data.encoding["preferred_chunks"] = {"a": 4, "b": 120}
    read = list(blocks.selections(data, {}))
    for dim, chunk, most in (("a", 4, 4), ("b", 120, 240)):
        assert {s[dim].start % chunk for s in read} == {0}
        assert max(s[dim].stop - s[dim].start for s in read) == most
    same(array_of(plot.sweep_map(data, pixels=(5, 50))), plain)
    assert (source.largest, source.total) == (960, 25_000)
    data.encoding["preferred_chunks"] = {"a": 4, "b": 500}  # more than a block
    assert max(s["b"].stop for s in blocks.selections(data, {})) == 2500
    plot.sweep_map(data)
    assert source.largest <= 1000


def test_a_median_that_is_too_large_is_refused(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 100)
    _, data = lazily((60, 40), ("a", "b"), rough)
    with pytest.raises(ValueError, match=r"at most 100 numbers in a pixel, got 240.*mean"):
        plot.sweep_map(data, reduce="median", pixels=(10, 1))
    plot.sweep_map(data, reduce="median", pixels=(10, 40))


def test_slopes_of_more_points_than_pixels(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 70)
    orders = np.linspace(1, 3, 100)
    source, data = lazily(
        (7, 100), ("epsilon", "b"), lambda i, j: EPS[i] ** orders[j], {"epsilon": EPS}
    )
    axis = plot.slope_map(data, pixels=(20, 5))
    close(axis.lines[0].get_ydata(), orders.reshape(20, 5).mean(1))
    assert source.largest == 70


def hamiltonian(t0, t1, q0, p1, args):
    return 0.5 * p1 @ p1 + 0.5 * args["k"] * q0 @ q0


def energy(t0, t1, q0, p0, q1, p1, args):
    return hamiltonian(t0, t1, q1, p1, args)


def small_sweep(**kw):
    """4 perturbations, of which the last is too large, × 5 springs."""
    kw = {"epsilon": [0.01, 0.02, 0.04, 1e80], "num_steps": 5} | kw
    system = dvi.System(hamiltonian, force=lambda t0, t1, q0, p1, args: -(q0**3))
    springs = {"k": dvi.Axis("k", [1.0, 1.5, 2.0, 2.5, 3.0])}
    return dvi.sweep(
        system, [0.5], [0.1], h=0.1, args=springs, observe={"drift": dvi.MaxDrift(energy)}, **kw
    )


def test_a_store_is_read_in_blocks(tmp_path, monkeypatch):
    eps = np.linspace(0.001, 0.2, 200)
    small_sweep(epsilon=eps, store=tmp_path / "s", lanes_per_task=100)
    whole = dvi.open_sweep(tmp_path / "s")["drift"]
    read = []
    get = lazy._StoreArray._get
    monkeypatch.setattr(
        lazy._StoreArray, "_get", lambda self, key: read.append(get(self, key)) or read[-1]
    )
    monkeypatch.setattr(blocks, "BLOCK", 60)
    data = dvi.open_sweep(tmp_path / "s").to_xarray()
    axis = plot.sweep_map(data.drift, pixels=(20, 5))
    same(array_of(axis), whole.reshape(20, 10, 5).max(1).T)
    assert axis.figure.axes[1].get_ylabel() == "largest drift"
    assert max(r.size for r in read) == 60
    assert sum(r.size for r in read) == 1000
    plot.failure_map(data, pixels=(20, 5))
    plot.slope_map(data.drift, pixels=(20, 5), local=True)
    assert max(r.size for r in read) == 200  # lines along ε are whole


def test_invalid_input_is_rejected():
    three = xr.DataArray(np.ones((2, 3, 4)), dims=("a", "b", "c"), name="v")
    two, many = three[0], xr.DataArray(np.ones((40, 2, 2)))
    status, ax = with_status().status.expand_dims(k=2), plt.subplots()[1]
    refuses(
        plot.sweep_map,
        ((drift(), "y"), {}, r"x must be one of .*epsilon \(7\), x .*got 'y'"),
        ((three,), {}, r"also has 'c'.*isel\(c=0\).*over=\['c'\].*facet"),
        ((three, "a", "a"), {}, "y and x must use different .*got 'a' for both"),
        ((three, "a"), {"over": "a"}, "got 'a' for both"),
        ((three[:, :0],), {}, "data along 'b' is empty"),
        ((three[0, 0, 0],), {}, "have a dimension of size 2 .*used: none"),
        ((two,), {"reduce": "sum"}, "one of 'max', 'min'"),
        ((two,), {"pixels": 3}, "pixels must be"),
        ((-two,), {"log": True}, r"log=True requires .*got -\d"),
        ((np.ones(3),), {}, "must be an xarray.DataArray", TypeError),
        ((with_status(),), {}, "one variable.*drift, status", TypeError),
        ((two + 1j,), {}, "real numbers, got .* complex128", TypeError),
        ((three,), {"facet": "a", "ax": ax}, "omit ax"),
        ((many,), {"facet": "dim_0"}, r"40 values.*at most 16.*slice\(None, None, 3\)"),
        ((drift(),), {"status": status}, "the same sweep and selection"),
    )
    refuses(
        plot.failure_map,
        ((drift().to_dataset(),), {}, "data must contain the variable status, got .* drift"),
        ((drift(),), {}, "data must have .*flag_values .* got None and None"),
    )
    local = {"x": "x", "y": "k", "local": True}
    refuses(
        plot.slope_map,
        ((drift(), "h"), {}, "along must be one of .*got 'h'"),
        ((three, "a"), {}, r"along='a' must have .*got array\(\[\]"),
        ((drift(),), {"over": "epsilon"}, "along='epsilon' and over"),
        ((drift()[:1],), {}, "two or more positive numbers"),
        ((drift().expand_dims(k=2),), local, "needs 'epsilon' as x or y"),
    )
