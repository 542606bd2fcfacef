"""The calls from XLA into machine code: a typed handler, and the threads that share a batch.

A handler gets XLA's call frame, a C structure; `structures` has the positions of its fields. Blocks
of trajectories are claimed one chunk after the other from a counter, by the caller and by the
threads of XLA's own pool; the caller waits only for chunks that another thread has begun. A task
that starts later finds nothing to do: all that it reads is in a record, the `Job`, that the last
user frees.
"""

import ctypes
import hashlib
import sys
import threading
from typing import Any

import jax.ffi

from . import machine
from .structures import addresses, offset, size

API_MAJOR, API_MINOR = 0, 1
"""The version of XLA's interface that the structures are of; newer ones of 0 keep them."""

_METADATA = 1  # XLA_FFI_Extension_Metadata


def handler_text(name: str, call: str, traits: int = 0) -> str:
    """The text of a handler: `call` are the instructions that compute `%r` from `%frame`; `traits`
    are those of XLA."""
    return f"""
define ptr @{name}(ptr %frame) {{
  %ext.at = getelementptr i8, ptr %frame, i64 {offset("CallFrame", "extension_start")}
  %ext = load ptr, ptr %ext.at
  %is.call = icmp eq ptr %ext, null
  br i1 %is.call, label %call, label %extended
extended:
  %type.at = getelementptr i8, ptr %ext, i64 {offset("Metadata_Extension", "extension_base.type")}
  %type = load i32, ptr %type.at
  %is.query = icmp eq i32 %type, {_METADATA}
  br i1 %is.query, label %version, label %call ; a call may have other extensions
version:                                     ; XLA queries the version of the interface
  %meta.at = getelementptr i8, ptr %ext, i64 {offset("Metadata_Extension", "metadata")}
  %meta = load ptr, ptr %meta.at
  %major = getelementptr i8, ptr %meta, i64 {offset("Metadata", "api_version.major_version")}
  store i32 {API_MAJOR}, ptr %major
  %minor = getelementptr i8, ptr %meta, i64 {offset("Metadata", "api_version.minor_version")}
  store i32 {API_MINOR}, ptr %minor
  %traits = getelementptr i8, ptr %meta, i64 {offset("Metadata", "traits")}
  store i32 {traits}, ptr %traits
  ret ptr null
call:
  {call}
  ret ptr %r
}}
"""


HANDLER = "declare ptr @lanewise_run(ptr, ptr, i64, i64)\n" + handler_text(
    "lanewise_handler",
    "%r = tail call ptr @lanewise_run(ptr %frame, ptr @lanewise_kernel, i64 BLOCK, i64 SCRATCH)",
)
"""`lanewise_kernel(args, rets, params, scratch, first, last)` computes the blocks first … last − 1;
`scratch` are SCRATCH bytes, from a multiple of 64 on."""

KERNEL = (
    "define internal void @lanewise_kernel(ptr %args, ptr %rets, ptr %params, ptr %scratch, "
    "i64 %first, i64 %last) alignstack(64) align 64 {\nentry:"
)

# Only Linux has `madvise`. Results below 32 MiB are memory that is mapped already: the C library
# reuses it, and the call would cost more time than it saves. Scratch is read in every step.
_LARGE_RESULT = 32 * 2**20 if sys.platform == "linux" else 2**63 - 1
_LARGE_SCRATCH = 4 * 2**20 if sys.platform == "linux" else 2**63 - 1

_NO_MEMORY = "not enough memory for the arrays of a compiled function"
_EXHAUSTED = 8  # XLA_FFI_Error_Code_RESOURCE_EXHAUSTED

