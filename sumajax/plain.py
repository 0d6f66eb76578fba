"""Settings as plain Python values, whatever kind of number they were given as.

Sweep tools hand out NumPy's numbers. They compute as Python's do, but print and hash in their own
way and are no JSON, so a configuration takes them as the numbers they are, once, where it is made.
"""

import dataclasses
from numbers import Integral, Real
from typing import Any

import jax
import numpy as np

ARRAYS = (np.generic, np.ndarray, jax.Array)


def plain(value: Any) -> Any:
    """`value` with every number, truth value and text in it as Python's own.

    Integral and real numbers become `int` and `float` of the same value, `np.bool_` becomes `bool`,
    `np.str_` becomes `str`, an array without axes the value it holds. Tuples, lists and
    dictionaries are gone through; everything else stays as it is, so that who checks it can name
    what was given.
    """
    if is_values(value) and value.ndim == 0:
        value = value.tolist()
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return str.__str__(value)
    if isinstance(value, Integral):
        return int(value)
    if isinstance(value, Real):
        return float(value)
    if type(value) in (tuple, list):
        return type(value)(plain(item) for item in value)
    if type(value) is dict:
        return {plain(key): plain(item) for key, item in value.items()}
    return value


def plain_fields(config: Any) -> None:
    """Makes the fields of a frozen dataclass `plain`; for the beginning of its `__post_init__`."""
    for field in dataclasses.fields(config):
        if field.init:
            object.__setattr__(config, field.name, plain(getattr(config, field.name)))


def is_values(value: Any) -> bool:
    """Whether it is an array of numbers, truth values or text, and no traced one, and no key."""
    if not isinstance(value, ARRAYS) or isinstance(value, jax.core.Tracer):
        return False
    kind = value.dtype.kind if isinstance(value.dtype, np.dtype) else "key"
    return kind in "biufU" or value.dtype == jax.numpy.bfloat16
