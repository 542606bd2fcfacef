"""Samples of a fit for ArviZ."""

from typing import Any

import numpy as np

import dvi_jax as dvi

from ..base.checks import instance
from ..observe.labelled import axis_names
from .extras import require


def to_inference_data(samples: dvi.Samples, observed: Any = None) -> Any:
    """Samples of ``dvi.sample`` as an object of ArviZ.

    - `samples`: a `Samples`. `observed`: the `Observations` that it was drawn for, or a list of
      them, or None.

    **Returns** ArviZ's `InferenceData` for arviz 0.x; an `xarray.DataTree` for arviz 1.x and
    arviz-base. Groups, dimensions chain and draw:

    - ``posterior``: one variable for each name of `samples`;
    - ``sample_stats``: ``diverging``, ``lp`` (log density in the free variables, up to a constant),
      ``n_steps``, ``tree_depth`` (of a tree of so many leapfrog steps), and ``acceptance_rate``,
      the mean of each chain, along chain alone;
    - ``observed_data``, with `observed`: ``values`` (or ``values_0``, … of a list), along ``ts``.

    **Raises** `ImportError` without arviz and arviz-base; `TypeError` for another object.
    """
    import xarray as xr

    hint = "For trajectories use solution.to_xarray()."
    instance("samples", samples, dvi.Samples, "a result of dvi.sample", hint)
    try:
        arviz = require("arviz", "interop.to_inference_data")
    except ImportError:
        arviz = require("arviz_base", "interop.to_inference_data")
    tree = samples.to_xarray()
    groups = {name: tree[name].to_dataset() for name in tree.children}
    steps = np.asarray(samples.steps)
    groups["sample_stats"] = groups["sample_stats"].assign(
        tree_depth=(("chain", "draw"), np.ceil(np.log2(steps + 1)).astype(int)),
        acceptance_rate=(("chain",), np.asarray(samples.acceptance)),
    )
    if observed is not None:
        arcs = list(observed) if isinstance(observed, list | tuple) else [observed]
        arrays, where = {}, {}
        for i, arc in enumerate(arcs):
            instance("observed", arc, dvi.Observations, "dvi.Observations, or a list of these")
            end = "" if len(arcs) == 1 else f"_{i}"
            values, name_of_values = np.asarray(arc.values), f"values{end}"
            axes = (f"ts{end}", *axis_names(name_of_values, values.shape[1:]))
            arrays[name_of_values] = (axes, values)
            where[f"ts{end}"] = np.asarray(arc.ts)
        groups["observed_data"] = xr.Dataset(arrays, where)
    attributes = {"inference_library": "dvi_jax", "inference_library_version": dvi.__version__}
    attributes |= {"sampler": "NUTS of numpyro", "status": samples.status}
    for group in groups.values():
        group.attrs.update(attributes)
    if hasattr(arviz, "InferenceData"):  # version 0.x, later ones take trees
        return arviz.InferenceData(**groups)
    return xr.DataTree.from_dict(groups)
