"""What each network is to learn: its inputs and targets, out of frames, and its error on others.

Occlusions are simulated: every epoch hides other markers of every frame, registers those left to
the template, and asks for all markers in that registered frame (paper, section 3.2.2).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand import simulation
from jaxhand.geometry import kabsch, untransform
from jaxhand.networks import arrays_of, build, predict
from jaxhand.occlusions import FEWEST_LEFT, Occlusions, draw
from jaxhand.skeleton import forward_kinematics, rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, CHAINS, FINGER_OF_ANGLE, FINGER_OF_POINT, FINGERS, Hand
from numpy_infer.networks import Dense, Network, Spec

JOINT_POINTS = tuple(point for chain in CHAINS for point in chain[1:])
"""PIP, DIP and tip of the fingers; MCP, IP and tip of the thumb: what the angles move."""


class Frames(NamedTuple):
    """Frames to train or validate on, in any order."""

    markers: Array
    """`[N, M, 3]` metres, any frame of reference; NaN where not measured."""
    angles: Array | None = None
    """`[N, 26]` radians, NaN where a frame has no joint truth; None without any."""
    weight: Array | None = None
    """`[N]` how often a frame is drawn; None draws every frame once an epoch."""
    simulated: float = 0.0
    """Share of the frames drawn in whose place fresh ones are simulated."""


class Task(NamedTuple):
    """What sets training one network apart from training another."""

    name: str
    network: Network
    """Untrained: its spec, its first weights and its scaling."""
    frames: Any
    """A tree of arrays `[N, …]`."""
    weight: Array | None
    """`[N]` how often a frame is drawn."""
    prepare: Callable[[Array, Any], tuple[Array, Array]]
    """(key, frames) → scaled inputs `[N, in]` and targets `[N, …]`."""
    loss: Callable[[Array, Array], Array]
    """Scaled outputs `[B, out]` and targets `[B, …]` → what is minimised. A pytree."""
    measure: Callable[[dict[str, Array]], tuple[Array, Array]]
    """Weights → validation loss, and mean error in metres."""


@jax.jit
def draw_visible(key: Array, occlusions: Array, seen: Array) -> Array:
    """`[N, M]` False at the markers to hide, and where `seen [N, M]` is: k of those seen with
    probability `occlusions[k - 1]`, any k alike, `FEWEST_LEFT` at least left."""
    number_key, order_key = jax.random.split(key)
    limits = jnp.cumsum(occlusions)[:-1]
    number = 1 + (jax.random.uniform(number_key, (len(seen), 1)) >= limits).sum(-1)
    order = jnp.where(seen, jax.random.uniform(order_key, seen.shape), 1)
    # Ranks by comparison: sorting is slow on a CPU.
    rank = (order[:, :, None] > order[:, None, :]).sum(-1)
    return seen & (rank >= jnp.minimum(number, seen.sum(-1) - FEWEST_LEFT)[:, None])


@jax.jit
def register(template: Array, markers: Array, weight: Array) -> Array:
    """`[N, M, 3]` markers moved rigidly onto the template `[M, 3]` by those of `weight [N, M]`."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=markers.dtype), (*markers.shape[:-2], 3, 3))
    return untransform(*kabsch(template, markers, weight, eye), markers)


def occlude(
    key: Array, markers: Array, template: Array, occlusions: Array | Occlusions
) -> tuple[Array, Array]:
    """Hides markers. Gives `[N, M]` visible, and `[N, M, 3]` all markers as registered by them, NaN
    where not measured."""
    seen = jnp.isfinite(markers).all(-1)
    if isinstance(occlusions, Occlusions):
        drawn = seen & draw(key, occlusions, seen.shape)
        visible = jnp.where(drawn.sum(-1, keepdims=True) >= FEWEST_LEFT, drawn, seen)
    else:
        visible = draw_visible(key, occlusions, seen)
    registered = register(
        template, jnp.where(seen[..., None], markers, 0), visible.astype(markers.dtype)
    )
    return visible, jnp.where(seen[..., None], registered, jnp.nan)


def _occluded_inputs(
    key: Array,
    markers: Array,
    hand: Hand,
    sizes: float,
    simulated: float,
    occlusions: Array | Occlusions,
    network: Network,
) -> tuple[Array, Array]:
    if sizes:
        markers = _resized(jax.random.fold_in(key, 2), markers, sizes)
    if simulated:
        markers, _ = _renewed(jax.random.fold_in(key, 1), hand, simulated, markers)
    template = jnp.asarray(hand.template, jnp.float32)
    return _scaled(network, *occlude(key, markers, template, occlusions))


