"""Imports run one way, the runtime needs numpy alone, and twins have the same face."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

import numpy_infer
from numpy_infer.cli import VERBS

ROOT = Path(numpy_infer.__file__).resolve().parents[1]

TWINS = (
    *("geometry", "skeleton", "networks", "predictors", "joints", "output", "gate", "continuity"),
    *("one_euro", "tracker"),
)

ONE_SIDED = {
    # What XLA must be told about small matrix products; numpy has `@`.
    # And halves of `kabsch`, for the pipeline of one frame; XLA takes apart what it compiles.
    "geometry": {"inner", "product", "pattern", "fit", "folded", "refit", "squares"},
    # An IMU glove's rotations are no angles; the runtime has its fingers from angles.
    "skeleton": {"align_fingers"},
    # For many frames at once, in `offline`: JAX scans over them.
    "continuity": {"blend", "blended", "each", "filled", "posture_change"},
    "gate": {"ahead"},
    # The spec and its file format exist once, in numpy; the flax module only beside JAX.
    "networks": {
        *("array_shapes", "read_spec", "write_spec"),
        *("arrays_of", "build", "from_arrays"),
    },
}
"""Public functions that only one of two twins has, with the reason."""

LOADED = """
import sys
before = {name.partition(".")[0] for name in sys.modules}
import numpy
import REPLACED
after = {name.partition(".")[0] for name in sys.modules} - before
allowed = set(sys.stdlib_module_names) | {"numpy", "numpy_infer", OWN}
print(" ".join(sorted(name for name in after - allowed if not name.startswith("__"))))
"""


def modules(package: ModuleType) -> list[str]:
    """All modules of a package by name, found without importing them."""
    found = pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    return [package.__name__, *(module.name for module in found)]


def surplus(*imports: str, own: str = "numpy_infer") -> set[str]:
    """Top-level modules that a fresh Python has loaded after `imports`, other than numpy, the
    standard library, `numpy_infer` and `own`."""
    code = LOADED.replace("REPLACED", ", ".join(imports)).replace("OWN", repr(own))
    # -I would be cleaner still, but the checkout may not be installed.
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    return set(run.stdout.split())


def test_the_runtime_loads_numpy_and_the_standard_library_alone() -> None:
    runnable = [name for name in modules(numpy_infer) if not name.endswith("__main__")]
    assert len(runnable) > 4
    assert surplus(*runnable) == set()


def test_the_test_above_can_fail() -> None:
    assert "pluggy" in surplus("numpy_infer", "pluggy")  # small, and pytest brings it
    assert "jaxhand" in surplus("numpy_infer.hand", "jaxhand")


def test_it_would_see_jax() -> None:
    pytest.importorskip("jax")
    assert {"jax", "jaxlib"} <= surplus("numpy_infer", "jax")


def test_jaxhand_alone_loads_neither_jax_nor_any_extra() -> None:
    assert surplus("jaxhand", own="jaxhand") == set()


@pytest.mark.parametrize("name", [n for n in modules(numpy_infer) if n != "numpy_infer"])
def test_no_line_of_the_runtime_imports_more_not_even_later(name: str) -> None:
    file = ROOT / Path(*name.split("."))
    source = file.with_suffix(".py") if file.with_suffix(".py").exists() else file / "__init__.py"
    found = set()
    for node in ast.walk(ast.parse(source.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            found.add((node.module or "").partition(".")[0])
    assert found <= set(sys.stdlib_module_names) | {"numpy", "numpy_infer"}


WITHOUT = """
import sys
for name in ("jax", "flax", "optax", "tyro", "rich", "orbax"):
    sys.modules[name] = None  # as if not installed
from numpy_infer.cli import main
sys.exit(main(["VERB"]))
"""


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_that_needs_more_than_numpy_says_what_to_install(verb: str) -> None:
    code = WITHOUT.replace("VERB", verb)
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert run.returncode == 2, run.stderr
    assert "pip install 'jaxhand[train]'" in run.stderr
    assert run.stderr.count("\n") == 1


# -- twins -------------------------------------------------------------------------------------


def twin(package: str, name: str) -> ModuleType:
    if not (ROOT / package / f"{name}.py").exists():
        pytest.skip(f"{package}.{name} is not there yet")
    if package == "jaxhand":
        pytest.importorskip("jax")
    return importlib.import_module(f"{package}.{name}")


def public_functions(module: ModuleType) -> dict[str, Callable[..., object]]:
    """The functions that a module defines (not those it imports) for others. Types are not
    compared: they exist once, in numpy_infer."""
    return {
        name: value
        for name, value in vars(module).items()
        if not name.startswith("_")
        and inspect.isfunction(value)
        and value.__module__ == module.__name__
    }


def first_sentence(value: object) -> str:
    return re.split(r"[.:;](?:\s|$)", " ".join((inspect.getdoc(value) or "").split()))[0]


def differences(
    numpy_side: dict[str, Callable[..., object]], jax_side: dict[str, Callable[..., object]]
) -> list[str]:
    """What keeps two modules from being twins, in words."""
    found = [f"only in one of them: {name}" for name in numpy_side.keys() ^ jax_side.keys()]
    for name in sorted(numpy_side.keys() & jax_side.keys()):
        ours, theirs = numpy_side[name], jax_side[name]
        if first_sentence(ours) != first_sentence(theirs):
            found.append(f"{name}: {first_sentence(ours)!r} is not {first_sentence(theirs)!r}")
        one, other = str(inspect.signature(ours)), str(inspect.signature(theirs))
        if one != other:
            found.append(f"{name}: {one} is not {other}")
    return found


@pytest.mark.parametrize("name", TWINS)
def test_twins_have_the_same_functions_signatures_and_docstrings(name: str) -> None:
    sides = [public_functions(twin(package, name)) for package in ("numpy_infer", "jaxhand")]
    both = sides[0].keys() & sides[1].keys()
    one_sided = ONE_SIDED.get(name, set())
    assert both
    assert not both & one_sided, "no longer one-sided"
    numpy_side, jax_side = ({k: v for k, v in s.items() if k not in one_sided} for s in sides)
    assert differences(numpy_side, jax_side) == []


def test_a_difference_between_twins_is_seen() -> None:
    def step(state: int, dt: float) -> int:
        """Moves on."""
        return state

    def swapped(dt: float, state: int) -> int:
        """Moves on."""
        return state

    def reworded(state: int, dt: float) -> int:
        """Goes on."""
        return state

    assert differences({"step": step}, {"step": step}) == []
    assert differences({"step": step}, {"step": swapped})
    assert differences({"step": step}, {"step": reworded})
    assert differences({"step": step}, {})
    assert differences({}, {"step": step})
