"""The one array type of both packages' signatures."""

from typing import Any

Array = Any
"""A numpy array here, a JAX array or tracer in the twins; shapes stand in the docstrings."""
