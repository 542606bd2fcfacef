"""Methods by name, such as "strang" or "KahanLi(8)"."""

import difflib
import re
from typing import Any

from ._adjoint import Adjoint
from ._gauss_legendre import GaussLegendre
from ._lobatto_pair import LobattoIIIAIIIB
from ._published import BlanesMoan, KahanLi, McLachlan, Suzuki, Yoshida
from ._rattle import Rattle
from ._runge_kutta4 import RungeKutta4
from ._splitting import Splitting
from ._strang import Strang
from ._type_ii import TypeII
from ._wisdom_holman import WisdomHolman


def as_method(given: Any) -> Any:
    """The method with a name: "strang", "leapfrog", "rk4", "KahanLi8", "yoshida(4)".

    Capital letters, spaces, hyphens and underscores make no difference. Any other object is
    returned. **Raises** `ValueError`.
    """
    if not isinstance(given, str):
        return given
    text = given
    plain = {
        **dict.fromkeys(("TypeII", "SymplecticEuler"), TypeII),
        "Adjoint": Adjoint,
        **dict.fromkeys(("Strang", "StormerVerlet", "Verlet", "Leapfrog"), Strang),
        "Rattle": Rattle,
        "Splitting": Splitting,
        "WisdomHolman": WisdomHolman,
        **dict.fromkeys(("RungeKutta4", "RK4"), RungeKutta4),
        "ImplicitMidpoint": lambda: GaussLegendre(1),
    }
    kinds = Yoshida, Suzuki, BlanesMoan, McLachlan, KahanLi, GaussLegendre, LobattoIIIAIIIB
    with_number = {kind.__name__: kind for kind in kinds}
    key = re.sub(r"[\s_-]", "", text).lower().replace("ö", "o").removesuffix("()")
    for name, make in plain.items():
        if key == name.lower():
            return make()
    found = re.fullmatch(r"([a-z]+?)\(?(?:order=|stages=)?(\d+)\)?", key)
    for name, kind in with_number.items():
        if found and found[1] == name.lower():
            return kind(int(found[2]))
    number = found[2] if found else ""
    known = {name.lower(): name for name in plain}
    known |= {f"{n}{number}".lower(): f"{n}{number or '(...)'}" for n in with_number}
    close = difflib.get_close_matches(key, known, 1, 0.5)
    meant = f" Did you mean {known[close[0]]!r}?" if close else ""
    raise ValueError(
        f"method must be a known name or an object such as dvi.Strang(), got {text!r}.{meant} The "
        f"names without a number are {', '.join(plain)}. The names with a number, as in "
        f"'Yoshida4', are {', '.join(with_number)}. The number is the order; for the last two it "
        "is the number of stages."
    )
