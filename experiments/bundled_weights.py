"""Trains the models that come with the package: `python experiments/bundled_weights.py`.

On simulated hands alone, one model for each bundled hand; some five minutes each on two cores.
`--finish` keeps the networks and only chooses the blend's fade and measures what errors to expect
anew, within two minutes each.
`numpy_infer/weights/CARD.md` says what they are worth on recordings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax

from jaxhand import simulation
from jaxhand.export import export, finish, with_expected_error
from jaxhand.training import TrainingConfig, train
from jaxhand.training_data import PEOPLE, SECONDS
from numpy_infer.hand import bundled
from numpy_infer.model import load

WEIGHTS = Path(__file__).resolve().parents[1] / "numpy_infer" / "weights"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("hands", nargs="*", default=bundled(), help="default: all bundled hands")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of the run folders")
    parser.add_argument("--out", type=Path, default=WEIGHTS, help="folder of the models")
    parser.add_argument("--epochs", type=int, default=150, help="at most, of each network")
    parser.add_argument("--finish", action="store_true", help="keep the networks as they are")
    options = parser.parse_args()
    for hand in options.hands:
        file = options.out / f"{hand}.npz"
        if options.finish:
            model = load(file)
            moving = simulation.sequences(jax.random.key(0), model.hand, PEOPLE, SECONDS)
            model = finish(model, moving, print)
        else:
            run = options.runs / f"bundled_{hand}"
            epochs = options.epochs
            train(TrainingConfig(("simulated",), run, hand=hand, epochs=epochs, overwrite=True))
            options.out.mkdir(parents=True, exist_ok=True)
            model = load(run / "model.npz")
        others = simulation.sequences(jax.random.key(1), model.hand)
        model = with_expected_error(model, others, print)
        export(model, file, overwrite=True)
        print(f"wrote {file}", flush=True)


if __name__ == "__main__":
    main()
