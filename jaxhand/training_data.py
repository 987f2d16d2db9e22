"""What a training is given: frames out of recordings, out of the simulator, or out of both."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxhand import simulation
from jaxhand.datasets import OWN, SIMULATED, DatasetSpec, Split, default_takes, load, parse_spec
from jaxhand.occlusions import FEWEST_LEFT
from jaxhand.sequences import Dataset, Sequence
from jaxhand.tasks import Frames, complete
from jaxhand.training_config import TrainingConfig
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.model import load as load_model

POSTURES, PEOPLE, SECONDS = 20_000, 16, 10
"""Simulated frames of an epoch, a tenth of it to validate on; people who move to choose on what
depends on motion, and for how long."""

MOST_NAMED = 6
"""Takes: of more the number is said, not the names."""


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
    digest: str
    """Of what lay under the config's paths; what is simulated its seed says."""


def collect(config: TrainingConfig) -> Given:
    """Reads the data sets of a config, and simulates what is to be simulated.

    Raises:
        ValueError: data that are missing or do not fit together, or a model that does not.
    """
    start = None if config.start is None else load_model(config.start)
    _check_layers(config, start)
    recorded, held_out = (_load(config, split, start) for split in ("train", "validation"))
    specs = [parse_spec(text) for text in config.data]
    of_files = [spec for spec in specs if spec.name != SIMULATED]
    hand = _hand_of(config, recorded, start)
    made = simulated_frames(hand, config.seed)
    training, validation = made
    if recorded:
        training, validation = gather(recorded), gather(held_out)
        weight = sum(spec.weight for spec in specs if spec.name == SIMULATED)
        simulated, measured = weight * len(made[0].markers), _weight(training, recorded)
        training = training._replace(simulated=simulated / (simulated + measured))
    notes = [_split(*parts) for parts in zip(of_files, recorded, held_out, strict=True)]
    joint_frames = None
    if config.joints and (training.angles is None or validation.angles is None):
        joint_frames = made if start is None or start.joint_network is None else None
        does = "stays as it is" if joint_frames is None else f"learns simulated {hand.name} hands"
        notes.append(f"the data hold no joints: the joint network {does}")
    if recorded:
        sequences = [s for dataset in held_out for s in dataset.sequences]
    else:
        key = jax.random.key(config.seed)
        sequences = simulation.sequences(key, hand, PEOPLE, SECONDS)
    digest = _digest(config, recorded + held_out)
    return Given(hand, training, validation, joint_frames, sequences, start, tuple(notes), digest)


def _digest(config: TrainingConfig, datasets: list[Dataset]) -> str:
    """The takes with their lengths, their gaps and where they are to the millimetre, and the bytes
    of files that are not recordings: what another release of a library reads alike."""
    said: list[Any] = []
    for dataset in datasets:
        said.append([dataset.name, dataset.weight])
        for s in dataset.sequences:
            where = 1e3 * np.nan_to_num(s.markers).mean(0)
            said.append([s.name, len(s.markers), int(np.isfinite(s.markers).sum())])
            said.append(where.round().astype(int).tolist())
    for path in (config.hand, config.start, config.occlusions):
        if isinstance(path, str | Path) and Path(path).is_file():
            said.append(hashlib.sha256(Path(path).read_bytes()).hexdigest())
    return hashlib.sha256(json.dumps(said).encode()).hexdigest()[:16]


def _check_layers(config: TrainingConfig, start: Model | None) -> None:
    """Refuses layers that were asked for where those of the model are gone on with.

    Raises:
        ValueError: names the option to leave out.
    """
    for network in ("marker", "joint"):
        begun = getattr(start, f"{network}_network", None)
        layers = f"{network}_layers"
        asked = getattr(config, layers)
        if begun and asked not in (getattr(type(config), layers), begun.spec[:-1]):
            raise ValueError(
                f"{layers}: {config.start} has its own and is gone on with: leave them out"
            )


