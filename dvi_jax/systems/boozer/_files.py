"""Fields and geometry from files: booz_xform's netCDF, and JSON of our own."""

import json
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ...base.checks import instance, positive
from ...base.files import user_file, user_path
from ...base.printing import printable
from ._field import Field, fitted_modes, from_modes, from_surfaces
from ._sums import Coefficients, Shape, total

DATA = Path(__file__).with_name("data")


@printable
class Geometry(eqx.Module):
    """Cylindrical coordinates of the points (s, θ, ζ) of a field.

    - `R`, `Z`: coefficients as those of `Field`, R [m] of cosines and Z of sines. `nu`: of sines,
      the cylindrical angle is φ = direction·(ζ − ν) [rad].
    - `direction`: 1, or −1 where the right-handed ζ runs against φ.
    """

    R: Coefficients
    Z: Coefficients
    nu: Coefficients
    shape: Shape = eqx.field(static=True)
    direction: int = eqx.field(static=True)

    def cylindrical(self, s: Any, theta: Any, zeta: Any) -> tuple[Array, Array, Array]:
        """(R, φ, Z) [m, rad, m] for arrays of one shape."""
        s, theta, zeta = jnp.broadcast_arrays(*map(jnp.asarray, (s, theta, zeta)))
        r = jnp.sqrt(s)
        point = (self.shape, r * jnp.cos(theta), r * jnp.sin(theta), zeta)
        R, Z, nu = (total(c, *point) for c in (self.R, self.Z, self.nu))
        return R, self.direction * (zeta - nu), Z

    def cartesian(self, s: Any, theta: Any, zeta: Any) -> Array:
        """Positions (x, y, z) [m], shape (…, 3), for arrays of one shape."""
        R, phi, Z = self.cylindrical(s, theta, zeta)
        return jnp.stack([R * jnp.cos(phi), R * jnp.sin(phi), Z], axis=-1)


class _Surfaces(NamedTuple):
    """What a file holds, in right-handed coordinates with ψ ≥ 0."""

    periods: int
    psi_edge: float
    direction: int
    s: np.ndarray
    m: np.ndarray
    n: np.ndarray
    iota: np.ndarray
    G: np.ndarray
    I: np.ndarray  # noqa: E741
    even: dict[str, np.ndarray]
    odd: dict[str, np.ndarray]


def read_booz_xform(
    path: Any,
    *,
    box: tuple[int, int] | None = None,
    degree: int = 6,
    helicity: int = 0,
    tolerance: float = 1e-2,
    psi_edge: float | None = None,
) -> Field:
    """A `Field` from a file of booz_xform (``boozmn_*.nc``), also as DESC writes it.

    Left-handed angles of the file become right-handed ones with ψ ≥ 0: θ is reversed if the
    toroidal flux of the file is positive, otherwise ζ.

    - `box`, `degree`, `helicity`, `tolerance`: as for `from_surfaces`.
    - `psi_edge`: toroidal flux of the edge/2π [T m²], with the sign of the file, where the file has
      none (booz_xform writes it only after ``read_wout(path, True)``).

    **Raises** `ValueError` for a file that is not netCDF of version 3, has no spectrum of |B|, or
    too few surfaces; `OSError` if it cannot be read.

    **Source** Sanchez et al. 2000, *J. Comput. Phys.* 161, 576 (booz_xform).
    """
    data = _surfaces(path, ["bmnc_b"], ["bmns_b"], psi_edge)
    parts = [data.even["bmnc_b"], *data.odd.values()]
    return from_surfaces(
        data.s, data.m, data.n, np.stack(parts) if len(parts) > 1 else parts[0],
        psi_edge=data.psi_edge, iota=data.iota, G=data.G, I=data.I, periods=data.periods,
        helicity=helicity, degree=degree, box=box, tolerance=tolerance,
    )  # fmt: skip


@runtime_checkable
class _NearAxis(Protocol):
    """What a `Qsc` has, which is no dependency of this package."""

    spsi: Any
    iotaN: Any
    etabar: Any


