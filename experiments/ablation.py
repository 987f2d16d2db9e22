"""What each part of the simulator is worth on recordings: `python experiments/ablation.py
manipnet:data/manipnet sig18:data/sig18`.

Trains marker networks on simulated hands alone, each time with one part of the simulator gone, and
prints their mean ratio to the affine combination over Table 3 of the data sets' test takes. Nothing
is chosen on those, and of all rows the length of training and the fade are the same. Some two
minutes a row on one core; another seed says what is chance. Ctrl-C keeps the rows that are done.
"""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxhand import datasets, evaluation, simulation
from jaxhand.anthropometry import People, mean_person
from jaxhand.occlusions import OcclusionsConfig, occlusions
from jaxhand.sequences import Dataset
from jaxhand.tasks import Frames
from jaxhand.training import Metrics, TrainingConfig, fit_networks
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, HIGH, LOW, Hand, load_hand
from numpy_infer.model import Model

HAND = load_hand("glove9")
FRAMES, HELD_OUT = 100_000, 5_000
"""Simulated frames to train on, every one once an epoch and with other gaps each time, and to see
on whether it gets better."""


def average(key: Array, hand: Hand, batch: tuple[int, ...] = ()) -> People:
    """Everybody the mean person, as `simulation.people` gives others."""
    return jax.tree.map(lambda a: jnp.broadcast_to(a, (*batch, *a.shape)), mean_person(hand))


def unrelated(key: Array, batch: tuple[int, ...] = ()) -> Array:
    """`[..., 26]` radians: every angle anywhere in its range, whatever the others are, in the place
    of `simulation.poses`."""
    return jax.random.uniform(key, (*batch, len(ANGLES)), minval=LOW, maxval=HIGH)


def as_described(key: Array, hand: Hand, people: People) -> Array:
    """`[..., M, 3]` metres: the offsets of the hand file on everybody, as `simulation.placed` gives
    those on the skin, stuck on with an error."""
    batch = people.radii.shape[:-1]
    return jnp.broadcast_to(jnp.asarray(hand.offsets, jnp.float32), (*batch, len(hand), 3))


class Row(NamedTuple):
    """How a training differs from that on the full simulator."""

    replaced: dict[str, Any]
    """Names in `simulation`, and what stands for them."""
    cameras: bool = False
    """Hides as many and the markers that simulated cameras lose, not 1 to 4, any alike."""
    seed: int = 0


ROWS = {
    "full simulator": Row({}),
    "another seed": Row({}, seed=1),
    "one person": Row({"people": average}),
    "no synergies": Row({"poses": unrelated}),
    "no skin, no misplacing": Row({"placed": as_described}),
    "none of the three": Row({"people": average, "poses": unrelated, "placed": as_described}),
    "gaps of cameras": Row({}, cameras=True),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", nargs="+", help="NAME:PATH, see jaxhand train")
    parser.add_argument("--epochs", type=int, default=24, help="of every row")
    parser.add_argument("--seeds", type=int, default=1, help="of Table 3")
    options = parser.parse_args()
    tests = [datasets.load(data, "test") for data in options.data]
    affine = [table(Model(test.hand, predictor="affine"), test, options.seeds) for test in tests]
    printed = [
        f"mean ratio to affine on {', '.join(options.data)}; all trained for {options.epochs} "
        f"epochs of {FRAMES:,} frames"
    ]
    try:
        for name, row in ROWS.items():
            model = trained(name, row, options.epochs)
            ratios = [
                evaluation.mean_ratio(
                    {name: table(model, test, options.seeds), "": rival}, name, ""
                )
                for test, rival in zip(tests, affine, strict=True)
            ]
            printed.append(f"  {name:22} " + "  ".join(f"{ratio:.3f}" for ratio in ratios))
            print(printed[-1], flush=True)
    except KeyboardInterrupt:
        printed.append("stopped")
    print("", *printed, sep="\n")


def simulated(row: Row, count: int) -> Array:
    """`[count, M, 3]` metres, hand frame: markers of the simulator of a row."""
    with ExitStack() as stack:
        for name, stand_in in row.replaced.items():
            stack.enter_context(patch.object(simulation, name, stand_in))
        # A function of its own: what was compiled before knows nothing of what is replaced.
        draw = jax.jit(lambda key: simulation.frames(key, HAND, count)[0])
        return np.asarray(draw(jax.random.key(row.seed)))


def trained(name: str, row: Row, epochs: int) -> Model:
    """The model of a row. One that is interrupted counts for nothing: KeyboardInterrupt."""
    markers = simulated(row, FRAMES + HELD_OUT)
    config = TrainingConfig(
        (), Path(), joints=False, epochs=epochs, halve_after=1, stop_after=epochs, seed=row.seed
    )
    with TemporaryDirectory() as folder:
        if row.cameras:
            config = replace(config, occlusions=counted(Path(folder) / "gaps.json"))
        training, validation = Frames(markers[:FRAMES]), Frames(markers[FRAMES:])
        model = fit_networks(training, validation, HAND, config, partial(report, name, epochs))
    if model.training["interrupted"]:
        raise KeyboardInterrupt
    return model


def counted(path: Path) -> str:
    """Writes the gaps of two hands before simulated cameras to a file, and gives its name."""
    occlusions(OcclusionsConfig(files=("simulated",), json=path), Console(quiet=True))
    return str(path)


def report(name: str, epochs: int, metrics: Metrics) -> None:
    """Progress, on one line of its own."""
    print(
        f"\r{name}: epoch {metrics.epoch}/{epochs}, {metrics.validation_cm:.2f} cm on its own kind",
        end="\n" if metrics.epoch == epochs else "",
        file=sys.stderr,
        flush=True,
    )


def table(model: Model, test: Dataset, seeds: int) -> dict[str, Any]:
    """Table 3 of one model."""
    return evaluation.table3({"": model}, test.sequences, seeds=seeds)[""]


if __name__ == "__main__":
    main()
