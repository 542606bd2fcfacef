"""The checks of arguments that all functions share."""

import jax.numpy as jnp
import numpy as np
import pytest

import dvi_jax as dvi
from dvi_jax import _checks


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (lambda x: _checks.whole("n", x), (1, np.int64(3)), (0, -1, 1.0, True, "2", None, np.nan)),
        (lambda x: _checks.whole("n", x, 0, 5), (0, 5), (6, -1)),
        (lambda x: _checks.positive("x", x), (0.5, 3, np.float32(1)), (0, -1.0, np.inf, np.nan)),
        (lambda x: _checks.positive("x", x, zero=True), (0, 2.0), (-1e-300, "1", None, True)),
        (lambda x: _checks.positive("x", x), (jnp.float32(2), np.array(1.0)), (np.ones(2), 1j)),
        (lambda x: _checks.finite("x", x), (-2, 0.0), (np.inf, "0", None, [1.0])),
        (lambda x: _checks.one_of("x", x, ["a", None]), ("a", None), ("b", 0, ["a"])),
    ],
)
def test_values(check, good, bad):
    for value in good:
        assert check(value) == value
    for value in bad:
        with pytest.raises(ValueError, match=r"^[nx] must be .*, got "):
            check(value)


def test_types():
    method = dvi.TypeII()
    assert _checks.instance("method", method, dvi.Method, "a dvi.Method") is method
    with pytest.raises(TypeError, match=r"method must be a dvi.Method, got 'Strang'\. Take one"):
        _checks.instance("method", "Strang", dvi.Method, "a dvi.Method", "Take one.")
    with pytest.raises(TypeError, match=r"got the class TypeII .is a pair of parentheses missing"):
        _checks.instance("method", dvi.TypeII, dvi.Method, "a dvi.Method")
    with pytest.raises(TypeError, match=r"f must be a function \(t, q\), got 3\."):
        _checks.function("f", 3, "(t, q)")
