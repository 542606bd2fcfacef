"""Launches without a GPU: XLA's call frame made by hand, and a substitute for the driver."""

import ctypes
import functools
import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import ptx_on_cpu
import pytest
from test_lanewise_threads import assert_same_bits, by_numbers, lowered, on_gpus as on_gpus

import lanewise
from lanewise.llvm.ir import NotCompilable
from lanewise.native import cuda, handler
from lanewise.native.structures import STRUCTURES, offset, size
from lanewise.targets import threads
from lanewise.targets.threads import ptx_of

STREAM, KERNEL, CONTEXT, ERROR = 0x51, 0xCE, 0xC0, 0xBAD
P, INT = ctypes.c_void_p, ctypes.c_int
Handler = ctypes.CFUNCTYPE(P, P)
Launch = ctypes.CFUNCTYPE(INT, P, *[ctypes.c_uint] * 7, P, ctypes.POINTER(P), P)
NAMES = {
    1: b"CUDA_ERROR_INVALID_VALUE", 2: b"CUDA_ERROR_OUT_OF_MEMORY", 218: b"CUDA_ERROR_INVALID_PTX",
    209: b"CUDA_ERROR_NO_BINARY_FOR_GPU", 700: b"CUDA_ERROR_ILLEGAL_ADDRESS",
    701: b"CUDA_ERROR_LAUNCH_OUT_OF_RESOURCES",
}  # fmt: skip


class Library:
    """A substitute for libcuda.so.1, which runs PTX on the CPU."""

    def __init__(self, text="", version=13_000, registers=68, local=0, fails=()):
        self.text, self.version, self.fails = text, version, dict(fails)
        self.attributes, self.contexts, self.retained = {3: local, 4: registers}, [], []
        self.calls, self.launches, self.loaded_on = [], [], []
        kinds = {
            "cuInit": [ctypes.c_uint], "cuDriverGetVersion": [P], "cuGetErrorName": [INT, P],
            "cuDeviceGet": [P, INT], "cuDevicePrimaryCtxRetain": [P, INT],
            "cuCtxPushCurrent_v2": [P], "cuKernelGetFunction": [P, P], "cuCtxPopCurrent_v2": [P],
            "cuDevicePrimaryCtxRelease_v2": [INT],
            "cuLibraryLoadData": [P, ctypes.c_char_p, P, P, ctypes.c_uint, P, P, ctypes.c_uint],
            "cuLibraryGetKernel": [P, P, ctypes.c_char_p], "cuKernelGetAttribute": [P, INT, P, INT],
        }  # fmt: skip
        for name, types in kinds.items():
            call = functools.partial(self.answer, name)
            setattr(self, name, ctypes.CFUNCTYPE(INT, *types)(call))
        self.cuLaunchKernel = Launch(self.launch)

    def answer(self, name, *args):
        self.calls.append(name)
        if name == "cuGetErrorName":
            if args[0] not in NAMES:
                return 1
            P.from_address(args[1]).value = ctypes.cast(NAMES[args[0]], P).value
        elif code := self.fails.get(name, 0):
            if name == "cuLibraryLoadData":
                log = (P * 2).from_address(args[3])
                ctypes.memmove(log[0], b"line 7: no such thing\0", 22)
            return code
        elif name == "cuLibraryLoadData":
            assert ".entry lanewise_kernel" in args[1].decode()
            assert list((INT * 2).from_address(args[2])) == [5, 6]
            P.from_address(args[0]).value = 0x11B
        elif name == "cuLibraryGetKernel":
            assert (args[1], args[2]) == (0x11B, b"lanewise_kernel")
            P.from_address(args[0]).value = KERNEL
        elif name == "cuDriverGetVersion":
            INT.from_address(args[0]).value = self.version
        elif name == "cuDeviceGet":
            INT.from_address(args[0]).value = 10 + args[1]  # a handle is no ordinal
        elif name == "cuDevicePrimaryCtxRetain":
            self.retained.append(args[1])
            P.from_address(args[0]).value = 1000 + args[1]
        elif name == "cuDevicePrimaryCtxRelease_v2":
            self.retained.remove(args[0])
        elif name == "cuCtxPushCurrent_v2":
            self.contexts.append(args[0])
        elif name == "cuCtxPopCurrent_v2":
            P.from_address(args[0]).value = self.contexts.pop()
        elif name == "cuKernelGetFunction":
            assert args[1] == KERNEL
            self.loaded_on.append(self.contexts[-1])
        elif name == "cuKernelGetAttribute":
            assert args[2] == KERNEL
            INT.from_address(args[0]).value = self.attributes[args[1]] + args[3] - 10
        return 0

    def launch(self, kernel, *rest):
        *grid, shared, stream, passed, extra = rest
        self.launches.append((kernel, *grid, shared, stream, extra))
        if code := self.fails.get("cuLaunchKernel", 0):
            return code
        run, _ = ptx_on_cpu.launch_of(self.text)
        count = self.text.split(".entry", 1)[1].split(")", 1)[0].count(".param")
        numbers = [ctypes.c_int64.from_address(passed[i]).value for i in range(count)]
        parameters = np.asarray(numbers, np.int64)
        run(parameters.ctypes.data, grid[0], grid[3])
        return 0


