"""People: how long, broad and thick their hands are, and where a marker then sits on the skin.

Sources, each also named where its number stands:
- FAA: anthropometric survey of Technical Operations personnel, US adults, 2006 to 2008, 5th / 50th
  / 95th percentile of men and women: hand length 180 / 196 / 212 and 163 / 178 / 193 mm, hand
  breadth 80 / 88 / 96 and 71 / 77 / 84 mm, breadth of the index finger's PIP joint 19 / 21 / 23 and
  16 / 18 / 21 mm. Half of our people are women, half are men: means of 187, 82.5 and 19.5 mm, and
  standard deviations of 7.0, 8.5 and 10 % of them. Not confirmed against the survey's report; the
  figures of others are near, see the next two.
- Garrett, AMRL-TR-69-42 and AMRL-TR-69-26 (1970), US Air Force men and women, as cited by others:
  mean hand length 197 and 179 mm, mean depth of the index finger's PIP joint 19.4 and 16.2 mm.
- British adults of 19 to 65 years, as cited by others: mean hand breadth of men 85 mm, of women
  75 mm, with standard deviations of 5 and 4 mm: 8.4 % of both together.
- Buchholz, Armstrong and Goldstein, Ergonomics 35 (1992): hand length explains 49 to 99 % of the
  variance of a segment's length and 82 to 96 % of how far a knuckle lies from the wrist crease;
  hand breadth explains 30 to 74 % of how far it lies aside.
- Buchholz and Armstrong, An ellipsoidal representation of human hand anthropometry, Human Factors
  33 (1991): hand breadth explains 12 to 47 % of segments' breadths and 6 to 74 % of their depths.
What has no source beside it is our own choice within these bounds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import CHAINS, FINGERS, JOINTS, PARENTS, POINTS, THUMB_AXES, Hand

SIZE_SPREAD = 0.07
"""Standard deviation of the logarithm of hand length (FAA)."""
BREADTH_SPREAD = 0.085
"""The same of hand breadth (FAA)."""
BREADTH_CORRELATION = 0.75
"""Of the two, over women and men together: our choice, most of it the difference of the sexes."""
FINGER_SPREAD = 0.03
"""Of how much longer the fingers, and shorter the palm, are than the hand's length says: their
correlation is then 0.7 over women and men together, without the spread of single bones."""
DIGIT_SPREAD, BONE_SPREAD = 0.02, 0.03
"""Of one finger's length beside that of the others, and of a bone's length beside its finger's.
With the spread of the wrist's point, hand length then explains 55 to 66 % of the variance of a
segment (Buchholz et al. 1992: 49 to 99 %)."""
KNUCKLE_SPREAD, ARCH_SPREAD = 0.002, 0.003
"""Metres, dorsal and palmar: of where each finger's base lies, and of how far the outer ones lie
out of the plane of the others: whoever measures takes a flat hand or a hollow one, whose fifth
metacarpal is flexed, for the hand at rest."""
WRIST_SPREAD = 0.006
"""Metres along the forearm: of where the wrist's point lies. It is a landmark of whoever measures:
from the distal crease to the head of the capitate, about which the hand turns, is a centimetre, by
eye."""

THICKNESS_SPREAD = 0.09
"""Of the logarithm of fingers' thickness (FAA: 10 % for one joint of one finger)."""
THICKNESS_CORRELATION = 0.6
"""With hand breadth, which then explains 36 % of the variance of thickness, and 30 % of that of one
bone's (Buchholz and Armstrong 1991: 12 to 47 % of a segment's breadth)."""
PAD_SPREAD = 0.04
"""Of one bone's thickness beside that of the others."""

