"""The calls from XLA into machine code: a typed handler, and the threads that share a batch.

A handler gets XLA's call frame, a C structure that `jax.ffi.include_dir()` documents
(``xla/ffi/api/c_api.h``); the offsets below are those of its 64-bit layout, which is stable for a
major version of the interface. Blocks of trajectories are claimed one chunk after the other from a
counter, by the caller and by the threads of XLA's own pool; the caller waits only for chunks that
somebody has begun. A task that starts later finds nothing to do: all that it reads is in a record
that the last user frees.
"""

import functools
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
version:                                     ; XLA asks for the version of the interface
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
  %blocks.at = getelementptr i8, ptr %job, i64 24
  %blocks = load i64, ptr %blocks.at
  %chunk.at = getelementptr i8, ptr %job, i64 32
  %chunk = load i64, ptr %chunk.at
  %kernel.at = getelementptr i8, ptr %job, i64 40
  %kernel = load ptr, ptr %kernel.at
  %params.at = getelementptr i8, ptr %job, i64 48
  %params = load ptr, ptr %params.at
  %args.at = getelementptr i8, ptr %job, i64 56
  %args = load ptr, ptr %args.at
  %rets.at = getelementptr i8, ptr %job, i64 64
  %rets = load ptr, ptr %rets.at
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
  %at = getelementptr ptr, ptr %from, i64 %i
  %buffer = load ptr, ptr %at
  %data.at = getelementptr i8, ptr %buffer, i64 24
  %data = load ptr, ptr %data.at
  %into = getelementptr ptr, ptr %to, i64 %i
  store ptr %data, ptr %into
  %i.next = add i64 %i, 1
  br label %head
over:
  ret void
}