def _resized(key: Array, markers: Array, spread: float) -> Array:
    """The frames as larger and smaller people would have made them; where registration puts them
    does not depend on the point they grow from."""
    grown = jnp.exp(spread * jax.random.normal(key, (len(markers), 1, 1), markers.dtype))
    return grown * markers


@partial(jax.jit, static_argnames=("hand", "share"))
def _renewed(
    key: Array, hand: Hand, share: float, markers: Array, angles: Array | None = None
) -> tuple[Array, Array | None]:
    """The frames with a share of them replaced by simulated ones: other people, other postures."""
    draw_key, share_key = jax.random.split(key)
    drawn, drawn_angles = simulation.frames(draw_key, hand, len(markers))
    chosen = jax.random.uniform(share_key, (len(markers), 1)) < share
    markers = jnp.where(chosen[..., None], drawn, markers)
    return markers, None if angles is None else jnp.where(chosen, drawn_angles, angles)


@jax.jit
def _scaled(network: Network, visible: Array, registered: Array) -> tuple[Array, Array]:
    targets = (registered.reshape(len(visible), -1) - network.output_mean) / network.output_scale
    return jnp.where(jnp.repeat(visible, 3, -1), targets, 0), targets


@jax.jit
def _marker_error(
    weights: dict[str, Array], network: Network, visible: Array, truth: Array
) -> tuple[Array, Array]:
    measured = jnp.isfinite(truth)
    inputs = jnp.where(measured, truth, 0).reshape(len(truth), -1)
    known = jnp.repeat(visible, 3, -1)
    off = predict(replace(network, arrays=weights), inputs, known) - inputs
    distance = _lengths(off.reshape(truth.shape))
    square = ((off / network.output_scale) ** 2).mean(where=measured.reshape(off.shape))
    return square, distance.mean(where=measured[..., 0] & ~visible)


def marker_task(
    training: Frames,
    validation: Frames,
    hand: Hand,
    key: Array,
    hidden: Spec,
    occlusions: tuple[float, ...] | Occlusions,
    start: Network | None = None,
    sizes: float = 0.0,
) -> Task:
    """The marker network: registered visible markers → all markers, in the same frame.

    Markers that were not measured count for nothing, neither as inputs nor as targets. `start`: the
    network to go on from, instead of a new one with layers `hidden`. `sizes`: in every epoch each
    frame that is not simulated is of another size, by as much as a standard deviation, as a part
    of 1.
    """
    template = jnp.asarray(hand.template, jnp.float32)
    markers, held_out = (jnp.asarray(x.markers, jnp.float32) for x in (training, validation))
    known = isinstance(occlusions, Occlusions)
    how = occlusions if known else jnp.asarray(occlusions, jnp.float32)
    network = start or _new_marker_network(markers, hand, key, hidden)
    hide = partial(
        _occluded_inputs,
        hand=hand,
        sizes=sizes,
        simulated=training.simulated,
        occlusions=how,
        network=replace(network, arrays={}),
    )
    # The same masks whatever the seed, so that losses of different runs can be compared.
    visible, truth = occlude(jax.random.key(0), held_out, template, how)
    whole = bool(np.isfinite(training.markers).all())
    return Task(
        name="marker_network",
        network=network,
        frames=markers,
        weight=_weight(training),
        prepare=hide,
        loss=mean_square if whole else mean_square_of_measured,
        measure=partial(_marker_error, network=network, visible=visible, truth=truth),
    )


def _new_marker_network(markers: Array, hand: Hand, key: Array, hidden: Spec) -> Network:
    seen, template = jnp.isfinite(markers).all(-1), jnp.asarray(hand.template, jnp.float32)
    registered = register(
        template, jnp.where(seen[..., None], markers, 0), seen.astype(markers.dtype)
    )
    # A marker that no frame has is simulated, about where the hand has it.
    mean = registered.mean(0, where=seen[..., None])
    mean = jnp.where(seen.any(0)[:, None], mean, template)
    scale = (registered - mean).std(where=seen[..., None])
    return _untrained(hidden, mean.ravel(), scale, mean.ravel(), scale, key)


def _mean_square(outputs: Array, targets: Array) -> Array:
    return ((outputs - targets) ** 2).mean()


def _mean_square_of_measured(outputs: Array, targets: Array) -> Array:
    known = jnp.isfinite(targets)
    return (jnp.where(known, outputs - targets, 0) ** 2).mean(where=known)


mean_square = jax.tree_util.Partial(_mean_square)
"""The paper's loss (section 3.4)."""
mean_square_of_measured = jax.tree_util.Partial(_mean_square_of_measured)
"""The same over the markers that were measured."""


