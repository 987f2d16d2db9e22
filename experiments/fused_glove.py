"""A glove that drifts, and markers with holes: `python experiments/fused_glove.py`.

Simulates a minute of people who wear an IMU glove (flexion only, 0.5 degrees a second of drift, 5
degrees of offset) and nine markers with gaps, their bones and where their markers sit known, and
prints how far PIP, DIP and tip (thumb: MCP, IP, tip) are off: with the glove alone, by the paper's
plain route, and fused. With --plot it draws one fingertip's error over time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from jaxhand import fusion, simulation
from jaxhand.skeleton import forward_kinematics
from jaxhand.tasks import JOINT_POINTS
from numpy_infer.arrays import Array
from numpy_infer.hand import POINTS, load_hand

RATE, NOISE = 60.0, 0.5e-3
POINTS_MEASURED = np.array(JOINT_POINTS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--people", type=int, default=6)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path, help="draw an index fingertip's error over time")
    options = parser.parse_args()
    hand, frames = load_hand("glove9"), round(options.seconds * RATE)
    stream_key, imu_key = jax.random.split(jax.random.key(options.seed))
    streams = simulation.streams(stream_key, hand, options.people, frames, RATE)
    rng = np.random.default_rng(options.seed)
    errors: dict[str, list[Array]] = {"glove alone": [], "the paper's route": [], "fused": []}
    for person in range(options.people):
        own = replace(hand, offsets=np.asarray(streams.offsets[person], np.float64))
        own = own.with_skeleton(np.asarray(streams.skeleton[person]))
        imu = fusion.simulate_imu(jax.random.fold_in(imu_key, person), streams.angles[person], RATE)
        markers = np.array(streams.markers[person]) + NOISE * rng.standard_normal((frames, 9, 3))
        markers[~np.asarray(streams.visible[person])] = np.nan
        fused = fusion.fuse(own, imu, markers, 1 / RATE)
        plain = fusion.paper_fuse(own, imu, markers, 1 / RATE)
        wrist = fused.wrist_rotation, fused.wrist_position  # the glove has no place of its own
        truth = np.asarray(streams.positions[person])
        for name, rotations in zip(errors, (imu, plain.rotations, fused.rotations), strict=True):
            placed, _ = forward_kinematics(np.float32(own.skeleton), rotations, *wrist)
            errors[name].append(1e3 * np.linalg.norm(np.asarray(placed) - truth, axis=-1))
        print(
            f"person {person}: "
            + ", ".join(
                f"{n} {e[-1][:, POINTS_MEASURED].mean():.2f} mm" for n, e in errors.items()
            ),
            flush=True,
        )
    print("\nmean and 99 % error of the joints, mm")
    for name, parts in errors.items():
        values = np.concatenate(parts)[:, POINTS_MEASURED]
        print(f"  {name:18} {values.mean():6.2f} {np.quantile(values, 0.99):6.1f}")
    if options.plot is not None:
        draw(errors, options.plot)


def draw(errors: dict[str, list[Array]], path: Path) -> None:
    """The error of the first person's index fingertip over time, in mm."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.2), layout="constrained")
    panel = figure.subplots()
    for (name, parts), colour in zip(
        errors.items(), ("#8c8c8c", "#e69f00", "#0072b2"), strict=True
    ):
        tip = parts[0][:, POINTS.index("index_tip")]
        panel.plot(np.arange(len(tip)) / RATE, tip, color=colour, linewidth=1, label=name)
    panel.set_xlabel("time (s)")
    panel.set_ylabel("index fingertip off by (mm)")
    panel.legend(frameon=False, loc="upper left")
    figure.savefig(path, dpi=150)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
