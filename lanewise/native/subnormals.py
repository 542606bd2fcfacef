"""Calls of kernels with the arithmetic of IEEE 754, in which subnormal numbers are not zero.

XLA sets a mode of the processor that replaces subnormal numbers by zero, in all threads that run
its code. Machine code of ours is made for IEEE 754, which a GPU has as well: the mode is changed
while a kernel runs, and set again after it, because the same thread also runs XLA's code.
"""

import platform

# The register with the mode: its bits that replace numbers (FTZ and DAZ of MXCSR, FZ and FIZ of
# FPCR), and the functions that read and set it.
_X86 = (
    0x8040,
    """
declare void @llvm.x86.sse.stmxcsr(ptr)
declare void @llvm.x86.sse.ldmxcsr(ptr)
define internal i64 @float_mode() {
  %at = alloca i32
  call void @llvm.x86.sse.stmxcsr(ptr %at)
  %word = load i32, ptr %at
  %mode = zext i32 %word to i64
  ret i64 %mode
}
define internal void @set_float_mode(i64 %mode) {
  %at = alloca i32
  %word = trunc i64 %mode to i32
  store i32 %word, ptr %at
  call void @llvm.x86.sse.ldmxcsr(ptr %at)
  ret void
}
""",
)
_ARM = (
    0x0100_0001,
    """
declare i64 @llvm.aarch64.get.fpcr()
declare void @llvm.aarch64.set.fpcr(i64)
define internal i64 @float_mode() {
  %mode = call i64 @llvm.aarch64.get.fpcr()
  ret i64 %mode
}
define internal void @set_float_mode(i64 %mode) {
  call void @llvm.aarch64.set.fpcr(i64 %mode)
  ret void
}
""",
)
_MODES = {"x86_64": _X86, "amd64": _X86, "aarch64": _ARM, "arm64": _ARM}


def compute_text(processor: str = "") -> str:
    """The function ``@compute`` of a kernel and its arguments; on other processors it is the call
    alone."""
    call = """call void %kernel(
    ptr %args, ptr %rets, ptr %params, ptr %scratch, i64 %first, i64 %last)"""
    bits, functions = _MODES.get((processor or platform.machine()).lower(), (0, ""))
    if functions:
        call = f"""%mode = call i64 @float_mode()
  %gradual = and i64 %mode, {~bits}
  call void @set_float_mode(i64 %gradual)
  {call}
  call void @set_float_mode(i64 %mode)"""
    return f"""{functions}
define internal void @compute(
    ptr %kernel, ptr %args, ptr %rets, ptr %params, ptr %scratch, i64 %first, i64 %last) {{
  {call}
  ret void
}}
"""