def _takes(dataset: Dataset) -> str:
    names = sorted({sequence.take for sequence in dataset.sequences})
    seconds = sum(len(sequence.markers) / sequence.rate for sequence in dataset.sequences)
    return f"{_named(names)} ({seconds:.0f} s)"


def _named(takes: Collection[str]) -> str:
    return ", ".join(takes) if len(takes) <= MOST_NAMED else f"{len(takes)} takes"


def _split(spec: DatasetSpec, training: Dataset, validation: Dataset) -> str:
    """Which takes are for what: `jaxhand evaluate` goes by the default split if told no other."""
    said = f"{training.name}: {_takes(training)} to train, {_takes(validation)} to validate"
    used = {s.take.split("/")[0] for dataset in (training, validation) for s in dataset.sequences}
    train, hold = ({s.take for s in dataset.sequences} for dataset in (training, validation))
    if both := sorted(train & hold):
        said += f" ({_named(both)} in both: the validation says nothing of other takes)"
    tested = default_takes(spec, "test")
    if not tested:
        return said
    if both := [take for take in tested if take in used]:
        names = ", ".join(both)
        return f"{said}; `jaxhand evaluate` would test on {names}, too: name others by its --test"
    return f"{said}; {_named(tested)} left to test on"


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


def _weight(gathered: Frames, datasets: list[Dataset]) -> float:
    """The sum over all frames; where the data sets weigh alike, the frames do not say how much."""
    if gathered.weight is None:
        return datasets[0].weight * len(gathered.markers)
    return float(gathered.weight.sum())


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
    said: dict[str, Any] = {"unit": config.unit, "left_handed": config.left_handed}
    datasets = []
    for spec in config.data:
        name = parse_spec(spec).name
        if name != SIMULATED:
            own = said if name == OWN else {}
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


def check_frames(what: str, frames: Frames, hand: Hand, least: int) -> None:
    """Refuses frames that a marker network cannot be trained on, or fewer than `least` of them.

    Raises:
        ValueError: says what the frames are for, what was expected and what was found.
    """
    _check_shapes(what, frames, hand)
    seen = np.isfinite(frames.markers).all(-1).sum(-1)
    if (seen <= FEWEST_LEFT).any():
        raise ValueError(
            f"{what}: expected more than {FEWEST_LEFT} markers measured in every frame, found "
            f"{seen.min()}"
        )
    if len(seen) < least:
        raise ValueError(f"{what}: expected {least} or more frames, found {len(seen)}")


def check_measured(what: str, frames: Frames, hand: Hand) -> None:
    """Refuses frames that say nothing of a marker to a new marker network.

    Raises:
        ValueError: names the markers that no frame has.
    """
    never = ~np.isfinite(frames.markers).all(-1).any(0)
    if never.any():
        names = ", ".join(np.array(hand.markers)[never])
        raise ValueError(
            f"{what}: expected every marker in some frame, found {names} in none; a model that "
            "knows them may be gone on from (--start)"
        )


def check_joint_frames(what: str, frames: Frames, hand: Hand, least: int) -> None:
    """Refuses frames of which fewer than `least` can teach a joint network anything.

    Raises:
        ValueError: says what the frames are for, what was expected and what was found.
    """
    what = f"{what} of the joint network"
    _check_shapes(what, frames, hand)
    if frames.angles is None:
        raise ValueError(f"{what}: expected angles [N, {len(ANGLES)}], found none")
    count = complete(frames).sum()
    if count < least:
        raise ValueError(
            f"{what}: expected {least} or more frames with all markers and angles, found {count}; "
            "joints=False trains the marker network alone"
        )


def _check_shapes(what: str, frames: Frames, hand: Hand) -> None:
    shape = np.shape(frames.markers)
    if len(shape) != 3 or shape[1:] != (len(hand), 3):
        raise ValueError(f"{what}: expected markers [N, {len(hand)}, 3], found {list(shape)}")
    expected = (shape[0], len(ANGLES))
    if frames.angles is not None and np.shape(frames.angles) != expected:
        raise ValueError(
            f"{what}: expected angles {list(expected)}, found {list(np.shape(frames.angles))}"
        )
