"""The joint stage: network, calibration, forward kinematics, finger alignment. Twin of
`jaxhand.joints`."""

from __future__ import annotations

from typing import Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import kabsch, untransform
from numpy_infer.model import Model
from numpy_infer.networks import Network, predict
from numpy_infer.skeleton import (
    angles_from_rotations,
    bend_fingers,
    flat_calibrated,
    place_fingers,
    rotations_from_angles,
)


def joint_stage(model: Model, markers: Array, rotation: Array, position: Array) -> dict[str, Any]:
    """Joint angles and positions from all markers and the wrist's pose (paper, sections 2.2, 3.3).

    Hidden markers turn their fingers as seen ones do: so the joints follow from the output markers
    alone, are as continuous as those, and stand still when they do.

    Args:
        model: what to run.
        markers: `[..., M, 3]` metres, world; all of them.
        rotation: `[..., 3, 3]` world_from_wrist.
        position: `[..., 3]` metres, the wrist joint.

    Returns:
        The fields `angles`, `rotations` and `positions` of `HandPose`; None each without a stage.
    """
    if model.joints == "none":
        return {"angles": None, "rotations": None, "positions": None}
    network: Network = model.joint_network  # type: ignore[assignment]
    own = untransform(rotation, position, markers)
    features = own if model.wearer is None else _as_trained(model, own)
    features = features.reshape(*features.shape[:-2], -1)
    angles = predict(network, features)
    if model.flat is not None:
        flat = model.flat.astype(angles.dtype, copy=False)
        angles = angles_from_rotations(flat_calibrated(rotations_from_angles(angles), flat))
    # In the hand frame: far from the origin float32 is too coarse for what is aligned.
    if model.alignment:
        angles = bend_fingers(model.body, angles, own)
    towards = own if model.alignment else None
    angles, positions, rotations = place_fingers(model.body, angles, towards, rotation, position)
    return {
        "angles": angles,
        "rotations": rotations,
        "positions": positions,
    }


def _as_trained(model: Model, markers: Array) -> Array:
    """`[..., M, 3]` metres: the markers in the hand frame of the template that the joint network
    was trained on, which is not the wearer's."""
    dtype = markers.dtype
    template = model.hand.template.astype(dtype, copy=False)
    alignment = model.hand.alignment_weight.astype(dtype, copy=False)
    weight = np.broadcast_to(alignment, markers.shape[:-1])
    eye = np.broadcast_to(np.eye(3, dtype=dtype), (*markers.shape[:-2], 3, 3))
    return untransform(*kabsch(template, markers, weight, eye), markers)
