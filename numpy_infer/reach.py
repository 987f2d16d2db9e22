"""How near and how far apart a hand can bring its markers, and which of them may be confused."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, HIGH, JOINTS, LOW, PARENTS, Hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

POSTURES = 2000
"""Postures out of which `reach` takes distances."""
NEARER, FARTHER, SLACK = 0.75, 1.25, 0.01
"""Factors, and metres, by which other people's distances and other gloves' may differ."""


class Reach(NamedTuple):
    """What a hand can do, as tables."""

    nearest: Array
    """`[M, M]` metres: the least distance of two markers."""
    farthest: Array
    """`[M, M]` metres: the largest."""
    carriers: Array
    """`[M, M]` True where the second marker is on what carries the first: the same link, or one
    between it and the wrist; False for a marker itself."""
    neighbours: Array
    """`[P, 2]` markers that may be taken for each other: the outermost ones of fingers side by
    side."""
    partner: Array
    """`[P, M]` each marker's own index, the other's for the two of a pair."""


@lru_cache(maxsize=64)
def reach(hand: Hand) -> Reach:
    """The tables of a hand, from random postures within the ranges of its joints."""
    angles = np.random.default_rng(0).uniform(LOW, HIGH, (POSTURES, len(ANGLES)))
    eye = np.broadcast_to(np.eye(3), (POSTURES, 3, 3))
    local = rotations_from_angles(angles)
    placed = forward_kinematics(hand.skeleton, local, eye, np.zeros((POSTURES, 3)))
    points = marker_positions(hand, *placed)
    apart = distances(points)
    chains = [_chain(link) for link in hand.links]
    carriers = np.array([[link in chain for link in hand.links] for chain in chains])
    ends = np.stack([hand.end_markers[0][:-1], hand.end_markers[0][1:]], -1)
    pairs = ends[(ends >= 0).all(-1)]
    partner = np.tile(np.arange(len(hand)), (len(pairs), 1))
    for own, (one, other) in zip(partner, pairs, strict=True):
        own[[one, other]] = other, one
    return Reach(
        nearest=np.maximum(NEARER * apart.min(0) - SLACK, 0),
        farthest=FARTHER * apart.max(0) + SLACK,
        carriers=carriers & ~np.eye(len(hand), dtype=bool),
        neighbours=pairs,
        partner=partner,
    )


def _chain(link: int) -> list[int]:
    """The joints from a link to the wrist, both included."""
    chain = [link]
    while PARENTS[chain[-1]] >= 0:
        chain.append(PARENTS[chain[-1]])
    return [joint for joint in chain if joint < len(JOINTS)]


def distances(points: Array) -> Array:
    """`[..., M, M]` metres, of all to all."""
    apart = points[..., :, None, :] - points[..., None, :, :]
    return np.sqrt((apart * apart).sum(-1))