def words(structure, keep, **fields):
    """The address of one of XLA's structures with these fields; the others are zero."""
    block = (ctypes.c_int64 * (size(structure) // 8))()
    for field, value in fields.items():
        block[offset(structure, field.replace("__", ".")) // 8] = value
    keep.append(block)
    return ctypes.addressof(block)


class Frame:
    """XLA_FFI_CallFrame, and what it points to."""

    def __init__(self, operands, results, params, has_stream=True):
        self.errors, self.keep = [], []
        self.arrays = [np.ascontiguousarray(x) for x in operands], results

        def stream(query):
            block = (ctypes.c_int64 * 4).from_address(query)
            assert (block[0], block[2]) == (size("Stream_Get_Args"), CONTEXT)
            block[3] = STREAM
            return None if has_stream else ERROR

        def error(report):
            block = (ctypes.c_int64 * 4).from_address(report)
            self.errors.append((ctypes.string_at(block[2]).decode(), block[3]))
            return ERROR

        self.functions = [Handler(stream), Handler(error)]
        at_stream, at_error = (ctypes.cast(f, P).value or 0 for f in self.functions)
        api = words("Api", self.keep, XLA_FFI_Stream_Get=at_stream, XLA_FFI_Error_Create=at_error)
        tables = []
        for arrays in self.arrays:
            buffers = [words("Buffer", self.keep, data=x.ctypes.data) for x in arrays]
            self.keep.append((ctypes.c_int64 * max(len(buffers), 1))(*buffers))
            tables.append(ctypes.addressof(self.keep[-1]))
        self.params = params
        attr = words("Array", self.keep, size=len(params), data=params.ctypes.data)
        self.keep.append((ctypes.c_int64 * 1)(attr))
        self.address = words(
            "CallFrame", self.keep, api=api, ctx=CONTEXT, args__size=len(operands),
            args__args=tables[0], rets__size=len(results), rets__rets=tables[1],
            attrs__size=1, attrs__attrs=ctypes.addressof(self.keep[-1]),
        )  # fmt: skip


def function_of_one(x, v, k):
    """With several operands and results, a loop of a length of its own, and a shared number."""

    def step(state, _):
        y, s = state
        y = y + 0.1 * jnp.sin(s + k)
        return (y, s - 0.1 * jnp.remainder(y, 0.7)), y

    (y, s), rows = jax.lax.scan(step, (x, x * x), None, length=11)
    return y, rows[::5] + v, s > 0


SHAPES = [jax.ShapeDtypeStruct((), "float64"), jax.ShapeDtypeStruct((3,), "float64")]
FUNCTION = jax.make_jaxpr(function_of_one)(*SHAPES, SHAPES[0])
FLAGS = (True, True, False)
LANES = 150  # no multiple of the threads of a block


@pytest.fixture
def installed(monkeypatch):
    """Replaces the driver; None: it does not exist."""
    real = ctypes.CDLL

    def install(library):
        def load(name, *args, **options):
            if name != "libcuda.so.1":
                return real(name, *args, **options)  # LLVM, if it is not started yet
            if library is None:
                raise OSError(f"{name}: cannot open shared object file")
            return library

        monkeypatch.setattr(cuda.ctypes, "CDLL", load)
        monkeypatch.setattr(cuda, "driver", functools.cache(cuda.driver.__wrapped__))
        monkeypatch.setattr(cuda, "_names", set())
        return library

    return install


def prepared(library, name, threads=64, has_stream=True):
    """(the handler as a function, a frame of it, operands)."""
    kernel = ptx_of(FUNCTION, FLAGS, 90)
    library.text = kernel.text
    cuda.Driver(library)
    rng = np.random.default_rng(2)
    operands = [rng.normal(size=LANES), rng.normal(size=(LANES, 3)), rng.normal()]
    results = [np.full((LANES, *a.shape), 77).astype(a.dtype) for a in FUNCTION.out_avals]
    params = np.asarray([LANES, 1, *[8] * len(results), *kernel.values], np.int64)
    run = Handler(cuda.handler_address(name, KERNEL, threads))
    return run, Frame(operands, results, params, has_stream), operands


def test_a_handler_reports_its_version_and_that_it_may_be_recorded():
    run, _, _ = prepared(Library(), "of_metadata")
    keep = []
    meta = words("Metadata", keep)
    extension = words("Metadata_Extension", keep, metadata=meta, extension_base__type=1)
    frame = words("CallFrame", keep, extension_start=extension)
    assert run(frame) is None
    version = [ctypes.c_int32.from_address(meta + offset("Metadata", name)).value for name in
               ("api_version.major_version", "api_version.minor_version", "traits")]  # fmt: skip
    assert version == [handler.API_MAJOR, handler.API_MINOR, 1]


@pytest.mark.parametrize("threads", [64, 128])
def test_a_call_has_the_bits_of_the_cpu(threads):
    library = Library()
    run, frame, operands = prepared(library, f"of_call_{threads}", threads)
    assert len(frame.params) > 5  # a length that is an input of the code
    assert run(frame.address) is None
    blocks = -(-LANES // threads)
    assert library.launches == [(KERNEL, blocks, 1, 1, threads, 1, 1, 0, STREAM, None)]
    assert_same_bits(frame.arrays[1], by_numbers(FUNCTION, FLAGS, operands, LANES))


@pytest.mark.parametrize(
    ("code", "name", "kind"),
    [
        (2, "CUDA_ERROR_OUT_OF_MEMORY", 8),
        (701, "CUDA_ERROR_LAUNCH_OUT_OF_RESOURCES", 8),
        (700, "CUDA_ERROR_ILLEGAL_ADDRESS", 13),
        (12345, "no name", 13),
    ],
)
def test_an_error_of_the_launch_is_an_error_of_xla(code, name, kind):
    library = Library(fails={"cuLaunchKernel": code})
    run, frame, _ = prepared(library, f"of_error_{code}")
    assert run(frame.address) == ERROR
    text = f"lanewise: the launch of a GPU kernel failed: {name} (CUDA error {code})"
    assert frame.errors == [(text, kind)]
    library.fails = {}
    assert run(frame.address) is None  # the next call works


def test_other_extensions_of_a_call_are_no_query():
    """Control: taken for one, they would end the call without a launch and without an error."""
    library = Library()
    run, frame, _ = prepared(library, "of_extension")
    keep = []
    extension = words("Metadata_Extension", keep, extension_base__type=7)
    ctypes.c_int64.from_address(
        frame.address + offset("CallFrame", "extension_start")
    ).value = extension
    assert run(frame.address) is None
    assert len(library.launches) == 1


def test_an_error_of_the_stream_is_that_of_xla():
    library = Library()
    run, frame, _ = prepared(library, "of_stream", has_stream=False)
    assert run(frame.address) == ERROR
    assert not library.launches
    assert not frame.errors


def test_xla_takes_a_handler_and_its_errors():
    """XLA itself calls one, on the CPU, where it has no stream."""
    library = Library()
    cuda.Driver(library)
    address = cuda.handler_address("of_xla", KERNEL, 64)
    jax.ffi.register_ffi_target("of_xla", handler.capsule(address), platform="cpu")
    call = jax.ffi.ffi_call("of_xla", jax.ShapeDtypeStruct((8,), float))
    with pytest.raises(jax.errors.JaxRuntimeError, match="GPU context is not available"):
        jax.block_until_ready(jax.jit(lambda x: call(x, params=np.array([8, 1, 8])))(np.ones(8)))
    assert not library.launches


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"version": 11_080}, "a driver for CUDA 12 is required, this one is for 11080"),
        ({"fails": {"cuInit": 100}}, r"cuInit: unknown error \(CUDA error 100\)"),
        (
            {"fails": {"cuLibraryLoadData": 218}},
            r"cuLibraryLoadData: CUDA_ERROR_INVALID_PTX \(CUDA error 218\) line 7: no such thing",
        ),
        ({"fails": {"cuKernelGetAttribute": 2}}, "cuKernelGetAttribute: CUDA_ERROR_OUT_OF_MEMORY"),
        ({"fails": {"cuKernelGetFunction": 209}}, "CUDA_ERROR_NO_BINARY_FOR_GPU"),
        ({"fails": {"cuDevicePrimaryCtxRetain": 2}}, "Retain: CUDA_ERROR_OUT_OF_MEMORY"),
        ({"local": 2**14 + 8}, "bytes of local memory of a GPU thread must be at most 16384"),
    ],
)
def test_a_kernel_that_cannot_run_is_left_to_xla(installed, settings, reason):
    library = installed(Library(**settings))
    with pytest.raises(NotCompilable, match=reason):
        cuda.register(ptx_of(FUNCTION, FLAGS, 90), [0])
    assert not library.contexts
    assert not library.retained


