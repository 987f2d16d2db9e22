"""What simulated hands are worth on recordings: `python experiments/no_data.py sig18:data/sig18`.

Table 3 on a data set's test takes for the affine combination, the bundled model that has seen
simulated hands only, a model of the data's own training takes, and the bundled one refined on
those. A refinement is shown hands in other sizes and a model of recordings alone is not; of either
there is also the other way. Trains four times, some three minutes each on two cores.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from jaxhand import datasets, evaluation
from jaxhand.anthropometry import SIZE_SPREAD
from jaxhand.training import TrainingConfig, train
from numpy_infer import model as models
from numpy_infer.model import Model

CELLS = (("1", "0.1"), ("1", "1.0"), ("4", "0.1"), ("4", "1.0"))
"""Hidden markers and seconds, printed of the twenty cells."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", nargs="+", help="NAME:PATH, see jaxhand train")
    parser.add_argument("--out", type=Path, default=Path("runs/no_data"), help="of the run folders")
    parser.add_argument("--epochs", type=int, default=300, help="at most")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    options = parser.parse_args()
    for data in options.data:
        name = datasets.parse_spec(data).name
        test = datasets.load(data, "test")
        bundled = Path(str(models.WEIGHTS / f"{test.hand.name}.npz"))
        own = TrainingConfig(
            (data,),
            options.out / name,
            joints=False,
            epochs=options.epochs,
            seed=options.seed,
            overwrite=True,
        )
        rows = {
            "affine": Model(test.hand, predictor="affine"),
            "simulated": replace(models.load(bundled), joints="none"),
        }
        for row, start, sizes in (
            ("recorded", None, None),
            ("recorded, other sizes", None, SIZE_SPREAD),
            ("simulated, refined", bundled, None),
            ("simulated, refined as recorded", bundled, 0.0),
        ):
            out = options.out / "_".join((name, *row.replace(",", "").split()))
            model = train(replace(own, out=out, start=start, sizes=sizes))
            rows[row] = replace(model, joints="none")
        table = evaluation.table3(rows, test.sequences, seeds=options.seeds)
        print(f"\n{data}, cm; hidden markers and seconds:", *(f"{c}/{d}" for c, d in CELLS))
        for row, cells in table.items():
            shown = [cells[count][duration] for count, duration in CELLS]
            figures = (f"{c['mean']:.2f} ±{(c['high'] - c['low']) / 2:.2f}" for c in shown)
            ratios = (evaluation.mean_ratio(table, row, rival) for rival in ("affine", "recorded"))
            of_affine, of_recorded = ratios
            print(
                f"  {row:30}",
                *figures,
                f" {of_affine:.3f} of affine, {of_recorded:.3f} of recorded",
            )


if __name__ == "__main__":
    main()
