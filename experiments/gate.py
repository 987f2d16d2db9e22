"""What the gate is worth, and what it costs: `python experiments/gate.py`.

Wrong positions are put into recordings: markers that jump by more than 2 cm, neighbouring fingers
that carry each other's label, markers frozen for more than 0.3 s; a third of the wrong time each.
The bundled model tracks them with the gate and without it. `--look DIRECTORY` draws what was
refused although right, and accepted although wrong.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxhand import datasets
from jaxhand.sequences import RATE, Dataset
from numpy_infer import tracker
from numpy_infer.arrays import Array
from numpy_infer.model import Model, load
from numpy_infer.pose import Status
from numpy_infer.reach import reach

LEVELS = (0.0, 0.001, 0.003, 0.01, 0.03)
"""Parts of all marker time."""
BLOCK = 600
"""Frames that are tracked as one stream; many streams run at once."""
LEAST_JUMP, JUMP = 0.02, 0.05
"""Metres: the least jump, and the standard deviation along each axis."""
SECONDS = {"jumped": (0.05, 0.1), "swapped": (0.05, 0.2), "frozen": (0.3, 0.2)}
"""The shortest fault of a kind, and the mean of what exponentially distributed time it lasts
longer."""


class Faulty(NamedTuple):
    """Streams with wrong positions."""

    markers: Array
    """`[T, H, M, 3]` metres, world; 0 where hidden."""
    visible: Array
    """`[T, H, M]` True where measured."""
    kind: Array
    """`[T, H, M]` 0 where right, else 1 + the place of the fault in `SECONDS`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    root = Path(os.environ.get("JAXHAND_DATA", "../shared/data"))
    parser.add_argument(
        "--data", type=Path, default=root, help="folder of manipnet, sig18, qualisys"
    )
    parser.add_argument("--split", choices=("train", "validation", "test"), default="test")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--look", type=Path, help="where to draw refused and missed cases")
    options = parser.parse_args()
    for name in ("manipnet", "sig18", "qualisys"):
        split = "test" if name == "qualisys" else options.split
        clean(f"{name}:{options.data / name}", split)
    faults(f"manipnet:{options.data / 'manipnet'}", options.split, options.seeds, options.look)


def clean(spec: str, split: datasets.Split) -> None:
    """Prints how much of a recording as it is, with its own gaps, the gate refuses."""
    data = datasets.load(spec, split)
    model = load(data.hand.name)
    refused = seen = frames = 0
    begin = time.perf_counter()
    for markers in streams(data):
        visible = np.isfinite(markers).all(-1)
        accepted, _ = track(model, np.nan_to_num(markers), visible)
        refused += int((visible & ~accepted).sum())
        seen += int(visible.sum())
        frames += visible[..., 0].size
    print(
        f"{data.name:10}{split:11} {refused} of {seen} observations refused: 1 in "
        f"{seen / max(refused, 1):.0f}  ({time.perf_counter() - begin:.0f} s)",
        flush=True,
    )


def faults(spec: str, split: datasets.Split, seeds: int, look: Path | None) -> None:
    """Prints what the gate makes of injected faults."""
    data = datasets.load(spec, split)
    model = load(data.hand.name)
    pairs = reach(model.hand).neighbours
    kinds = "".join(f"{kind:>10}" for kind in SECONDS)
    print(
        f"{'wrong':>7}{'error, mm':>11}{'with gate':>11}{'repaired':>10}{'broken':>8}"
        f"   caught:{kinds}",
        flush=True,
    )
    for level in LEVELS:
        totals = np.zeros(3 + 2 * len(SECONDS))
        errors = np.zeros(2)
        equal = True
        for truth in streams(data):
            truth = np.tile(truth, (1, seeds, 1, 1))
            faulty = misplaced(truth, pairs, level, np.random.default_rng(0))
            accepted, with_gate = track(model, faulty.markers, faulty.visible)
            _, without = track(model, faulty.markers, faulty.visible, gated=False)
            refused = faulty.visible & ~accepted
            wrong = faulty.kind > 0
            errors += [np.linalg.norm(out - truth, axis=-1).sum() for out in (without, with_gate)]
            counts = [wrong.size, (refused & wrong).sum(), (refused & ~wrong).sum()]
            for kind in range(1, 1 + len(SECONDS)):
                counts += [(refused & (faulty.kind == kind)).sum(), (faulty.kind == kind).sum()]
            totals += counts
            equal &= bool(refused.any() or (without == with_gate).all())
            if look and level == LEVELS[2]:
                draw(look, truth, faulty, accepted)
        before, after = 1e3 * errors / totals[0]
        shares = "".join(
            f"{100 * caught / number:9.0f}%" if number else f"{'':10}"
            for caught, number in totals[3:].reshape(-1, 2)
        )
        print(
            f"{level:7.1%}{before:11.3f}{after:11.3f}{totals[1]:10.0f}{totals[2]:8.0f}"
            f"{'':11}{shares}{'' if equal else '  outputs differ'}",
            flush=True,
        )


