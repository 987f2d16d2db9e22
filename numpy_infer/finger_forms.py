"""What of a finger is linear: in products of 1, cosine and sine of its angles, and in waves.

Three angles one after the other turn a finger's base, and three what lies beyond it. Everything
that `skeleton` asks about such a chain is linear in those products, so in constants of a hand.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, CHAINS, FINGERS, JOINTS, THUMB_AXES, Hand


def _axis(letter: str, joint: str) -> list[float]:
    axes = np.array(THUMB_AXES) if joint.startswith("thumb") else np.eye(3)
    return list(axes[:, "xyz".index(letter)])


def _cross_matrix(axis: list[float]) -> Array:
    x, y, z = axis
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


SIGNS = np.array([angle.sign for angle in ANGLES])
CROSS = np.stack([_cross_matrix(_axis(angle.axis, angle.joint)) for angle in ANGLES])
"""`[26, 3, 3]` cross-product matrices of the angles' axes in the flat hand's frame."""

CROSS_SQUARED = CROSS @ CROSS

JOINT_AXES = np.stack(
    [np.array(THUMB_AXES) if joint.startswith("thumb") else np.eye(3) for joint in JOINTS[1:]]
)
"""`[15, 3, 3]` the joints' own axes in the flat hand, as columns."""

BASE_ANGLES = np.array([[i for i, a in enumerate(ANGLES) if a.joint == j] for j in JOINTS[1::3]])
"""`[5, 3]` the angles of each finger's base: about its x, y and z."""

_BEYOND_BASE = (
    ("thumb_mcp_flexion", "thumb_mcp_abduction", "thumb_ip_flexion"),
    *((f"{finger}_pip_flexion", None, f"{finger}_dip_flexion") for finger in FINGERS[1:]),
)
_NAMES = [angle.name for angle in ANGLES]
OUTER_ANGLES = np.array([[_NAMES.index(name or row[0]) for name in row] for row in _BEYOND_BASE])
"""`[5, 3]` the angles beyond each finger's base: of its middle joint flexion and abduction, which
only a thumb has, and flexion of its last joint."""
FLEXIONS = OUTER_ANGLES[:, [0, 2]]

_TURNING = SIGNS[OUTER_ANGLES] * np.array(
    [[name is not None for name in row] for row in _BEYOND_BASE]
)
_SIGNED_CROSS = np.stack(
    [
        (SIGNS[:, None, None] * CROSS)[BASE_ANGLES],
        _TURNING[..., None, None] * CROSS[OUTER_ANGLES],
    ],
    1,
)
_SIGNED_SQUARED = _SIGNED_CROSS @ _SIGNED_CROSS
_WAVES = np.stack([np.eye(3) + _SIGNED_SQUARED, -_SIGNED_SQUARED, _SIGNED_CROSS], 3)
"""`[5, 2, 3, 3, 3, 3]` of the angles at each finger's base, and beyond it: what 1, cosine and sine
of the angle are worth in its rotation."""

FINGER_ANGLES = np.stack([BASE_ANGLES, OUTER_ANGLES], 1)
"""`[5, 2, 3]` of each finger those of its base, and those beyond."""
_BEYOND = np.array(CHAINS)[:, 1:]
"""`[5, 3]` the points of each finger after its base."""
_TURN = "fiab,fjbc,fkcd->fijkad"
BASE_FORM = np.einsum(_TURN, *np.moveaxis(_WAVES[:, 0], 1, 0)).reshape(5, 27, 9)
"""The rotation of a finger's base, linear in such products of its angles."""


class FingerForms(NamedTuple):
    """What stands beyond the fingers' bases, linear in products of 1, cosine and sine of the angles
    `OUTER_ANGLES`, the last one's running fastest."""

    beyond: Array
    """`[5, 27, 30]` in the base joint's frame, as `[3, 10]`: the points after the base, metres; the
    rotations of the two joints; the outermost marker, metres."""
    square: Array
    """`[5, 9, 3]` m²: the square of that marker's distance from the base."""


