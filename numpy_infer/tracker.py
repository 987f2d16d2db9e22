"""The pipeline of one frame, as pure `init` and `step`. Twin of `jaxhand.tracker`.

Gate → register the visible markers → fill the hidden ones → continuity → hand pose from the
alignment markers → joint angles → calibration → forward kinematics → finger alignment. From frame
to frame: `continuity`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from numpy_infer import gate, one_euro, wearer
from numpy_infer.arrays import Array, floats, some
from numpy_infer.continuity import advance, each
from numpy_infer.geometry import mirror, second_extent
from numpy_infer.hand import Hand
from numpy_infer.model import ERROR_CHANGES, Model, load
from numpy_infer.offline import together
from numpy_infer.one_euro import Filter, Smoothing
from numpy_infer.output import hand_pose, smoothed, wrist_pose
from numpy_infer.pose import DETERMINED_EXTENT, HandPose, State
from numpy_infer.predictors import PREDICTORS

FARTHEST = 1e5
"""Metres: no coordinate is larger; one that is would overflow where it is squared."""

LONGEST = 3600.0
"""Seconds: a longer pause counts as this one, so that nothing extrapolated overflows."""


def init(model: Model, batch: tuple[int, ...] = (), right: Array = False) -> State:
    """A tracker that has seen nothing.

    Args:
        model: what to run.
        batch: leading shape of everything: () for one hand, (hands,) for several.
        right: True for a right hand; broadcast to `batch`.

    Raises:
        ValueError: the model's predictor is not known.
    """
    if model.predictor not in PREDICTORS:
        raise ValueError(
            f"unknown predictor {model.predictor!r}: expected one of {', '.join(PREDICTORS)}"
        )
    template = np.broadcast_to(model.hand.template, (*batch, *model.hand.template.shape))
    dtype, count = template.dtype, len(model.hand)
    eye = np.broadcast_to(np.eye(3, dtype=dtype), (*batch, 3, 3))
    origin = np.zeros((*batch, 3), dtype)
    never = np.zeros((*batch, count), bool)
    return State(
        right=np.broadcast_to(np.asarray(right, bool), batch),
        gate=gate.init(model, batch) if model.gate else (),
        rejected=never,
        predictor=PREDICTORS[model.predictor].init(model, batch),
        smoothing=() if model.smoothing is None else one_euro.init(template),
        output=template,
        wrist_rotation=eye,
        wrist_position=origin,
        markers=np.zeros_like(template),
        visible=never,
        tracked=np.zeros(batch, bool),
        tracking=np.zeros(batch, bool),
        rotation=eye,
        translation=origin,
        seen=template,
        known=never,
        correction=np.zeros_like(template),
        anchor=template,
        prior=eye,
        drift=np.full((*batch, count), ERROR_CHANGES[-1], dtype),
        change=np.zeros(batch, dtype),
    )


def step(
    model: Model, state: State, markers: Array, visible: Array, dt: Array
) -> tuple[State, HandPose]:
    """Takes in one frame.

    Args:
        model: what to run.
        state: from `init` or the previous `step`.
        markers: `[..., M, 3]` metres, world; a marker with a coordinate that is not finite, or
            beyond all measure (`FARTHEST`), is hidden.
        visible: `[..., M]` True where measured; hidden coordinates are never read.
        dt: `[...]` seconds since the previous frame. If it is not positive nothing that runs on
            time moves, and the same markers again change nothing.
    """
    markers, visible, elapsed, late = _cleaned(state, markers, visible, dt)
    state = shown = advance(model, state, markers, visible, elapsed, late)
    if model.smoothing is not None:
        state, shown = smoothed(model, model.smoothing, state, elapsed)
    return state, hand_pose(model, shown, late)


def run(
    model: Model, state: State, markers: Array, visible: Array, dt: Array
) -> tuple[State, HandPose]:
    """Takes in many frames at once: what `step` gives one after the other, within rounding.

    Args:
        model: what to run.
        state: from `init` or the previous `step` or `run`.
        markers: `[T, ..., M, 3]` as `step` takes them; one frame or more.
        visible: `[T, ..., M]` likewise.
        dt: `[T, ...]` likewise.

    Returns:
        The state after the last frame; the poses, everything in them with T in front.
    """
    # Frames in which nothing is out of the ordinary are done together, and the poses of all.
    markers, visible, elapsed, late = _cleaned(state, markers, visible, dt)
    count = len(markers)
    shown = {
        name: np.empty((count, *leaf.shape), leaf.dtype)
        for name in SHOWN
        for leaf in (getattr(state, name),)
    }
    begins = np.ones(count, bool)
    if PREDICTORS[model.predictor].of_frame is not None:
        determined = second_extent(markers, visible.astype(markers.dtype)) > DETERMINED_EXTENT
        alone = (late | ~determined).any(tuple(range(1, late.ndim)))
        begins[1:] = alone[1:] | alone[:-1]
        if model.gate:
            begins[1:] |= (visible[1:] & ~visible[:-1]).any(tuple(range(1, visible.ndim)))
    starts = [*np.flatnonzero(begins), count]
    for start, end in pairwise(starts):
        done, ahead = start, count
        while done < end:
            frames = slice(done, min(done + ahead, end) if done > start else start + 1)
            own, asked = state.gate, (markers[frames], visible[frames], elapsed[frames])
            if model.gate and len(asked[0]) > 1:
                own, passed = gate.ahead(model, own, state.tracked, *asked)
                frames, asked = slice(done, done + passed), tuple(part[:passed] for part in asked)
            several = len(asked[0]) > 1
            states = several and together(model, state, *asked)
            # After a refusal less is asked for, or a recording would be gone through endlessly.
            ahead = min(2 * ahead, count) if states or not several else 2
            if states:
                states = states._replace(gate=each(lambda leaf: leaf[None], own))
            else:
                frames = slice(done, done + 1)
                one = markers[done], visible[done], elapsed[done], late[done]
                states = each(lambda leaf: leaf[None], advance(model, state, *one))
            for name, values in shown.items():
                values[frames] = getattr(states, name)
            state = each(lambda leaf: leaf[-1], states)
            done = frames.stop
    right = np.broadcast_to(state.right, late.shape)
    every = state._replace(right=right, **shown)
    if model.smoothing is not None:
        own, every = _smoothed(model, model.smoothing, state, every, elapsed)
        state = state._replace(smoothing=own)
    return state, hand_pose(model, every, late)


def _smoothed(
    model: Model, smoothing: Smoothing, state: State, every: State, dt: Array
) -> tuple[Filter, State]:
    """The output filter's state after many frames, and `every` state with what is to be shown."""
    # The filter goes frame by frame; the wrists' poses wait until all are done.
    own, output = state.smoothing, np.empty_like(every.output)
    for i, (tracked, markers) in enumerate(zip(every.tracked, every.output, strict=True)):
        own = own._replace(begun=own.begun & tracked)
        own, output[i] = one_euro.step(smoothing, own, markers, dt[i])
    rotation, position = wrist_pose(model, output, every.wrist_rotation)
    return own, every._replace(output=output, wrist_rotation=rotation, wrist_position=position)


