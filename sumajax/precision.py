"""The precision of matrix products, decided in one place."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

import jax

MATRIX_PRECISION = "float32"
"""What products of float32 matrices are computed in.

Accelerators left to themselves round the operands first: an H100 to ten bits of mantissa (TF32), a
TPU to seven (bfloat16). A CPU never does, so this is what makes figures agree between them.
"""

P = ParamSpec("P")
T = TypeVar("T")


def stated_precision(function: Callable[P, T]) -> Callable[P, T]:
    """`function` with its matrix products, and those of its derivatives, in `MATRIX_PRECISION`.

    A precision that JAX has been told (`jax_default_matmul_precision`) goes before it.
    """

    @wraps(function)
    def stated(*args: P.args, **kwargs: P.kwargs) -> T:
        asked = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
        with jax.default_matmul_precision(asked or MATRIX_PRECISION):
            return function(*args, **kwargs)

    return stated
