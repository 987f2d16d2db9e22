"""What a training is given: frames out of recordings, out of the simulator, or out of both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import numpy as np

from jaxhand import simulation
from jaxhand.datasets import OWN, Split, load, parse_spec
from jaxhand.expected_error import people
from jaxhand.occlusions import FEWEST_LEFT
from jaxhand.sequences import Dataset, Sequence
from jaxhand.tasks import Frames
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.model import load as load_model

if TYPE_CHECKING:
    from jaxhand.training import TrainingConfig

SIMULATED = "simulated"
"""The name of the data set that is made while it is trained on."""
POSTURES, PEOPLE, SECONDS = 20_000, 16, 10
"""Simulated frames of an epoch, a tenth of it to validate on; people who move to choose on what
depends on motion, and for how long."""


class Given(NamedTuple):
    """All that a training needs to be given."""

    hand: Hand
    training: Frames
    validation: Frames
    joint_frames: tuple[Frames, Frames] | None
    """To train and validate the joint network on, where the others hold no joints."""
    sequences: list[Sequence]
    """To choose on what depends on motion."""
    start: Model | None
    """To go on from."""
    notes: tuple[str, ...]
    """What the user should know, one line each."""


def collect(config: TrainingConfig) -> Given:
    """Reads the data sets of a config, and simulates what is to be simulated.

    Raises:
        ValueError: data that are missing or do not fit together, or a model that does not.
    """
    start = None if config.start is None else load_model(config.start)
    recorded, held_out = (_load(config, split, start) for split in ("train", "validation"))
    specs = [parse_spec(text) for text in config.data]
    simulated = sum(spec.weight for spec in specs if spec.name == SIMULATED)
    hand = _hand_of(config, recorded, start)
    people = simulated_frames(hand, config.seed)
    training, validation = people
    if recorded:
        training, validation = gather(recorded), gather(held_out)
        share = _share(simulated * len(people[0].markers), training)
        training = training._replace(simulated=share)
    joint_frames, notes = None, []
    if config.joints and (training.angles is None or validation.angles is None):
        joint_frames = people if start is None or start.joint_network is None else None
        does = "stays as it is" if joint_frames is None else f"learns simulated {hand.name} hands"
        notes.append(f"the data hold no joints: the joint network {does}")
    sequences = _sequences(held_out, hand, config.seed)
    return Given(hand, training, validation, joint_frames, sequences, start, tuple(notes))


def simulated_frames(hand: Hand, seed: int) -> tuple[Frames, Frames]:
    """Simulated people in a glove, others in every epoch, and some to validate on."""
    keys = jax.random.split(jax.random.key(seed))
    # As a whole: operation by operation it is compiled for longer.
    simulate = jax.jit(simulation.frames, static_argnames=("hand", "count"))
    (markers, angles), held_out = (
        simulate(key, hand, count)
        for key, count in zip(keys, (POSTURES, POSTURES // 10), strict=True)
    )
    return Frames(markers, angles, simulated=1.0), Frames(*held_out)


def _sequences(validation: list[Dataset], hand: Hand, seed: int) -> list[Sequence]:
    if validation:
        return [s for dataset in validation for s in dataset.sequences]
    return simulated_sequences(hand, seed)


def simulated_sequences(hand: Hand, seed: int) -> list[Sequence]:
    """Simulated people in motion. Their markers are not quite in place: on gloves put on by the
    millimetre a network looks better than it will be."""
    return people(hand, seed, PEOPLE, SECONDS)


def _share(simulated: float, frames: Frames) -> float:
    """Of so many simulated frames beside the recorded ones, each by its weight."""
    recorded = len(frames.markers) if frames.weight is None else frames.weight.sum()
    return float(simulated / (simulated + recorded))


def _hand_of(config: TrainingConfig, training: list[Dataset], start: Model | None) -> Hand:
    if start is not None:
        return start.hand
    return mean_hand(training) if training else load_hand(config.hand or "glove9")


def mean_hand(datasets: list[Dataset]) -> Hand:
    """The hand of the data, with the mean of the skeletons that are known, each frame alike."""
    known = [d for d in datasets if d.observed_angles is not None]
    if not known:
        return datasets[0].hand
    frames = [sum(len(s.markers) for s in d.sequences) for d in known]
    skeleton = np.average([d.hand.skeleton for d in known], axis=0, weights=frames)
    return known[0].hand.with_skeleton(skeleton)


def _load(config: TrainingConfig, split: Split, start: Model | None) -> list[Dataset]:
    hand = None if config.hand is None else load_hand(config.hand)
    if start is not None:
        if hand is not None and hand.markers != start.hand.markers:
            raise ValueError(f"{config.start} is a model for {start.hand.name}, not {hand.name}")
        hand = start.hand
    takes = config.train if split == "train" else config.validation
    truth = config.truth or False
    recorded = [spec for spec in config.data if parse_spec(spec).name != SIMULATED]
    said: dict[str, Any] = {"unit": config.unit, "left_handed": config.left_handed}
    datasets = []
    for spec in recorded:
        # Beside others, it is the recordings that this is said of.
        own = said if parse_spec(spec).name == OWN or len(recorded) == 1 else {}
        datasets.append(load(spec, split, hand=hand, takes=takes or None, truth=truth, **own))
    for dataset in datasets[1:]:
        if dataset.hand.markers != datasets[0].hand.markers:
            raise ValueError(
                f"{dataset.name} has markers {', '.join(dataset.hand.markers)}; {datasets[0].name} "
                f"has {', '.join(datasets[0].hand.markers)}: pass one --hand for both"
            )
    return datasets


def gather(datasets: list[Dataset]) -> Frames:
    """The frames of all data sets in which enough is seen to train on, with their weights."""
    parts = [_usable(dataset) for dataset in datasets]
    markers = np.concatenate([markers for markers, _ in parts])
    angles = np.concatenate([angles for _, angles in parts])
    weight = None
    if len({dataset.weight for dataset in datasets}) > 1:
        weight = np.repeat([d.weight for d in datasets], [len(markers) for markers, _ in parts])
    return Frames(markers, angles if np.isfinite(angles).any() else None, weight)


def _usable(dataset: Dataset) -> tuple[Array, Array]:
    markers = np.concatenate([s.markers for s in dataset.sequences])
    angles = np.concatenate(
        [
            np.full((len(s.markers), len(ANGLES)), np.nan, np.float32)
            if s.angles is None
            else s.angles
            for s in dataset.sequences
        ]
    )
    enough = np.isfinite(markers).all(-1).sum(-1) > FEWEST_LEFT
    return markers[enough], angles[enough]