def joint_points(skeleton: Array, angles: Array) -> Array:
    """`[N, 15, 3]` metres, hand frame: where the angles put the points of `JOINT_POINTS`."""
    eye = jnp.broadcast_to(jnp.eye(3), (len(angles), 3, 3))
    origin = jnp.zeros((len(angles), 3))
    positions, _ = forward_kinematics(skeleton, rotations_from_angles(angles), eye, origin)
    return positions[:, np.array(JOINT_POINTS)]


class Augmentation(NamedTuple):
    """How the joint network's frames are made more than were recorded."""

    mixed: float
    """Share of frames in which each finger is taken from another frame."""
    drawn: float
    """Share of frames that are drawn postures, on the training skeleton."""


def mix_fingers(key: Array, hand: Hand, markers: Array, angles: Array) -> tuple[Array, Array]:
    """Makes frames of fingers from different frames, each with its markers and its angles.

    Args:
        hand: says which finger carries a marker; those on the wrist stay.
        markers: `[N, M, 3]` metres, hand frame, where fingers do not depend on each other.
        angles: `[N, 26]` radians.
    """
    finger_of_marker = FINGER_OF_POINT[list(hand.links)]
    for finger in range(len(FINGERS)):
        order = jax.random.permutation(jax.random.fold_in(key, finger), len(markers))
        own = (finger_of_marker == finger)[:, None]
        markers = jnp.where(own, markers[order], markers)
        angles = jnp.where(finger == FINGER_OF_ANGLE, angles[order], angles)
    return markers, angles


@partial(jax.jit, static_argnames=("augmentation", "simulated", "hand"))
def _joint_frames(
    key: Array,
    frames: tuple[Array, Array],
    augmentation: Augmentation,
    simulated: float,
    hand: Hand,
    network: Network,
    point_scale: Array,
) -> tuple[Array, Array]:
    """`Task.prepare`. simulated: see `Frames.simulated`; what is augmented is the rest."""
    markers, angles = frames
    mix_key, share_key, draw_key = jax.random.split(key, 3)
    share = jax.random.uniform(share_key, (len(markers), 1))
    if augmentation.mixed:
        mixed, mixed_angles = mix_fingers(mix_key, hand, markers, angles)
        chosen = share < augmentation.mixed
        markers = jnp.where(chosen[..., None], mixed, markers)
        angles = jnp.where(chosen, mixed_angles, angles)
    if augmentation.drawn:
        drawn_angles = simulation.poses(draw_key, (len(markers),))
        drawn = simulation.still_markers(hand, hand.skeleton, drawn_angles)
        chosen = share > 1 - augmentation.drawn
        markers = jnp.where(chosen[..., None], drawn, markers)
        angles = jnp.where(chosen, drawn_angles, angles)
    if simulated:
        # People differ in where the alignment markers put their hand frame.
        fresh_key = jax.random.fold_in(key, 1)
        markers, angles = _renewed(fresh_key, hand, simulated, markers, angles)
        markers = align(markers, hand)
    inputs = (markers.reshape(len(markers), -1) - network.input_mean) / network.input_scale
    return inputs, _joint_targets(angles, hand.skeleton, network, point_scale)


def _joint_targets(angles: Array, skeleton: Array, network: Network, point_scale: Array) -> Array:
    """`[N, 26 + 45]` scaled angles, then the scaled joint positions that they make."""
    scaled = (angles - network.output_mean) / network.output_scale
    points = joint_points(jnp.asarray(skeleton, jnp.float32), angles) / point_scale
    return jnp.concatenate([scaled, points.reshape(len(angles), -1)], -1)


def _joint_loss(
    outputs: Array,
    targets: Array,
    weight: Array,
    skeleton: Array,
    network: Network,
    point_scale: Array,
) -> Array:
    """MSE of the scaled angles (paper, section 3.4) and `weight` times that of the scaled joint
    positions, through forward kinematics."""
    scaled, points = targets[:, : len(ANGLES)], targets[:, len(ANGLES) :]
    angles = network.output_mean + network.output_scale * outputs
    found = joint_points(skeleton, angles).reshape(points.shape) / point_scale
    return ((outputs - scaled) ** 2).mean() + weight * ((found - points) ** 2).mean()


def _angle_loss(outputs: Array, targets: Array) -> Array:
    return ((outputs - targets[:, : len(ANGLES)]) ** 2).mean()


