"""Numbers with units are refused where numbers are taken: an array would drop the unit."""

from typing import Any


def refuse_quantity(name: str, value: Any) -> None:
    """Refuse a quantity of astropy or pint called `name`.

    **Raises** `TypeError`.
    """
    unit = None
    if hasattr(value, "to_value"):
        unit = getattr(value, "unit", None)
    elif hasattr(value, "magnitude"):
        unit = getattr(value, "units", None)
    if unit is not None:
        raise TypeError(
            f"{name} has the unit {str(unit) or '1'!r}, and numbers are taken here: it would be "
            "lost. dvi_jax.interop.integrate(..., units=...) takes quantities of astropy and "
            "converts them; or divide by the unit that the run is in."
        )
