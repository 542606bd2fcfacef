"""Numbers with units are refused where numbers are taken: an array would drop the unit."""

from typing import Any


def refuse_quantity(name: str, value: Any) -> None:
    """Refuse a quantity of astropy or pint called `name`."""
    if hasattr(value, "unit") and hasattr(value, "to_value"):
        unit = value.unit
    elif hasattr(value, "units") and hasattr(value, "magnitude"):
        unit = value.units
    else:
        return
    raise TypeError(
        f"{name} has the unit {str(unit) or '1'!r}, and numbers are taken here: it would be lost. "
        "dvi_jax.interop.integrate(..., units=...) takes quantities of astropy and converts them; "
        "or divide by the unit that the run is in."
    )
