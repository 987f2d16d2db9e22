"""Euler angles in degrees, as files write them, to rotation matrices that act on columns."""

from __future__ import annotations

import numpy as np


def axis_rotation(axis: int, degrees: np.ndarray) -> np.ndarray:
    """[...] degrees about axis 0, 1 or 2 (x, y, z) → [..., 3, 3]."""
    angle = np.radians(degrees)
    cos, sin = np.cos(angle), np.sin(angle)
    second, third = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.zeros((*angle.shape, 3, 3))
    rotation[..., axis, axis] = 1.0
    rotation[..., second, second] = cos
    rotation[..., third, third] = cos
    rotation[..., second, third] = -sin
    rotation[..., third, second] = sin
    return rotation


def composed(axes: list[int], degrees: np.ndarray) -> np.ndarray:
    """[..., n] degrees → [..., 3, 3], the product in the order listed: the last one acts first."""
    rotation = np.broadcast_to(np.eye(3), (*degrees.shape[:-1], 3, 3))
    for column, axis in enumerate(axes):
        rotation = rotation @ axis_rotation(axis, degrees[..., column])
    return rotation
