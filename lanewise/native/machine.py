"""LLVM IR to machine code: the host's features, the optimiser, and what an earlier process made."""

import functools
import threading
from collections.abc import Callable
from typing import Any

from . import cache

# Part of the name of each file in the cache: increase it with each change of what machine code
# expects of the process around it, or processes would load code that does not fit.
FORMAT = 4

_lock = threading.RLock()


def once(function: Callable) -> Callable:
    """`functools.cache` for threads: of two that begin together, as for two devices, one computes
    and the other waits."""
    cached = functools.cache(function)

    @functools.wraps(function)
    def locked(*args: Any) -> Any:
        with _lock:
            return cached(*args)

    return locked


@once
def start_llvm() -> Any:
    """The module `llvmlite.binding`, with LLVM started.

    **Raises** `ImportError` where llvmlite is not installed.
    """
    # Imported at the first use: it takes 0.09 s, and programs that generate no code need none.
    try:
        import llvmlite.binding as llvm
    except ImportError as error:
        raise ImportError(f"{error}. Run pip install --force-reinstall llvmlite") from error
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm


@once
def host() -> tuple[str, str]:
    """(name, features) of the processor, as LLVM calls them."""
    llvm = start_llvm()
    features = llvm.get_host_cpu_features().flatten()
    if "+avx512f" in features.split(","):
        # LLVM prefers half of a register on some processors with AVX-512; our vectors fill it.
        features += ",-prefer-256-bit"
    return llvm.get_host_cpu_name(), features


@once
def width() -> int:
    """How many float64 a vector register has."""
    features = set(host()[1].split(","))
    if {"+avx512f", "+avx512dq", "+avx512vl"} <= features:
        return 8
    return 4 if "+avx2" in features else 2


@once
def target_machine(triple: str | None = None, cpu: str | None = None, features: str | None = None):
    """LLVM's view of a machine, by default of this one."""
    llvm = start_llvm()
    if triple is None:
        target, (cpu, features) = llvm.Target.from_default_triple(), host()
    else:
        target = llvm.Target.from_triple(triple)
    # The large code model: the loader may put code and data further apart than 32 bits can say.
    return target.create_target_machine(
        cpu=cpu or "", features=features or "", opt=2, reloc="static", codemodel="large"
    )


_LONG = 2_000_000
"""Characters of a text from which only the passes are run whose time is proportional to it."""


def optimise(ir: str, machine: Any, level: int = 2, unroll: bool = False) -> Any:
    """A module after the passes that pay for code which is written number by number."""
    llvm = start_llvm()
    module = llvm.parse_assembly(ir)
    module.verify()
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    # No vectoriser, for the code consists of vectors, and no unrolling, for it fills the cache.
    options = llvm.create_pipeline_tuning_options(speed_level=level)
    options.slp_vectorization = options.loop_vectorization = False
    options.loop_unrolling = unroll
    builder = llvm.create_pass_builder(machine, options)
    if len(ir) < _LONG:
        passes = builder.getModulePassManager()
    else:
        # Moving numbers out of loops takes minutes for thousands of weights, and they would have to
        # wait in memory again.
        passes = llvm.create_new_module_pass_manager()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
        passes.add_new_gvn_pass()
        passes.add_aggressive_dce_pass()
    passes.run(module, builder)
    return module


def object_code(ir: str, machine: Any = None) -> bytes:
    """The object file of a module, by default for the processor of this process."""
    machine = target_machine() if machine is None else machine
    return machine.emit_object(optimise(ir, machine))


def assembly(ir: str) -> str:
    """The machine code of a module in the assembler's language."""
    return target_machine().emit_assembly(optimise(ir, target_machine()))


def load(ir: str, symbols: dict[str, int] | None = None) -> Any:
    """The engine, with a module's machine code in it; from the cache on disk, if it is there.

    One engine holds the code of all modules, which must define different names; JAX may call it as
    long as the process lives.
    """
    import llvmlite

    llvm = start_llvm()
    for name, address in (symbols or {}).items():
        llvm.add_symbol(name, address)
    cpu, features = host()
    # All that the code depends on: an object file of another processor or release does not fit.
    key = cache.key(FORMAT, llvmlite.__version__, llvm.llvm_version_info, cpu, features, ir)
    code = cache.read(key)
    if code is None:
        code = object_code(ir)
        cache.write(key, code)
    engine = _engine()
    # An empty module with the key as its name makes the engine read the code from its object cache.
    empty = llvm.parse_assembly("")
    empty.name = key
    with _lock:
        _codes[key] = code
        try:
            engine.add_module(empty)
            engine.finalize_object()
        finally:
            del _codes[key]
    return engine


_codes: dict[str, bytes] = {}  # of modules that are being added to the engine, by their names


@once
def _engine() -> Any:
    llvm, (cpu, features) = start_llvm(), host()
    first = llvm.parse_assembly("define internal void @nothing() { ret void }")
    # A machine of its own: an engine takes possession of the one that it gets.
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=cpu, features=features, opt=2, reloc="pic", codemodel="jitdefault", jit=True
    )
    engine = llvm.create_mcjit_compiler(first, machine)
    engine.set_object_cache(None, lambda module: _codes.get(module.name))
    return engine
