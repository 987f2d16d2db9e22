"""A calibration file: the bones of whoever wears the glove, where its markers sit, a flat pose."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.formats.json_text import read_json
from numpy_infer.formats.refusal import refusal
from numpy_infer.hand import ANGLES, FINGERS, Hand, hand_from_json
from numpy_infer.model import Model
from numpy_infer.networks import Network
from numpy_infer.skeleton import rotations_from_angles

FORMAT, VERSION = "jaxhand-calibration", 1


@dataclass(frozen=True, eq=False)
class Wearer:
    """What a calibration found out about a person in a glove."""

    hand: Hand
    """The glove's markers on the person's bones and at their places."""
    flat: Array | None = None
    """`[26]` radians that the joint network gives while the person holds a flat hand, or None."""
    unseen: tuple[str, ...] = ()
    """Fingers that moved too little to say anything of their bones."""


def save(wearer: Wearer, path: str | Path, *, overwrite: bool = False) -> None:
    """Writes a calibration as JSON.

    Raises:
        ValueError: the file exists and `overwrite` is False.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists; pass overwrite=True to replace it")
    flat = None
    if wearer.flat is not None:
        flat = {a.name: float(v) for a, v in zip(ANGLES, wearer.flat, strict=True)}
    data = {
        "format": FORMAT,
        "version": VERSION,
        "hand": wearer.hand.to_json(),
        "flat": flat,
        "unseen": list(wearer.unseen),
    }
    part = path.with_name(path.name + ".part")
    part.write_text(json.dumps(data, indent=1) + "\n", "utf-8")
    part.replace(path)


def load(path: str | Path) -> Wearer:
    """Reads a calibration, with every check.

    Raises:
        ValueError: no such file, or one that is damaged; the message says where.
    """
    try:
        return _read(read_json(Path(path)))
    except FileNotFoundError:
        raise ValueError(f"no calibration file {path}") from None
    except ValueError as error:  # no JSON, no calibration
        raise refusal(path, error) from None


def _read(data: Any) -> Wearer:
    expected = {"format", "version", "hand", "flat", "unseen"}
    if not isinstance(data, dict) or set(data) != expected:
        raise ValueError(f"expected an object with {', '.join(sorted(expected))}")
    if data["format"] != FORMAT or data["version"] != VERSION:
        raise ValueError(
            f"expected format {FORMAT!r} version {VERSION}, found {data['format']!r} version "
            f"{data['version']!r}"
        )
    flat = data["flat"]
    if flat is not None:
        names = [angle.name for angle in ANGLES]
        if not isinstance(flat, dict) or list(flat) != names:
            raise ValueError(
                f"'flat': expected the {len(names)} angles in the order of hand.ANGLES"
            )
        if not all(type(v) in (int, float) and abs(v) < 10 for v in flat.values()):
            raise ValueError(f"'flat': expected radians, found {list(flat.values())}")
        flat = np.array(list(flat.values()), np.float64)
    unseen = data["unseen"]
    if not isinstance(unseen, list) or any(finger not in FINGERS for finger in unseen):
        raise ValueError(
            f"'unseen': expected fingers out of {', '.join(FINGERS)}, found {unseen!r}"
        )
    return Wearer(hand_from_json(data["hand"]), flat, tuple(unseen))


def calibrated(model: Model, wearer: Wearer) -> Model:
    """The model as it runs for this person, see `worn_by`, and with the person's flat pose.

    Raises:
        ValueError: the calibration is of another glove.
    """
    flat = None if wearer.flat is None else rotations_from_angles(wearer.flat)
    return replace(worn_by(model, wearer.hand), flat=flat)


def worn_by(model: Model, hand: Hand) -> Model:
    """The model for other bones: joints and wrist pose are made with them, and networks see markers
    in the size of hand that they were trained on, for they take a large hand for an open one.

    Raises:
        ValueError: the hand has other markers than the model.
    """
    factor = hand.size / model.hand.size
    return replace(
        model,
        hand=model.hand.resized(factor),
        wearer=hand,
        marker_network=_resized(model.marker_network, factor, factor),
        joint_network=_resized(model.joint_network, factor, 1),
    )


def _resized(network: Network | None, inputs: float, outputs: float) -> Network | None:
    """The network with its inputs and outputs as large as this."""
    if network is None:
        return None
    return replace(
        network,
        input_mean=np.float32(inputs) * network.input_mean,
        input_scale=np.float32(inputs) * network.input_scale,
        output_mean=np.float32(outputs) * network.output_mean,
        output_scale=np.float32(outputs) * network.output_scale,
    )
