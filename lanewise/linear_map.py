"""A linear map with a transpose of its own, compiled to machine code."""

from collections.abc import Callable
from typing import Any, NamedTuple

from .jaxprs.jaxapi import linear_map
from .primitive import AUTO, Layout, call


class LinearMap(NamedTuple):
    """The linear map L with L·x = ``push(*point, x)`` and Lᵀ·y = ``pull(*point, record, y)``.

    `push` and `pull` are functions of one trajectory. `point`: the arrays that L depends on;
    derivatives by them are those of `push`. `record`: what only the transpose needs, such as
    intermediate values.
    """

    push: Callable
    pull: Callable
    layout: Layout = AUTO

    def __call__(self, point: tuple, record: Any, x: Any) -> Any:
        """L·x, which JAX transposes by `pull`."""

        def definition(residuals, x):
            return self.push(*residuals[0], x)

        def push(residuals, x):
            return call(self.push, *residuals[0], x, layout=self.layout)

        def pull(residuals, y):
            return call(self.pull, *residuals[0], residuals[1], y, layout=self.layout)

        return linear_map(push, pull, definition, (point, record), x)
