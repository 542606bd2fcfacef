"""How the primitives of JAX are written in LLVM IR: each file registers its rules in `RULES`."""

from . import (
    calls as calls,
    elementary as elementary,
    elementwise as elementwise,
    elimination as elimination,
    indexing as indexing,
    loops as loops,
    moves as moves,
    reductions as reductions,
    written as written,
)
