"""Batches of trajectories compiled to machine code, from functions written in JAX for one."""

from .derivative import with_derivative as with_derivative
from .explained import Explanation as Explanation, Part as Part, explain as explain
from .implicit import implicit_root as implicit_root
from .jaxprs.jaxapi import once as once
from .linear import on_any as on_any, solve as solve, unit_vectors as unit_vectors
from .native.handler import get_threads as get_threads, set_threads as set_threads
from .primitive import Layout as Layout, batched as batched, call as call, generates as generates