RADII = dict(
    zip(
        POINTS,
        (
            *(20.0, 13.0, 12.0, 10.5),
            *(11.5, 9.5, 8.5),
            *(11.5, 9.5, 8.5),
            *(11.0, 9.0, 8.0),
            *(11.0, 8.0, 7.0),
            *(9.0, 7.5, 7.5, 7.0, 6.5),
        ),
        strict=True,
    )
)
"""Millimetres: mean radius of the capsule around the bone that ends in each point, half of the mean
of breadth and depth. The index finger's PIP joint is 19.5 mm broad (FAA) and 17.8 mm deep
(Garrett), so its radius is 9.3 mm; all stand in proportion to it, by eye."""

PLACEMENT = 0.003
"""Metres: standard deviation of where a marker is stuck, in each direction along the skin."""

_RADII = np.array([RADII[point] for point in POINTS], np.float32) / 1e3
_DIGIT = np.array(
    [next((i for i, f in enumerate(FINGERS) if p.startswith(f)), len(FINGERS)) for p in POINTS]
)
"""`[21]` the finger of each point; 5 for the wrist."""
_BASES = np.array([chain[0] for chain in CHAINS])
_IS_BASE = np.isin(np.arange(len(POINTS)), _BASES)
_HOLLOW = np.select(
    [FINGERS.index(finger) == _DIGIT for finger in ("index", "ring", "pinky")], [0.3, 0.4, 1], 0
).astype(np.float32)
"""`[21]` how much each finger's base goes along as the palm hollows."""
_ENDS = np.array([PARENTS.index(joint) if joint else CHAINS[2][0] for joint in range(len(JOINTS))])
"""`[16]` the point at which the bone behind each joint ends; of the wrist the middle knuckle."""

_VARIANCE = np.where(
    _IS_BASE[:, None],
    [
        BREADTH_SPREAD**2 + BONE_SPREAD**2,
        THICKNESS_SPREAD**2,
        SIZE_SPREAD**2 + FINGER_SPREAD**2 + BONE_SPREAD**2,
    ],
    SIZE_SPREAD**2 + FINGER_SPREAD**2 + DIGIT_SPREAD**2 + BONE_SPREAD**2,
)
"""`[21, 3]` of the logarithm of each coordinate of the skeleton."""


class People(NamedTuple):
    """Hands of people, without their postures."""

    skeleton: Array
    """`[..., 21, 3]` metres, each point from its parent in the flat hand."""
    radii: Array
    """`[..., 21]` metres: of the capsule around the bone from each point's parent to it; the
    wrist's own is half the wrist's breadth."""


def people(key: Array, hand: Hand, batch: tuple[int, ...] = ()) -> People:
    """Draws people whose mean is the hand's skeleton, bone by bone, and `RADII`.

    A hand's length, its breadth and its thickness are correlated numbers with log-normal spread;
    fingers go with length, how far the knuckles lie aside with breadth, the arch with thickness.
    The fingers' phalanges keep their directions.
    """
    # One call draws all: XLA takes a second to compile each.
    normal = jax.random.normal(key, (*batch, 6 + len(FINGERS) + 4 * len(POINTS)))
    size, broad, long, thick, wrist, hollow = (normal[..., i, None] for i in range(6))
    digit, own = normal[..., 6:11], normal[..., 11:].reshape(*batch, 4, len(POINTS))

    breadth = _correlated(BREADTH_CORRELATION, size, broad)
    length = SIZE_SPREAD * size
    digit = jnp.concatenate([digit, jnp.zeros_like(size)], -1)[..., _DIGIT]
    finger = length + FINGER_SPREAD * long + DIGIT_SPREAD * digit + BONE_SPREAD * own[..., 0, :]
    palm = length - FINGER_SPREAD * long + BONE_SPREAD * own[..., 0, :]
    aside = BREADTH_SPREAD * breadth + BONE_SPREAD * own[..., 1, :]
    thickness = THICKNESS_SPREAD * _correlated(THICKNESS_CORRELATION, breadth, thick)

    base = jnp.stack([aside, jnp.broadcast_to(thickness, aside.shape), palm], -1)
    logarithm = jnp.where(jnp.asarray(_IS_BASE)[:, None], base, finger[..., None])
    mean = jnp.asarray(hand.skeleton, jnp.float32)
    arch = KNUCKLE_SPREAD * own[..., 3, :] + ARCH_SPREAD * hollow * jnp.asarray(_HOLLOW)
    shift = jnp.stack(
        [jnp.zeros_like(arch), arch, jnp.broadcast_to(WRIST_SPREAD * wrist, arch.shape)], -1
    )
    skeleton = mean * _unbiased(logarithm, _VARIANCE) + shift * _IS_BASE[:, None].astype(np.float32)
    pads = thickness + PAD_SPREAD * own[..., 2, :]
    variance = np.array(THICKNESS_SPREAD**2 + PAD_SPREAD**2)
    return People(skeleton, jnp.asarray(_RADII) * _unbiased(pads, variance))


