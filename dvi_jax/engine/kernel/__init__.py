"""A function of one lane on many lanes as one GPU kernel, its loops with the state in registers.

In component form every number of a lane is a variable of its own, and a block of lanes goes through
all loops of the function within one call of a Pallas kernel (Triton backend): one lane a thread,
nothing in memory but inputs, outputs and the rows that a loop saves. Rows are written from within
the loop; what is made of them afterwards (reshaping, joining) is left to XLA. A function that does
not go into a kernel is found out by looking at its program before anything is compiled.
"""

from ._call import run_in_kernel as run_in_kernel
from ._limits import LOWERED as LOWERED, NotInKernelError as NotInKernelError