_RUNTIME = f"""
@no_memory = private constant [{len(_NO_MEMORY) + 1} x i8] c"{_NO_MEMORY}\\00"
@lanewise_threads = global i64 0

declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
declare i32 @madvise(ptr, i64, i32)

; Large arrays in large pages: at 4 KiB each, the first touch of new memory costs as much as steps.
define internal void @large_pages(ptr %at, i64 %bytes, i64 %least) {{
  %is.large = icmp uge i64 %bytes, %least
  br i1 %is.large, label %yes, label %no
yes:
  %address = ptrtoint ptr %at to i64
  %up = add i64 %address, 2097151
  %start = and i64 %up, -2097152
  %end0 = add i64 %address, %bytes
  %end = and i64 %end0, -2097152
  %whole = sub i64 %end, %start
  %from = inttoptr i64 %start to ptr
  %ignored = call i32 @madvise(ptr %from, i64 %whole, i32 14)
  ret void
no:
  ret void
}}

define internal void @drop(ptr %job) {{
  %before = atomicrmw sub ptr %job, i64 1 acq_rel
  %last = icmp eq i64 %before, 1
  br i1 %last, label %yes, label %no
yes:
  call void @free(ptr %job)
  ret void
no:
  ret void
}}

define internal ptr @aligned(ptr %memory) {{
  %address = ptrtoint ptr %memory to i64
  %up = add i64 %address, 63
  %start = and i64 %up, -64
  %scratch = inttoptr i64 %start to ptr
  ret ptr %scratch
}}

define internal void @work(ptr %job, ptr %memory) {{
entry:
  %scratch = call ptr @aligned(ptr %memory)
  {addresses("job", "Job", "next done blocks claims chunk kernel params args rets")}
  %blocks = load i64, ptr %job.blocks
  %claims = load i64, ptr %job.claims
  %chunk = load i64, ptr %job.chunk
  %kernel = load ptr, ptr %job.kernel
  %params = load ptr, ptr %job.params
  %args = load ptr, ptr %job.args
  %rets = load ptr, ptr %job.rets
  br label %claim
claim:
  %first = atomicrmw add ptr %job.next, i64 %chunk acq_rel
  %is.over = icmp sge i64 %first, %claims
  br i1 %is.over, label %over, label %run
run:
  %end = add i64 %first, %chunk
  %fits = icmp slt i64 %end, %claims
  %last = select i1 %fits, i64 %end, i64 %blocks
  call void %kernel(ptr %args, ptr %rets, ptr %params, ptr %scratch, i64 %first, i64 %last)
  %mine = sub i64 %last, %first
  %ignored = atomicrmw add ptr %job.done, i64 %mine acq_rel
  br label %claim
over:
  ret void
}}

define internal void @task(ptr %job) {{
  {addresses("job", "Job", "scratch")}
  %bytes = load i64, ptr %job.scratch
  %memory = call ptr @malloc(i64 %bytes)
  call void @large_pages(ptr %memory, i64 %bytes, i64 {_LARGE_SCRATCH})
  %is.none = icmp eq ptr %memory, null
  br i1 %is.none, label %over, label %run      ; the caller has memory, and computes all
run:
  call void @work(ptr %job, ptr %memory)
  call void @free(ptr %memory)
  br label %over
over:
  call void @drop(ptr %job)
  ret void
}}

define internal void @pointers(ptr %from, i64 %count, ptr %to) {{
entry:
  br label %head
head:
  %i = phi i64 [0, %entry], [%i.next, %body]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %over
body:
  %from.i = getelementptr ptr, ptr %from, i64 %i
  %buffer = load ptr, ptr %from.i
  {addresses("buffer", "Buffer", "data")}
  %data = load ptr, ptr %buffer.data
  %to.i = getelementptr ptr, ptr %to, i64 %i
  store ptr %data, ptr %to.i
  %i.next = add i64 %i, 1
  br label %head
over:
  ret void
}}

define ptr @lanewise_run(ptr %frame, ptr %kernel, i64 %block, i64 %scratch.size) {{
entry:
  %count = alloca i64
  %report = alloca [{size("Error_Create_Args")} x i8], align 8
  %query = alloca [{size("ThreadPool_NumThreads_Args")} x i8], align 8
  {addresses("frame", "CallFrame", "api ctx args.size args.args rets.size rets.rets attrs.attrs")}
  %api = load ptr, ptr %frame.api
  %ctx = load ptr, ptr %frame.ctx
  %nargs = load i64, ptr %frame.args.size
  %args = load ptr, ptr %frame.args.args
  %nrets = load i64, ptr %frame.rets.size
  %rets = load ptr, ptr %frame.rets.rets
  %attrs = load ptr, ptr %frame.attrs.attrs
  %attr = load ptr, ptr %attrs                 ; the only attribute: the parameters
  {addresses("attr", "Array", "data")}
  %params = load ptr, ptr %attr.data
  %lanes = load i64, ptr %params
  %params.1 = getelementptr i64, ptr %params, i64 1
  %cost = load i64, ptr %params.1

  %pointers = add i64 %nargs, %nrets
  %bytes0 = mul i64 %pointers, 8
  %bytes = add i64 %bytes0, {size("Job")}
  %job = call ptr @malloc(i64 %bytes)
  ; Not from the stack: that of a thread of XLA's pool may be small.
  %memory.size = add i64 %scratch.size, 64
  %memory = call ptr @malloc(i64 %memory.size)
  call void @large_pages(ptr %memory, i64 %memory.size, i64 {_LARGE_SCRATCH})
  %no.job = icmp eq ptr %job, null
  %no.memory = icmp eq ptr %memory, null
  %none.of = or i1 %no.job, %no.memory
  br i1 %none.of, label %exhausted, label %start
exhausted:
  call void @free(ptr %job)
  call void @free(ptr %memory)
  {addresses("report", "Error_Create_Args", "extension_start message errc")}
  store i64 {size("Error_Create_Args")}, ptr %report
  store ptr null, ptr %report.extension_start
  store ptr @no_memory, ptr %report.message
  store i64 {_EXHAUSTED}, ptr %report.errc
  {addresses("api", "Api", "XLA_FFI_Error_Create")}
  %create = load ptr, ptr %api.XLA_FFI_Error_Create
  %report.made = call ptr %create(ptr %report)
  ret ptr %report.made
start:
  %a = getelementptr i8, ptr %job, i64 {size("Job")}
  %r = getelementptr ptr, ptr %a, i64 %nargs
  call void @pointers(ptr %args, i64 %nargs, ptr %a)
  call void @pointers(ptr %rets, i64 %nrets, ptr %r)
  %sizes = getelementptr i64, ptr %params, i64 2
  br label %next.result
next.result:
  %n = phi i64 [0, %start], [%n.next, %one.result]
  %n.more = icmp slt i64 %n, %nrets
  br i1 %n.more, label %one.result, label %ready.to.run
one.result:
  %r.n = getelementptr ptr, ptr %r, i64 %n
  %result = load ptr, ptr %r.n
  %sizes.n = getelementptr i64, ptr %sizes, i64 %n
  %size.each = load i64, ptr %sizes.n
  %size.all = mul i64 %size.each, %lanes
  call void @large_pages(ptr %result, i64 %size.all, i64 {_LARGE_RESULT})
  %n.next = add i64 %n, 1
  br label %next.result
ready.to.run:
  %over = sub i64 %block, 1
  %lanes.up = add i64 %lanes, %over
  %blocks = udiv i64 %lanes.up, %block
  ; A last block that is not full begins inside of the one before, and results are also the memory
  ; of values in between: one thread computes both, one after the other.
  %left = urem i64 %lanes, %block
  %is.full = icmp eq i64 %left, 0
  %all.but.one = sub i64 %blocks, 1
  %claims = select i1 %is.full, i64 %blocks, i64 %all.but.one

  %set = load atomic i64, ptr @lanewise_threads monotonic, align 8
  %work = mul i64 %blocks, %cost
  %is.long = icmp sgt i64 %work, 100000
  %is.many = icmp sgt i64 %claims, 1
  %may = and i1 %is.long, %is.many
  %one = icmp eq i64 %set, 1
  %not.one = xor i1 %one, true
  %go = and i1 %may, %not.one
  br i1 %go, label %ask.pool, label %alone
alone:
  %scratch = call ptr @aligned(ptr %memory)
  call void %kernel(ptr %a, ptr %r, ptr %params, ptr %scratch, i64 0, i64 %blocks)
  call void @free(ptr %memory)
  call void @free(ptr %job)
  ret ptr null

ask.pool:
  store i64 1, ptr %count
  {addresses("query", "ThreadPool_NumThreads_Args", "extension_start ctx num_threads")}
  store i64 {size("ThreadPool_NumThreads_Args")}, ptr %query
  store ptr null, ptr %query.extension_start
  store ptr %ctx, ptr %query.ctx
  store ptr %count, ptr %query.num_threads
  {addresses("api", "Api", "XLA_FFI_ThreadPool_NumThreads XLA_FFI_ThreadPool_Schedule")}
  %num_threads = load ptr, ptr %api.XLA_FFI_ThreadPool_NumThreads
  %error = call ptr %num_threads(ptr %query)
  %failed = icmp ne ptr %error, null
  %pool0 = load i64, ptr %count
  %pool1 = select i1 %failed, i64 1, i64 %pool0
  %is.set = icmp sgt i64 %set, 0
  %fewer = icmp slt i64 %set, %pool1
  %take = and i1 %is.set, %fewer
  %pool2 = select i1 %take, i64 %set, i64 %pool1
  %few = icmp slt i64 %claims, %pool2
  %pool3 = select i1 %few, i64 %claims, i64 %pool2
  %none = icmp slt i64 %pool3, 1
  %threads = select i1 %none, i64 1, i64 %pool3
  %parts = mul i64 %threads, 16
  %parts.up = add i64 %blocks, %parts
  %parts.less = sub i64 %parts.up, 1
  %chunk = udiv i64 %parts.less, %parts

  {addresses("job", "Job", "next done blocks claims chunk kernel params args rets scratch")}
  store i64 %threads, ptr %job                 ; users: each task is one, and the caller another
  store i64 0, ptr %job.next
  store i64 0, ptr %job.done
  store i64 %blocks, ptr %job.blocks
  store i64 %claims, ptr %job.claims
  store i64 %chunk, ptr %job.chunk
  store ptr %kernel, ptr %job.kernel
  store ptr %params, ptr %job.params
  store ptr %a, ptr %job.args
  store ptr %r, ptr %job.rets
  store i64 %memory.size, ptr %job.scratch
  %schedule = load ptr, ptr %api.XLA_FFI_ThreadPool_Schedule
  br label %next.task
next.task:
  %t = phi i64 [1, %ask.pool], [%t.next, %scheduled]
  %t.more = icmp slt i64 %t, %threads
  br i1 %t.more, label %one.task, label %own
one.task:
  %plan = alloca [{size("ThreadPool_Schedule_Args")} x i8], align 8
  {addresses("plan", "ThreadPool_Schedule_Args", "extension_start ctx task data")}
  store i64 {size("ThreadPool_Schedule_Args")}, ptr %plan
  store ptr null, ptr %plan.extension_start
  store ptr %ctx, ptr %plan.ctx
  store ptr @task, ptr %plan.task
  store ptr %job, ptr %plan.data
  %refused = call ptr %schedule(ptr %plan)
  %is.refused = icmp ne ptr %refused, null
  br i1 %is.refused, label %give.back, label %scheduled
give.back:
  call void @drop(ptr %job)
  br label %scheduled
scheduled:
  %t.next = add i64 %t, 1
  br label %next.task
own:
  call void @work(ptr %job, ptr %memory)
  br label %wait
wait:
  %spins = phi i64 [0, %own], [%spins.next, %again]
  %so.far = load atomic i64, ptr %job.done acquire, align 8
  %ready = icmp sge i64 %so.far, %blocks
  br i1 %ready, label %finish, label %not.yet
not.yet:
  %spins.next = add i64 %spins, 1
  %long = icmp sgt i64 %spins.next, 200
  br i1 %long, label %yield, label %again
yield:
  %ignored = call i32 @sched_yield()
  br label %again
again:
  br label %wait
finish:
  call void @free(ptr %memory)
  call void @drop(ptr %job)
  ret ptr null
}}
"""

