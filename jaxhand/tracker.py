"""The pipeline of one frame, as pure `init` and `step`. Twin of `numpy_infer.tracker`.

Gate → register the visible markers → fill the hidden ones → continuity → hand pose from the
alignment markers → joint angles → calibration → forward kinematics → finger alignment. From frame
to frame: `continuity`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jaxhand import gate, one_euro
from jaxhand.continuity import advance
from jaxhand.geometry import mirror
from jaxhand.output import hand_pose, smoothed, wrist_pose
from jaxhand.predictors import PREDICTORS
from numpy_infer.arrays import Array
from numpy_infer.model import ERROR_CHANGES, Model
from numpy_infer.one_euro import Filter, Smoothing
from numpy_infer.pose import HandPose, State
from numpy_infer.tracker import FARTHEST, LONGEST, SHOWN


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
    template = jnp.broadcast_to(
        jnp.asarray(model.hand.template), (*batch, *model.hand.template.shape)
    )
    dtype, count = template.dtype, len(model.hand)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*batch, 3, 3))
    origin = jnp.zeros((*batch, 3), dtype)
    never = jnp.zeros((*batch, count), bool)
    return State(
        right=jnp.broadcast_to(jnp.asarray(right, bool), batch),
        gate=gate.init(model, batch) if model.gate else (),
        rejected=never,
        predictor=PREDICTORS[model.predictor].init(model, batch),
        smoothing=() if model.smoothing is None else one_euro.init(template),
        output=template,
        wrist_rotation=eye,
        wrist_position=origin,
        markers=jnp.zeros_like(template),
        visible=never,
        tracked=jnp.zeros(batch, bool),
        tracking=jnp.zeros(batch, bool),
        rotation=eye,
        translation=origin,
        seen=template,
        known=never,
        correction=jnp.zeros_like(template),
        anchor=template,
        prior=eye,
        drift=jnp.full((*batch, count), ERROR_CHANGES[-1], dtype),
        change=jnp.zeros(batch, dtype),
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
    state = shown = _posed(model, advance(model, state, markers, visible, elapsed, late))
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
    markers, visible, elapsed, late = _cleaned(state, markers, visible, dt)

    def frame(state: State, of: tuple[Array, ...]) -> tuple[State, dict[str, Array]]:
        state = advance(model, state, *of)
        return state, {name: getattr(state, name) for name in (*SHOWN, "rotation")}

    # The wrist and the joints depend on their own frame alone: they are made of all at once.
    state, shown = jax.lax.scan(frame, state, (markers, visible, elapsed, late))
    right = jnp.broadcast_to(state.right, late.shape)
    every = _posed(model, state._replace(right=right, **shown))
    wrist = every.wrist_rotation[-1], every.wrist_position[-1]
    state = state._replace(wrist_rotation=wrist[0], wrist_position=wrist[1])
    if model.smoothing is not None:
        own, every = _smoothed(model, model.smoothing, state, every, elapsed)
        state = state._replace(smoothing=own)
    return state, hand_pose(model, every, late)


def _posed(model: Model, state: State) -> State:
    """The state with the wrist's pose of its output."""
    rotation, position = wrist_pose(model, state.output, state.rotation)
    return state._replace(wrist_rotation=rotation, wrist_position=position)


def _smoothed(
    model: Model, smoothing: Smoothing, state: State, every: State, dt: Array
) -> tuple[Filter, State]:
    """The output filter's state after many frames, and `every` state with what is to be shown."""

    def frame(own: Filter, of: tuple[Array, ...]) -> tuple[Filter, Array]:
        tracked, markers, elapsed = of
        own = own._replace(begun=own.begun & tracked)
        return one_euro.step(smoothing, own, markers, elapsed)

    own, output = jax.lax.scan(frame, state.smoothing, (every.tracked, every.output, dt))
    rotation, position = wrist_pose(model, output, every.wrist_rotation)
    return own, every._replace(output=output, wrist_rotation=rotation, wrist_position=position)


def _cleaned(
    state: State, markers: Array, visible: Array, dt: Array
) -> tuple[Array, Array, Array, Array]:
    """Markers of a left hand, 0 where hidden; what is visible of them; seconds that have passed,
    and where none have."""
    dtype = state.markers.dtype
    visible = visible & (jnp.abs(markers) < FARTHEST).all(-1)
    markers = jnp.where(visible[..., None], markers, 0).astype(dtype)
    markers = jnp.where(state.right[..., None, None], mirror(markers), markers)
    late = jnp.logical_not(dt > 0)
    return markers, visible, jnp.where(late, 0, jnp.minimum(dt, LONGEST)).astype(dtype), late
