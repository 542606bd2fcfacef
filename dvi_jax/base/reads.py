"""Values that a user's function reads from outside: globals, closures, attributes of its object."""

# They become constants of a compiled program, which must not be used again once they have changed.

import array
import collections
import contextlib
import functools
import inspect
import itertools
import operator
import re
import sys
import types
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import numpy as np

Reads = tuple[tuple[str, Any], ...]
"""Names, each with a mark that identifies its value and can be compared and hashed."""

# The comparison is made at every call, so that its time is limited: large NumPy arrays are compared
# in some entries, long lists and dictionaries in the first ones.
_MOST_BYTES = 1 << 20
_MOST_ENTRIES = 1000

_LIBRARIES = frozenset(["jax", "jaxlib", "numpy", "scipy", "equinox", "lanewise", "dvi_jax"])

_SIMPLE = (bool, int, float, complex, str, bytes, type(None), np.generic)
_CONSTANTS = (*_SIMPLE, np.ndarray, list, tuple, dict)
_LISTS = (list, tuple, collections.deque, collections.UserList)
_TABLES = (dict, types.MappingProxyType, collections.ChainMap, collections.UserDict)

# Special methods that no operator, index or conversion calls.
_NOT_IMPLICIT = frozenset(
    ["__new__", "__repr__", "__str__", "__eq__", "__hash__", "__del__", "__setattr__", "__reduce__"]
)


class _Identity:
    """An object that is compared by identity."""

    # It holds the object, since the id of one that is deleted may be given to another.
    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identity) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)

    def __deepcopy__(self, memo: Any) -> "_Identity":
        return self


def reads(*values: Any) -> Reads:
    """The values that functions read from outside: those in `values`, in pytrees and in modules,
    and the methods of the classes that a user has written for these.

    - Numbers, strings, tuples, lists, dictionaries, sets and NumPy arrays are compared by value
      (arrays above 1 MiB and lists above 1000 entries in part), other objects by identity.
    - Attributes of an object or a class are compared if their names occur in the function or in a
      method such as ``__mul__`` of the object; those of the user's objects in any such function.
    - Functions that are called are followed unless they belong to a library. Programs that
      `jax.jit` has compiled for the user, files, and results of calls are not seen.
    """
    reader = _Reader()
    for function in _functions(values):
        if isinstance(function, type):
            reader.follow_class(function)
        else:
            reader.follow(function)
    reader.follow_arguments()
    return tuple(reader.values.items())


def differences(earlier: Reads, later: Reads) -> list[str]:
    """The names in both whose values differ, with the values where they can be printed."""
    old = dict(earlier)
    return [
        f"{name} ({_difference(old[name], mark)})"
        for name, mark in later
        if name in old and old[name] != mark
    ]


def _difference(old: Any, new: Any) -> str:
    if old[0] == new[0] and old[0] in ("value", "length"):
        return f"{old[0]} {old[1]}, now {new[1]}"
    return "an array whose values have changed" if old[0] == new[0] == "array" else "replaced"


