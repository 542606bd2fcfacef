"""Texts such as ``Yoshida(4)``: names of known classes with arguments; nothing else is called."""

import ast
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import dvi_jax as dvi
from dvi_jax.discover import AbstractBasis

from .._errors import InputError, one_of
from .loader import Loader


def public(base: type, *exclusions: type) -> dict[str, type]:
    """The public classes of the package that are subclasses of `base`, by name."""
    # `dvi_jax` has some of its names after their first use only: the folder of `base` has them.
    folder = sys.modules[".".join(base.__module__.split(".")[:2])]
    classes = {name: c for name, c in {**vars(dvi), **vars(folder)}.items() if isinstance(c, type)}
    return {
        name: c
        for name, c in classes.items()
        if issubclass(c, base) and c is not base and c not in exclusions and hasattr(dvi, name)
    }


@dataclass(frozen=True)
class Expressions:
    """Reader of the texts of one key.

    - `kind`: what a text describes. `classes`: name → class. `rule`: follows the names in an
      error.
    """

    key: str
    kind: type
    classes: Mapping[str, type]
    rule: str = ""

    def read(self, text: str) -> Any:
        """The object that a text describes. **Raises** `InputError`."""
        try:
            instance = self._evaluate(ast.parse(text.strip(), mode="eval").body)
        except InputError:
            raise
        except SyntaxError:
            raise self.error(f"{text!r} is not a valid expression") from None
        except (ValueError, TypeError, RecursionError, MemoryError) as error:
            raise self.error(f"{text!r} is invalid: {error}") from None
        return self.require_kind(instance, text)

    def require_kind(self, instance: Any, text: str) -> Any:
        """The object that was made, an instance of `kind`."""
        if not isinstance(instance, self.kind):
            raise self.error(f"{text!r} is another object")
        return instance

    def error(self, defect: str, name: str = "") -> InputError:
        return InputError(self.key, defect, one_of(self.classes, name) + self.rule)

    def _evaluate(self, node: ast.expr) -> Any:
        match node:
            case ast.Constant(value=value):
                return value
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return -self._evaluate(operand)
            case ast.List(elts=items):
                return [self._evaluate(item) for item in items]
            case ast.Tuple(elts=items):
                return tuple(self._evaluate(item) for item in items)
            case ast.BinOp(left=left, op=ast.Add() | ast.Mult() as op, right=right):
                left, right = self._evaluate(left), self._evaluate(right)
                if not (isinstance(left, self.kind) and isinstance(right, self.kind)):
                    raise ValueError(
                        f"+ and * do not apply to numbers, texts or lists, got {ast.unparse(node)}"
                    )
                return left + right if isinstance(op, ast.Add) else left * right
            case ast.Name(id=name):
                try:
                    return self._instantiate(name, [], [])
                except TypeError:
                    raise self.error(f"{name!r} requires arguments: {name}(...)") from None
            case ast.Call(func=ast.Name(id=name), args=arguments, keywords=keywords):
                return self._instantiate(name, arguments, keywords)
        name = next(iter(self.classes))
        raise ValueError(
            f"{ast.unparse(node)!r} is not a name ({name}, not dvi.{name}), a number (0.5, not "
            "1/2), a text or a list"
        )

    def _instantiate(self, name: str, arguments: list[Any], keywords: list[ast.keyword]) -> Any:
        if name not in self.classes:
            raise self.error(f"{name!r} is not a known name", name)
        if any(k.arg is None for k in keywords):
            raise self.error(f"{name!r} has an argument with **, not name=value")
        options = {str(k.arg): self._evaluate(k.value) for k in keywords}
        return self.classes[name](*(self._evaluate(argument) for argument in arguments), **options)


def parse_method(text: str) -> dvi.Method:
    """The method that a text such as ``"Yoshida(4)"`` or ``"Adjoint(TypeII)"`` describes.

    **Raises** `InputError`.
    """
    return Expressions("method", dvi.Method, public(dvi.Method)).read(text)


def parse_basis(text: str, loader: Loader) -> Any:
    """The basis that a text such as ``"Polynomials(2) + Radial((-1,))"`` describes, or that a file
    has under the name in it. **Raises** `InputError`.
    """
    rule = ', their sums and products; or "file.py:name"'
    reader = Expressions("basis", AbstractBasis, public(AbstractBasis, dvi.Basis), rule)
    if ".py:" not in text:
        return reader.read(text)
    target = loader.load("basis", text)
    basis = dvi.Basis(target) if isinstance(target, list | dict) else target
    return reader.require_kind(basis, text)
