"""What fills hidden markers, each an `init` and a `step`. Twin of `numpy_infer.predictors`.

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

import jax.numpy as jnp

from jaxhand.compiled import apart
from jaxhand.geometry import centre, inner, kabsch, product, solve, transform, untransform
from jaxhand.networks import predict
from numpy_infer.arrays import Array
from numpy_infer.model import Model
from numpy_infer.networks import Network
from numpy_infer.predictors import (
    AVERAGE_SECONDS,
    RIDGE,
    SHORTEST,
    AffineState,
    LastKnownState,
    MovingAverageState,
    Predictor,
)


def _zeros(model: Model, batch: tuple[int, ...], *shape: int) -> Array:
    return jnp.zeros((*batch, len(model.hand), *shape), jnp.asarray(model.hand.template).dtype)


def _false(model: Model, batch: tuple[int, ...], *shape: int) -> Array:
    return jnp.zeros((*batch, len(model.hand), *shape), bool)


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
    position = jnp.where(visible[..., None], markers, state.position)
    known = visible | state.known
    return LastKnownState(position, known), jnp.where(known[..., None], position, last)


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
    fade = jnp.exp(-elapsed / AVERAGE_SECONDS).astype(markers.dtype)
    travelled = jnp.where(paired[..., None], markers - state.position, 0)
    path = jnp.where(visible[..., None], state.path * fade[..., None] + travelled, state.path)
    span = jnp.where(visible, state.span * fade + jnp.where(paired, elapsed, 0), state.span)
    position = jnp.where(visible[..., None], markers, state.position)
    age = jnp.where(visible, 0, state.age + elapsed)
    known = visible | state.known
    velocity = path / jnp.where(span > 0, span, 1)[..., None]
    filled = jnp.where(known[..., None], position + velocity * age[..., None], last)
    filled = jnp.where(visible[..., None], markers, filled)
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
        frame = jnp.where(restart[..., None], last[..., None, :, :], frame)
        known = known | restart
    measured = jnp.where(visible[..., None], markers, 0)
    combined, possible = affine_combination(frame, known & visible[..., None, :], measured)
    predicted = jnp.where(possible[..., None], combined, last)
    filled = jnp.where(visible[..., None], markers, predicted)
    now = visible[..., None]
    frame = jnp.where(now[..., None], measured[..., None, :, :], frame)
    known = jnp.where(now, visible[..., None, :], known)
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
    own = jnp.swapaxes(jnp.diagonal(frame, axis1=-3, axis2=-2), -1, -2)
    then, then_mean = centre(frame, weight)
    now, now_mean = centre(markers[..., None, :, :], weight)
    then = then * weight[..., None]
    scatter = apart(inner(then, then))
    # λ must not drown in the rounding of a scatter that is no hand's, or there is no solution.
    trace = scatter[..., 0, 0] + scatter[..., 1, 1] + scatter[..., 2, 2]
    ridge = jnp.maximum(trace * (2 * jnp.finfo(markers.dtype).eps), RIDGE)[..., None, None]
    eye = jnp.eye(3, dtype=markers.dtype)
    coefficients = apart(solve(scatter + ridge * eye, own - then_mean))
    shares = apart(product(then, coefficients[..., None]))
    return now_mean + inner(now, shares)[..., 0], weight.any(-1)


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
        template = jnp.asarray(model.hand.template, markers.dtype)
        measured = jnp.where(visible[..., None], markers, 0)
        eye = jnp.broadcast_to(jnp.eye(3, dtype=markers.dtype), (*visible.shape[:-1], 3, 3))
        registration = kabsch(template, measured, visible.astype(markers.dtype), eye)
        said = of_frame(model, untransform(*registration, measured), visible)
        return state, jnp.where(visible[..., None], markers, transform(*registration, said))

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
    known = jnp.repeat(visible, 3, -1)
    return predict(network, features, known).reshape(registered.shape)


def none_init(model: Model, batch: tuple[int, ...] = ()) -> tuple[()]:
    """Nothing is remembered."""
    return ()


def none_step(
    model: Model, state: tuple[()], markers: Array, visible: Array, last: Array, dt: Array
) -> tuple[tuple[()], Array]:
    """No prediction: a hidden marker stays where the output has it."""
    return state, jnp.where(visible[..., None], markers, last)


PREDICTORS: dict[str, Predictor] = {
    "last_known": Predictor(last_known_init, last_known_step, uses_frame=False),
    "moving_average": Predictor(moving_average_init, moving_average_step, uses_frame=False),
    "affine": Predictor(affine_init, affine_step, uses_frame=True),
    "learned": by_frame(predicted_markers),
    "none": Predictor(none_init, none_step, uses_frame=False),
}
