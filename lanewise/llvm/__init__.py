"""LLVM IR: numbers, operations, loops, memory."""
