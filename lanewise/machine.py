"""LLVM IR to machine code: the host's features, the optimiser, and what an earlier process made."""

import functools
from typing import Any

from . import cache

try:
    import llvmlite
    import llvmlite.binding as llvm
except ImportError as error:  # not on every platform: `started` says so, and all goes through XLA
    llvmlite: Any = None
    llvm: Any = None
    _missing: ImportError | None = error
else:
    _missing = None

FORMAT = 3
"""Goes up with each change of what the machine code expects of the process around it."""


@functools.cache
def started() -> None:
    """Start LLVM, once.

    **Raises** `ImportError` where llvmlite is not installed.
    """
    if _missing is not None:
        raise _missing
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


@functools.cache
def host() -> tuple[str, str]:
    """(name, features) of the processor, as LLVM calls them."""
    features = llvm.get_host_cpu_features().flatten()
    if "+avx512f" in features.split(","):
        features += ",-prefer-256-bit"
    return llvm.get_host_cpu_name(), features


@functools.cache
def width() -> int:
    """How many float64 a vector register has."""
    features = set(host()[1].split(","))
    if {"+avx512f", "+avx512dq", "+avx512vl"} <= features:
        return 8
    return 4 if "+avx2" in features else 2


@functools.cache
def target_machine(triple: str | None = None, cpu: str | None = None, features: str | None = None):
    """LLVM's view of a machine, by default of this one."""
    started()
    if triple is None:
        target, (cpu, features) = llvm.Target.from_default_triple(), host()
    else:
        target = llvm.Target.from_triple(triple)
    # The large code model: the loader may put code and data further apart than 32 bits can say.
    return target.create_target_machine(
        cpu=cpu or "", features=features or "", opt=2, reloc="static", codemodel="large"
    )


def _optimised(module: Any, machine: Any) -> None:
    """The passes that pay for code which is written number by number: no vectoriser, no unrolling,
    nothing that may change an operation."""
    options = llvm.create_pipeline_tuning_options(speed_level=2)
    options.slp_vectorization = options.loop_vectorization = options.loop_unrolling = False
    builder = llvm.create_pass_builder(machine, options)
    builder.getModulePassManager().run(module, builder)


def object_code(ir: str, machine: Any = None) -> bytes:
    """The object file of a module."""
    machine = target_machine() if machine is None else machine
    module = llvm.parse_assembly(ir)
    module.verify()
    module.triple = machine.triple
    module.data_layout = str(machine.target_data)
    _optimised(module, machine)
    return machine.emit_object(module)


def assembly(ir: str) -> str:
    """The machine code of a module in the assembler's language."""
    machine = target_machine()
    module = llvm.parse_assembly(ir)
    module.verify()
    _optimised(module, machine)
    return machine.emit_assembly(module)


def loaded(ir: str, symbols: dict[str, int] | None = None) -> Any:
    """The engine, with a module's machine code in it; from the cache on disk, if it is there.

    One engine holds the code of all modules, which must define different names; JAX may call it as
    long as the process lives.
    """
    started()
    for name, address in (symbols or {}).items():
        llvm.add_symbol(name, address)
    cpu, features = host()
    key = cache.key(FORMAT, llvmlite.__version__, llvm.llvm_version_info, cpu, features, ir)
    code = cache.read(key)
    if code is None:
        code = object_code(ir)
        cache.write(key, code)
    engine = _engine()
    empty = llvm.parse_assembly("")
    empty.name = key
    _codes[key] = code
    try:
        engine.add_module(empty)
        engine.finalize_object()
    finally:
        del _codes[key]
    return engine


_codes: dict[str, bytes] = {}
"""The code of a module that is being added to the engine, by the module's name."""


@functools.cache
def _engine() -> Any:
    first = llvm.parse_assembly("define internal void @nothing() { ret void }")
    engine = llvm.create_mcjit_compiler(first, _own_machine())
    engine.set_object_cache(None, lambda module: _codes.get(module.name))
    return engine


def _own_machine() -> Any:
    """An engine takes the machine that it is given for itself."""
    cpu, features = host()
    return llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=2, reloc="pic", codemodel="jitdefault", jit=True
    )
