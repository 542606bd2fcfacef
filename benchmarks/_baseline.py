"""The integrators of baseline.c, compiled for this machine and callable on NumPy arrays."""

import ctypes
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

SOURCE = Path(__file__).with_name("baseline.c")
FLAGS = ["-O3", "-ffast-math", "-fPIC"]
TUNED = [["-march=native"], ["-mcpu=native"], []]
"""Options that select this processor; the first one that the compiler accepts is used."""

VECTOR_MATH = [["-DHAVE_LIBMVEC", "-lmvec"], ["-UHAVE_LIBMVEC"]]
"""With glibc's vectorised sin and cos where they are; else one lane at a time."""

NEWTON_TOLERANCE = float(np.sqrt(np.finfo(np.float64).eps))
"""A correction of this relative size was the last one needed, convergence being quadratic."""


class NoCompilerError(RuntimeError):
    """There is no C compiler to be found, or none that can compile baseline.c."""


class Run(NamedTuple):
    """A kernel with its arrays: calling it integrates from the start into the outputs.

    `timed` is what is to be timed: the same, or into new memory where outputs are large.
    """

    call: Callable[[], None]
    outputs: dict[str, np.ndarray]
    timed: Callable[[], None]

    def __call__(self) -> dict[str, np.ndarray]:
        self.call()
        return self.outputs


