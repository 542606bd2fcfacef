"""Functions with long arrays as loops over elements.

The lanes of a vector are neighbours in an array.

`equations` makes a tree of statements (`tree`) from a jaxpr, with arrays as `boxes`; `schedule`
joins statements into loops, `places` decides which arrays share memory, and `nests` and `code`
write LLVM IR.
"""

from . import (  # they register rules
    flow as flow,
    indices as indices,
    reductions as reductions,
    systems as systems,
)