define ptr @lanewise_run(ptr %frame, ptr %kernel, i64 %block) {
entry:
  %seen = alloca i64
  %ask = alloca [4 x i64]
  %api.at = getelementptr i8, ptr %frame, i64 16
  %api = load ptr, ptr %api.at
  %ctx.at = getelementptr i8, ptr %frame, i64 24
  %ctx = load ptr, ptr %ctx.at
  %nargs.at = getelementptr i8, ptr %frame, i64 56
  %nargs = load i64, ptr %nargs.at
  %args.at = getelementptr i8, ptr %frame, i64 72
  %args = load ptr, ptr %args.at
  %nrets.at = getelementptr i8, ptr %frame, i64 96
  %nrets = load i64, ptr %nrets.at
  %rets.at = getelementptr i8, ptr %frame, i64 112
  %rets = load ptr, ptr %rets.at
  %attrs.at = getelementptr i8, ptr %frame, i64 160
  %attrs = load ptr, ptr %attrs.at
  %attr = load ptr, ptr %attrs
  %params.at = getelementptr i8, ptr %attr, i64 16
  %params = load ptr, ptr %params.at
  %lanes = load i64, ptr %params
  %cost.at = getelementptr i64, ptr %params, i64 1
  %cost = load i64, ptr %cost.at

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
  %result.at = getelementptr ptr, ptr %r, i64 %n
  %result = load ptr, ptr %result.at
  %size.of = getelementptr i64, ptr %sizes, i64 %n
  %size.each = load i64, ptr %size.of
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
  %ask1 = getelementptr i64, ptr %ask, i64 1
  store ptr null, ptr %ask1
  %ask2 = getelementptr i64, ptr %ask, i64 2
  store ptr %ctx, ptr %ask2
  %ask3 = getelementptr i64, ptr %ask, i64 3
  store ptr %seen, ptr %ask3
  %size.at = getelementptr i8, ptr %api, i64 COUNT
  %size = load ptr, ptr %size.at
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
  %j1 = getelementptr i8, ptr %job, i64 8
  store i64 0, ptr %j1
  %j2 = getelementptr i8, ptr %job, i64 16
  store i64 0, ptr %j2
  %j3 = getelementptr i8, ptr %job, i64 24
  store i64 %blocks, ptr %j3
  %j4 = getelementptr i8, ptr %job, i64 32
  store i64 %chunk, ptr %j4
  %j5 = getelementptr i8, ptr %job, i64 40
  store ptr %kernel, ptr %j5
  %j6 = getelementptr i8, ptr %job, i64 48
  store ptr %params, ptr %j6
  %j7 = getelementptr i8, ptr %job, i64 56
  store ptr %a, ptr %j7
  %j8 = getelementptr i8, ptr %job, i64 64
  store ptr %r, ptr %j8
  %schedule.at = getelementptr i8, ptr %api, i64 SCHEDULE
  %schedule = load ptr, ptr %schedule.at
  br label %next.task
next.task:
  %t = phi i64 [1, %ask.pool], [%t.next, %scheduled]
  %t.more = icmp slt i64 %t, %threads
  br i1 %t.more, label %one.task, label %own
one.task:
  %plan = alloca [5 x i64]
  store i64 40, ptr %plan
  %plan1 = getelementptr i64, ptr %plan, i64 1
  store ptr null, ptr %plan1
  %plan2 = getelementptr i64, ptr %plan, i64 2
  store ptr %ctx, ptr %plan2
  %plan3 = getelementptr i64, ptr %plan, i64 3
  store ptr @task, ptr %plan3
  %plan4 = getelementptr i64, ptr %plan, i64 4
  store ptr %job, ptr %plan4
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
  %so.far = load atomic i64, ptr %j2 acquire, align 8
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

_FIRST_FUNCTION = 48
"""Offset of the first function in XLA's table: size, extension, version (24), internal table."""
_SCHEDULE = _FIRST_FUNCTION + 8 * 11
_COUNT = _FIRST_FUNCTION + 8 * 12

_lock = threading.RLock()
_targets: dict[str, str] = {}


@functools.cache
def runtime() -> Any:
    text = _RUNTIME.replace("SCHEDULE", str(_SCHEDULE)).replace("COUNT", str(_COUNT))
    # Only Linux knows the request. Below 32 MiB the C library hands out memory that it has had
    # before, where the request costs more than it brings.
    text = text.replace("LARGE", str(32 * 2**20 if sys.platform == "linux" else 2**63 - 1))
    return machine.loaded(text)


def set_threads(count: int) -> None:
    """Threads that a batch is shared over: 0 means all of XLA's pool."""
    if isinstance(count, bool) or not isinstance(count, int):
        raise TypeError(f"the number of threads must be an integer, got {count!r}.")
    if count < 0:
        raise ValueError(f"the number of threads must be at least 1, or 0 for all; got {count}.")
    import ctypes

    address = runtime().get_global_value_address("lanewise_threads")
    ctypes.c_int64.from_address(address).value = count


def get_threads() -> int:
    import ctypes

    address = runtime().get_global_value_address("lanewise_threads")
    return ctypes.c_int64.from_address(address).value


def module_text(kernel: str, block: int) -> str:
    """A kernel with its handler."""
    handler = HANDLER.replace("MAJOR", str(API_MAJOR)).replace("MINOR", str(API_MINOR))
    return kernel + handler.replace("BLOCK", str(block))


def registered(text: str) -> str:
    """The name by which XLA calls a module's handler, compiled and registered if it was not."""
    import hashlib

    key = hashlib.sha256(text.encode()).hexdigest()
    with _lock:
        if key not in _targets:
            run = runtime().get_function_address("lanewise_run")
            name = f"lanewise_{key[:32]}"
            text = text.replace("@lanewise_handler", f"@{name}")
            engine = machine.loaded(text, {"lanewise_run": run})
            address = engine.get_function_address(name)
            jax.ffi.register_ffi_target(name, _capsule(address), platform="cpu")
            _targets[key] = name
        return _targets[key]


def _capsule(address: int) -> Any:
    import ctypes

    new = ctypes.pythonapi.PyCapsule_New
    new.restype, new.argtypes = (
        ctypes.py_object,
        [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p],
    )
    return new(address, None, None)
