"""Whether `expected_error` tells the truth: `python experiments/expected_error.py glove9
manipnet:../shared/data/manipnet`.

Gaps like real ones are put into the test takes; whatever is hidden is sorted by what the tracker
expects it to be off, and beside that stands what it was off. `--measured` first measures the
errors anew on the data's validation takes: what a model trained on these data would say.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import jax
import numpy as np

from jaxhand import datasets, simulation
from jaxhand.evaluation import interval
from jaxhand.expected_error import Samples, measure
from jaxhand.export import with_expected_error
from jaxhand.sequences import Sequence as MarkerSequence
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.model import load

EDGES = (0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 20, 25, 32, 40, np.inf)
"""Millimetres: the bins."""
FEWEST, WITHIN = 500, 0.15
"""What is promised: in bins of so many samples the means agree within this part of the measured."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("model", help="a model file or a bundled model")
    parser.add_argument("data", help=f"NAME:PATH, or the word {datasets.SIMULATED}")
    parser.add_argument("--split", choices=("validation", "test"), default="test")
    parser.add_argument("--measured", action="store_true", help="measure on validation first")
    options = parser.parse_args()
    model = replace(load(options.model), predictor="learned", joints="none")
    if options.measured:
        model = with_expected_error(model, takes(options.data, "validation", model.hand))
    show(measure(model, takes(options.data, options.split, model.hand), seed=1))


def takes(spec: str, split: datasets.Split, hand: Hand) -> Sequence[MarkerSequence]:
    """Of a data set; or of simulated people, other ones for the test."""
    if spec == datasets.SIMULATED:
        return simulation.sequences(jax.random.key(1 if split == "validation" else 2), hand)
    return datasets.load(spec, split, hand=hand).sequences


def show(samples: Samples) -> None:
    """Prints the bins, each with the 95 % interval of its ratio."""
    place = np.digitize(1e3 * samples.expected, EDGES) - 1
    print("expected, mm      mean  measured  ratio                  samples")
    missed = surely = counted = 0
    for i in np.unique(place):
        inside = place == i
        off, low, high = line(f"{EDGES[i]:g} to {EDGES[i + 1]:g}", samples, inside)
        if inside.sum() >= FEWEST:
            counted += 1
            missed += abs(off - 1) > WITHIN
            surely += low > 1 + WITHIN or high < 1 - WITHIN
    line("all", samples, np.ones_like(place, bool))
    correlation = np.corrcoef(samples.expected, samples.measured)[0, 1]
    print(
        f"correlation {correlation:.2f}; of {counted} bins with {FEWEST} samples or more, {missed} "
        f"are more than {WITHIN:.0%} off, {surely} of them beyond chance"
    )


def line(name: str, samples: Samples, inside: Array) -> tuple[float, float, float]:
    """Prints a line for some of the samples. Gives the ratio of what was expected to what was
    measured, and its interval by a bootstrap of blocks of time."""
    sums = [
        np.bincount(samples.block[inside], 1e3 * values[inside])
        for values in (samples.expected, samples.measured)
    ]
    cell, count = interval(*sums), inside.sum()
    off, low, high = (np.nan if cell[k] is None else cell[k] for k in ("mean", "low", "high"))
    mean, truly = (part.sum() / count for part in sums)
    print(f"{name:14}{mean:8.2f}{truly:10.2f}{off:7.2f} ({low:5.2f} to {high:5.2f}){count:9}")
    return off, low, high


if __name__ == "__main__":
    main()