def _functions(value: Any) -> Iterator[Any]:
    """The functions in a pytree, a module, or a container; and the classes of its modules that are
    not of a library, whose methods a run may call."""
    # Arrays in a module are arguments of a compiled program, not constants: they may change.
    if isinstance(value, eqx.Module):
        fields = vars(value)
        if fields.get("reads"):  # a system, whose values are compared when a run begins
            return
        yield from _user_classes(type(value))
        for inner in fields.values():
            yield from _functions(inner)
        if callable(value):
            yield inspect.unwrap(type(value).__call__)
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _functions(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _functions(inner)
    elif callable(value) and not isinstance(value, type):
        yield value


@functools.lru_cache(maxsize=4096)
def _user_classes(kind: type) -> tuple[type, ...]:
    return tuple(base for base in kind.__mro__ if not _is_of_a_library(base.__module__))


class _Reader:
    """Collects in `values` the values that functions read."""

    def __init__(self):
        self.values: dict[str, Any] = {}
        self.objects: dict[Any, Any] = {}
        self.names: dict[str, None] = {}  # of attributes, in all functions of the user
        self.arguments: dict[int, tuple[str, Any]] = {}  # objects of the user
        self.noted: set[tuple[int, str]] = set()
        self.is_of_a_library = False  # the function that is followed

    def is_new(self, thing: Any, names: tuple[str, ...] | None = None) -> bool:
        """Whether this is the first visit; by `names`, of these attributes."""
        key = id(thing), names
        new = key not in self.objects
        self.objects[key] = thing  # held, so that no other object gets its id
        return new

    def follow(self, function: Any) -> None:
        """Collect the values that a function reads, and those that it calls."""
        if not self.is_new(function):
            return
        if isinstance(function, functools.partial):
            self.names |= dict.fromkeys(x for x in function.args if isinstance(x, str))
            for inner in (function.func, function.args, function.keywords):
                self.note("an argument of a partial", inner, ())
        elif inspect.ismethod(function):
            code = getattr(function.__func__, "__code__", None)
            self.note("self", function.__self__, _attributes(code) if code else ())
            self.follow(function.__func__)
        elif isinstance(function, types.FunctionType):
            self.follow_code(function)
        elif isinstance(function, operator.attrgetter | operator.methodcaller):
            self.names |= dict.fromkeys(re.findall(r"\w+", repr(function)))
        elif hasattr(function, "__wrapped__"):
            self.follow(function.__wrapped__)
        elif isinstance(function, eqx.Module):
            for inner in _functions(function):
                self.follow(inner)
        elif callable(function) and inspect.ismethod(function.__call__):
            self.follow(function.__call__)

    def follow_arguments(self) -> None:
        """Collect attributes that a function reads of an object that is its argument."""
        size = -1
        while size != (size := len(self.objects)):
            for name, value in list(self.arguments.values()):
                names = tuple(x for x in self.names if (id(value), x) not in self.noted)
                self.note_attributes(name, value, names)

    def follow_class(self, kind: type) -> None:
        """Collect the constants of a class, and what its methods and properties read."""
        if not self.is_new(kind):
            return
        for name, member in vars(kind).items():
            if name.startswith("__") and name != "__call__":
                continue
            if isinstance(member, property):
                self.follow(member.fget)
            elif callable(function := getattr(kind, name, None)):
                self.follow(inspect.unwrap(function))
            elif isinstance(member, _CONSTANTS):
                self.note(f"{kind.__name__}.{name}", member, ())

    def follow_code(self, function: types.FunctionType) -> None:
        code = function.__code__
        code_names, names = _names(code), _attributes(code)
        outer, self.is_of_a_library = self.is_of_a_library, _is_of_a_library(function.__module__)
        for name, cell in zip(code.co_freevars, function.__closure__ or (), strict=True):
            with contextlib.suppress(ValueError):  # not assigned yet
                self.note(name, cell.cell_contents, names)
        for value in (function.__defaults__, function.__kwdefaults__):
            if value:
                self.note(f"the defaults of {function.__name__}", value, names)
        if not self.is_of_a_library:
            self.names |= dict.fromkeys(names)
            globals_ = function.__globals__
            for name in code_names:
                if name in globals_:
                    self.note(name, globals_[name], names)
        self.is_of_a_library = outer

    def note(self, name: str, value: Any, names: tuple[str, ...]) -> None:
        """Collect one value and what it refers to; `names` are those in the code that reads it."""
        if isinstance(value, types.ModuleType):
            if not _is_of_a_library(value.__name__):
                self.note_attributes(name, value, names)
        elif isinstance(value, _SIMPLE):
            self.add(name, ("value", repr(value)))
        elif isinstance(value, np.ndarray):
            self.add(name, ("array", value.shape, str(value.dtype), _digest(value)))
        elif isinstance(value, set | frozenset):
            self.add(name, ("length", len(value)))
            self.add(name, ("entries", frozenset(itertools.islice(value, _MOST_ENTRIES))))
        elif isinstance(value, bytearray | memoryview | array.array):
            self.add(name, ("bytes", bytes(value[:_MOST_BYTES])))
        elif isinstance(value, _LISTS):
            self.add(name, ("length", len(value)))
            for i, entry in enumerate(itertools.islice(value, _MOST_ENTRIES)):
                self.note(f"{name}[{i}]", entry, names)
        elif isinstance(value, _TABLES):
            self.add(name, ("length", len(value)))
            for key in list(value)[:_MOST_ENTRIES]:
                self.note(f"{name}[{key!r}]", value[key], names)
        else:
            self.note_object(name, value, names)

    def note_object(self, name: str, value: Any, names: tuple[str, ...]) -> None:
        """Collect an object by its identity, and what it and its methods refer to."""
        kind = value if isinstance(value, type) else type(value)
        is_of_user = not _is_of_a_library(kind.__module__)
        # Objects of a library that a library has made may be others in each call.
        if isinstance(value, jax.Array) or is_of_user or not self.is_of_a_library:
            self.add(name, ("object", _Identity(value)))
        self.note_attributes(name, value, names)
        if is_of_user and value is not kind and self.is_new(value, ("its special methods",)):
            # Operators and indices call methods whose names are not in the function.
            for base in _user_classes(kind):
                for method, function in vars(base).items():
                    is_special = method.startswith("__") and "init" not in method
                    if is_special and method not in _NOT_IMPLICIT and inspect.isfunction(function):
                        self.note_attributes(name, value, _attributes(function.__code__))
                        self.follow(function)
        if callable(value) and value is not kind:
            self.follow(value)

    def note_attributes(self, name: str, value: Any, names: tuple[str, ...]) -> None:
        """Collect attributes of an object or of its class, and what methods and properties read."""
        fields = getattr(value, "__dict__", {})
        kind = value if isinstance(value, type) else type(value)
        # A namespace is of the module `types`.
        if kind.__module__ == "types" or not _is_of_a_library(kind.__module__):
            self.arguments.setdefault(id(value), (name, value))
        for attribute in names if self.is_new(value, names) else ():
            self.noted.add((id(value), attribute))
            if attribute in fields and value is not kind:
                self.note(f"{name}.{attribute}", fields[attribute], names)
                continue
            # Statically: the property of a user may compute for long, or raise.
            of_class = inspect.getattr_static(kind, attribute, None)
            method = getattr(of_class, "fget", getattr(of_class, "func", of_class))
            method = getattr(method, "__func__", method)  # of the class, or static
            if isinstance(method, types.FunctionType):
                self.note_attributes(name, value, _attributes(method.__code__))
                self.follow(method)
            elif isinstance(of_class, types.MemberDescriptorType):
                with contextlib.suppress(AttributeError):  # not assigned yet
                    self.note(f"{name}.{attribute}", getattr(value, attribute), names)
            elif isinstance(of_class, _CONSTANTS) and of_class is not None:
                self.note(f"{name}.{attribute}", of_class, names)

    def add(self, name: str, mark: Any) -> None:
        while name in self.values:  # the same name in another function
            name += "′"
        self.values[name] = mark


def _digest(array: np.ndarray) -> Any:
    if array.dtype.hasobject:  # its bytes are addresses
        return _Identity(array)
    if array.nbytes > _MOST_BYTES:
        array = array.reshape(-1)[:: array.nbytes // _MOST_BYTES + 1]
    return hash(array.tobytes())


@functools.lru_cache(maxsize=4096)
def _names(code: types.CodeType) -> tuple[str, ...]:
    """The names of globals and attributes in a function and in the functions inside it."""
    inner = [constant for constant in code.co_consts if isinstance(constant, types.CodeType)]
    inner_names = [name for inner_code in inner for name in _names(inner_code)]
    return tuple(dict.fromkeys([*code.co_names, *inner_names]))


@functools.lru_cache(maxsize=4096)
def _attributes(code: types.CodeType) -> tuple[str, ...]:
    """The names in a function that may be attributes, those in strings for `getattr` included."""
    # Also in the tuples of a `match`, and in the "a.b" of an `attrgetter`.
    tuples = [x if isinstance(x, tuple) else (x,) for x in code.co_consts]
    strings = ".".join(x for x in itertools.chain(*tuples) if isinstance(x, str))
    words = (x for x in strings.split(".") if x.isidentifier())
    return tuple(dict.fromkeys([*_names(code), *words]))


@functools.lru_cache(maxsize=4096)
def _is_of_a_library(module: str | None) -> bool:
    root = (module or "").partition(".")[0]
    return root in _LIBRARIES or (root in sys.stdlib_module_names and root != "__main__")