_FIRST, _SIDE, _LAST = np.moveaxis(_WAVES[:, 1], 1, 0)
_MIDDLE = np.einsum("fiab,fjbc->fijac", _FIRST, _SIDE)
_OUTER = np.einsum(_TURN, _FIRST, _SIDE, _LAST)


def finger_forms(hand: Hand, xp: Any = np) -> FingerForms:
    """The forms of a hand's bones and markers; `xp` is numpy, or `jax.numpy` for traced ones."""
    arms = _end_arms(hand, xp)
    # Of 1, cosine and sine: 1 alone.
    one, middle, outer, last = (
        xp.asarray(part, arms.dtype) for part in (np.eye(3)[0], _MIDDLE, _OUTER, _LAST)
    )

    def point(parts: Array) -> Array:
        """`[5, 3, 3, 3, 3]` of three parts `[5, 3, 3]`, each carried by a further joint."""
        near = xp.einsum("i,j,k,fa->fijka", one, one, one, parts[:, 0])
        between = xp.einsum("fijac,fc,k->fijka", middle, parts[:, 1], one)
        return near + between + xp.einsum("fijkad,fd->fijka", outer, parts[:, 2])

    bones = xp.asarray(hand.skeleton)[_BEYOND]
    points = [point(xp.where(np.arange(3)[:, None] <= n, bones, 0)) for n in range(3)]
    turns = xp.einsum("fijac,k->fijkac", middle, one), outer
    columns = [xp.stack(points, -1), *turns, point(arms)[..., None]]
    out = xp.einsum("fkcd,fd->fkc", last, arms[:, 2])
    inner = xp.einsum("fijac,fc,k->fijka", middle, arms[:, 1], one)
    inner = inner + xp.einsum("fijac,fkc->fijka", middle, out)
    square = 2 * xp.einsum("fa,fijka->fijk", arms[:, 0], inner)
    square = square + 2 * xp.einsum("i,j,fc,fkc->fijk", one, one, arms[:, 1], out)
    length = (arms * arms).sum((-1, -2))
    square = square + xp.einsum("i,j,k,f->fijk", one, one, one, length)
    beyond = xp.concatenate(columns, -1).reshape(5, 27, 30)
    return FingerForms(beyond, square.reshape(5, 9, 3))


def _end_arms(hand: Hand, xp: Any = np) -> Array:
    """`[5, 3, 3]` metres: the way from each finger's base to its outermost marker, in the three
    parts that its joints carry, from the base out; 0 where it has none. `xp` as above."""
    ends, has = hand.end_markers
    joints, links = (places[ends, None] for places in hand.placing)
    level = np.arange(3)
    between = (np.array(CHAINS) == joints).argmax(-1)[:, None] > level
    skeleton, offsets = xp.asarray(hand.skeleton), xp.asarray(hand.offsets)
    carries = has[:, None] > 0
    bones = xp.where((carries & between)[..., None], skeleton[_BEYOND], 0)
    own = (carries & ((links - 1) % 3 == level))[..., None]
    return bones + xp.where(own, offsets[ends, None].astype(skeleton.dtype), 0)


BASE_AXES = JOINT_AXES[::3]
_BY_AXES = BASE_AXES.swapaxes(-1, -2)[:, None]


def _sums() -> tuple[Array, Array, Array]:
    """Three angles in `[3, 27]` sums, their phases `[27]`, and `[27, 27]` what the sines of those
    make of products as above: one base of the same functions, and another."""
    half = [(0, 0, 1), *((0, 1, k) for k in (-1, 0, 1))]
    half += [(1, j, k) for j in (-1, 0, 1) for k in (-1, 0, 1)]
    often, phases = np.array([(0, 0, 0), *half, *half]).T, np.repeat([np.pi / 2, 0], [14, 13])
    # As many angles as there are functions tell them apart.
    angles = 2 * np.pi / 3 * np.stack(np.meshgrid(*3 * [range(3)]), -1).reshape(27, 3)
    first, second, third = np.stack([np.ones((27, 3)), np.cos(angles), np.sin(angles)]).T
    products = np.einsum("ni,nj,nk->nijk", first, second, third).reshape(27, 27)
    return often.astype(float), phases, np.linalg.solve(np.sin(angles @ often + phases), products)


