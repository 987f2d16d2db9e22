"""Trains the models that come with the package: `python experiments/bundled_weights.py`.

On simulated hands alone, one model for each bundled hand; some five minutes each on two cores.
`--errors` keeps the networks and only measures anew what errors to expect, within a minute each.
`numpy_infer/weights/CARD.md` says what they are worth on recordings.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from jaxhand.expected_error import people
from jaxhand.export import export, with_expected_error
from jaxhand.training import TrainingConfig, train
from numpy_infer.hand import bundled
from numpy_infer.model import load

WEIGHTS = Path(__file__).resolve().parents[1] / "numpy_infer" / "weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", default=bundled(), help="default: all bundled hands")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the run folders")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder of the models")
    parser.add_argument("--epochs", type=int, default=150, help="at most, of each network")
    parser.add_argument("--errors", action="store_true", help="train nothing, measure errors")
    options = parser.parse_args()
    for hand in options.hands:
        file = options.out / f"{hand}.npz"
        if not options.errors:
            run = options.runs / f"bundled_{hand}"
            epochs = options.epochs
            train(TrainingConfig(("simulated",), run, hand=hand, epochs=epochs, overwrite=True))
            options.out.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(run / "model.npz", file)
        model = load(file)
        model = with_expected_error(model, people(model.hand, seed=1), print)
        export(model, file, overwrite=True)
        print(f"wrote {file}", flush=True)


if __name__ == "__main__":
    main()
