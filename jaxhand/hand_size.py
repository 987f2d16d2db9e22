"""How large a hand is, out of a glove with few markers: as large as the model explains them best.

Few markers cannot tell a long bone from a bent joint. A fit of bones and angles together leans on a
prior for the angles, and makes bones long wherever postures were straighter than that. The joint
network knows postures better than any such prior, so the size is the one in which network and bones
put the markers where they were measured. One number is all that is taken from them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxhand.calibration import FLEXIONS, MOVED
from jaxhand.joint_evaluation import evaluate_poses
from numpy_infer.arrays import Array, floats
from numpy_infer.hand import FINGER_OF_ANGLE, FINGERS, SLOT_OF_ANGLE
from numpy_infer.model import Model
from numpy_infer.skeleton import marker_positions

SIZES = np.exp(np.linspace(-0.25, 0.25, 51))
"""Of the model's hand: three and a half standard deviations of people's (see
`anthropometry.SIZE_SPREAD`), in steps of one per cent."""
FRAMES, FEWEST = 600, 30
"""At most so many frames are looked at, evenly spread; and at least so many are needed."""
FAR = 20e-3
"""Metres: a marker that is farther off is as bad as this one, so that a ghost cannot decide."""
ALIKE = 0.03
"""Hands whose sizes differ by less are taken for one: their bones differ as much beside the size,
and where the markers sit on them. Of 192 simulated people (`experiments/person.py demo/model.npz
--people 64`, seeds 97 to 99) what is found is off by 3.5 %, and 9 are worse off with this."""
BLOCKS, RESAMPLINGS = 20, 1000
"""Of the bootstrap behind the interval: neighbouring frames are much alike."""


class Size(NamedTuple):
    """What is known of a hand's size."""

    factor: float
    """Of the model's hand; 1 where the interval, made wider by `ALIKE`, holds 1: then the model's
    hand will do; and where no finger was seen, for one posture tells no size."""
    likeliest: float
    interval: tuple[float, float]
    """95 %, from blocks of the recording. What one number cannot say of a hand is not in it."""
    off: float
    """Metres: root mean square distance of measured markers from where the model puts them, none
    taken for farther off than `FAR`."""
    seen: Array
    """`[5]` by finger: True once it has moved enough to say how far it reaches."""


def hand_size(model: Model, markers: Array) -> Size:
    """The size of hand in which a model explains a recording best.

    Args:
        model: with a joint network.
        markers: `[T, M, 3]` metres, of a canonical left hand. Not finite: not measured.

    Raises:
        ValueError: no joint network, or fewer than `FEWEST` frames with all markers.
    """
    if model.joint_network is None:
        raise ValueError("the model has no joint network, so there is nothing to calibrate")
    markers = floats(markers)
    complete = np.flatnonzero(np.isfinite(markers).all((-1, -2)))
    if len(complete) < FEWEST:
        raise ValueError(
            f"{len(complete)} frames show all of {', '.join(model.hand.markers)}; "
            f"{FEWEST} are needed"
        )
    spread = np.linspace(0, len(complete) - 1, min(FRAMES, len(complete))).astype(int)
    chosen = np.asarray(markers[complete[spread]], np.float32)
    # Alignment would hide the very distance that tells a size.
    cost, angles = zip(*(_explained(model, chosen, size) for size in SIZES), strict=True)
    blocks = np.stack([part.sum(-1) for part in np.array_split(np.stack(cost), BLOCKS, -1)], -1)
    best = _lowest(blocks.sum(-1))
    drawn = np.random.default_rng(0).integers(BLOCKS, size=(RESAMPLINGS, BLOCKS))
    low, high = np.quantile([_lowest(blocks[:, own].sum(-1)) for own in drawn], (0.025, 0.975))
    nearest = np.abs(SIZES - best).argmin()
    seen = _seen(angles[nearest])
    return Size(
        factor=1.0 if low - ALIKE <= 1 <= high + ALIKE or not seen.any() else best,
        likeliest=best,
        interval=(float(low), float(high)),
        off=float(np.sqrt(cost[nearest].mean())),
        seen=seen,
    )


def _explained(model: Model, markers: Array, size: float) -> tuple[Array, Array]:
    """`[T]` mean square distance of the markers from where the model puts them, in m², and `[T,
    26]` the angles, if the hand is of this size: the same as smaller markers on the model's."""
    model = replace(model, alignment=False, wearer=None, flat=None)
    smaller = markers / np.float32(size)
    poses = evaluate_poses(model, smaller)
    places = marker_positions(model.hand, poses.positions, poses.rotations)
    off = size * np.linalg.norm(places - smaller, axis=-1)
    return (np.minimum(off, FAR) ** 2).mean(-1), poses.angles


def _lowest(cost: Array) -> float:
    """The size at the lowest point of `cost [G]`, by a parabola through it and its neighbours."""
    least = int(np.clip(cost.argmin(), 1, len(SIZES) - 2))
    before, here, after = cost[least - 1 : least + 2]
    curvature = before - 2 * here + after
    aside = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    step = np.log(SIZES[1] / SIZES[0])
    return float(SIZES[least] * np.exp(np.clip(aside, -1, 1) * step))


def _seen(angles: Array) -> Array:
    few, most = np.quantile(angles, [0.05, 0.95], axis=0)
    moved = (most - few > MOVED) | ~np.isin(SLOT_OF_ANGLE, FLEXIONS)
    return np.array([moved[finger == FINGER_OF_ANGLE].all() for finger in range(len(FINGERS))])
