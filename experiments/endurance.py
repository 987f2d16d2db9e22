"""Whether memory grows while hands are tracked: `python experiments/endurance.py --frames 1000000`.

The bundled model, with gate and finger alignment, in fresh processes of numpy alone: one hand, then
two, five simulated minutes with their gaps, there and back until the frames are done. Printed is
what is resident beyond numpy and the recording, from before `numpy_infer` is imported on.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import cycle, islice
from multiprocessing import get_context
from typing import Any

# Before numpy is loaded, here and in the fresh processes: one thread, as in `stages.py`.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

WARM_UP = 0.1
"""Part of the frames after which nothing may grow any more."""


def resident() -> float:
    """Megabytes of this process."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096 / 1e6


def recording() -> np.ndarray:
    """`[T, 2, M, 3]` as `stages.filmed` gives it."""
    from stages import RATE, SECONDS, filmed

    return filmed(round(RATE * SECONDS))


def track(markers: np.ndarray, hands: int, frames: int) -> None:
    """Prints memory at every tenth of the frames, and what it has grown since the warm-up."""
    markers = markers if hands == 2 else np.ascontiguousarray(markers[:, 0])
    bare = resident()
    from numpy_infer import HandTracker

    tracker = HandTracker.load(alignment=True, right=[False, True] if hands == 2 else False)
    print(f"\n{'one hand' if hands == 1 else 'two hands'}\n{'frames':>10} {'MB':>7}")
    print(f"{0:10,} {resident() - bare:7.2f}", flush=True)
    there_and_back = cycle([*range(len(markers)), *range(len(markers) - 2, 0, -1)])
    done, taken = 0, []
    for part in np.diff(np.linspace(0, frames, round(1 / WARM_UP) + 1).astype(int)):
        for i in islice(there_and_back, int(part)):
            tracker.step(markers[i], 1 / 60)
        done += part
        taken.append(resident() - bare)
        print(f"{done:10,} {taken[-1]:7.2f}", flush=True)
    grown = taken[-1] - taken[0], max(taken) - taken[0]
    print(f"since the first tenth {grown[0]:+.2f}, at most {grown[1]:+.2f}")


def fresh(function: Callable[..., Any], *arguments: Any) -> Any:
    """What the function gives in a new process: what is measured must not hold JAX, or a past."""
    with ProcessPoolExecutor(1, get_context("spawn")) as process:
        return process.submit(function, *arguments).result()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=18_000, help="for one hand, and for two")
    parser.add_argument("--hands", type=int, nargs="+", choices=(1, 2), default=(1, 2))
    options = parser.parse_args()
    markers = fresh(recording)
    for hands in options.hands:
        fresh(track, markers, hands, options.frames)


if __name__ == "__main__":
    main()
