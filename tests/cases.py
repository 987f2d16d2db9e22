"""Every predictor, on every layout, in both precisions: what the laws of the tracker are crossed
with."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from streams import a_model

from jaxhand import laws, strategies
from jaxhand.strategies import Stream
from jaxhand.trial import ModelTracker
from numpy_infer.model import Model
from numpy_infer.predictors import PREDICTORS

FEW = settings(max_examples=3)
"""Every example is a batch of hands over tens of frames: a few hundred frames each."""


class Case(NamedTuple):
    """A predictor on a layout in a precision."""

    predictor: str
    layout: str = "glove9"
    dtype: type[np.floating] = np.float64

    @property
    def metres(self) -> float:
        """The promise is 1e-5 m. In float32 a metre or two from the origin markers are rounded to
        1e-7 m, and three of them 5 mm off a line pass that on to the rotation a hundredfold."""
        return 1e-5 if self.dtype == np.float64 else 1e-4

    @property
    def radians(self) -> float:
        """The promise is 1e-4 rad. In float32 it is what `metres` is over a lever of 2 cm: a finger
        is turned towards its marker, and a fist's tips are that near to their knuckles."""
        return 1e-4 if self.dtype == np.float64 else 5e-3

    def streams(self, frames: int, hands: int, **kind: Any) -> st.SearchStrategy[Stream]:
        """In float32 without postures pressed nearly to a line: a metre or two from the origin the
        rounding of their coordinates alone turns the hand by more than `metres` allows for."""
        hand, pressed = self.model().hand, self.dtype == np.float64
        return strategies.streams(hand, frames, hands, **{"pressed": pressed, **kind})

    def model(self, **changes: Any) -> Model:
        return _model(self, tuple(sorted(changes.items())))

    def tracker(self, **changes: Any) -> ModelTracker:
        return laws.tracker(self.model(**changes))


@functools.cache
def _model(case: Case, changes: tuple[tuple[str, Any], ...]) -> Model:
    return a_model(*case, **dict(changes))


CASES = [
    *(Case(predictor) for predictor in PREDICTORS),
    Case("affine", "qualisys13"),
    Case("learned", "dense19"),
    Case("moving_average", dtype=np.float32),
    Case("learned", dtype=np.float32),
]


def crossed(cases: list[Case]) -> pytest.MarkDecorator:
    return pytest.mark.parametrize(
        "case", cases, ids=lambda c: "-".join([*c[:2], c.dtype.__name__])
    )


each = crossed(CASES)
