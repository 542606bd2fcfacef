"""Calls with arguments that a function does not have, or without those that it needs."""

import difflib
import functools
import inspect
import re
import sys
import traceback
from collections.abc import Callable
from types import ModuleType
from typing import Any, TypeVar

import jax
import numpy as np

from . import checks
from .checks import argument_names, arguments_text, only_one, refuse_unknown, require
from .machine import refuse_fork

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

_ABSENT = object()


def checked_keywords(function: F) -> F:
    """Decorator of a function with ``**settings: Unpack[...]``, which Python itself does not check:
    an unknown keyword, or the absence of a necessary one, **raises** `TypeError`. In a process that
    was forked after JAX had started it raises `RuntimeError`."""
    names = frozenset(argument_names(function))
    necessary = sorted(getattr(checks.settings_type(function), "__required_keys__", ()))

    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        unknown = [name for name in keywords if name not in names]
        refuse_unknown(function.__name__, function, unknown)
        values: dict[str, Any] = {name: keywords.get(name, _ABSENT) for name in necessary}
        require(function.__name__, values, _ABSENT)
        refuse_fork()
        return function(*args, **keywords)

    return call  # pyright: ignore[reportReturnType]


def accept_newton(cls: type[T]) -> type[T]:
    """Decorator of a class: `newton=` means `root_finder=`; both at once **raise** `TypeError`."""
    construct = cls.__init__

    @functools.wraps(construct)
    def init(self: T, *args: Any, **options: Any) -> None:
        if "newton" in options:
            only_one(TypeError, newton=options["newton"], root_finder=options.get("root_finder"))
            options["root_finder"] = options.pop("newton")
        construct(self, *args, **options)

    # In place: `isinstance` and pickles refer to this class, not to a subclass of it.
    cls.__init__ = init
    return cls


_OWN = ("dvi_jax", "lanewise")
_BETWEEN = (*_OWN, "equinox", "jaxtyping", "beartype", "contextlib")


def user_level() -> int:
    """The `stacklevel` of a warning that shows the line of the user's program."""
    # Counted, because it is one more frame under some decorators.
    frame, level = sys._getframe(1), 1
    while frame.f_back and frame.f_globals.get("__name__", "").split(".")[0] in _BETWEEN:
        frame, level = frame.f_back, level + 1
    return level


def explain_calls(module: ModuleType) -> None:
    """Make the public functions and classes of a module explain a call with wrong arguments."""
    # The error of Python has neither the names that are allowed nor the one that was meant.
    if module.__name__ in sys.modules and not hasattr(module, "__getattr__"):
        vars(module)["__getattr__"] = functools.partial(_refuse_name, module)
    for name, value in list(vars(module).items()):
        owner = getattr(value, "__module__", None) or ""
        if isinstance(value, ModuleType):
            # A package in a package, such as `boozer` in `systems`.
            if value.__name__ == f"{module.__name__}.{name}" and hasattr(value, "__path__"):
                explain_calls(value)
        elif name.startswith("_") or not owner.startswith((module.__name__, "lanewise")):
            continue
        elif inspect.isfunction(value) and not hasattr(value, "explains_calls"):
            # A pickle looks a function up where it was defined.
            home = sys.modules[owner]
            call = getattr(home, value.__name__, None)
            if call is value:
                call = _explained(value, value.__name__, value)
                setattr(home, value.__name__, call)
            if getattr(call, "__wrapped__", None) is value:
                setattr(module, name, call)
        elif isinstance(value, type):
            _explain_methods(value)
    for name, table in vars(module).items():
        if isinstance(table, dict) and not name.startswith("_"):
            table.update({key: _replacement(value) for key, value in table.items()})


_IN_STEPS = ("engine", "problem", "methods", "integration")


def _explain_methods(cls: type) -> None:
    """Make the constructor of a class explain a call with wrong arguments, and its methods, but for
    those that are called in steps, where each would be a frame more in the errors of a user's
    functions: those of a base, and of the classes that make a step."""
    inherited = {name for base in cls.__mro__[1:] for name in vars(base)} - {"__init__"}
    if cls.__module__.split(".")[1] in _IN_STEPS:
        inherited |= vars(cls).keys() - {"__init__"}
    for name, member in list(vars(cls).items()):
        function = member.__func__ if isinstance(member, classmethod) else member
        if name in inherited or (name[0] == "_" and name != "__init__"):
            continue
        if inspect.isfunction(function) and not inspect.isabstract(cls):
            label = cls.__name__ if name == "__init__" else f"{cls.__name__}.{name}"
            call = _explained(function, label, functools.partial(function, None))
            # In place, as in `accept_newton`.
            setattr(cls, name, classmethod(call) if function is not member else call)


def _replacement(value: Any) -> Any:
    """What has taken the place of a function, such as one in `systems.LIBRARY`, where it was
    defined; else the value itself."""
    home = sys.modules.get(str(getattr(value, "__module__", "")))
    call = getattr(home, str(getattr(value, "__name__", "")), None)
    return call if getattr(call, "__wrapped__", None) is value else value


