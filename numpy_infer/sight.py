"""What follows from the set of visible markers alone, kept from frame to frame."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import PRIOR_STRENGTH, Folded, folded
from numpy_infer.hand import Hand
from numpy_infer.pose import DETERMINED_EXTENT


class Sight(NamedTuple):
    """Of one visible set `[..., M]`; it is kept, so nobody may write into its arrays."""

    weight: Array
    """`[..., M]` 1 where visible, else 0."""
    parts: Array
    """See `parts_of`."""
    direct: bool
    """True if all alignment markers are, so that those measured give the wrist's pose."""
    template: Folded
    """What registers the template."""
    both: Folded
    """The same and, behind it, the body by its alignment markers; without those if not `direct`."""
    least: Array
    """`[2]` m²: a larger second singular value of the template's cross-covariance says that the
    visible markers determine the hand, for theirs is at least that over the template's first; and
    a larger one of the body's, that no prior is needed."""


KEPT = 256
"""Markers of all hands: of more the visible set seldom stays, and what follows from it takes
kilobytes each."""


def sight(hand: Hand, body: Hand, visible: Array, dtype: np.dtype) -> Sight:
    """Of markers `[..., M]` that are visible now, in the precision of `dtype`."""
    if visible.size > KEPT:
        return _of(hand, body, dtype.char, visible)
    return _kept(hand, body, dtype.char, visible.shape, visible.tobytes())


@lru_cache(maxsize=64)
def _kept(hand: Hand, body: Hand, dtype: str, shape: tuple[int, ...], seen: bytes) -> Sight:
    return _of(hand, body, dtype, np.frombuffer(seen, bool).reshape(shape))


def _of(hand: Hand, body: Hand, dtype: str, visible: Array) -> Sight:
    weight = visible.astype(dtype)
    direct = bool(visible[..., hand.aligned].all())
    templates = np.array([hand.template, body.template][: 1 + direct], dtype)
    weights = np.empty((*visible.shape[:-1], 1 + direct, len(hand)), dtype)
    weights[..., 1:, :], weights[..., 0, :] = hand.alignment_weight, weight
    both = folded(templates, weights)
    return Sight(
        weight=weight,
        parts=parts_of(visible, dtype),
        direct=direct,
        template=Folded(both.shares, both.table[..., :19].copy(), both.mean[..., :1, :, :]),
        both=both,
        least=np.array([DETERMINED_EXTENT * hand.extent, 2 * PRIOR_STRENGTH]),
    )


@lru_cache(maxsize=64)
def aligned(hand: Hand, body: Hand, dtype: str) -> Folded:
    """The body by the hand's alignment markers: what gives the wrist's pose once every marker is
    somewhere."""
    return folded(body.template.astype(dtype)[None], hand.alignment_weight.astype(dtype)[None])


def parts_of(visible: Array, dtype: np.dtype | str) -> Array:
    """`[..., 3M, 1]` what part of all visible markers each is, for each of its coordinates; 0 where
    none is hidden."""
    count = visible.sum(-1, keepdims=True)
    some = visible & (count < visible.shape[-1])
    return (some / np.maximum(count, 1)).astype(dtype).repeat(3, -1)[..., None]