def from_near_axis(stellarator: Any, minor_radius: float) -> Field:
    r"""A `Field` from an expansion about the axis, of first or second order in the distance r.

        |B| = B0 (1 + r η̄ cos ϑ) + r² (B20(ζ) + B2c cos 2ϑ + B2s sin 2ϑ),    ϑ = θ − Nζ

    with ψ = r² B0/2, G = G0 + r² G2, I = r² I2 and constant ι.

    - `stellarator`: an object of the package ``qsc``, such as ``Qsc.from_paper("precise QA")``.
    - `minor_radius`: r at the edge s = 1 [m].

    **Raises** `ValueError` for an expansion with the sign of ψ reversed, and as `from_modes`.

    **Source** Landreman & Sengupta 2019, *J. Plasma Phys.* 85, 815850601.
    """
    hint = 'Give the object itself, such as qsc.Qsc.from_paper("precise QA").'
    q = instance("stellarator", stellarator, _NearAxis, "a Qsc of the package qsc", hint)
    a = positive("minor_radius", minor_radius)
    if q.spsi != 1:
        raise ValueError(f"from_near_axis requires spsi = 1 (ψ ≥ 0), got spsi = {q.spsi}.")
    N = round(float(q.iota - q.iotaN))
    modes = {(0, 0): [q.B0, 0.0, 0.0], (1, N): [q.B0 * q.etabar * a, 0.0, 0.0]}
    second = q.order != "r1"
    if second:
        zeta, count = np.asarray(q.varphi), len(q.varphi) // 4
        n = q.nfp * np.arange(count + 1)
        columns = np.hstack([np.cos(np.outer(zeta, n)), -np.sin(np.outer(zeta, n[1:]))])
        c, *_ = np.linalg.lstsq(columns, np.asarray(q.B20), rcond=None)
        even, odd = c[: count + 1], np.concatenate([[0.0], c[count + 1 :]])
        is_large = (np.abs(even) + np.abs(odd)) > 1e-9 * np.abs(c).max()
        for i in np.flatnonzero(is_large):
            row = modes.setdefault((0, int(n[i])), [0.0, 0.0, 0.0])
            row[1], row[2] = a**2 * even[i], a**2 * odd[i]
        modes[2, 2 * N] = [a**2 * q.B2c, 0.0, 0.0]
    m, n = zip(*modes, strict=True)
    rows = np.array(list(modes.values()))
    sine = np.stack([0 * rows[:, 2], rows[:, 2]], 1)
    if second:
        sine[list(modes).index((2, 2 * N)), 0] = a**2 * q.B2s
    r2 = [q.G0, a**2 * (np.nan_to_num(float(q.G2)) if second else 0.0)]
    B = np.stack([rows[:, :2], sine]) if sine.any() else rows[:, :2]
    return from_modes(
        m, n, B, psi_edge=q.B0 * a**2 / 2, iota=float(q.iota), G=r2,
        I=[0.0, a**2 * q.I2] if q.I2 else None, periods=int(q.nfp), helicity=N // int(q.nfp),
    )  # fmt: skip


def read_geometry(
    path: Any,
    *,
    box: tuple[int, int] | None = None,
    degree: int = 6,
    scale: float = 1.0,
    tolerance: float = 1e-2,
) -> Geometry:
    """The `Geometry` of a stellarator-symmetric field, from a file of booz_xform or DESC.

    `scale`: factor of all lengths. `box`, `degree`: as for `from_surfaces`. `tolerance`:
    largest error of R and Z over the mean of R, and of ν [rad], measured as there.

    **Raises** as `read_booz_xform`; `ValueError` for a field without that symmetry.
    """
    f = _surfaces(path, ["bmnc_b", "rmnc_b"], ["zmns_b", "pmns_b", "bmns_b"])
    if "bmns_b" in f.odd:
        raise ValueError(f"{path}: the symmetry (θ, ζ) → (−θ, −ζ) is required, got bmns_b.")
    tables, settings = {}, (f.periods, degree, box, tolerance)
    length = scale * np.abs(f.even["rmnc_b"][:, (f.m == 0) & (f.n == 0)]).mean()
    for name, values, size in (
        ("R", scale * f.even["rmnc_b"], length),
        ("Z", scale * f.odd["zmns_b"], length),
        ("nu", f.odd["pmns_b"], 1.0),
    ):
        table = fitted_modes(name, f.s, f.m, f.n, values, size, settings)
        zeros = np.zeros_like(table)
        tables[name] = jnp.asarray(np.stack([table, zeros] if name == "R" else [zeros, table]))
    return Geometry(**tables, shape=Shape(f.periods, 0), direction=f.direction)


