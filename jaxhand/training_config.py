"""Everything a training depends on: the command line of `jaxhand train`."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from jaxhand.datasets import OWN, SIMULATED, parse_spec
from jaxhand.options import DataSets, Layers, Takes, Unit
from numpy_infer.networks import Dense, Dropout, write_spec

PAPER_JOINTS: dict[str, Any] = {
    "joint_layers": (Dense(200), Dropout(0.1), Dense(200), Dropout(0.1), Dense(200)),
    "position_weight": 0.0,
    "mixed": 0.0,
    "drawn": 0.0,
}
"""The paper's joint network (sections 3.3 and 3.4) as fields of `TrainingConfig`."""


@dataclass(frozen=True)
class TrainingConfig:
    """Everything a training depends on, and the command line of `jaxhand train`."""

    data: DataSets
    """Data set NAME[:PATH][@WEIGHT], as often as wanted; a frame of weight 2 is drawn twice as
    often. `simulated` needs no path: it is made meanwhile, alone or beside recordings."""
    out: Path
    """Folder of the run: config.json, metrics.jsonl, checkpoints, model.npz."""
    hand: str | None = None
    """Name or file of the hand; by default what the first data set is read as."""
    train: Takes = ()
    """Takes (SIG18: users) to train on instead of the data set's default split."""
    validation: Takes = ()
    """Takes (SIG18: users) to validate on instead of the data set's default split."""
    truth: Path | None = None
    """Fit joint truth to recordings that hold none but have the markers for it (SIG18,
    minutes for each user), keep it in this folder, and train the joint network on it."""
    unit: Unit = None
    """Unit of `recordings` whose files do not say."""
    left_handed: bool = False
    """The coordinates of `recordings` are left-handed."""
    marker_layers: Layers = (Dense(200), Dense(150), Dense(200))
    """Hidden layers of the marker network: units with ReLU, dropouts as parts of 1 (200,0.1,200),
    or a JSON file with a list of {"type": "dense", "units": 200, "activation": "relu"} (or
    "linear") and {"type": "dropout", "rate": 0.1}; a linear layer follows."""
    joint_layers: Layers = (Dense(200), Dense(200), Dense(200))
    """Hidden layers of the joint network, likewise."""
    joints: bool = True
    """The joint network is trained, too, unless this is said: on the data's joint truth or, where
    there is none, on simulated postures in the same glove."""
    position_weight: float = 30.0
    """Weight of the joints' positions, through forward kinematics, in the joint network's loss
    beside the mean square of its angles."""
    mixed: float = 1.0
    """Share of the joint network's frames in which each finger is taken from another frame."""
    drawn: float = 0.0
    """Share of its frames that are drawn postures, on the training data's skeleton."""
    paper_joints: bool = False
    """Train the joint network by the paper's plain recipe instead: layers 200,0.1,200,0.1,200, the
    mean square of the angles, frames as they were recorded."""
    occlusions: tuple[float, ...] | str = (0.70, 0.17, 0.08, 0.05)
    """Probabilities that 1, 2, 3, … markers are hidden, any of them alike; or a file of `jaxhand
    occlusions --json`: as many as there, and those that were missing more often more often."""
    sizes: float | None = None
    """Spread of the sizes in which the marker network is shown recorded hands, for recordings of a
    few people; people's is 0.07. By default that for a model that is gone on from, which would
    forget the sizes it knows, and otherwise 0, as in the paper."""
    batch: int = 32
    """Frames a step."""
    learning_rate: float = 1e-3
    """Adam's, at the start."""
    halve_after: int = 5
    """Epochs without progress of the validation loss after which the learning rate is halved."""
    stop_after: int = 11
    """Epochs without progress after which the training ends."""
    epochs: int = 300
    """The most epochs for each network."""
    start: Path | None = None
    """A model to go on from, a file or the name of a bundled one, with its hand and its layers:
    recordings of your own then refine it, the marker network as far as is good on validation.
    Networks that the data say nothing of stay as they are."""
    seed: int = 0
    """The same seed gives the same numbers on the same machine."""
    resume: bool = False
    """Go on from the checkpoint in the run's folder."""
    overwrite: bool = False
    """Throw away the run that the folder holds."""

    def __post_init__(self) -> None:
        for name in ("batch", "halve_after", "stop_after", "epochs"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected 1 or more, found {getattr(self, name)}")
        if not 0 < self.learning_rate < math.inf:
            raise ValueError(f"learning_rate: expected above 0, found {self.learning_rate}")
        parts = (1.0,) if isinstance(self.occlusions, str) else self.occlusions
        if min(parts, default=-1) < 0 or abs(sum(parts) - 1) > 1e-6:
            raise ValueError(f"occlusions: expected parts that sum to 1, found {parts}")
        if not 0 <= self.position_weight < math.inf:
            raise ValueError(f"position_weight: expected 0 or more, found {self.position_weight}")
        if self.sizes is not None and not 0 <= self.sizes < 0.5:
            raise ValueError(f"sizes: expected 0 to 0.5, a part of 1, found {self.sizes}")
        if not (self.mixed >= 0 and self.drawn >= 0 and self.mixed + self.drawn <= 1):
            raise ValueError(
                "mixed and drawn: expected parts of the same frames, 1 together at most, found "
                f"{self.mixed} and {self.drawn}"
            )
        own = [n for n in PAPER_JOINTS if getattr(self, n) != getattr(TrainingConfig, n)]
        if self.paper_joints and own:
            raise ValueError(
                f"paper_joints has its own {', '.join(own)}: leave out the one or these"
            )
        if self.paper_joints and not self.joints:
            raise ValueError("paper_joints is how joints are trained: leave out one or the other")
        if self.resume and self.overwrite:
            raise ValueError("resume and overwrite exclude each other")
        names = [parse_spec(text).name for text in self.data]
        found = f"found {', '.join(names) or 'none'}"
        if (self.train or self.validation) and len(names) - names.count(SIMULATED) != 1:
            raise ValueError(f"train and validation name takes of one data set, {found}")
        if (self.unit is not None or self.left_handed) and OWN not in names:
            raise ValueError(f"unit and left_handed are for {OWN}, {found}")
        if self.sizes and set(names) == {SIMULATED}:
            raise ValueError(f"sizes are for recordings: {SIMULATED} hands have people's already")
        if self.truth is not None and "sig18" not in names:
            raise ValueError(f"truth is fitted to sig18 alone, {found}")
        for spec in map(parse_spec, self.data):
            if spec.name == SIMULATED and spec.path is not None:
                raise ValueError(f"{SIMULATED} has no files: leave out {spec.path}")


def as_json(config: TrainingConfig) -> dict[str, Any]:
    """The config as JSON has it."""
    plain = {field.name: getattr(config, field.name) for field in fields(config)}
    layers = {name: write_spec(plain[name]) for name in ("marker_layers", "joint_layers")}
    return json.loads(json.dumps(plain | layers, default=str))
