"""Methods by name, such as "strang" or "KahanLi(8)"."""

import difflib
import re
from typing import Any

from ._adjoint import Adjoint
from ._charged import Boris, MagneticSplitting
from ._gauss_legendre import GaussLegendre
from ._lobatto_pair import LobattoIIIAIIIB
from ._published import BlanesMoan, KahanLi, McLachlan, Suzuki, Yoshida
from ._rattle import Rattle
from ._relativistic import HigueraCary, RelativisticBoris, Vay
from ._runge_kutta4 import RungeKutta4
from ._splitting import Splitting
from ._stochastic import BAOAB, OBABO, StochasticEuler, StochasticMidpoint, StrongSplitting
from ._strang import Strang
from ._type_ii import TypeII
from ._wisdom_holman import WisdomHolman


def as_method(method: Any) -> Any:
    """The method with a name: "strang", "leapfrog", "rk4", "KahanLi8", "yoshida(4)".

    Capital letters, spaces, hyphens and underscores make no difference. Any other object is
    returned. **Raises** `ValueError`.
    """
    if not isinstance(method, str):
        return method
    plain = {
        **dict.fromkeys(("TypeII", "SymplecticEuler"), TypeII),
        "Adjoint": Adjoint,
        **dict.fromkeys(("Strang", "StormerVerlet", "Verlet", "Leapfrog"), Strang),
        "Boris": Boris,
        "MagneticSplitting": MagneticSplitting,
        **{kind.__name__: kind for kind in (RelativisticBoris, HigueraCary, Vay)},
        "Rattle": Rattle,
        "Splitting": Splitting,
        "WisdomHolman": WisdomHolman,
        **dict.fromkeys(("RungeKutta4", "RK4"), RungeKutta4),
        **{kind.__name__: kind for kind in (BAOAB, OBABO, StrongSplitting)},
        **{kind.__name__: kind for kind in (StochasticEuler, StochasticMidpoint)},
        "ImplicitMidpoint": lambda: GaussLegendre(1),
    }
    kinds = Yoshida, Suzuki, BlanesMoan, McLachlan, KahanLi, GaussLegendre, LobattoIIIAIIIB
    with_number = {kind.__name__: kind for kind in kinds}
    key = re.sub(r"[\s_-]", "", method).lower().replace("ö", "o").removesuffix("()")
    for name, make in plain.items():
        if key == name.lower():
            return make()
    match = re.fullmatch(r"([a-z]+?)\(?(?:order=|stages=)?(\d+)\)?", key)
    for name, kind in with_number.items():
        if match and match[1] == name.lower():
            return kind(int(match[2]))
    number = match[2] if match else ""
    spellings = {name.lower(): name for name in plain}
    spellings |= {f"{name}{number}".lower(): f"{name}{number or '(...)'}" for name in with_number}
    close = difflib.get_close_matches(key, spellings, 1, 0.5)
    suggestion = f" Did you mean {spellings[close[0]]!r}?" if close else ""
    raise ValueError(
        f"method must be an object such as dvi.Strang(), or a name, got {method!r}.{suggestion} "
        f"Names are {', '.join(plain)}; with a number, as in 'Yoshida4', {', '.join(with_number)}."
    )
