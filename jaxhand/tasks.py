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

from jaxhand.geometry import kabsch, untransform
from jaxhand.networks import arrays_of, build, predict
from jaxhand.skeleton import forward_kinematics, rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.hand import CHAINS, Hand
from numpy_infer.networks import Dense, Network, Spec

JOINT_POINTS = tuple(point for chain in CHAINS for point in chain[1:])
"""PIP, DIP and tip of the fingers; MCP, IP and tip of the thumb: what the angles move."""


class Frames(NamedTuple):
    """Frames to train or validate on, in any order."""

    markers: Array
    """`[N, M, 3]` metres, any frame of reference; all of them measured."""
    angles: Array | None = None
    """`[N, 26]` radians, NaN where a frame has no joint truth; None without any."""
    weight: Array | None = None
    """`[N]` how often a frame is drawn; None draws every frame once an epoch."""


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
    """(key, frames) → scaled inputs `[N, in]` and targets `[N, out]`."""
    measure: Callable[[dict[str, Array]], tuple[Array, Array]]
    """Weights → validation loss, and mean error in metres."""


@partial(jax.jit, static_argnames="shape")
def draw_visible(key: Array, occlusions: Array, shape: tuple[int, int]) -> Array:
    """`[N, M]` False at the markers to hide: k of them with probability `occlusions[k - 1]`, any k
    alike. Three are always left, so that a registration is determined."""
    number_key, order_key = jax.random.split(key)
    frames, markers = shape
    limits = jnp.cumsum(occlusions)[:-1]
    number = 1 + (jax.random.uniform(number_key, (frames, 1)) >= limits).sum(-1)
    order = jax.random.uniform(order_key, shape)
    # Ranks by comparison: sorting is slow on a CPU.
    rank = (order[:, :, None] > order[:, None, :]).sum(-1)
    return rank >= jnp.minimum(number, markers - 3)[:, None]


@jax.jit
def register(template: Array, markers: Array, weight: Array) -> Array:
    """`[N, M, 3]` markers moved rigidly onto the template `[M, 3]` by those of `weight [N, M]`."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=markers.dtype), (*markers.shape[:-2], 3, 3))
    return untransform(*kabsch(template, markers, weight, eye), markers)


def occlude(key: Array, markers: Array, template: Array, occlusions: Array) -> tuple[Array, Array]:
    """Hides markers. Gives `[N, M]` visible, and `[N, M, 3]` all markers as registered by them."""
    visible = draw_visible(key, occlusions, markers.shape[:-1])
    return visible, register(template, markers, visible.astype(markers.dtype))


def _occluded_inputs(
    key: Array, markers: Array, template: Array, occlusions: Array, network: Network
) -> tuple[Array, Array]:
    return _scaled(network, *occlude(key, markers, template, occlusions))


@jax.jit
def _scaled(network: Network, visible: Array, registered: Array) -> tuple[Array, Array]:
    targets = (registered.reshape(len(visible), -1) - network.output_mean) / network.output_scale
    return jnp.where(jnp.repeat(visible, 3, -1), targets, 0), targets


@jax.jit
def _marker_error(
    weights: dict[str, Array], network: Network, visible: Array, truth: Array
) -> tuple[Array, Array]:
    inputs = truth.reshape(len(truth), -1)
    known = jnp.repeat(visible, 3, -1)
    off = predict(replace(network, arrays=weights), inputs, known) - inputs
    distance = _lengths(off.reshape(truth.shape))
    return ((off / network.output_scale) ** 2).mean(), distance.mean(where=~visible)


def marker_task(
    training: Frames,
    validation: Frames,
    hand: Hand,
    key: Array,
    hidden: Spec,
    occlusions: tuple[float, ...],
) -> Task:
    """The marker network: registered visible markers → all markers, in the same frame."""
    template = jnp.asarray(hand.template, jnp.float32)
    markers, held_out = (jnp.asarray(x.markers, jnp.float32) for x in (training, validation))
    registered = register(template, markers, jnp.ones(markers.shape[:-1]))
    mean, scale = registered.mean(0).ravel(), (registered - registered.mean(0)).std()
    network = _untrained(hidden, mean, scale, mean, scale, key)
    probabilities = jnp.asarray(occlusions, jnp.float32)
    hide = partial(_occluded_inputs, template=template, occlusions=probabilities, network=network)
    # The same masks whatever the seed, so that losses of different runs can be compared.
    visible, truth = occlude(jax.random.key(0), held_out, template, probabilities)
    return Task(
        name="marker_network",
        network=network,
        frames=markers,
        weight=_weight(training),
        prepare=hide,
        measure=partial(_marker_error, network=network, visible=visible, truth=truth),
    )


def as_is(key: Array, frames: tuple[Array, Array]) -> tuple[Array, Array]:
    """The `Task.prepare` of frames that are inputs and targets already."""
    return frames


def joint_points(skeleton: Array, angles: Array) -> Array:
    """`[N, 15, 3]` metres, hand frame: where the angles put the points of `JOINT_POINTS`."""
    eye = jnp.broadcast_to(jnp.eye(3), (len(angles), 3, 3))
    origin = jnp.zeros((len(angles), 3))
    positions, _ = forward_kinematics(skeleton, rotations_from_angles(angles), eye, origin)
    return positions[:, np.array(JOINT_POINTS)]


@jax.jit
def _joint_error(
    weights: dict[str, Array], network: Network, skeleton: Array, inputs: Array, truth: Array
) -> tuple[Array, Array]:
    predicted = predict(replace(network, arrays=weights), inputs, jnp.ones(inputs.shape, bool))
    loss = (((predicted - truth) / network.output_scale) ** 2).mean()
    return loss, _lengths(joint_points(skeleton, predicted) - joint_points(skeleton, truth)).mean()


def joint_task(training: Frames, validation: Frames, hand: Hand, key: Array, hidden: Spec) -> Task:
    """The joint network: markers as registered by the alignment markers → the 26 angles."""
    inputs, angles, weight = _aligned(training, hand)
    held_out, truth, _ = _aligned(validation, hand)
    mean, scale = inputs.mean(0), (inputs - inputs.mean(0)).std()
    # One number for all angles: what hardly moves, or was not observed, must not count as much as
    # what moves the fingertips.
    angle_mean, angle_scale = angles.mean(0), (angles - angles.mean(0)).std()
    network = _untrained(hidden, mean, scale, angle_mean, angle_scale, key)
    skeleton = jnp.asarray(hand.skeleton, jnp.float32)
    return Task(
        name="joint_network",
        network=network,
        frames=((inputs - mean) / scale, (angles - angle_mean) / angle_scale),
        weight=weight,
        prepare=as_is,
        measure=partial(
            _joint_error, network=network, skeleton=skeleton, inputs=held_out, truth=truth
        ),
    )


def _aligned(frames: Frames, hand: Hand) -> tuple[Array, Array, Array | None]:
    """Inputs `[N, 3M]` metres, angles `[N, 26]` and weights of the frames with joint truth."""
    known = np.isfinite(np.asarray(frames.angles)).all(-1)
    angles = jnp.asarray(np.asarray(frames.angles)[known], jnp.float32)
    markers = jnp.asarray(np.asarray(frames.markers)[known], jnp.float32)
    alignment = jnp.broadcast_to(jnp.asarray(hand.alignment_weight), markers.shape[:-1])
    aligned = register(jnp.asarray(hand.template, jnp.float32), markers, alignment)
    weight = _weight(frames)
    return aligned.reshape(len(aligned), -1), angles, weight if weight is None else weight[known]


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