# Several threads of Python may trace and compile at once; a name may be registered once only.
_lock = threading.RLock()
_targets: dict[str, str] = {}


@machine.once
def runtime() -> Any:
    """The machine code that all kernels share."""
    return machine.load(_RUNTIME)


def set_threads(count: int) -> None:
    """Set the number of threads of a batch; 0 means all of XLA's pool."""
    if isinstance(count, bool) or not isinstance(count, int):
        raise TypeError(f"count must be an int, got {count!r}.")
    if count < 0:
        raise ValueError(f"count must be a number of threads, or 0 for all, got {count}.")
    _threads().value = count


def get_threads() -> int:
    """The number of threads of a batch, as set by `set_threads`."""
    return _threads().value


def _threads() -> ctypes.c_int64:
    # A variable of the machine code itself, so that a new number holds for compiled programs too.
    return ctypes.c_int64.from_address(runtime().get_global_value_address("lanewise_threads"))


def module_text(kernel: str, block: int, scratch: int) -> str:
    """A kernel with its handler."""
    return kernel + HANDLER.replace("BLOCK", str(block)).replace("SCRATCH", str(scratch))


def register(text: str) -> str:
    """The name by which XLA calls a module's handler, compiled and registered if it was not."""
    # The text is the key, not the function: two programs with equal code are compiled once.
    key = hashlib.sha256(text.encode()).hexdigest()
    with _lock:
        if key not in _targets:
            run = runtime().get_function_address("lanewise_run")
            name = f"lanewise_{key[:32]}"
            # One engine holds all modules, so that each needs a name of its own.
            text = text.replace("@lanewise_handler", f"@{name}")
            engine = machine.load(text, {"lanewise_run": run})
            address = engine.get_function_address(name)
            jax.ffi.register_ffi_target(name, capsule(address), platform="cpu")
            _targets[key] = name
        return _targets[key]


def capsule(address: int) -> Any:
    """The form in which JAX takes the address of a handler."""
    new = ctypes.pythonapi.PyCapsule_New
    new.restype = ctypes.py_object
    new.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)