def test_without_a_driver_or_with_an_old_one_there_is_a_reason(installed):
    library = installed(Library())
    del library.cuLibraryLoadData
    with pytest.raises(NotCompilable, match="no function cuLibraryLoadData: it is too old"):
        cuda.register(ptx_of(FUNCTION, FLAGS, 90), [0])

    installed(None)
    with pytest.raises(NotCompilable, match=r"there is no CUDA driver: libcuda.so.1: cannot open"):
        cuda.register(ptx_of(FUNCTION, FLAGS, 90), [0])


@pytest.mark.parametrize(("registers", "threads"), [(67, 128), (166, 128), (167, 64), (253, 64)])
def test_a_kernel_is_loaded_once_for_all_devices(installed, monkeypatch, registers, threads):
    library, blocks = installed(Library(registers=registers)), []
    address_of = cuda.handler_address

    def recorded(name, handle, threads):
        blocks.append(threads)
        return address_of(f"{name}_{registers}", handle, threads)

    monkeypatch.setattr(cuda, "handler_address", recorded)
    monkeypatch.setattr(jax.ffi, "register_ffi_target", lambda *args, **options: None)
    kernel = ptx_of(FUNCTION, FLAGS, 90)
    assert cuda.register(kernel, [2, 0]) == cuda.register(kernel, [2, 0])
    assert blocks == [threads]
    assert library.calls.count("cuLibraryLoadData") == 1
    # In the context of each device that JAX uses, and of no other; of the driver's three here.
    assert library.loaded_on == [1012, 1010]
    assert not library.contexts
    assert not library.retained


