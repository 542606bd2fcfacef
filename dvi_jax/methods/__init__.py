"""How one step is made of maps: one file for each method, over one abstract base."""

from ._adjoint import Adjoint as Adjoint
from ._base import Method as Method
from ._composition import Composition as Composition
from ._runge_kutta4 import RungeKutta4 as RungeKutta4
from ._strang import Strang as Strang
from ._type_ii import TypeII as TypeII
from ._yoshida import Yoshida as Yoshida