def _refuse_name(module: ModuleType, name: str) -> None:
    names = [n for n, x in vars(module).items() if not (n[0] == "_" or isinstance(x, ModuleType))]
    close = difflib.get_close_matches(name.lower(), names, 3, 0.5)
    hint = f" Did you mean {' or '.join(close)}?" if close else f" See dir({module.__name__})."
    text = f"module {module.__name__!r} has no attribute {name!r}.{hint}"
    raise AttributeError(text, name=name, obj=module)


def _explained(function: Callable[..., Any], name: str, signature: Any) -> Callable[..., Any]:
    """The function, with `signature` as the arguments that a user gives."""
    if hasattr(function, "explains_calls"):
        return function

    settings = getattr(checks.settings_type(function), "__annotations__", {})
    kinds = {**function.__annotations__, **settings}
    flags = {argument for argument, kind in kinds.items() if kind is bool}
    # Others may compile; a result can be read and drawn in any process.
    only_reads = function.__module__.startswith(("dvi_jax.plot", "dvi_jax.sweep"))

    @functools.wraps(function)
    def call(*args: Any, **keywords: Any) -> Any:
        if signature is function and not only_reads:
            refuse_fork()
        # Text such as "no" would count as True.
        for flag in flags & keywords.keys():
            checks.instance(flag, keywords[flag], bool | np.bool_, "True or False")
        try:
            return function(*args, **keywords)
        except TypeError as error:
            own = args[1:] if signature is not function else args
            _note_tracing(name, error)
            # Most errors come from inside of the function, and not from this call of it.
            if not _CALL.search(str(error)) or _fits(signature, own, keywords):
                raise
        _refuse_call(name, signature, len(own), keywords)

    # A mark, since a module may be explained more than once.
    vars(call)["explains_calls"] = True
    return call


# What Python says of arguments that do not fit; an error inside of the function may say it, too.
_CALL = re.compile(r"\(\) (got (an unexpected|multiple)|missing \d|takes )")


def _fits(function: Callable[..., Any], args: tuple[Any, ...], keywords: dict[str, Any]) -> bool:
    try:
        inspect.signature(function).bind(*args, **keywords)
    except TypeError:
        return False
    return True


def _refuse_call(name: str, function: Callable[..., Any], count: int, keywords: Any) -> None:
    """**Raise** `TypeError` for a call with `count` arguments by position and these keywords."""
    names = argument_names(function)
    refuse_unknown(name, function, [keyword for keyword in keywords if keyword not in names])
    # First unknown names: a misspelt argument is missing as well.
    parameters = list(inspect.signature(function).parameters.values())
    by_position = [p.name for p in parameters if p.kind <= p.POSITIONAL_OR_KEYWORD]
    absent = {
        p.name: None
        for p in parameters
        if p.default is p.empty
        and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
        and p.name not in (*by_position[:count], *keywords)
    }
    hint = arguments_text(names)
    require(name, absent, hint=hint)
    raise TypeError(
        f"{name} takes {len(by_position)} argument(s) by position, got {count}"
        f"{f' and {list(keywords)} by name' if keywords else ''}. {hint}"
    )


def _note_tracing(name: str, error: Exception) -> None:
    """Add advice to an error of JAX about traced values, unless it has some."""
    notes = getattr(error, "__notes__", ())
    if not isinstance(error, jax.errors.JAXTypeError) or any(TRACED in note for note in notes):
        return
    # The traceback has the frames of JAX as well, which are filtered only when it is printed.
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    roots = [str(frame.f_globals.get("__name__")).split(".")[0] for frame in frames]
    owners = [root for root in roots if root not in _BELOW]
    # The last line that is not of a library is in a function of the user, or in a call with a
    # traced value.
    is_of_user = owners and owners[-1] not in _OWN
    error.add_note(
        tracing_note(f"a function that {name} calls", error)
        if is_of_user
        else f"An argument of {name} {TRACED}, but must be known here: compute it outside of jit, "
        "grad and vmap."
    )


_BELOW = ("jax", "jaxlib", "numpy", "scipy", *_BETWEEN[len(_OWN) :])
TRACED = "is traced by JAX"


def tracing_note(name: str, error: Exception) -> str:
    """Advice about an error in a function of the user that JAX traces."""
    if isinstance(error, jax.errors.TracerBoolConversionError):
        return (
            f"{name} is traced by JAX: its values are not known yet, so if and while cannot depend "
            "on them. Use jnp.where(condition, a, b), jax.lax.cond or jax.lax.while_loop."
        )
    errors = jax.errors
    if isinstance(error, errors.ConcretizationTypeError | errors.TracerArrayConversionError):
        return (
            f"{name} is traced by JAX: use jnp.cos, jnp.sqrt, … in place of np.cos, math.cos, "
            "float() or int()."
        )
    if isinstance(error, TypeError) and "NoneType" in str(error):
        return f"In this call args is None: if {name} uses args, pass args=... to the call."
    return f"{name} is traced by JAX: it must consist of functions of jax.numpy."
