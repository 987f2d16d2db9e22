"""What fills hidden markers, each an `init` and a `step`. Twin of `jaxhand.predictors`.

A predictor sees one frame at a time, in world coordinates, with no need of a complete one before.
`step(model, state, markers, visible, last, dt) -> (state, filled)`:

- markers `[..., M, 3]` metres, world; visible `[..., M]` True where measured; what stands in a
  hidden coordinate is never read;
- last `[..., M, 3]` the previous output, metres, world; finite;
- dt `[...]` seconds since the previous frame, not negative;
- filled `[..., M, 3]` equals `markers` where visible.

With `model.continuity` predictions are made from measured markers only, and the tracker's blend
makes them continuous. Without it a predictor starts from its own last output, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import centre, kabsch, solve, transform, untransform
from numpy_infer.model import Model
from numpy_infer.networks import Network, predict

AVERAGE_SECONDS = 1 / 6
"""Age at which a velocity counts 1/e in the moving average: the mean age of its samples is then
that of the paper's plain mean over 20 frames at 60 Hz."""

SHORTEST = 1e-6
"""Seconds: frames nearer in time say nothing of a velocity, but of the clock."""

RIDGE = 1e-8
"""m²: λ of equation 8."""


class Predictor(NamedTuple):
    """A named way to fill hidden markers."""

    init: Callable[..., Any]
    step: Callable[..., tuple[Any, Array]]
    uses_frame: bool
    """True if a hidden marker follows from this frame's measurements; False if it is held."""
    of_frame: Callable[[Model, Array, Array], Array] | None = None
    """Of one made by `by_frame`: what it says of registered markers."""


class LastKnownState(NamedTuple):
    position: Array
    """`[..., M, 3]` metres, world: where each marker was last measured."""
    known: Array
    """`[..., M]` True once the marker has been measured."""


class MovingAverageState(NamedTuple):
    position: Array
    """`[..., M, 3]` metres, world: where each marker was last measured."""
    known: Array
    """`[..., M]` True once the marker has been measured."""
    visible: Array
    """`[..., M]` True if it was measured in the previous frame."""
    age: Array
    """`[..., M]` seconds since it was measured."""
    path: Array
    """`[..., M, 3]` metres: displacements between measured frames, fading with their age."""
    span: Array
    """`[..., M]` seconds: the durations of those displacements, fading alike."""


class AffineState(NamedTuple):
    frame: Array
    """`[..., M, M, 3]` metres, world: for each marker all markers in the frame that saw it last."""
    known: Array
    """`[..., M, M]` True where `frame` was measured."""
    visible: Array
    """`[..., M]` the previous frame's visible markers."""


def _zeros(model: Model, batch: tuple[int, ...], *shape: int) -> Array:
    return np.zeros((*batch, len(model.hand), *shape), model.hand.template.dtype)


def _false(model: Model, batch: tuple[int, ...], *shape: int) -> Array:
    return np.zeros((*batch, len(model.hand), *shape), bool)


def last_known_init(model: Model, batch: tuple[int, ...] = ()) -> LastKnownState:
    """No marker has been measured yet."""
    return LastKnownState(_zeros(model, batch, 3), _false(model, batch))


def last_known_step(
    model: Model,
    state: LastKnownState,
    markers: Array,
    visible: Array,
    last: Array,
    dt: Array,
) -> tuple[LastKnownState, Array]:
    """Last known position (paper, section 3.2.1): a hidden marker stays where it was measured
    last; one never measured stays where the output has it."""
    position = np.where(visible[..., None], markers, state.position)
    known = visible | state.known
    return LastKnownState(position, known), np.where(known[..., None], position, last)


def moving_average_init(model: Model, batch: tuple[int, ...] = ()) -> MovingAverageState:
    """No marker has been measured yet."""
    return MovingAverageState(
        position=_zeros(model, batch, 3),
        known=_false(model, batch),
        visible=_false(model, batch),
        age=_zeros(model, batch),
        path=_zeros(model, batch, 3),
        span=_zeros(model, batch),
    )


def moving_average_step(
    model: Model,
    state: MovingAverageState,
    markers: Array,
    visible: Array,
    last: Array,
    dt: Array,
) -> tuple[MovingAverageState, Array]:
    """Moving average (paper, section 3.2.1): a hidden marker goes on with the mean velocity of its
    last third of a second. Counted in seconds, from pairs of measured frames alone; a pair with no
    time between its frames says nothing of a velocity."""
    elapsed = dt[..., None]
    paired = visible & state.visible & (elapsed > SHORTEST)
    fade = np.exp(-elapsed / AVERAGE_SECONDS).astype(markers.dtype)
    travelled = np.where(paired[..., None], markers - state.position, 0)
    path = np.where(visible[..., None], state.path * fade[..., None] + travelled, state.path)
    span = np.where(visible, state.span * fade + np.where(paired, elapsed, 0), state.span)
    position = np.where(visible[..., None], markers, state.position)
    age = np.where(visible, 0, state.age + elapsed)
    known = visible | state.known
    velocity = path / np.where(span > 0, span, 1)[..., None]
    filled = np.where(known[..., None], position + velocity * age[..., None], last)
    filled = np.where(visible[..., None], markers, filled)
    return MovingAverageState(position, known, visible, age, path, span), filled


def affine_init(model: Model, batch: tuple[int, ...] = ()) -> AffineState:
    """No marker has been measured yet."""
    markers = len(model.hand)
    return AffineState(
        frame=_zeros(model, batch, markers, 3),
        known=_false(model, batch, markers),
        visible=_false(model, batch),
    )