_ORIGIN = np.zeros(3)  # a number would be made one each time

SHOWN = (
    *("rejected", "output", "wrist_rotation", "wrist_position", "visible", "tracked", "tracking"),
    *("seen", "correction", "drift", "change"),
)
"""Fields of `State` that the pose is made of."""


def _cleaned(
    state: State, markers: Array, visible: Array, dt: Array
) -> tuple[Array, Array, Array, Array]:
    """Markers of a left hand, 0 where hidden; what is visible of them; seconds that have passed,
    and where none have."""
    dtype = state.markers.dtype
    within = np.abs(markers) < FARTHEST
    visible = visible & within[..., 0] & within[..., 1] & within[..., 2]
    markers = np.where(visible[..., None], markers, _ORIGIN).astype(dtype, copy=False)
    if some(state.right):
        markers = np.where(state.right[..., None, None], mirror(markers), markers)
    late = np.logical_not(dt > 0)  # a Python float's `~` would be a number
    elapsed = np.minimum(dt, LONGEST)
    if some(late):
        elapsed = np.where(late, 0, elapsed)
    if elapsed.dtype != dtype:
        elapsed = elapsed.astype(dtype)
    return markers, visible, elapsed, late


_FLOAT64 = np.dtype(np.float64)


def _numbers(markers: Array, expected: tuple[int, ...]) -> Array:
    """Whatever stands for markers as an array of floats, NaN where it is masked."""
    try:
        return floats(markers)
    except (TypeError, ValueError):
        raise ValueError(
            f"markers: expected numbers of shape {expected}, three NaN for a hidden marker, "
            f"received a {type(markers).__name__} that does not make such an array"
        ) from None


