"""How one step is composed of maps: methods over one abstract base."""

from ._adjoint import Adjoint as Adjoint
from ._base import InLoop as InLoop, Method as Method
from ._charged import Boris as Boris, MagneticSplitting as MagneticSplitting
from ._composition import Composition as Composition
from ._dissipation import warn_of_dissipation as warn_of_dissipation
from ._gauss_legendre import GaussLegendre as GaussLegendre
from ._lobatto_pair import LobattoIIIAIIIB as LobattoIIIAIIIB
from ._names import as_method as as_method
from ._published import (
    BlanesMoan as BlanesMoan,
    KahanLi as KahanLi,
    McLachlan as McLachlan,
    Suzuki as Suzuki,
    Yoshida as Yoshida,
)
from ._rattle import Rattle as Rattle
from ._relativistic import (
    HigueraCary as HigueraCary,
    RelativisticBoris as RelativisticBoris,
    Vay as Vay,
)
from ._runge_kutta4 import RungeKutta4 as RungeKutta4
from ._splitting import Splitting as Splitting
from ._stochastic import (
    BAOAB as BAOAB,
    OBABO as OBABO,
    StochasticEuler as StochasticEuler,
    StochasticMidpoint as StochasticMidpoint,
    StrongSplitting as StrongSplitting,
)
from ._strang import Strang as Strang
from ._type_ii import TypeII as TypeII
from ._wisdom_holman import WisdomHolman as WisdomHolman