def affine_step(
    model: Model,
    state: AffineState,
    markers: Array,
    visible: Array,
    last: Array,
    dt: Array,
) -> tuple[AffineState, Array]:
    """Affine combination (paper, equations 3-8): a hidden marker is the combination of the visible
    ones, with weights that sum to 1, that it was when it was seen last."""
    frame, known = state.frame, state.known
    if not model.continuity:
        changed = (visible != state.visible).any(-1)[..., None]
        restart = (changed & ~visible & state.visible.any(-1)[..., None])[..., None]
        frame = np.where(restart[..., None], last[..., None, :, :], frame)
        known = known | restart
    measured = np.where(visible[..., None], markers, 0)
    combined, possible = affine_combination(frame, known & visible[..., None, :], measured)
    predicted = np.where(possible[..., None], combined, last)
    filled = np.where(visible[..., None], markers, predicted)
    now = visible[..., None]
    frame = np.where(now[..., None], measured[..., None, :, :], frame)
    known = np.where(now, visible[..., None, :], known)
    return AffineState(frame, known, visible), filled


def affine_combination(frame: Array, weight: Array, markers: Array) -> tuple[Array, Array]:
    """Each marker as an affine combination of others: W = Y Xᵀ (X Xᵀ + λI)⁻¹ (equation 8).

    In its small form, 3×3 instead of N×N, with coordinates centred on the mean of the markers
    combined. So weights sum to 1 exactly, for any number and arrangement of markers and in float32.

    Args:
        frame: `[..., M, M, 3]` metres: row m holds the frame that marker m is taken from.
        weight: `[..., M, M]` True at the markers that row m may combine.
        markers: `[..., M, 3]` metres: those markers now.

    Returns:
        `[..., M, 3]` metres; `[..., M]` False where there was nothing to combine.
    """
    weight = weight.astype(markers.dtype)
    own = np.swapaxes(np.diagonal(frame, axis1=-3, axis2=-2), -1, -2)
    then, then_mean = centre(frame, weight)
    now, now_mean = centre(markers[..., None, :, :], weight)
    then = then * weight[..., None]
    scatter = np.swapaxes(then, -1, -2) @ then
    # λ must not drown in the rounding of a scatter that is no hand's, or there is no solution.
    trace = scatter[..., 0, 0] + scatter[..., 1, 1] + scatter[..., 2, 2]
    ridge = np.maximum(trace * (2 * np.finfo(markers.dtype).eps), RIDGE)[..., None, None]
    eye = np.eye(3, dtype=markers.dtype)
    coefficients = solve(scatter + ridge * eye, own - then_mean)
    change = np.swapaxes(now, -1, -2) @ (then @ coefficients[..., None])
    return now_mean + change[..., 0], weight.any(-1)


def by_frame(of_frame: Callable[[Model, Array, Array], Array]) -> Predictor:
    """A predictor that looks at one frame, remembers nothing, and is asked for many at once.

    Args:
        of_frame: what it says of all markers, `[..., M, 3]` metres, registered frame; of the model,
            the markers `[..., M, 3]` metres in that frame, of which hidden ones mean nothing, and
            `visible`, which broadcasts to `[..., M]`.
    """

    def step(
        model: Model,
        state: tuple[()],
        markers: Array,
        visible: Array,
        last: Array,
        dt: Array,
    ) -> tuple[tuple[()], Array]:
        template = model.hand.template.astype(markers.dtype)
        measured = np.where(visible[..., None], markers, 0)
        eye = np.broadcast_to(np.eye(3, dtype=markers.dtype), (*visible.shape[:-1], 3, 3))
        registration = kabsch(template, measured, visible.astype(markers.dtype), eye)
        said = of_frame(model, untransform(*registration, measured), visible)
        return state, np.where(visible[..., None], markers, transform(*registration, said))

    return Predictor(none_init, step, uses_frame=True, of_frame=of_frame)


def predicted_markers(model: Model, registered: Array, visible: Array) -> Array:
    """Marker regressor (paper, section 3.2.2): the visible markers, registered to the template, go
    through the network, hidden ones entering as 0.

    Args:
        model: its marker network is run.
        registered: `[..., M, 3]` metres, registered frame.
        visible: what broadcasts to `[..., M]`.

    Returns:
        `[..., M, 3]` metres, registered frame: what it says of all markers.
    """
    network: Network = model.marker_network  # type: ignore[assignment]
    features = registered.reshape(*registered.shape[:-2], -1)
    known = visible.repeat(3, -1)
    return predict(network, features, known).reshape(registered.shape)


def none_init(model: Model, batch: tuple[int, ...] = ()) -> tuple[()]:
    """Nothing is remembered."""
    return ()


def none_step(
    model: Model, state: tuple[()], markers: Array, visible: Array, last: Array, dt: Array
) -> tuple[tuple[()], Array]:
    """No prediction: a hidden marker stays where the output has it."""
    return state, np.where(visible[..., None], markers, last)


BASELINES = ("last_known", "moving_average", "affine")
"""Predictors that need no training, so no model file."""

PREDICTORS: dict[str, Predictor] = {
    "last_known": Predictor(last_known_init, last_known_step, uses_frame=False),
    "moving_average": Predictor(moving_average_init, moving_average_step, uses_frame=False),
    "affine": Predictor(affine_init, affine_step, uses_frame=True),
    "learned": by_frame(predicted_markers),
    "none": Predictor(none_init, none_step, uses_frame=False),
}
