"""Equilibria of VMEC, transformed to Boozer coordinates by the package booz_xform."""

import importlib
import tempfile
from pathlib import Path
from typing import Any

from ...base.checks import whole
from ...base.files import user_file
from ._field import Field
from ._files import Geometry, read_booz_xform, read_geometry


def package(name: str, purpose: str) -> Any:
    """An optional package. **Raises** `ImportError` with the line that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(f"{purpose} requires the package {name}: pip install {name}.") from error


def read_vmec(
    path: Any, *, modes: tuple[int, int] = (32, 32), surfaces: int | None = None, **settings: Any
) -> tuple[Field, Geometry]:
    """The `Field` and the `Geometry` of a ``wout_*.nc`` file of VMEC, by booz_xform.

    - `modes`: largest m, and n per period, of the transformation.
    - `surfaces`: about this many of the half-grid surfaces of VMEC, in equal steps of s; all of
      them by default. The transformation takes time in proportion to it.
    - `settings`: ``box``, ``degree`` and ``tolerance`` of `read_booz_xform` and `read_geometry`.

    **Raises** `ImportError` without booz_xform; `ValueError` as `read_booz_xform` and, for an
    equilibrium without stellarator symmetry, `read_geometry`.

    **Source** Sanchez et al. 2000, *J. Comput. Phys.* 161, 576.
    """
    path, (m, n) = user_file("path", path), modes
    transform = package("booz_xform", "boozer.read_vmec").Booz_xform()
    transform.verbose = 0
    transform.read_wout(str(path), True)  # with the toroidal flux
    transform.mboz, transform.nboz = whole("modes[0]", m), whole("modes[1]", n, 0)
    if surfaces is not None:
        count = len(transform.s_in)
        step = max(1, round(count / whole("surfaces", surfaces, 3)))
        # With the last surface, from which the fit continues to the edge.
        transform.compute_surfs = range(count)[::-step][::-1]
    transform.run()
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "boozmn.nc"
        transform.write_boozmn(str(file))
        return read_booz_xform(file, **settings), read_geometry(file, **settings)
