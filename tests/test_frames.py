"""From the public call to the user's H_D there are few frames of the package, in few files."""

import traceback
from pathlib import Path

import jax.numpy as jnp
import pytest

import dvi_jax as dvi
import lanewise

PACKAGES = tuple(str(Path(package.__file__).parent) for package in (dvi, lanewise))


class Reached(Exception):
    """Raised in H_D."""


def frames_to_the_equation(call: int, **how) -> list[str]:
    """The files of the package's frames above H_D when it is called for the `call`-th time."""
    calls = []

    def H_D(t0, t1, q0, p1, args):
        calls.append(1)
        if len(calls) == call:
            raise Reached
        return p1 @ p1 / 2 + q0 @ q0 / 2 + p1 @ jnp.sin(q0)

    with pytest.raises(Reached) as raised:
        dvi.integrate(dvi.System(H_D), [1.0, 0.2], [0.0, 0.1], h=0.1, num_steps=3, **how)
    files = [frame.f_code.co_filename for frame, _ in traceback.walk_tb(raised.tb)]
    return [file for file in files if file.startswith(PACKAGES)]


@pytest.mark.parametrize(
    ("method", "frames", "files"), [(dvi.TypeII(), 19, 8), (dvi.Strang(), 21, 9)]
)
@pytest.mark.parametrize("call", [2, 3], ids=["momentum", "position"])
def test_the_equation_is_few_frames_from_the_call(method, frames, files, call):
    found = frames_to_the_equation(call, method=method)
    assert len(found) <= frames
    assert len(set(found)) <= files


def test_the_frames_are_counted():
    """The count above is of the run, which begins with the second call of H_D."""
    found = frames_to_the_equation(1)
    files = ["keywords", "integrate", "preparation", "system", "system"]
    assert [Path(file).stem for file in found] == files
    # A method around the map adds frames, so that the numbers above could fail.
    nested = dvi.Composition((1.0,), base=dvi.Composition((0.5, 0.5), base=dvi.Strang()))
    assert len(frames_to_the_equation(2, method=nested)) > 21