class Baseline:
    """baseline.c as a shared library, built in a folder that is removed with the object.

    `source` may be another file that contains it.

    **Raises** `NoCompilerError` if neither $CC nor gcc, cc, clang on the PATH compiles it.
    """

    def __init__(self, source: Path = SOURCE):
        self._folder = tempfile.TemporaryDirectory(prefix="dvi_jax_baseline_")
        target = Path(self._folder.name) / "baseline.so"
        self.command = compile_source(source, target)
        self.library = ctypes.CDLL(str(target))
        self.width = int(self.library.vector_width())
        self.has_libmvec = bool(self.library.has_libmvec())
        self._block = int(self.library.block())

    def __str__(self) -> str:
        sines = "libmvec" if self.has_libmvec else "libm, lane by lane"
        return f"{' '.join(self.command)}; {self.width} doubles a vector; sin, cos from {sines}"

    def final(self, kernel: str, q0, p0, *, h: float, steps: int, epsilon: float) -> Run:
        """The explicit run to the state after the last step: outputs q, p."""
        return self._run(
            f"{kernel}_final",
            q0,
            p0,
            [_whole(steps), _real(h), _real(epsilon)],
            lambda n, lanes: {"q": (n, lanes), "p": (n, lanes)},
        )

    def streamed(self, kernel: str, q0, p0, *, h: float, steps: int, epsilon: float) -> Run:
        """As `final`, and of the energy its largest `drift` and its `slope` against time."""
        return self._run(
            f"{kernel}_streamed",
            q0,
            p0,
            [_whole(steps), _real(h), _real(epsilon)],
            lambda n, lanes: {
                "q": (n, lanes),
                "p": (n, lanes),
                "drift": (lanes,),
                "slope": (lanes,),
            },
        )

    def saved(
        self, kernel: str, q0, p0, *, h: float, steps: int, every: int, epsilon: float
    ) -> Run:
        """The start and every m-th state of the explicit run, shape (saves, n, lanes).

        Into new memory on each call: what a caller gets to keep.
        """
        if steps % every:
            raise ValueError(f"steps must be a multiple of every, got {steps} and {every}.")
        shape = steps // every + 1
        return self._run(
            f"{kernel}_saved",
            q0,
            p0,
            [_whole(steps), _whole(every), _real(h), _real(epsilon)],
            lambda n, lanes: {"q": (shape, n, lanes), "p": (shape, n, lanes)},
            anew=True,
        )

    def implicit(
        self,
        kernel: str,
        q0,
        p0,
        *,
        h: float,
        steps: int,
        epsilon: float,
        iterations: int,
        monitor: bool = False,
    ) -> Run:
        """The implicit run to its last state; with `monitor`, the largest last `correction` too."""
        if iterations < 1:
            raise ValueError(f"iterations must be at least 1, got {iterations}.")
        numbers = [_whole(steps), ctypes.c_int(iterations), _real(h), _real(epsilon)]
        return self._run(
            kernel,
            q0,
            p0,
            numbers,
            lambda n, lanes: {
                "q": (n, lanes),
                "p": (n, lanes),
                "correction": (lanes,) if monitor else None,
            },
        )

    def iterations_needed(
        self, kernel: str, q0, p0, *, h: float, steps: int, epsilon: float
    ) -> tuple[int, float]:
        """The least number of iterations whose last correction is below √ε, and that correction.

        Relative to the largest momentum of the start; the error that is left is its square.
        """
        scale, correction = float(np.max(np.abs(p0))), np.inf
        for iterations in range(1, 9):
            run = self.implicit(
                kernel,
                q0,
                p0,
                h=h,
                steps=steps,
                epsilon=epsilon,
                iterations=iterations,
                monitor=True,
            )
            correction = float(np.max(run()["correction"])) / scale
            if correction <= NEWTON_TOLERANCE:
                return iterations, correction
        raise RuntimeError(
            f"{kernel}: Newton's method does not converge in 8 iterations at h = {h:g}: "
            f"the last correction is {correction:.1e}."
        )

    def _run(self, name: str, q0, p0, numbers: list[Any], shapes, anew: bool = False) -> Run:
        """`name` on states (n, lanes), or `name`_one on states (n,); its outputs made `anew`?"""
        q0, p0 = np.asarray(q0, float), np.asarray(p0, float)
        if q0.shape != p0.shape or q0.ndim not in (1, 2):
            raise ValueError(f"q0, p0 must be (n, lanes) or (n,), got {q0.shape} and {p0.shape}.")
        one = q0.ndim == 1
        n, lanes = (q0.shape[0], 1) if one else q0.shape
        padded = lanes if one else -(-lanes // self._block) * self._block
        start = [_aligned(x.reshape(n, lanes), padded) for x in (q0, p0)]
        outputs = {
            key: None if shape is None else _empty(shape)
            for key, shape in shapes(n, padded).items()
        }
        function = getattr(self.library, f"{name}_one" if one else name)
        function.restype = None
        given = [_whole(padded), *numbers, *map(_address, start)]
        addresses = [_address(x) for x in outputs.values()]

        def call(kept=(start, outputs)):  # the library has only their addresses
            function(*given, *addresses)

        def call_anew(kept=(start, outputs)):
            fresh = [None if x is None else np.empty_like(x) for x in outputs.values()]
            function(*given, *map(_address, fresh))

        shown = {key: x[..., :lanes] for key, x in outputs.items() if x is not None}
        if one:
            shown = {key: x[..., 0] for key, x in shown.items()}
        return Run(call, shown, call_anew if anew else call)


def _address(x: np.ndarray | None):
    return ctypes.c_void_p(None if x is None else x.ctypes.data)


def _whole(x: int):
    return ctypes.c_long(x)


def _real(x: float):
    return ctypes.c_double(x)


def _empty(shape: tuple[int, ...]) -> np.ndarray:
    """Zeros, so that their pages are there, from an address that is a multiple of 64."""
    size = int(np.prod(shape))
    raw = np.zeros(size + 8)
    start = (-raw.ctypes.data % 64) // 8
    return raw[start : start + size].reshape(shape)


def _aligned(x: np.ndarray, lanes: int) -> np.ndarray:
    """x with its last lane repeated up to `lanes` of them."""
    out = _empty((x.shape[0], lanes))
    out[:, : x.shape[1]] = x
    out[:, x.shape[1] :] = x[:, -1:]
    return out


def find_compiler() -> list[str]:
    """$CC, or the first of gcc, cc, clang on the PATH, as the words of a command."""
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])
    for name in ("gcc", "cc", "clang"):
        if found := shutil.which(name):
            return [found]
    raise NoCompilerError(
        "the baseline is compiled from source, and there is no C compiler: looked for $CC and for "
        "gcc, cc, clang on the PATH. Install one (apt install gcc), or set CC."
    )


def compile_source(source: Path, target: Path) -> list[str]:
    """Compiled and linked by two commands: linked with -ffast-math, a library of gcc before 13
    switches the whole process to rounding subnormal numbers to zero as it is loaded."""
    compiler, errors = find_compiler(), []
    compiled = str(target.with_suffix(".o"))
    for tuned in TUNED:
        for define, *libraries in VECTOR_MATH:
            command = [*compiler, *FLAGS, *tuned]
            errors.append(_run([*command, define, "-c", str(source), "-o", compiled]))
            if not errors[-1]:
                errors[-1] = _run(
                    [*compiler, "-shared", compiled, "-o", str(target), *libraries, "-lm"]
                )
            if not errors[-1]:
                return command
    raise NoCompilerError(f"{compiler[0]} does not compile {source.name}:\n{errors[0]}")


def _run(command: list[str]) -> str:
    """The error message with the command; empty if it succeeded."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise NoCompilerError(f"{command[0]} does not start: {error}.") from error
    return f"{shlex.join(command)}\n{done.stderr}" if done.returncode else ""