@jax.jit
def _joint_error(
    weights: dict[str, Array],
    network: Network,
    skeleton: Array,
    inputs: Array,
    truth: Array,
    targets: Array,
    loss: Callable[[Array, Array], Array],
) -> tuple[Array, Array]:
    predicted = predict(replace(network, arrays=weights), inputs, jnp.ones(inputs.shape, bool))
    scaled = (predicted - network.output_mean) / network.output_scale
    off = joint_points(skeleton, predicted) - joint_points(skeleton, truth)
    return loss(scaled, targets), _lengths(off).mean()


def joint_task(
    training: Frames,
    validation: Frames,
    hand: Hand,
    key: Array,
    hidden: Spec,
    position_weight: float,
    augmentation: Augmentation,
    start: Network | None = None,
) -> Task:
    """The joint network: markers as registered by the alignment markers → the 26 angles. `start`:
    the network to go on from, instead of a new one with layers `hidden`."""
    markers, angles, weight = _aligned(training, hand)
    held_out, truth, _ = _aligned(validation, hand)
    network = start or _new_joint_network(markers, angles, key, hidden)
    skeleton = jnp.asarray(hand.skeleton, jnp.float32)
    points = joint_points(skeleton, angles)
    point_scale = (points - points.mean(0)).std()
    loss = jax.tree_util.Partial(_angle_loss)
    if position_weight:
        loss = jax.tree_util.Partial(
            _joint_loss,
            weight=jnp.float32(position_weight),
            skeleton=skeleton,
            network=replace(network, arrays={}),
            point_scale=point_scale,
        )
    shared = {"network": replace(network, arrays={}), "point_scale": point_scale}
    return Task(
        name="joint_network",
        network=network,
        frames=(markers, angles),
        weight=weight,
        prepare=partial(
            _joint_frames,
            augmentation=augmentation,
            simulated=training.simulated,
            hand=hand,
            **shared,
        ),
        loss=loss,
        measure=partial(
            _joint_error,
            network=network,
            skeleton=skeleton,
            inputs=held_out.reshape(len(held_out), -1),
            truth=truth,
            targets=_joint_targets(truth, skeleton, **shared),
            loss=loss,
        ),
    )


def _new_joint_network(markers: Array, angles: Array, key: Array, hidden: Spec) -> Network:
    inputs = markers.reshape(len(markers), -1)
    mean, scale = inputs.mean(0), (inputs - inputs.mean(0)).std()
    # One number for all angles: what hardly moves, or was not observed, must not count as much as
    # what moves the fingertips.
    angle_mean, angle_scale = angles.mean(0), (angles - angles.mean(0)).std()
    return _untrained(hidden, mean, scale, angle_mean, angle_scale, key)


def complete(frames: Frames) -> Array:
    """`[N]` True where a frame has joint truth and all markers: what a joint network is shown."""
    angles = np.isfinite(np.asarray(frames.angles)).all(-1)
    return angles & np.isfinite(np.asarray(frames.markers)).all((-1, -2))


def _aligned(frames: Frames, hand: Hand) -> tuple[Array, Array, Array | None]:
    """Markers `[N, M, 3]` metres, hand frame, angles `[N, 26]` and weights of complete frames."""
    known = complete(frames)
    angles = jnp.asarray(np.asarray(frames.angles)[known], jnp.float32)
    markers = jnp.asarray(np.asarray(frames.markers)[known], jnp.float32)
    weight = _weight(frames)
    return align(markers, hand), angles, weight if weight is None else weight[known]


def align(markers: Array, hand: Hand) -> Array:
    """`[N, M, 3]` metres: frames moved to the hand frame by the alignment markers."""
    alignment = jnp.broadcast_to(jnp.asarray(hand.alignment_weight), markers.shape[:-1])
    return register(jnp.asarray(hand.template, jnp.float32), markers, alignment)


def _untrained(
    hidden: Spec,
    input_mean: Array,
    input_scale: Array,
    output_mean: Array,
    output_scale: Array,
    key: Array,
) -> Network:
    """A network with random weights; the scales `[]` hold for all its inputs and outputs."""
    inputs, outputs = input_mean.shape[0], output_mean.shape[0]
    spec = (*hidden, Dense(outputs, "linear"))
    return Network(
        spec,
        arrays_of(build(spec, inputs, key)),
        input_mean,
        jnp.broadcast_to(input_scale, (inputs,)),
        output_mean,
        jnp.broadcast_to(output_scale, (outputs,)),
    )


def _weight(frames: Frames) -> Array | None:
    return None if frames.weight is None else jnp.asarray(frames.weight, jnp.float32)


def _lengths(vectors: Array) -> Array:
    return jnp.sqrt((vectors * vectors).sum(-1))
