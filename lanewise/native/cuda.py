"""Calls from XLA into a kernel of an NVIDIA GPU: the driver, and handlers that launch on a stream.

A handler is LLVM IR for the CPU, as in `handler`. It queries XLA for the stream, makes the array of
pointers to the parameters of the kernel, and calls `cuLaunchKernel`, whose address is in a variable
of the runtime. A kernel is loaded when a program is lowered, never in a handler, and its handle
(`CUkernel` of CUDA 12) is valid on all devices: a call may be recorded in a CUDA graph.
"""

import ctypes
import threading
from collections.abc import Sequence
from typing import Any

import jax.ffi

from ..llvm.ir import check_size, check_that
from ..llvm.ptx import PtxKernel, threads_for
from . import cache, machine
from .handler import capsule, handler_text
from .structures import addresses, size

MOST_LOCAL_BYTES = 16 * 2**10
"""Memory of a thread for arrays and for what registers cannot hold. The driver reserves it for all
threads that the device runs at once, in addition to the memory that XLA has taken."""

_OLDEST_DRIVER = 12_000
_LOCAL_BYTES, _REGISTERS = 3, 4  # of CUfunction_attribute
_LOG, _LOG_BYTES = 5, 6  # of CUjit_option
_HEAD = 2  # parameters in front of the bytes of the results, as in `targets.numbers`
_LITTLE, _OTHER = 8, 13  # XLA_FFI_Error_Code_RESOURCE_EXHAUSTED, …_INTERNAL

_MESSAGE = "lanewise: the launch of a GPU kernel failed: %s (CUDA error %d)"

_RUNTIME = f"""
@lanewise_cuda_launch = global ptr null      ; cuLaunchKernel
@lanewise_cuda_name = global ptr null        ; cuGetErrorName
@failed = private constant [{len(_MESSAGE) + 1} x i8] c"{_MESSAGE}\\00"
@no_name = private constant [8 x i8] c"no name\\00"

declare i32 @snprintf(ptr, i64, ptr, ...)

define internal void @list_buffers(ptr %buffers, i64 %count, ptr %passed) {{
entry:
  br label %head
head:
  %i = phi i64 [0, %entry], [%i.next, %body]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %over
body:
  %buffers.i = getelementptr ptr, ptr %buffers, i64 %i
  %buffer = load ptr, ptr %buffers.i
  {addresses("buffer", "Buffer", "data")}
  %to = getelementptr ptr, ptr %passed, i64 %i
  store ptr %buffer.data, ptr %to              ; a parameter is passed by its address
  %i.next = add i64 %i, 1
  br label %head
over:
  ret void
}}

define ptr @lanewise_cuda_run(ptr %frame, ptr %kernel, i64 %threads) {{
entry:
  %query = alloca [{size("Stream_Get_Args")} x i8], align 8
  %report = alloca [{size("Error_Create_Args")} x i8], align 8
  %text = alloca [160 x i8]
  %name.at = alloca ptr
  {addresses("frame", "CallFrame", "api ctx args.size args.args rets.size rets.rets attrs.attrs")}
  %api = load ptr, ptr %frame.api
  %ctx = load ptr, ptr %frame.ctx
  %nargs = load i64, ptr %frame.args.size
  %args = load ptr, ptr %frame.args.args
  %nrets = load i64, ptr %frame.rets.size
  %rets = load ptr, ptr %frame.rets.rets
  %attrs = load ptr, ptr %frame.attrs.attrs
  %attr = load ptr, ptr %attrs                 ; the only attribute: the parameters
  {addresses("attr", "Array", "size data")}
  %params.size = load i64, ptr %attr.size
  %params = load ptr, ptr %attr.data
  %lanes = load i64, ptr %params

  {addresses("query", "Stream_Get_Args", "extension_start ctx stream")}
  store i64 {size("Stream_Get_Args")}, ptr %query
  store ptr null, ptr %query.extension_start
  store ptr %ctx, ptr %query.ctx
  store ptr null, ptr %query.stream
  {addresses("api", "Api", "XLA_FFI_Stream_Get XLA_FFI_Error_Create")}
  %get = load ptr, ptr %api.XLA_FFI_Stream_Get
  %error = call ptr %get(ptr %query)
  %is.error = icmp ne ptr %error, null
  br i1 %is.error, label %no.stream, label %ready
no.stream:
  ret ptr %error
ready:
  %stream = load ptr, ptr %query.stream
  %buffers = add i64 %nargs, %nrets
  %front = add i64 %nrets, {_HEAD}
  %values = sub i64 %params.size, %front
  %after = add i64 %buffers, 1
  %count = add i64 %after, %values
  %passed = alloca ptr, i64 %count
  call void @list_buffers(ptr %args, i64 %nargs, ptr %passed)
  %r.passed = getelementptr ptr, ptr %passed, i64 %nargs
  call void @list_buffers(ptr %rets, i64 %nrets, ptr %r.passed)
  %lanes.to = getelementptr ptr, ptr %passed, i64 %buffers
  store ptr %params, ptr %lanes.to
  br label %next.value
next.value:
  %k = phi i64 [0, %ready], [%k.next, %one.value]
  %more = icmp slt i64 %k, %values
  br i1 %more, label %one.value, label %go
one.value:
  %k.from = add i64 %front, %k
  %from = getelementptr i64, ptr %params, i64 %k.from
  %k.to = add i64 %after, %k
  %to = getelementptr ptr, ptr %passed, i64 %k.to
  store ptr %from, ptr %to
  %k.next = add i64 %k, 1
  br label %next.value
go:
  %lanes.up = add i64 %lanes, %threads
  %lanes.less = sub i64 %lanes.up, 1
  %blocks.64 = udiv i64 %lanes.less, %threads
  %are.many = icmp ugt i64 %blocks.64, 4294967295
  %blocks.most = select i1 %are.many, i64 4294967295, i64 %blocks.64  ; the driver refuses it
  %blocks = trunc i64 %blocks.most to i32
  %block = trunc i64 %threads to i32
  %launch = load ptr, ptr @lanewise_cuda_launch
  %code = call i32 %launch(ptr %kernel, i32 %blocks, i32 1, i32 1, i32 %block, i32 1, i32 1,
                           i32 0, ptr %stream, ptr %passed, ptr null)
  %is.fine = icmp eq i32 %code, 0
  br i1 %is.fine, label %done, label %failed
done:
  ret ptr null
failed:
  store ptr @no_name, ptr %name.at
  %name.of = load ptr, ptr @lanewise_cuda_name
  %ignored = call i32 %name.of(i32 %code, ptr %name.at)
  %name.0 = load ptr, ptr %name.at
  %is.null = icmp eq ptr %name.0, null         ; of a code that the driver does not know
  %name = select i1 %is.null, ptr @no_name, ptr %name.0
  %length = call i32 (ptr, i64, ptr, ...) @snprintf(ptr %text, i64 160, ptr @failed, ptr %name,
                                                    i32 %code)
  %no.memory = icmp eq i32 %code, 2
  %no.resources = icmp eq i32 %code, 701
  %is.exhausted = or i1 %no.memory, %no.resources
  %kind = select i1 %is.exhausted, i64 {_LITTLE}, i64 {_OTHER}
  {addresses("report", "Error_Create_Args", "extension_start message errc")}
  store i64 {size("Error_Create_Args")}, ptr %report
  store ptr null, ptr %report.extension_start
  store ptr %text, ptr %report.message
  store i64 %kind, ptr %report.errc
  %create = load ptr, ptr %api.XLA_FFI_Error_Create
  %report.made = call ptr %create(ptr %report)
  ret ptr %report.made
}}
"""

