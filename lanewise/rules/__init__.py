"""How the primitives of JAX are written in LLVM IR."""
