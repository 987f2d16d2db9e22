"""Trains the models that come with the package: `python experiments/bundled_weights.py`.

On simulated hands alone, one model for each bundled hand; some five minutes each on two cores.
`numpy_infer/weights/CARD.md` says what they are worth on recordings.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

from jaxhand.training import TrainingConfig, train
from numpy_infer.hand import bundled

WEIGHTS = Path(__file__).resolve().parents[1] / "numpy_infer" / "weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", default=bundled(), help="default: all bundled hands")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the run folders")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder of the models")
    parser.add_argument("--epochs", type=int, default=150, help="at most, of each network")
    options = parser.parse_args()
    for hand in options.hands:
        run = options.runs / f"bundled_{hand}"
        train(TrainingConfig(("simulated",), run, hand=hand, epochs=options.epochs, overwrite=True))
        options.out.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(run / "model.npz", options.out / f"{hand}.npz")
        print(f"wrote {options.out / hand}.npz")


if __name__ == "__main__":
    main()