def mean_person(hand: Hand) -> People:
    """Whose bones are the hand's, `[21, 3]`, and whose radii are `RADII`, `[21]`."""
    return People(jnp.asarray(hand.skeleton, jnp.float32), jnp.asarray(_RADII))


def placed(key: Array, hand: Hand, people: People, error: float = PLACEMENT) -> Array:
    """`[..., M, 3]` metres: each marker from its joint, in the link's frame, on these people.

    The part of the hand's offset across the bone grows with the thickness of who wears it, the part
    along the bone with the bone's length; `dataclasses.replace(hand, offsets=...)` wears it.

    Args:
        key: what the errors are drawn from.
        hand: whose offsets are those of the mean person.
        people: `[...]` of them.
        error: metres, standard deviation of the placement in each direction along the skin. Where
            a marker has no offset its skin has no direction: the error is the same in all three.
            On the back of the hand, where there is no joint to aim at, it is twice as large.
    """
    joints, links = hand.placing
    # Offsets stand in the link's frame: the flat hand's axes, also at the thumb.
    bone = np.array([_direction(joint) for joint in joints])
    offsets = np.asarray(hand.offsets)
    along = (offsets * bone).sum(-1, keepdims=True) * bone
    across = offsets - along
    depth = np.linalg.norm(across, axis=-1, keepdims=True)
    normal = across / np.where(depth > 0, depth, 1)

    ends = np.where(joints < len(JOINTS), _ENDS[np.minimum(joints, len(JOINTS) - 1)], joints)
    ratio = (people.radii / jnp.asarray(_RADII))[..., ends, None]
    lengths = jnp.sqrt((people.skeleton * people.skeleton).sum(-1))
    own = np.linalg.norm(hand.skeleton, axis=-1).astype(np.float32)
    stretch = lengths[..., ends, None] / own[ends, None]

    spread = error * np.where(links[:, None] == 0, 2, 1)
    drawn = jax.random.normal(key, (*people.radii.shape[:-1], len(hand), 3))
    drawn = drawn * jnp.asarray(spread, jnp.float32)
    skin = jnp.asarray(normal, jnp.float32)
    drawn = drawn - (drawn * skin).sum(-1, keepdims=True) * skin
    across, along = (jnp.asarray(part, jnp.float32) for part in (across, along))
    return across * ratio + along * stretch + drawn


def _direction(point: int) -> Array:
    """`[3]` unit vector of the bone behind a point, or before a tip, in the flat hand."""
    thumb = POINTS[point].startswith("thumb")
    return -np.array(THUMB_AXES)[:, 2] if thumb else np.array([0.0, 0, -1])


def _correlated(correlation: float, given: Array, other: Array) -> Array:
    """Standard normal, correlated with the standard normal `given`."""
    return correlation * given + math.sqrt(1 - correlation**2) * other


def _unbiased(logarithm: Array, variance: Array) -> Array:
    """The exponential of normal numbers of this variance, scaled to a mean of 1."""
    return jnp.exp(logarithm - jnp.asarray(variance / 2, jnp.float32))