def _surfaces(path: Any, even: list[str], odd: list[str], psi: float | None = None) -> _Surfaces:
    from scipy.io import netcdf_file  # a part of import time

    path = user_file("path", path)
    try:
        with netcdf_file(str(path), "r", mmap=False) as file:
            variables = {k: np.array(v.data) for k, v in file.variables.items()}
    except TypeError as error:  # of a file in another format
        raise ValueError(
            f"{path} is not a file of netCDF version 3, as of booz_xform ({error})."
        ) from None
    names = ["nfp_b", "ns_b", "jlist", "ixm_b", "ixn_b", "iota_b", "bvco_b", "buco_b", "phi_b"]
    absent = [name for name in (*names, *even) if name not in variables]
    if absent:
        raise ValueError(f"{path} is not a file of booz_xform: it has no {', '.join(absent)}.")
    # Surfaces are in the middle between those of VMEC, and entry 0 of profiles is not used.
    rows = variables["jlist"].astype(int) - 1
    s = (rows - 0.5) / (int(variables["ns_b"]) - 1)
    flux = float(variables["phi_b"][-1]) / (2 * np.pi) if psi is None else psi
    if flux == 0:
        raise ValueError(
            f"{path}: the toroidal flux phi_b at the edge is 0. Give psi_edge= (flux/2π, with its "
            "sign), or call read_wout(path, True) of booz_xform."
        )
    m, n = variables["ixm_b"].astype(int), -variables["ixn_b"].astype(int)
    G, I = variables["bvco_b"][rows], variables["buco_b"][rows]  # noqa: E741
    # The angles of the file are left-handed with R, φ, Z. Of θ → −θ and ζ → −ζ, the one that
    # makes ψ positive; mode (m, n) becomes (m, −n) in both, and an odd function changes its sign
    # with θ.
    by_theta = flux > 0
    sign = -1 if by_theta else 1
    # A negative n of m = 0 is the same mode as the positive one.
    mirror = (m == 0) & (n < 0)
    odd_sign = np.where(mirror, -1, 1)
    evens = {k: np.asarray(variables[k], float) for k in even}
    odds = {}
    for k in (k for k in odd if k in variables):
        # ν = ζ − direction·φ has the sign of pmns_b for both reversals.
        factor = 1 if k == "pmns_b" else sign
        odds[k] = factor * odd_sign * np.asarray(variables[k], float)
    return _Surfaces(
        int(variables["nfp_b"]), abs(flux), 1 if by_theta else -1, s, m, np.where(mirror, -n, n),
        -variables["iota_b"][rows], G if by_theta else -G, -I if by_theta else I, evens, odds,
    )  # fmt: skip


def save_field(field: Field, path: Any, source: str = "") -> None:
    """Write a field as JSON. `source`: where it comes from, as text."""
    table = np.asarray(field.coefficients)
    profiles = {"iota": field.iota, "G": field.G, "I": field.I}
    contents = {"source": source, **field.shape._asdict(), "psi_edge": float(field.psi_edge)}
    contents |= {k: None if c is None else np.asarray(c).tolist() for k, c in profiles.items()}
    parts = table.reshape(len(table), -1, table.shape[-1])
    modes = [(m, n, parts[:, i]) for i, (m, n) in enumerate(field.modes)]
    lines = ",\n".join(json.dumps([m, n, *b.tolist()]) for m, n, b in modes if b.any())
    text = json.dumps(contents, indent=1)[:-2] + ',\n "modes": [\n' + lines + "\n]}\n"
    user_path("path", path).write_text(text)


def load_field(path: Any) -> Field:
    """Read a field that `save_field` has written. **Raises** `ValueError` for another file."""
    text = user_file("path", path).read_bytes()
    try:
        contents = json.loads(text)
        rows = contents["modes"]
        return from_modes(
            [row[0] for row in rows],
            [row[1] for row in rows],
            np.moveaxis(np.array([row[2:] for row in rows], float), 1, 0),
            **{k: contents[k] for k in ("psi_edge", "iota", "G", "I", "periods", "helicity")},
        )
    except (LookupError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path} is not a field that save_field has written: {error!r}."
        ) from error


def precise_qa() -> Field:
    """A precisely quasi-axisymmetric vacuum field at reactor size; 2 periods, aspect ratio 6.

    Volume average of |B| 5.7 T, minor radius 1.7 m. Modes up to m = 5, |n| = 6; those left out are
    1.6e-5 of |B| (root mean square at the edge, 3e-6 at s = 0.5). The largest symmetry-breaking
    mode is 2e-4 of |B|.

    **Source** Landreman & Paul 2022, *Phys. Rev. Lett.* 128, 035001, from the equilibrium
    ``precise_QA`` in the package desc-opt.
    """
    return load_field(DATA / "precise_qa.json")


def w7x() -> Field:
    """A field like that of Wendelstein 7-X at reactor size: 5 periods, aspect ratio 11.

    Volume average of |B| 5.7 T, minor radius 1.7 m. Modes up to m = 8, |n| = 50; those left out are
    1.5e-3 of |B| (root mean square, at the edge). It has a small toroidal current.

    **Source** the equilibrium ``W7-X`` in the package desc-opt (Dudt & Kolemen 2020, *Phys.
    Plasmas* 27, 102513).
    """
    return load_field(DATA / "w7x.json")
