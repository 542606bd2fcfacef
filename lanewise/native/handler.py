"""The calls from XLA into machine code: a typed handler, and the threads that share a batch.

A handler gets XLA's call frame, a C structure that `jax.ffi.include_dir()` documents
(``xla/ffi/api/c_api.h``); the offsets below are those of its 64-bit layout, which is stable for a
major version of the interface. Blocks of trajectories are claimed one chunk after the other from a
counter, by the caller and by the threads of XLA's own pool; the caller waits only for chunks that
somebody has begun. A task that starts later finds nothing to do: all that it reads is in a record
that the last user frees.
"""

import ctypes
import functools
import hashlib
import itertools
import re
import sys
import threading
from typing import Any

import jax.ffi

from . import machine

API_MAJOR, API_MINOR = 0, 1
"""The version of XLA's interface that the offsets are for; newer ones of 0 keep them."""

HANDLER = """
declare ptr @lanewise_run(ptr, ptr, i64)

define ptr @lanewise_handler(ptr %frame) {
  %ext.at = getelementptr i8, ptr %frame, i64 8
  %ext = load ptr, ptr %ext.at
  %is.call = icmp eq ptr %ext, null
  br i1 %is.call, label %call, label %version
version:                                     ; XLA queries the version of the interface
  %meta.at = getelementptr i8, ptr %ext, i64 24
  %meta = load ptr, ptr %meta.at
  %major = getelementptr i8, ptr %meta, i64 24
  store i32 MAJOR, ptr %major
  %minor = getelementptr i8, ptr %meta, i64 28
  store i32 MINOR, ptr %minor
  ret ptr null
call:
  %r = tail call ptr @lanewise_run(ptr %frame, ptr @lanewise_kernel, i64 BLOCK)
  ret ptr %r
}
"""
"""`lanewise_kernel(args, rets, params, first, last)` computes the blocks first … last − 1."""

