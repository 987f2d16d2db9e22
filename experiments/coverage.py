"""Whether a calibration's intervals hold what they say: `python experiments/coverage.py`.

Simulated people in `dense19`, out of the very priors that the fit is given: their bones, offsets
2 mm off per axis, 1 mm of noise. How far off each kind of unknown is, and how much of it lies
within its 95 % interval; a person's frames are off together, so people are drawn again for the
interval of that share.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import jax
import numpy as np

from jaxhand import arrow, motion, simulation
from jaxhand.calibration import Calibration, Priors, Unknowns, calibrate
from jaxhand.motion import Motion
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, POINTS, Hand, load_hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

RATE, NOISE, OFFSET = 60.0, 1e-3, 2e-3
DRAWN = 2000
"""How often people are drawn again."""
MCP = [i for i, a in enumerate(ANGLES) if "_mcp_" in a.name and "thumb" not in a.name]
PIP = [i for i, point in enumerate(POINTS) if point.endswith("pip")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--people", type=int, default=96)
    parser.add_argument("--seconds", type=float, default=4)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    hand = load_hand("dense19")
    rng = np.random.default_rng(options.seed)
    moves = movements(jax.random.key(options.seed), options.people, round(RATE * options.seconds))
    inside, off = [], []
    for number in range(options.people):
        own = somebody(hand, rng)
        move = Motion(*(array[number] for array in moves))
        points, markers = worn(own, move)
        markers += NOISE * rng.normal(size=markers.shape)
        found = calibrate(hand, markers, rate=RATE, priors=Priors(offset=OFFSET))
        errors = errors_of(found, own, move)
        inside.append([within(*pair) for pair in zip(errors, found.interval, strict=True)])
        far = np.linalg.norm(places(found) - points, axis=-1)
        parts = errors.bone_lengths[PIP], np.degrees(errors.angles[:, MCP]), far[:, PIP]
        off.append([rms(part) for part in parts])
        print(f"person {number}: {100 * np.mean(inside[-1]):.0f} % within", flush=True)
    again = np.array(inside)[rng.integers(0, options.people, (DRAWN, options.people))].mean(1)
    print(f"{options.people} people, {options.seconds:g} s: % within the 95 % interval")
    for name, mean, drawn in zip(Unknowns._fields, np.mean(inside, 0), again.T, strict=True):
        low, high = np.quantile(drawn, (0.025, 0.975))
        print(f"  {name:16} {100 * mean:.1f} ({100 * low:.1f}-{100 * high:.1f})")
    bone, angle, place = np.sqrt(np.mean(np.square(off), 0)) * (1e3, 1, 1e3)
    print(f"rms: first phalanx {bone:.2f} mm, MCP {angle:.2f}°, PIP {place:.2f} mm")


def movements(key: Array, people: int, frames: int) -> Motion:
    """From posture to posture of those that the prior of the angles is rounded from, float64."""
    count = motion.enough(frames / RATE, motion.MOVE_SECONDS)

    @jax.jit
    def draw(key: Array) -> Motion:
        postures = simulation.poses(key, (people, count))
        return motion.motion(key, frames, RATE, (people,), postures=postures)

    return Motion(*(np.asarray(array, np.float64) for array in draw(key)))


def somebody(hand: Hand, rng: np.random.Generator) -> Hand:
    """A hand out of the priors, its markers out of theirs."""
    known = Priors()
    spread = np.repeat([known.size, known.bone, known.bone], arrow.WIDTHS)
    unlike = np.float32(spread * rng.normal(size=len(spread)))
    bones = np.asarray(arrow.skeleton(np.float32(hand.skeleton), unlike), np.float64)
    offsets = hand.offsets + OFFSET * rng.normal(size=hand.offsets.shape)
    return replace(hand, offsets=offsets).with_skeleton(bones)


def worn(hand: Hand, move: Motion) -> tuple[Array, Array]:
    """Points `[T, 21, 3]` and markers `[T, M, 3]` metres, world."""
    local = rotations_from_angles(move.angles)
    points, rotations = forward_kinematics(hand.skeleton, local, *move[1:])
    return points, marker_positions(hand, points, rotations)


def errors_of(found: Calibration, own: Hand, move: Motion) -> Unknowns:
    """How far off what was found is."""
    angles, rotation, position = move
    lengths = (np.linalg.norm(hand.skeleton, axis=-1) for hand in (found.hand, own))
    return Unknowns(
        np.subtract(*lengths),
        found.hand.offsets - own.offsets,
        found.angles - angles,
        arrow.axial(found.wrist_rotation @ rotation.swapaxes(-1, -2)),
        found.wrist_position - position,
    )


def places(found: Calibration) -> Array:
    """`[T, 21, 3]` metres, world."""
    local = rotations_from_angles(found.angles)
    return forward_kinematics(
        found.hand.skeleton, local, found.wrist_rotation, found.wrist_position
    )[0]


def within(error: Array, interval: Array) -> float:
    """The share of what was to be found that is."""
    return float((np.abs(error) <= interval)[interval > 0].mean())


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