_COMMAND_BUFFER_COMPATIBLE = 1  # XLA_FFI_Handler_Traits

_HANDLER = """
@NAME_kernel = global ptr null
declare ptr @lanewise_cuda_run(ptr, ptr, i64)
""" + handler_text(
    "NAME",
    """%kernel = load ptr, ptr @NAME_kernel
  %r = tail call ptr @lanewise_cuda_run(ptr %frame, ptr %kernel, i64 THREADS)""",
    _COMMAND_BUFFER_COMPATIBLE,
)

# Several threads of Python may trace and compile at once; a name may be registered once only.
_lock = threading.RLock()
_names: set[str] = set()


@machine.once
def _runtime() -> Any:
    """The machine code that the handlers of all kernels share."""
    return machine.load(_RUNTIME)


def _variable(name: str) -> ctypes.c_void_p:
    return ctypes.c_void_p.from_address(_runtime().get_global_value_address(name))


class Driver:
    """NVIDIA's driver. Where a call fails, the program is left to XLA, with the error as reason."""

    def __init__(self, library: Any):
        self.library = library
        self.call("cuInit", 0)
        version = ctypes.c_int()
        self.call("cuDriverGetVersion", ctypes.byref(version))
        is_new = version.value >= _OLDEST_DRIVER
        check_that(is_new, f"a driver for CUDA 12 is required, this one is for {version.value}")
        # The handlers call these functions without Python.
        for variable, name in (("launch", "cuLaunchKernel"), ("name", "cuGetErrorName")):
            address = ctypes.cast(getattr(library, name), ctypes.c_void_p).value
            _variable(f"lanewise_cuda_{variable}").value = address

    def call(self, name: str, *args: Any, log: Any = None) -> None:
        """Call a function of the driver; `log` is a buffer with what it reports about an error."""
        function = getattr(self.library, name, None)
        check_that(function is not None, f"the driver has no function {name}: it is too old")
        assert function is not None
        code = function(*args)
        if code:
            text = ctypes.c_char_p()
            self.library.cuGetErrorName(code, ctypes.byref(text))
            reason = f"{name}: {(text.value or b'unknown error').decode()} (CUDA error {code})"
            details = log.value.decode(errors="replace").strip() if log is not None else ""
            check_that(False, f"{reason} {details}".strip())

    def load(self, text: str, name: str) -> int:
        """The handle of a kernel on every device, from its PTX."""
        library, kernel = ctypes.c_void_p(), ctypes.c_void_p()
        log = ctypes.create_string_buffer(4096)
        # A log, so that a reason names the line of PTX that the driver does not take.
        options = (ctypes.c_int * 2)(_LOG, _LOG_BYTES)
        values = (ctypes.c_void_p * 2)(ctypes.addressof(log), len(log))
        image = ctypes.c_char_p(text.encode())
        handle = ctypes.byref(library)
        # The driver compiles PTX here, or reads it from a cache of its own.
        self.call("cuLibraryLoadData", handle, image, options, values, 2, None, None, 0, log=log)
        self.call("cuLibraryGetKernel", ctypes.byref(kernel), library, name.encode())
        assert kernel.value is not None
        return kernel.value

    def largest(self, kernel: int, devices: Sequence[int]) -> tuple[int, int]:
        """The largest (registers, bytes of local memory) of a thread on these devices, on which the
        kernel is then loaded."""
        pairs = [self._prepare(ctypes.c_void_p(kernel), number) for number in devices]
        return max(registers for registers, _ in pairs), max(local for _, local in pairs)

    def _prepare(self, kernel: Any, number: int) -> tuple[int, int]:
        device, context, function = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_void_p()
        self.call("cuDeviceGet", ctypes.byref(device), number)
        # The context that XLA uses as well. The kernel is loaded there now: the driver would do so
        # at the first launch, which may fall into the record of a graph.
        self.call("cuDevicePrimaryCtxRetain", ctypes.byref(context), device)
        self.call("cuCtxPushCurrent_v2", context)
        try:
            self.call("cuKernelGetFunction", ctypes.byref(function), kernel)
        finally:
            self.call("cuCtxPopCurrent_v2", ctypes.byref(context))
            self.call("cuDevicePrimaryCtxRelease_v2", device)
        values = ctypes.c_int(), ctypes.c_int()
        for value, attribute in zip(values, (_REGISTERS, _LOCAL_BYTES), strict=True):
            self.call("cuKernelGetAttribute", ctypes.byref(value), attribute, kernel, device)
        return values[0].value, values[1].value