_OFTEN, _PHASES, _PRODUCTS = _sums()


def waves(angles: Array) -> Array:
    """`[..., 27]` sines of sums of three angles `[..., 3]`, radians: whatever is linear in products
    of 1, cosine and sine of the three is linear in these, too."""
    phases = angles.reshape(-1, 3) @ _OFTEN.astype(angles.dtype, copy=False)
    phases += _PHASES.astype(angles.dtype, copy=False)
    return np.sin(phases).reshape(*angles.shape[:-1], 27)


AXES_FORM = _PRODUCTS @ (_BY_AXES @ BASE_FORM.reshape(5, 27, 3, 3) @ BASE_AXES[:, None]).reshape(
    5, 27, 9
)
"""The rotation of a finger's base by the axes of that joint's own, linear in waves."""


class FingerWaves(NamedTuple):
    """What fingers are made of, linear in waves, and where their markers are measured. Each finger
    has the axes that the angles at its base are about: by those they can be read off."""

    beyond: Array
    """`[5, 27, 42]` of the waves of the angles beyond the base, as `[3, 14]` by those axes, before
    the base is turned: the rotations of the finger's three joints; its four points from the base
    on, metres; the outermost marker, metres."""
    square: Array
    """`[5, 27, 3]` m², of the same waves: the square of that marker's distance from the base, and
    its slopes by the two flexions."""
    bases: Array
    """`[5, 3, 13]` metres: what is added to those but for the marker once the base is turned, by
    the same axes: to points the base, to rotations nothing."""
    base_by_axes: Array
    """`[15]` metres: the bases, each by its finger's axes."""
    ends: Array
    """`[3M, 15]` from all markers to the outermost of each finger, by its axes."""


@lru_cache(maxsize=64)
def finger_waves(hand: Hand) -> FingerWaves:
    """The tables of a hand's bones and markers."""
    forms, base = finger_forms(hand), hand.skeleton[1:16:3]
    columns = forms.beyond.reshape(5, 27, 3, 10)
    points, turns, marker = columns[..., :3], columns[..., 3:9], columns[..., 9:]
    first, nothing = np.zeros((5, 27, 3, 3)), np.zeros((5, 27, 3, 1))
    first[:, 0] = np.eye(3)
    beyond = _BY_AXES @ np.concatenate([first, turns, nothing, points, marker], -1)
    square = forms.square.reshape(5, 3, 3, 3)
    by_first, by_last = (np.einsum(of, _SLOPE, square) for of in ("ia,fajk->fijk", "kc,fijc->fijk"))
    ends = np.zeros((len(hand), 3, 5, 3))
    for finger, (end, has) in enumerate(zip(*hand.end_markers, strict=True)):
        ends[end, :, finger] = has * BASE_AXES[finger]
    base = (base[:, None] @ BASE_AXES)[:, 0]
    bases = np.zeros((5, 3, 13))
    bases[..., 9:] = base[..., None]
    return FingerWaves(
        beyond=_PRODUCTS @ beyond.reshape(5, 27, 42),
        square=_PRODUCTS @ np.stack([square, by_first, by_last], -1).reshape(5, 27, 3),
        bases=bases,
        base_by_axes=base.reshape(15),
        ends=ends.reshape(-1, 15),
    )


_SLOPE = np.array([[0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""`[3, 3]` what the slope of 1, cosine and sine adds to those: columns to rows."""