# Offsets in the record of a job: users, next block, blocks done, blocks, chunk, kernel, parameters,
# pointers of arguments, pointers of results; the pointers themselves come after it.
_RUNTIME = """
@lanewise_threads = global i64 0

declare ptr @malloc(i64)
declare void @free(ptr)
declare i32 @sched_yield()
declare i32 @madvise(ptr, i64, i32)

; Large results in large pages: at 4 KiB each, the first touch of new memory costs as much as steps.
define internal void @large_pages(ptr %at, i64 %bytes) {
  %is.large = icmp uge i64 %bytes, LARGE
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
}

define internal void @drop(ptr %job) {
  %before = atomicrmw sub ptr %job, i64 1 acq_rel
  %last = icmp eq i64 %before, 1
  br i1 %last, label %yes, label %no
yes:
  call void @free(ptr %job)
  ret void
no:
  ret void
}

define internal void @work(ptr %job) {
entry:
  %next = getelementptr i8, ptr %job, i64 8
  %done = getelementptr i8, ptr %job, i64 16
  %blocks = load i64, i8 %job[24]
  %chunk = load i64, i8 %job[32]
  %kernel = load ptr, i8 %job[40]
  %params = load ptr, i8 %job[48]
  %args = load ptr, i8 %job[56]
  %rets = load ptr, i8 %job[64]
  br label %claim
claim:
  %first = atomicrmw add ptr %next, i64 %chunk acq_rel
  %is.over = icmp sge i64 %first, %blocks
  br i1 %is.over, label %over, label %run
run:
  %end = add i64 %first, %chunk
  %fits = icmp sle i64 %end, %blocks
  %last = select i1 %fits, i64 %end, i64 %blocks
  call void %kernel(ptr %args, ptr %rets, ptr %params, i64 %first, i64 %last)
  %mine = sub i64 %last, %first
  %ignored = atomicrmw add ptr %done, i64 %mine acq_rel
  br label %claim
over:
  ret void
}

define internal void @task(ptr %job) {
  call void @work(ptr %job)
  call void @drop(ptr %job)
  ret void
}

define internal void @pointers(ptr %from, i64 %count, ptr %to) {
entry:
  br label %head
head:
  %i = phi i64 [0, %entry], [%i.next, %body]
  %more = icmp slt i64 %i, %count
  br i1 %more, label %body, label %over
body:
  %buffer = load ptr, ptr %from[%i]
  %data = load ptr, i8 %buffer[24]
  store ptr %data, ptr %to[%i]
  %i.next = add i64 %i, 1
  br label %head
over:
  ret void
}

define ptr @lanewise_run(ptr %frame, ptr %kernel, i64 %block) {
entry:
  %seen = alloca i64
  %ask = alloca [4 x i64]
  %api = load ptr, i8 %frame[16]
  %ctx = load ptr, i8 %frame[24]
  %nargs = load i64, i8 %frame[56]
  %args = load ptr, i8 %frame[72]
  %nrets = load i64, i8 %frame[96]
  %rets = load ptr, i8 %frame[112]
  %attrs = load ptr, i8 %frame[160]
  %attr = load ptr, ptr %attrs
  %params = load ptr, i8 %attr[16]
  %lanes = load i64, ptr %params
  %cost = load i64, i64 %params[1]

  %count = add i64 %nargs, %nrets
  %bytes0 = mul i64 %count, 8
  %bytes = add i64 %bytes0, 72
  %job = call ptr @malloc(i64 %bytes)
  %a = getelementptr i8, ptr %job, i64 72
  %r = getelementptr ptr, ptr %a, i64 %nargs
  call void @pointers(ptr %args, i64 %nargs, ptr %a)
  call void @pointers(ptr %rets, i64 %nrets, ptr %r)
  %sizes = getelementptr i64, ptr %params, i64 2
  br label %next.result
next.result:
  %n = phi i64 [0, %entry], [%n.next, %one.result]
  %n.more = icmp slt i64 %n, %nrets
  br i1 %n.more, label %one.result, label %ready.to.run
one.result:
  %result = load ptr, ptr %r[%n]
  %size.each = load i64, i64 %sizes[%n]
  %size.all = mul i64 %size.each, %lanes
  call void @large_pages(ptr %result, i64 %size.all)
  %n.next = add i64 %n, 1
  br label %next.result
ready.to.run:
  %over = sub i64 %block, 1
  %lanes.up = add i64 %lanes, %over
  %blocks = udiv i64 %lanes.up, %block

  %set = load atomic i64, ptr @lanewise_threads monotonic, align 8
  %work = mul i64 %blocks, %cost
  %is.long = icmp sgt i64 %work, 100000
  %is.many = icmp sgt i64 %blocks, 1
  %may = and i1 %is.long, %is.many
  %one = icmp eq i64 %set, 1
  %not.one = xor i1 %one, true
  %go = and i1 %may, %not.one
  br i1 %go, label %ask.pool, label %alone
alone:
  call void %kernel(ptr %a, ptr %r, ptr %params, i64 0, i64 %blocks)
  call void @free(ptr %job)
  ret ptr null

ask.pool:
  store i64 1, ptr %seen
  store i64 32, ptr %ask
  store ptr null, i64 %ask[1]
  store ptr %ctx, i64 %ask[2]
  store ptr %seen, i64 %ask[3]
  %size = load ptr, i8 %api[COUNT]
  %error = call ptr %size(ptr %ask)
  %failed = icmp ne ptr %error, null
  %pool0 = load i64, ptr %seen
  %pool1 = select i1 %failed, i64 1, i64 %pool0
  %is.set = icmp sgt i64 %set, 0
  %fewer = icmp slt i64 %set, %pool1
  %take = and i1 %is.set, %fewer
  %pool2 = select i1 %take, i64 %set, i64 %pool1
  %few = icmp slt i64 %blocks, %pool2
  %pool3 = select i1 %few, i64 %blocks, i64 %pool2
  %none = icmp slt i64 %pool3, 1
  %threads = select i1 %none, i64 1, i64 %pool3
  %parts = mul i64 %threads, 16
  %parts.up = add i64 %blocks, %parts
  %parts.less = sub i64 %parts.up, 1
  %chunk = udiv i64 %parts.less, %parts

  store i64 %threads, ptr %job                 ; every task has one share, the caller another
  store i64 0, i8 %job[8]
  %done = getelementptr i8, ptr %job, i64 16
  store i64 0, ptr %done
  store i64 %blocks, i8 %job[24]
  store i64 %chunk, i8 %job[32]
  store ptr %kernel, i8 %job[40]
  store ptr %params, i8 %job[48]
  store ptr %a, i8 %job[56]
  store ptr %r, i8 %job[64]
  %schedule = load ptr, i8 %api[SCHEDULE]
  br label %next.task
next.task:
  %t = phi i64 [1, %ask.pool], [%t.next, %scheduled]
  %t.more = icmp slt i64 %t, %threads
  br i1 %t.more, label %one.task, label %own
one.task:
  %plan = alloca [5 x i64]
  store i64 40, ptr %plan
  store ptr null, i64 %plan[1]
  store ptr %ctx, i64 %plan[2]
  store ptr @task, i64 %plan[3]
  store ptr %job, i64 %plan[4]
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
  call void @work(ptr %job)
  br label %wait
wait:
  %spins = phi i64 [0, %own], [%spins.next, %again]
  %so.far = load atomic i64, ptr %done acquire, align 8
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
  call void @drop(ptr %job)
  ret ptr null
}
"""