@machine.once
def driver() -> Driver:
    """The driver of this machine. **Raises** `NotCompilable` if it is missing or too old."""
    try:
        library = ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        check_that(False, f"there is no CUDA driver: {error}")
    return Driver(library)  # pyright: ignore[reportPossiblyUnboundVariable]


def name_of(kernel: PtxKernel) -> str:
    """The name by which XLA calls a kernel."""
    return f"lanewise_cuda_{cache.key(kernel.text)[:32]}"


def register(kernel: PtxKernel, devices: Sequence[int]) -> str:
    """The same, and the kernel is loaded on these devices and registered if it was not.

    **Raises** `NotCompilable` with the reason if the driver does not take it.
    """
    name = name_of(kernel)
    with _lock:
        if name not in _names:
            handle = driver().load(kernel.text, kernel.name)
            # Only the driver knows how many registers it uses, and what it moves to memory.
            registers, local = driver().largest(handle, devices)
            check_size(local, MOST_LOCAL_BYTES, "bytes of local memory of a GPU thread")
            threads = min(threads_for(registers), kernel.threads)
            address = handler_address(name, handle, threads)
            jax.ffi.register_ffi_target(name, capsule(address), platform="CUDA")
            _names.add(name)
    return name


def handler_address(name: str, handle: int, threads: int) -> int:
    """The address of a new handler, which launches the kernel in blocks of so many threads."""
    run = _runtime().get_function_address("lanewise_cuda_run")
    text = _HANDLER.replace("NAME", name).replace("THREADS", str(threads))
    engine = machine.load(text, {"lanewise_cuda_run": run})
    # In a variable, not in the text: the code is stored on disk, and another process has another
    # handle.
    variable = engine.get_global_value_address(f"{name}_kernel")
    ctypes.c_void_p.from_address(variable).value = handle
    return engine.get_function_address(name)
