"""How good the joints are: Table 4 through the whole pipeline, and what stands beside it.

The protocol is that of Table 3 (see `evaluation`); the error is the mean distance of PIP, DIP and
tip of the fingers, MCP, IP and tip of the thumb, to the truth on the last hidden frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand import evaluation, ik, sparse_fit
from jaxhand import sequences as data
from jaxhand.compiled import compiled
from jaxhand.evaluation import Cell, Report, Starts, interval
from jaxhand.geometry import kabsch
from jaxhand.joints import joint_stage
from jaxhand.output import wrist_pose
from jaxhand.skeleton import forward_kinematics, rotations_from_angles
from jaxhand.sparse_fit import PosePrior
from jaxhand.tasks import JOINT_POINTS
from numpy_infer.arrays import Array
from numpy_infer.hand import CHAINS, Hand, bundled, load_hand
from numpy_infer.model import Model
from numpy_infer.pose import HandPose
from numpy_infer.wearer import worn_by

POINTS = np.array(JOINT_POINTS)

TIPS = np.array([chain[-1] for chain in CHAINS])

ROWS = (
    *("ik", "ik_tuned", "least_squares", "learned", "learned_unaligned", "learned_uncalibrated"),
    "noise_floor",
)
"""Names in Table 4 that are taken, see `rows` and `noise_floor_row`."""

SOLVED_EVERY = 10
"""A solver takes every tenth start, once: it is a thousand times slower than a network."""

STILL_NOISE = 5e-4
"""Metres per axis: noise of the markers of a hand that is held still."""

Solve = Callable[[Array], Array]
"""A joint stage: all markers `[N, M, 3]` → positions `[N, 21, 3]`; metres, world."""


class Row(NamedTuple):
    """One method of Table 4."""

    model: Model
    """What fills the markers and, without `solve`, makes the joints."""
    solve: Solve | None = None
    """What makes the joints of the filled markers instead."""
    hides: bool = True
    """False: it is measured with nothing hidden alone, which takes little time."""


def rows(
    model: Model, dataset: data.Dataset, others: Mapping[str, Model] | None = None
) -> dict[str, Row]:
    """The methods of Table 4 for a model, all with the data set's own bones and marker places but
    one.

    `learned` is the pipeline with finger alignment, `learned_unaligned` without it, with nothing
    hidden alone, `learned_uncalibrated` with it on the bones of the bundled hand, as somebody has
    it who never calibrates; `ik` and `ik_tuned` are the paper's rival on the same filled markers,
    and `least_squares` the likeliest posture, with the prior that the model's training left behind.

    Args:
        model: with both networks.
        dataset: whose hand is taken.
        others: further models by the name of their row, none of `ROWS`.
    """
    wearer = dataset.hand
    uncalibrated = replace(model, predictor="learned", joints="learned", alignment=True)
    learned = worn_by(uncalibrated, wearer)
    filled = replace(learned, joints="none")
    found = {
        "ik": Row(filled, partial(_descend, wearer, tuned=False)),
        "ik_tuned": Row(filled, partial(_descend, wearer, tuned=True)),
    }
    posture = model.training.get("posture")
    if posture is not None:
        prior = PosePrior(*(np.array(posture[name], np.float32) for name in PosePrior._fields))
        found["least_squares"] = Row(filled, partial(_fit, wearer, prior))
    found["learned"] = Row(learned)
    found["learned_unaligned"] = Row(replace(learned, alignment=False), hides=False)
    if model.hand.name in bundled():
        average = model.hand.with_skeleton(load_hand(model.hand.name).skeleton)
        found["learned_uncalibrated"] = Row(replace(uncalibrated, wearer=average))
    for name, other in (others or {}).items():
        found[name] = Row(worn_by(replace(other, alignment=True), wearer))
    return found


def _descend(wearer: Hand, markers: Array, *, tuned: bool) -> Array:
    return np.asarray(ik.ccd(wearer, markers, tuned=tuned).positions)


def _fit(wearer: Hand, prior: PosePrior, markers: Array) -> Array:
    return np.asarray(sparse_fit.least_squares(wearer, markers, prior).positions)


def table4(
    methods: Mapping[str, Row],
    dataset: data.Dataset,
    *,
    seeds: int = evaluation.SEEDS,
    report: Report = lambda name, share: None,
) -> dict[str, dict[str, Any]]:
    """Joint error of each method, `{METHOD: {"0": CELL, "1".."4": {"0.1".."2.0": CELL}}}`, in cm.

    Args:
        methods: see `rows`.
        dataset: with joint truth.
        seeds: how many times every start is taken, with other markers hidden; a `solve` takes every
            `SOLVED_EVERY`-th, once.
        report: is told the method at work and the share of its trials done.

    Raises:
        ValueError: no joint truth, or no sequence is long enough.
    """
    truth = _truth(dataset)
    starts = evaluation.find_starts(dataset.sequences)
    table: dict[str, dict[str, Any]] = {}
    for name, row in methods.items():
        own, times = starts, seeds
        if row.solve is not None:
            own, times = Starts(starts.frames, *(a[::SOLVED_EVERY] for a in starts[1:])), 1
        errors = partial(_joint_errors, row, truth)
        shortest = evaluation.DURATIONS[:1]
        seen = evaluation.table_of(
            row.model, own, 1, errors=errors, counts=(0,), durations=shortest
        )
        if row.hides:
            told = partial(report, name)
            hidden = evaluation.table_of(row.model, own, times, told, errors=errors)
        else:
            hidden = _not_measured()
            report(name, 1.0)
        table[name] = {"0": next(iter(seen["0"].values())), **hidden}
    return table


def noise_floor_row(dataset: data.Dataset) -> dict[str, Any]:
    """What the truth of a data set that was fitted is off by itself, as a row of Table 4 with
    nothing hidden; the other cells are empty. Blocks are takes."""
    assert dataset.noise_floor is not None
    blocks = [off[np.isfinite(off)] for off in dataset.noise_floor.values()]
    total = 1e2 * np.array([block.sum() for block in blocks])
    cell = interval(total, np.array([len(block) for block in blocks]))
    return {"0": cell, **_not_measured()}


def _not_measured() -> dict[str, dict[str, Cell]]:
    """The cells with markers hidden of a row that has none."""
    empty = interval(np.zeros(0), np.zeros(0, int))
    durations = [f"{duration:.1f}" for duration in evaluation.DURATIONS]
    return {str(count): dict.fromkeys(durations, empty) for count in evaluation.COUNTS}


def wrist_errors(
    model: Model, dataset: data.Dataset, seeds: int = evaluation.SEEDS
) -> dict[str, dict[str, Cell]]:
    """Error of the wrist's pose with nothing and with 1, 2, 3 alignment markers hidden for half a
    second, `{"0".."3": {"mm", "deg"}}`."""
    starts, result = evaluation.find_starts(dataset.sequences), {}
    truth = np.concatenate([s.positions[:, 0] for s in dataset.sequences])  # type: ignore[index]
    turned = np.concatenate([s.rotations[:, 0] for s in dataset.sequences])  # type: ignore[index]
    for count in range(len(model.hand.alignment) + 1):
        cells = {}
        for key, measure in (
            ("mm", lambda pose, last: _millimetres(pose, truth[last])),
            ("deg", lambda pose, last: _degrees(pose.wrist_rotation, turned[last])),
        ):
            errors = partial(_wrist_errors, model, measure)
            times = 1 if count in (0, len(model.hand.alignment)) else seeds
            table = evaluation.table_of(
                model, starts, times, errors=errors, counts=(count,), durations=(0.5,)
            )
            cells[key] = table[str(count)]["0.5"]
        result[str(count)] = cells
    return result


def steadiness(model: Model, dataset: data.Dataset, seed: int = 0) -> dict[str, float | None]:
    """How quiet the output is, in mm.

    Returns:
        `jitter`, `jitter_of_truth`: mean size of the third difference of the joints' positions from
        frame to frame, nothing hidden, and the same of the truth, over all four frames in a row
        that have all markers and joint truth; None where there are none. `still`: mean step of the
        joints of a hand that stands still, with `STILL_NOISE` on its markers.

    Raises:
        ValueError: no frame has all markers and joint truth.
    """
    frames = _known(dataset)
    lengths = np.array([len(sequence.markers) + 1 for sequence in dataset.sequences])
    place = (np.cumsum(lengths) - lengths)[frames.sequence] + frames.index
    found: Array = evaluate_poses(model, frames.markers).positions
    # Between sequences stands a frame that is none: no difference reaches across it.
    whole = np.full((2, lengths.sum(), *found.shape[1:]), np.nan, np.float32)
    whole[:, place] = found, frames.positions
    jitter, of_truth = ([*off[np.isfinite(off)]] for off in map(_third, whole))
    rng = np.random.default_rng(seed)
    shape = (300, len(model.hand), 3)
    still = frames.markers[0] + STILL_NOISE * rng.standard_normal(shape)
    held: Array = evaluate_poses(model, still.astype(np.float32)).positions
    return {
        "jitter": float(np.mean(jitter)) if jitter else None,
        "jitter_of_truth": float(np.mean(of_truth)) if of_truth else None,
        "still": float(1e3 * np.linalg.norm(np.diff(held, axis=0), axis=-1)[:, POINTS].mean()),
    }


def tip_distance_errors(model: Model, dataset: data.Dataset) -> Cell:
    """Mean error in mm of the distances from the thumb's tip to the other fingers' tips, in frames
    where that is less than 3 cm: what decides whether a pinch looks like one. Nothing hidden.
    ValueError as `steadiness`."""
    frames = _known(dataset)
    assert frames.positions is not None
    found = evaluate_poses(model, frames.markers).positions
    apart, wanted = _tip_distances(found), _tip_distances(frames.positions)
    near = wanted < 0.03
    off = 1e3 * np.abs(apart - wanted)
    blocks = np.broadcast_to(frame_blocks(dataset, frames)[:, None], near.shape)
    return _interval_of(off[near], blocks[near])


def joint_errors(model: Model, dataset: data.Dataset) -> dict[str, dict[str, Cell]]:
    """The joint stage with nothing hidden, `{METHOD: {"cm", "deg", "wrist_mm", "wrist_deg"}}`.

    `cm` is the mean distance of PIP, DIP and tip (thumb: MCP, IP, tip) to the truth, through the
    whole pipeline, wrist pose and the model's own bone lengths included; `deg` the mean angle error
    over the angles that the data determine. `learned` is the model, `mean_pose` the same with the
    mean angles of its training data, whatever the markers say.

    Raises:
        ValueError: the model has no joint network, or no frame all markers and joint truth.
    """
    if model.joint_network is None:
        raise ValueError("the model has no joint network")
    frames = _known(dataset)
    assert frames.positions is not None
    assert frames.rotations is not None
    assert frames.angles is not None
    observed = dataset.observed_angles
    observed = np.ones(frames.angles.shape[-1], bool) if observed is None else observed
    poses = evaluate_poses(model, frames.markers)
    mean_angles = np.broadcast_to(model.joint_network.output_mean, frames.angles.shape)
    mean_positions = _positions(model, mean_angles, poses.wrist_rotation, poses.wrist_position)
    blocks = frame_blocks(dataset, frames)
    truth = frames.rotations[:, 0]
    wrist = {
        "wrist_mm": _millimetres(poses, frames.positions[:, 0]),
        "wrist_deg": _degrees(poses.wrist_rotation, truth),
    }
    rows = {"learned": (poses.angles, poses.positions), "mean_pose": (mean_angles, mean_positions)}
    result = {}
    for name, (angles, positions) in rows.items():
        distance = np.linalg.norm(positions - frames.positions, axis=-1)[:, POINTS]
        turned = np.abs(np.degrees(angles - frames.angles))[:, observed]
        values = {"cm": 1e2 * distance.mean(-1), "deg": turned.mean(-1), **wrist}
        result[name] = {key: _interval_of(value, blocks) for key, value in values.items()}
    return result


class Poses(NamedTuple):
    """Fields of `HandPose`, `[N]` of each."""

    wrist_rotation: Array
    wrist_position: Array
    angles: Array
    rotations: Array
    positions: Array


def evaluate_poses(model: Model, markers: Array) -> Poses:
    """What the tracker says of the hand in complete frames `[N, M, 3]`, each as a first frame."""
    model = replace(model, joints="learned")
    chunks, size = evaluation.chunked(len(markers))
    parts = []
    for chunk in chunks:
        part = markers[chunk]
        poses = _poses(model, jnp.asarray(evaluation.padded(part, size), jnp.float32))
        parts.append([np.asarray(array)[: len(part)] for array in poses])
    return Poses(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


@compiled
def _poses(model: Model, markers: Array) -> Poses:
    # Nothing is hidden, so what the tracker gives out is what it is given.
    template = jnp.asarray(model.hand.template, markers.dtype)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=markers.dtype), (len(markers), 3, 3))
    prior = kabsch(template, markers, jnp.ones_like(markers[..., 0]), eye)[0]
    rotation, position = wrist_pose(model, markers, prior)
    return Poses(rotation, position, **joint_stage(model, markers, rotation, position))


@jax.jit
def _positions(model: Model, angles: Array, rotation: Array, position: Array) -> Array:
    local = rotations_from_angles(angles)
    skeleton = jnp.asarray(model.hand.skeleton, angles.dtype)
    return forward_kinematics(skeleton, local, rotation, position)[0]


def frame_blocks(dataset: data.Dataset, frames: data.CompleteFrames) -> Array:
    """`[N]` bootstrap block of each complete frame."""
    takes: dict[tuple[str, int], int] = {}
    blocks = []
    for number, index in zip(frames.sequence, frames.index, strict=True):
        sequence = dataset.sequences[number]
        key = (sequence.take, int(index / (sequence.rate * evaluation.BLOCK_SECONDS)))
        blocks.append(takes.setdefault(key, len(takes)))
    return np.array(blocks)


def _interval_of(values: Array, blocks: Array) -> Cell:
    return interval(np.bincount(blocks, values), np.bincount(blocks))


def _known(dataset: data.Dataset) -> data.CompleteFrames:
    """The frames with all markers and joint truth.

    Raises:
        ValueError: there is none.
    """
    if any(s.positions is None or s.angles is None for s in dataset.sequences):
        raise ValueError(f"data set {dataset.name!r} has no joint truth")
    frames = data.complete_frames(dataset)
    if not len(frames.index):
        raise ValueError(f"data set {dataset.name!r} has no frame with all markers and joint truth")
    return frames


def _truth(dataset: data.Dataset) -> Array:
    """`[F, 21, 3]` metres, all sequences end to end as in `Starts.frames`. ValueError as
    `_known`."""
    _known(dataset)
    return np.concatenate([s.positions for s in dataset.sequences if s.positions is not None])


def _joint_errors(
    row: Row,
    truth: Array,
    state: Any,
    starts: Starts,
    count: int,
    duration: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Mean error of the joints in cm, and the block, of each admissible trial."""
    hidden = evaluation.hide(rng, len(starts.start), len(row.model.hand), count)
    trials, block = evaluation.run_trials(row.model, state, starts, hidden, duration)
    found = trials.pose.positions
    if not len(block):
        return np.zeros(0), block
    if row.solve is not None:
        # As many each time: another number would compile anew.
        size = len(state.tracked)
        markers = evaluation.padded(trials.pose.markers, size)
        found = row.solve(markers)[: len(block)]
    off = np.linalg.norm(found - truth[trials.last], axis=-1)[:, POINTS].mean(-1)
    known = np.isfinite(off)  # a frame may have no truth
    return 1e2 * off[known], block[known]