# The functions in XLA's table follow its size, extension, version (24 bytes) and internal table.
_SCHEDULE, _COUNT = (48 + 8 * place for place in (11, 12))

# Several threads of Python may trace and compile at once; a name may be registered once only.
_lock = threading.RLock()
_targets: dict[str, str] = {}


_PLACE = re.compile(r"^(.*(?:load|store) .*), (i8|i64|ptr) (%[\w.]+)\[(%?[\w.]+)\]$", re.MULTILINE)


def _addressed(text: str) -> str:
    """Operands of the form ``i8 %pointer[24]``, which LLVM has not, as pointers."""
    names = itertools.count()

    def expanded(found: re.Match) -> str:
        instruction, item, base, index = found.groups()
        at = f"%at{next(names)}"
        pointer = f"  {at} = getelementptr {item}, ptr {base}, i64 {index}"
        return f"{pointer}\n{instruction}, ptr {at}"

    return _PLACE.sub(expanded, text)


@functools.cache
def runtime() -> Any:
    """The machine code that all kernels share."""
    text = _addressed(_RUNTIME).replace("SCHEDULE", str(_SCHEDULE)).replace("COUNT", str(_COUNT))
    # Only Linux has this system call. Below 32 MiB the C library reuses memory that is mapped
    # already, so that the call would cost more time than it saves.
    text = text.replace("LARGE", str(32 * 2**20 if sys.platform == "linux" else 2**63 - 1))
    return machine.loaded(text)


def set_threads(count: int) -> None:
    """Set the number of threads of a batch; 0 means all of XLA's pool."""
    if isinstance(count, bool) or not isinstance(count, int):
        raise TypeError(f"count must be a number of threads of the type int, got {count!r}.")
    if count < 0:
        raise ValueError(f"count must be a positive number of threads, or 0 for all, got {count}.")
    _threads().value = count


def get_threads() -> int:
    """The number of threads of a batch, as set by `set_threads`."""
    return _threads().value


def _threads() -> ctypes.c_int64:
    # A variable of the machine code itself, so that a new number holds for compiled programs too.
    return ctypes.c_int64.from_address(runtime().get_global_value_address("lanewise_threads"))


def module_text(kernel: str, block: int) -> str:
    """A kernel with its handler."""
    handler = HANDLER.replace("MAJOR", str(API_MAJOR)).replace("MINOR", str(API_MINOR))
    return kernel + handler.replace("BLOCK", str(block))


def registered(text: str) -> str:
    """The name by which XLA calls a module's handler, compiled and registered if it was not."""
    # The text is the key, not the function: two programs with equal code are compiled once.
    key = hashlib.sha256(text.encode()).hexdigest()
    with _lock:
        if key not in _targets:
            run = runtime().get_function_address("lanewise_run")
            name = f"lanewise_{key[:32]}"
            # One engine holds all modules, so that each needs a name of its own.
            text = text.replace("@lanewise_handler", f"@{name}")
            engine = machine.loaded(text, {"lanewise_run": run})
            address = engine.get_function_address(name)
            jax.ffi.register_ffi_target(name, _capsule(address), platform="cpu")
            _targets[key] = name
        return _targets[key]


def _capsule(address: int) -> Any:
    # The form in which JAX takes the address of a handler.
    new = ctypes.pythonapi.PyCapsule_New
    new.restype = ctypes.py_object
    new.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    return new(address, None, None)