def test_a_grid_that_is_too_large_is_refused():
    """Not computed in part: 2³² blocks would become none in 32 bits."""
    library = Library(fails={"cuLaunchKernel": 1})
    run, frame, _ = prepared(library, "of_large")
    frame.params[0] = 2**38
    assert run(frame.address) == ERROR
    assert library.launches[0][1] == 2**32 - 1
    assert "CUDA_ERROR_INVALID_VALUE" in frame.errors[0][0]


REFUSALS = {
    "no driver": None, "an old driver": {"version": 11_080},
    "no device": {"fails": {"cuInit": 100}},
    "PTX is refused": {"fails": {"cuLibraryLoadData": 218}},
    "no memory": {"fails": {"cuKernelGetFunction": 2}},
    "too much local memory": {"local": 2**20},
}  # fmt: skip


@pytest.mark.usefixtures("on_gpus")
@pytest.mark.parametrize("name", REFUSALS)
def test_a_program_that_the_driver_refuses_is_compiled_by_xla(installed, monkeypatch, name):
    """Also one of several pieces; the CPU's code is unaffected."""
    settings = REFUSALS[name]
    installed(None if settings is None else Library(**settings))
    gpu = SimpleNamespace(compute_capability="9.0", process_index=0, local_hardware_id=0)
    monkeypatch.setattr(threads, "gpus", lambda: [gpu])

    def of_pieces(x, v):
        return lanewise.call(lambda x, v: function_of_one(x, jnp.fft.fft(v).real, x), x, v)

    x, v = np.ones(LANES), np.ones((LANES, 3))
    for function in (of_pieces, lambda x, v: lanewise.call(function_of_one, x, v, x)):
        text = lowered(function, x, v)
        assert "custom_call @lanewise" not in text
        assert "stablehlo.while" in text
        assert np.isfinite(jax.jit(jax.vmap(function))(x, v)[0]).all()


IMPORT = """
import sys, dvi_jax, lanewise, jax, numpy as np
jax.jit(lanewise.batched(lambda x: x + 1))(np.ones(3))
print("lanewise.native.cuda" in sys.modules, "libcuda" in open("/proc/self/maps").read())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="requires /proc")
@pytest.mark.parametrize("switch", ["", "on"])
def test_a_machine_without_a_gpu_loads_no_cuda_library(switch):
    environment = {**os.environ, "LANEWISE_CUDA": switch, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", IMPORT]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "False"
    assert switch or done.stdout.split()[0] == "False"


def test_structures_have_the_fields_of_a_launch():
    assert {"Stream_Get_Args", "Metadata"} <= STRUCTURES.keys()
    assert offset("Metadata", "traits") == 32
