"""The one array type of both packages' signatures, and what one asks of it all the time."""

from typing import Any

import numpy as np

Array = Any
"""A numpy array here, a JAX array or tracer in the twins; shapes stand in the docstrings."""


def floats(values: Array) -> Array:
    """In float64, NaN where a masked array is masked."""
    if isinstance(values, np.ma.MaskedArray):
        return np.ma.filled(values.astype(np.float64), np.nan)
    return np.asarray(values, np.float64)


def some(condition: Array) -> bool:
    """True if it is True anywhere. Of one hand it is a numpy scalar, which is slow to count."""
    return bool(np.count_nonzero(condition)) if condition.ndim else bool(condition)


def every(condition: Array) -> bool:
    """True if it is True everywhere."""
    return np.count_nonzero(condition) == condition.size if condition.ndim else bool(condition)
