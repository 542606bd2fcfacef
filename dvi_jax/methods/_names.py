"""Methods by name, such as "strang" or "KahanLi(8)"."""

import difflib
import re
from typing import Any


def as_method(given: Any) -> Any:
    """The method with a name: "strang", "leapfrog", "rk4", "KahanLi8", "yoshida(4)".

    Capital letters, spaces, hyphens and underscores make no difference. What is not text is
    returned. **Raises** `ValueError`.
    """
    if not isinstance(given, str):
        return given
    text = given
    from .. import methods as m  # the package that this file is a part of

    plain = {
        "TypeII": m.TypeII,
        "SymplecticEuler": m.TypeII,
        "Adjoint": m.Adjoint,
        "Strang": m.Strang,
        "StormerVerlet": m.Strang,
        "Verlet": m.Strang,
        "Leapfrog": m.Strang,
        "RungeKutta4": m.RungeKutta4,
        "RK4": m.RungeKutta4,
        "ImplicitMidpoint": lambda: m.GaussLegendre(1),
    }
    with_number = {
        "Yoshida": m.Yoshida,
        "Suzuki": m.Suzuki,
        "BlanesMoan": m.BlanesMoan,
        "McLachlan": m.McLachlan,
        "KahanLi": m.KahanLi,
        "GaussLegendre": m.GaussLegendre,
        "LobattoIIIAIIIB": m.LobattoIIIAIIIB,
    }
    key = re.sub(r"[\s_-]", "", text).lower().replace("ö", "o").removesuffix("()")
    for name, make in plain.items():
        if key == name.lower():
            return make()
    found = re.fullmatch(r"([a-z]+?)\(?(?:order=|stages=)?(\d+)\)?", key)
    for name, kind in with_number.items():
        if found and found[1] == name.lower():
            return kind(int(found[2]))
    known = {name.lower(): name for name in (*plain, *(f"{n}8" for n in with_number))}
    close = difflib.get_close_matches(key, known, 1, 0.5)
    meant = f" Did you mean {known[close[0]]!r}?" if close else ""
    raise ValueError(
        f"method {text!r} is not known.{meant} Allowed are {', '.join(plain)}; with an order or a "
        f"number of stages, as in 'Yoshida4', {', '.join(with_number)}; and objects such as "
        "dvi.Strang()."
    )
