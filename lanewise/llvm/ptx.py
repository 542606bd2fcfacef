"""LLVM IR to PTX, the assembler's language of NVIDIA GPUs, which the driver compiles further."""

import dataclasses
import importlib.util
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from ..native import cache, machine

ARCHITECTURES = {80: 70, 86: 71, 89: 78, 90: 78, 100: 86, 120: 87}
"""Ten times the compute capability → ten times the first version of PTX that has it.

LLVM ends the process at a name that it does not know: only these are passed to it. A newer GPU
runs code for an older one."""

THREADS = 128
"""Threads of a block at most; a launch may have fewer."""

_FORMAT = 1
"""Part of the name in the cache: increase it with each change of this file that changes the text.
"""


@dataclasses.dataclass(frozen=True)
class PtxKernel:
    """A kernel of one thread for each trajectory, as the driver takes it.

    Its parameters, of 8 bytes each: pointers to the operands, pointers to the results, the number
    of trajectories, `values`. Thread `i` of the grid computes trajectory `i`; those beyond the
    last one do nothing. Any number of threads up to `threads` may form a block.

    - `text`: PTX; the name of its entry is `name`.
    - `operands`, `results`: how many pointers there are of each.
    - `values`: whole numbers that are inputs of the code.
    - `local_bytes`: memory of a thread for arrays, without registers that the driver moves there.
    - `operations`: see `Part`.
    """

    text: str
    name: str
    operands: int
    results: int
    values: tuple[int, ...]
    threads: int
    local_bytes: int
    operations: int
    architecture: int


def threads_for(registers: int) -> int:
    """Threads of a block for a kernel that uses so many registers, which the driver reports."""
    # Two blocks of 128 threads leave no third one: smaller blocks fill the rest.
    return THREADS // 2 if registers > 168 else THREADS


def architecture_for(capability: int) -> int | None:
    """The highest architecture for which code is made that a GPU runs; None if it is too old."""
    return max((number for number in ARCHITECTURES if number <= capability), default=None)


@machine.once
def _target_machine(architecture: int) -> Any:
    llvm = machine.start_llvm()
    # The target of GPUs is part of the wheel of llvmlite: CUDA need not be installed.
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    version = ARCHITECTURES[architecture]  # an unknown one ends here, and not in LLVM
    target = llvm.Target.from_triple("nvptx64-nvidia-cuda")
    return target.create_target_machine(
        cpu=f"sm_{architecture}", features=f"+ptx{version}", opt=3, reloc="default"
    )


def ptx_text(ir: str, architecture: int) -> str:
    """A module with one kernel as PTX; from the cache on disk, if it is there."""
    import llvmlite

    llvm = machine.start_llvm()
    versions = llvmlite.__version__, llvm.llvm_version_info, ARCHITECTURES[architecture]
    key = cache.key("ptx", _FORMAT, *versions, architecture, THREADS, ir)
    content = cache.read(key)
    if content is not None:
        return content.decode()
    # Short loops are unrolled: an array whose indices are known is in registers.
    target = _target_machine(architecture)
    module = machine.optimise(ir, target, level=3, unroll=True)
    text = _with_bounds(target.emit_assembly(module))
    cache.write(key, text.encode())  # the driver stores what it makes of it itself
    return text


def _with_bounds(text: str) -> str:
    """The text with the bounds of a launch. With one block on a multiprocessor, at least, the
    driver may use all registers of a thread."""
    # LLVM before 21 writes only some of them: they are removed, and written here.
    # The text and not an attribute of the IR, so that all releases give the same.
    text = re.sub(r"^\s*\.(?:maxntid|minnctapersm|reqntid)\b.*\n", "", text, flags=re.M)
    bounds = f".maxntid {THREADS}, 1, 1\n.minnctapersm 1\n"
    return re.sub(r"(\.entry \w+\([^)]*\)\s*)", lambda m: m[1].rstrip() + "\n" + bounds, text)


def local_bytes(text: str) -> int:
    """Bytes of memory that the functions of a module reserve for a thread."""
    return sum(map(int, re.findall(r"\.local\b.*\b__local_depot\w*\[(\d+)\]", text)))


def occupancy(registers: int, architecture: int) -> float:
    """The fraction of the warps of a multiprocessor that can run at once."""
    # Cards for servers have more than those for desktops.
    limit = 64 if architecture in (80, 90, 100) else 48
    # A thread takes registers by eights, of 65 536; a block starts as a whole.
    warps = 65_536 // (32 * (-(-registers // 8) * 8))
    warps_of_block = threads_for(registers) // 32
    return min(warps // warps_of_block * warps_of_block, limit) / limit


def ptxas() -> str | None:
    """The assembler of CUDA, from the path or from its package, None if it is not installed."""
    # JAX for CUDA installs it as a package of Python, outside of the path.
    packages = importlib.util.find_spec("nvidia")
    places = packages.submodule_search_locations if packages else None
    folders = [path for place in places or () for path in Path(place).glob("*/bin")]
    return shutil.which("ptxas") or next(
        (name for folder in folders if (name := shutil.which("ptxas", path=str(folder)))), None
    )


def report_of_ptxas(text: str, architecture: int) -> str | None:
    """What CUDA's assembler says about a kernel: registers, stack and spills; None without it."""
    program = ptxas()
    if program is None:
        return None
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "kernel.ptx"
        source.write_text(text)
        # The options of the driver, which compiles the text when it is loaded.
        options = f"-arch=sm_{architecture}", "-v", "-O3", "-o", str(source.with_suffix(".cubin"))
        command = [program, *options, str(source)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stderr


def registers_of(text: str, architecture: int) -> int | None:
    """Registers of a thread, None where CUDA's assembler is not installed."""
    match = re.search(r"Used (\d+) registers", report_of_ptxas(text, architecture) or "")
    return int(match[1]) if match else None
