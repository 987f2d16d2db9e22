"""A model of every part there is, and whether another is the same."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from streams import a_model

from numpy_infer.model import ERROR_NUMBERS, Model
from numpy_infer.networks import Network

Array = np.ndarray


def whole_model() -> Model:
    """A model of every part there is, none of them at its default."""
    table = np.linspace(0, 0.05, 12).reshape(2, 6)
    return replace(
        a_model("learned", joints=True, seed=4),
        fade=0.1 + 0.2,  # no short decimal
        continuity=False,
        expected_error=table,
        marker_error=np.linspace(0.1, 2, 9),
        faded_error=0.2 + 0.1,
        error_saturation=17.3,
        least_error=1 / 1300,
        training={"data": ["a", "b"], "loss": 1 / 3, "seed": 0, "note": "Knöchel", "none": None},
    )


def assert_same(one: Model, other: Model) -> None:
    """Every field, bit for bit."""
    assert one.hand.to_json() == other.hand.to_json()
    assert one.hand.template.tobytes() == other.hand.template.tobytes()
    for field in ("predictor", "joints", "fade", *ERROR_NUMBERS, "continuity", "training"):
        assert getattr(one, field) == getattr(other, field)
        assert type(getattr(one, field)) is type(getattr(other, field))
    for name in ("marker_network", "joint_network"):
        mine, theirs = getattr(one, name), getattr(other, name)
        assert (mine is None) == (theirs is None)
        if mine is not None:
            assert mine.spec == theirs.spec
            assert_same_arrays(mine.arrays, theirs.arrays)
            for part in fields(Network)[2:]:
                pair = {0: getattr(mine, part.name)}, {0: getattr(theirs, part.name)}
                assert_same_arrays(*pair)
    assert_same_arrays({0: np.asarray(one.expected_error)}, {0: other.expected_error})
    assert_same_arrays({0: one.error_factors}, {0: other.error_factors})


def assert_same_arrays(one: Any, other: Any) -> None:
    assert one.keys() == other.keys()
    for key, array in one.items():
        assert array.dtype == other[key].dtype
        assert array.shape == other[key].shape
        assert array.tobytes() == other[key].tobytes()


def unpack(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def array_of(content: bytes) -> Array:
    return np.load(io.BytesIO(content))


def header_of(path: Path) -> dict[str, Any]:
    return json.loads(array_of(unpack(path)["header.npy"]).tobytes())
