"""How one step is made of maps: one file for each method, over one abstract base."""

from ._adjoint import Adjoint as Adjoint
from ._base import Method as Method
from ._blanes_moan import BlanesMoan as BlanesMoan
from ._composition import Composition as Composition
from ._dissipation import warn_of_dissipation as warn_of_dissipation
from ._gauss_legendre import GaussLegendre as GaussLegendre
from ._kahan_li import KahanLi as KahanLi
from ._lobatto_pair import LobattoIIIAIIIB as LobattoIIIAIIIB
from ._mclachlan import McLachlan as McLachlan
from ._runge_kutta4 import RungeKutta4 as RungeKutta4
from ._strang import Strang as Strang
from ._suzuki import Suzuki as Suzuki
from ._type_ii import TypeII as TypeII
from ._yoshida import Yoshida as Yoshida