class HandTracker:
    """One hand, or several of one model, frame by frame: `init` and `step` with the state inside.

    `tracker = HandTracker.load("glove9"); pose = tracker.step(markers, dt)`
    """

    def __init__(self, model: Model, *, right: bool | Sequence[bool] = False) -> None:
        """`right`: True for a right hand; a sequence, one entry a hand, for several hands.

        Raises:
            ValueError: no `Model`, its predictor is not known, or a side that is neither.
        """
        if not isinstance(model, Model):
            raise ValueError(
                f"model: expected a Model, received a {type(model).__name__}; HandTracker.load "
                "takes a file, or a bundled model's name"
            )
        self.model = model
        self._right = np.asarray(right)
        if self._right.dtype != bool:  # any text would count as True
            raise ValueError(
                f"right: expected True or False, or one of them for each hand, received {right!r}"
            )
        self._state = init(model, self._right.shape, self._right)
        self._all = np.ones((*self._right.shape, len(model.hand)), bool)

    @classmethod
    def load(
        cls,
        path: str | Path = "glove9",
        *,
        calibration: str | Path | None = None,
        alignment: bool = False,
        gate: bool = True,
        smoothing: Smoothing | None = None,
        right: bool | Sequence[bool] = False,
    ) -> HandTracker:
        """A tracker that runs a model file or, by its name, a bundled model (`model.bundled`), for
        whoever a calibration file describes; with `alignment` fingers are turned towards their
        markers, which takes a third as long again; without `gate` every measurement is believed;
        with `smoothing` what is given out jitters less and lags more, see `one_euro`.

        Raises:
            ValueError: a file is not what it should be, or damaged; see `model.load` and
                `wearer.load`.
        """
        model = replace(load(path), alignment=alignment, gate=gate, smoothing=smoothing)
        if calibration is not None:
            model = wearer.calibrated(model, wearer.load(calibration))
        return cls(model, right=right)

    @property
    def hand(self) -> Hand:
        """The model's hand: marker names in their order, template, skeleton."""
        return self.model.hand

    def reset(self) -> None:
        """Forgets all that was seen."""
        self._state = init(self.model, self._right.shape, self._right)

    def step(self, markers: Array, dt: Array, visible: Array | None = None) -> HandPose:
        """Takes in one frame and gives back the whole hand.

        Args:
            markers: `[M, 3]` (several hands: `[hands, M, 3]`) metres, world, in the order of
                `hand.markers`; NaN, or a masked array's mask, where a marker is hidden, and all of
                a hand that is away.
            dt: seconds since the previous frame; `[hands]` if each has its own.
            visible: `[M]` (several hands: `[hands, M]`) True where measured, if NaN is not to say
                it.

        Raises:
            ValueError: a wrong shape, or no numbers. Wrong data never raise; they show in the
                output's `state`, `status` and `notice`.
        """
        if type(markers) is not np.ndarray or markers.dtype is not _FLOAT64:
            markers = _numbers(markers, (*self._all.shape, 3))
        expected = self._all.shape
        if markers.shape != (*expected, 3):
            raise ValueError(f"markers: expected shape {(*expected, 3)}, received {markers.shape}")
        shown = self._all if visible is None else np.asarray(visible, bool)
        if shown.shape != expected:
            raise ValueError(f"visible: expected shape {expected}, received {shown.shape}")
        elapsed = np.asarray(dt, np.float64)
        if elapsed.shape != self._right.shape:
            if elapsed.shape:
                shapes = " or ".join(str(shape) for shape in sorted({(), self._right.shape}))
                raise ValueError(f"dt: expected shape {shapes}, received {elapsed.shape}")
            elapsed = np.broadcast_to(elapsed, self._right.shape)
        self._state, pose = step(self.model, self._state, markers, shown, elapsed)
        return pose
