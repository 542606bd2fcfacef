"""A check for numbers with units and masked numbers."""

from typing import Any

import numpy as np


def refuse_unit_or_mask(name: str, value: Any) -> None:
    """**Raises** `TypeError` for a quantity of astropy or pint, `ValueError` for an array with
    masked numbers."""
    # Both are accepted by np.asarray, which drops the unit or the mask without a warning.
    if np.ma.is_masked(value):
        where = np.argwhere(np.ma.getmaskarray(value))[0].tolist()
        raise ValueError(
            f"{name} is a masked array with a masked number"
            + (f" at index {where}" if where else "")
            + ". The mask would be ignored: remove the masked numbers, or replace them."
        )
    unit = None
    if hasattr(value, "to_value"):
        unit = getattr(value, "unit", None)
    elif hasattr(value, "magnitude"):
        unit = getattr(value, "units", None)
    if unit is not None:
        raise TypeError(
            f"{name} has the unit {str(unit) or '1'!r}, but numbers without units are required "
            "here. Convert all quantities to one system of units and give plain numbers: "
            "x.to_value(unit) of astropy, x.m_as(unit) of pint. For trajectories, "
            "dvi_jax.interop.integrate(..., units=...) accepts quantities of astropy."
        )
