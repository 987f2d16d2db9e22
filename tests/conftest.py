"""The numerics policy of all tests, and what they share. Imports without jax: CI has a pass with
numpy, pytest and hypothesis alone."""

from __future__ import annotations

import contextlib
import functools
import importlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, settings
from model_files import whole_model

from numpy_infer.model import Model, save

REPOSITORY = Path(__file__).resolve().parents[1]

# No deadline: the first example pays for compilation. In CI the same examples every time, so that
# a red run is about the commit and not about luck.
settings.register_profile(
    "jaxhand",
    deadline=None,
    max_examples=15,
    phases=[phase for phase in Phase if phase is not Phase.explain],  # slow, and rarely right here
    derandomize=bool(os.environ.get("CI")),
    suppress_health_check=[HealthCheck.too_slow],
)
# pytest --hypothesis-profile=thorough: for an hour when nobody waits.
settings.register_profile(
    "thorough", settings.get_profile("jaxhand"), max_examples=500, derandomize=False
)
settings.load_profile("jaxhand")

os.environ.setdefault("JAX_PLATFORMS", "cpu")
# Most of the time goes into compilation. What is compiled is shared between workers and kept for
# the next run, by the program compiled and JAX's version; `pytest --cache-clear` forgets it.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(REPOSITORY / ".pytest_cache/d/jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
try:
    import jax
except ModuleNotFoundError:
    jax = None  # type: ignore[assignment]  # the pass without it
else:
    # float64 stays off, as for users; the tests that want it ask for `x64`. Promotion is strict: a
    # float64 constant that slips in is an error, not a slower net. Rank promotion stays allowed:
    # "leading axes are free" leans on it everywhere.
    jax.config.update("jax_numpy_dtype_promotion", "strict")


_compiled_for_x64 = False


def _compile_for(on: bool) -> None:
    """Forgets what JAX has traced whenever the precision changes: JAX 0.10 keeps constants in the
    precision of their first trace, and float64 would meet float32 ones."""
    global _compiled_for_x64
    if on != _compiled_for_x64:
        jax.clear_caches()
        _jitted.cache_clear()
        _compiled_for_x64 = on


@contextlib.contextmanager
def x64(on: bool = True) -> Iterator[None]:
    """JAX in float64 inside the block."""
    _compile_for(on)
    enable = getattr(jax, "enable_x64", None)  # jax < 0.8 keeps it elsewhere
    if enable is None:
        enable = importlib.import_module("jax.experimental").enable_x64
    with enable(on):
        yield


@pytest.fixture(autouse=True, scope="session")
def few_streams() -> Iterator[None]:
    """What error to expect is measured in a sixteenth of the gaps: quicker, and coarser."""
    with pytest.MonkeyPatch.context() as patched:
        if jax is not None:
            patched.setattr("jaxhand.expected_error.STREAMS", 256)
        yield


@pytest.fixture
def put(tmp_path: Path) -> Callable[[str, str], Path]:
    """Puts a text into a file, as it stands."""

    def write_text(name: str, text: str) -> Path:
        (tmp_path / name).write_bytes(text.encode())
        return tmp_path / name

    return write_text


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With `pytest -n 2` a file is one worker's: what its tests share is made once."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log)


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Every test starts in the precision of users; a `Side` chooses its own."""
    if jax is not None and "side" not in getattr(item, "fixturenames", ()):
        _compile_for(False)


class Side:
    """One package at one precision: `side.geometry.kabsch(…)` takes and returns numpy arrays.

    Floating arguments are cast to the precision, JAX functions run under jit, and a result in any
    other precision is an error.
    """

    def __init__(self, package: str, dtype: type[np.floating]) -> None:
        self.package, self.dtype = package, np.dtype(dtype)

    def __repr__(self) -> str:
        return f"{self.package}-{self.dtype}"

    @property
    def is_jax(self) -> bool:
        return self.package == "jaxhand"

    @property
    def metres(self) -> float:
        """Tolerance of positions, also fit for entries of rotations. Two tiers: float64 shows what
        is wrong in the algebra, float32 what rounding does to coordinates of a few metres."""
        return 1e-9 if self.dtype == np.float64 else 1e-5

    @property
    def geometry(self) -> _Functions:
        return self.module("geometry")

    @property
    def skeleton(self) -> _Functions:
        return self.module("skeleton")

    def module(self, name: str) -> _Functions:
        """Any other twin."""
        return _Functions(self, importlib.import_module(f"{self.package}.{name}"))

    def cast(self, value: Any) -> Any:
        """Floating arrays in this precision; everything else untouched."""
        if isinstance(value, np.ndarray) and value.dtype.kind == "f":
            return value.astype(self.dtype)
        return value

    def check(self, result: Any) -> Any:
        if isinstance(result, tuple):
            return tuple(map(self.check, result))
        result = np.asarray(result)
        assert result.dtype.kind != "f" or result.dtype == self.dtype, (
            f"{self}: a result in {result.dtype}"
        )
        return result


class _Functions:
    """The functions of one module, as `Side` runs them."""

    def __init__(self, side: Side, module: ModuleType) -> None:
        self._side, self._module = side, module

    def __getattr__(self, name: str) -> Callable[..., Any]:
        side, function = self._side, getattr(self._module, name)

        def run(*arguments: Any) -> Any:
            cast = [side.cast(argument) for argument in arguments]
            if not side.is_jax:
                return side.check(function(*cast))
            static = tuple(i for i, a in enumerate(cast) if not isinstance(a, np.ndarray))
            with x64(side.dtype == np.float64):
                return side.check(_jitted(function, static)(*cast))

        return run


@functools.cache
def _jitted(function: Callable[..., Any], static: tuple[int, ...]) -> Callable[..., Any]:
    return jax.jit(function, static_argnums=static)


@pytest.fixture(
    params=[
        pytest.param((package, dtype), id=f"{package}-{np.dtype(dtype)}")
        for package in ("numpy_infer", "jaxhand")
        for dtype in (np.float32, np.float64)
    ],
    scope="session",
)
def side(request: pytest.FixtureRequest) -> Side:
    """A law that takes `side` is tested on both packages and in both precisions."""
    package, dtype = request.param
    if package == "jaxhand":
        pytest.importorskip("jax")
    return Side(package, dtype)


REFERENCE = Side("numpy_infer", np.float64)
"""What every other side is compared with, where a law asks for the same numbers."""


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real recordings; a test that needs it is skipped where there is none."""
    root = Path(os.environ.get("JAXHAND_DATA", REPOSITORY.parent / "shared" / "data"))
    if not root.is_dir():
        message = f"no real data at {root}; set JAXHAND_DATA"
        if os.environ.get("JAXHAND_REQUIRE_DATA") == "1":
            pytest.fail(message)
        pytest.skip(message)
    return root


@pytest.fixture
def model() -> Model:
    """A model of every part there is."""
    return whole_model()


@pytest.fixture
def path(model: Model, tmp_path: Path) -> Path:
    """Its file."""
    save(model, tmp_path / "model.npz")
    return tmp_path / "model.npz"