def streams(data: Dataset) -> list[Array]:
    """`[T, H, M, 3]` metres: all sequences cut into streams of one length, and the short rests."""
    blocks: dict[int, list[Array]] = {}
    for sequence in data.sequences:
        for start in range(0, len(sequence.markers), BLOCK):
            block = np.asarray(sequence.markers[start : start + BLOCK], np.float64)
            blocks.setdefault(len(block), []).append(block)
    return [np.stack(same, 1) for same in blocks.values()]


def misplaced(truth: Array, pairs: Array, level: float, rng: np.random.Generator) -> Faulty:
    """Puts faults into complete streams `truth [T, H, M, 3]`; no two of them on one marker."""
    frames, hands, count, _ = truth.shape
    markers, kind = truth.copy(), np.zeros(truth.shape[:-1], int)
    for number, (least, more) in enumerate(SECONDS.values(), 1):
        wanted, tries = level / len(SECONDS) * kind.size, 0
        while (kind == number).sum() < wanted and tries < 10000:
            tries += 1
            length = round(RATE * (least + rng.exponential(more)))
            start, hand = int(rng.integers(1, frames)), int(rng.integers(hands))
            own = pairs[rng.integers(len(pairs))] if number == 2 else [rng.integers(count)]
            part = (slice(start, start + length), hand)
            if any(kind[*part, marker].any() for marker in own):
                continue
            for marker, other in zip(own, own[::-1], strict=True):
                kind[*part, marker] = number
                if number == 1:
                    jump = JUMP * rng.standard_normal(3)
                    jump *= max(1, LEAST_JUMP / np.linalg.norm(jump))
                    markers[*part, marker] += jump
                elif number == 2:
                    markers[*part, marker] = truth[*part, other]
                else:
                    markers[*part, marker] = truth[start - 1, hand, marker]
    kind = np.where((markers != truth).any(-1), kind, 0)
    return Faulty(markers, np.ones(kind.shape, bool), kind)


def track(
    model: Model, markers: Array, visible: Array, *, gated: bool = True
) -> tuple[Array, Array]:
    """`[T, H, M]` True where accepted, `[T, H, M, 3]` the tracker's markers."""
    model = replace(model, gate=gated)
    dt = np.full(visible.shape[:-1], 1 / RATE)
    start = tracker.init(model, visible.shape[1:-1])
    _, pose = tracker.run(model, start, markers, visible, dt)
    return visible & (pose.status != Status.REJECTED), pose.markers


def draw(folder: Path, truth: Array, faulty: Faulty, accepted: Array) -> None:
    """Distances from the truth over time, of a few streams: right and wrong, accepted or not."""
    from matplotlib.figure import Figure

    folder.mkdir(parents=True, exist_ok=True)
    off = 1e2 * np.linalg.norm(faulty.markers - truth, axis=-1)
    names = list(SECONDS)
    for hand in range(min(4, truth.shape[1])):
        figure = Figure(figsize=(14, 8), layout="constrained")
        panels = figure.subplots(truth.shape[2], 1, sharex=True)
        for marker, panel in enumerate(panels):
            own = faulty.kind[:, hand, marker]
            panel.plot(off[:, hand, marker], color="0.7")
            refused = ~accepted[:, hand, marker]
            for mask, colour in ((refused & (own > 0), "g"), (refused & (own == 0), "r")):
                frame = np.flatnonzero(mask)
                panel.plot(frame, off[frame, hand, marker], "." + colour)
            missed = np.flatnonzero(~refused & (own > 0))
            panel.plot(missed, off[missed, hand, marker], ".k")
            panel.set_ylabel(" ".join(sorted({names[k - 1] for k in own if k})) or "right")
        panels[0].set_title("cm off the truth; green refused, black missed, red refused when right")
        figure.savefig(folder / f"{truth.shape[0]}_{hand}.png", dpi=80)


if __name__ == "__main__":
    main()
