"""What the runtime costs before its first frame: `python experiments/footprint.py`.

Each figure is the median of fresh processes, with the middle half, and beyond numpy's own:
importing `numpy_infer`, loading the bundled model, and the memory that both and 100 frames take.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

MEASURED = """
import json, time
import numpy as np

def resident():
    pages = open("/proc/self/statm").read().split()[1]
    return int(pages) * 4096 / 1e6

before, began = resident(), time.process_time()
import numpy_infer
from numpy_infer.model import load
imported = time.process_time()
model = load("MODEL")
loaded = time.process_time()
tracker = numpy_infer.HandTracker(model)
markers = model.hand.template.copy()
for i in range(100):
    markers += 1e-3
    tracker.step(np.where(np.arange(len(markers))[:, None] == i % 7, np.nan, markers), 1 / 60)
print(json.dumps([1e3 * (imported - began), 1e3 * (loaded - imported), resident() - before]))
"""


def footprint(model: str, processes: int) -> np.ndarray:
    """`[processes, 3]` milliseconds of processor for import and load, megabytes."""
    code = MEASURED.replace("MODEL", model)
    root = Path(__file__).resolve().parents[1]

    def run() -> list[float]:
        command = [sys.executable, "-c", code]
        return json.loads(subprocess.run(command, cwd=root, capture_output=True, check=True).stdout)

    run()  # compiles what has changed
    return np.array([run() for _ in range(processes)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="glove9", help="a bundled model")
    parser.add_argument("--processes", type=int, default=21)
    options = parser.parse_args()
    figures = footprint(options.model, options.processes)
    low, middle, high = np.quantile(figures, (0.25, 0.5, 0.75), axis=0)
    names = ("import numpy_infer, ms", f"load {options.model}, ms", "memory after 100 frames, MB")
    for name, *three in zip(names, middle, low, high, strict=True):
        print(f"{name:28} {three[0]:5.1f} ({three[1]:.1f}-{three[2]:.1f})")


if __name__ == "__main__":
    main()