def _wrist_errors(
    model: Model,
    measure: Callable[[HandPose, Array], Array],
    state: Any,
    starts: Starts,
    count: int,
    duration: float,
    rng: np.random.Generator,
) -> tuple[Array, Array]:
    """Error of the wrist with `count` of the alignment markers hidden, and the block."""
    alignment = list(model.hand.alignment)
    hidden = np.zeros((len(starts.start), len(model.hand)), bool)
    hidden[:, alignment] = evaluation.hide(rng, len(hidden), len(alignment), count)
    trials, block = evaluation.run_trials(model, state, starts, hidden, duration)
    off = measure(trials.pose, trials.last)
    return off[np.isfinite(off)], block[np.isfinite(off)]


def _millimetres(pose: HandPose | Poses, position: Array) -> Array:
    return 1e3 * np.linalg.norm(pose.wrist_position - position, axis=-1)


def _degrees(rotation: Array, truth: Array) -> Array:
    """Angle between rotations; from the sine too, for the cosine alone is blind below 0.02°."""
    between = np.swapaxes(rotation, -1, -2).astype(float) @ truth
    skew = between - np.swapaxes(between, -1, -2)
    sine = np.sqrt((skew * skew).sum((-1, -2)) / 8)
    cosine = (np.trace(between, axis1=-2, axis2=-1) - 1) / 2
    return np.degrees(np.arctan2(sine, cosine))


def _third(positions: Array) -> Array:
    """`[T - 3]` mean size of the third difference, mm."""
    off = np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1)[:, POINTS]
    return np.asarray(1e3 * off.mean(-1))


def _tip_distances(positions: Array) -> Array:
    """`[N, 4]` metres from the thumb's tip."""
    tips = positions[:, TIPS]
    return np.linalg.norm(tips[:, 1:] - tips[:, :1], axis=-1)
