"""A person's hand out of labelled markers: bone lengths and the markers' places on them, together
with the joint angles and the wrist's pose of every frame.

One least-squares problem with priors, because few markers leave much open. What they leave open is
said: every unknown has an interval and a flag.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import jax
import numpy as np

from jaxhand import arrow
from jaxhand.arrow import Priors, Problem, State
from jaxhand.motion import DIP_SHARE
from numpy_infer import geometry
from numpy_infer import skeleton as runtime
from numpy_infer.arrays import Array, floats
from numpy_infer.hand import (
    ANGLES,
    CHAINS,
    FINGER_OF_ANGLE,
    FINGER_OF_POINT,
    FINGERS,
    SLOT_OF_ANGLE,
    Hand,
)
from numpy_infer.pose import DETERMINED_EXTENT

__all__ = ["Calibration", "Priors", "Unknowns", "calibrate"]

FRAMES = 240
"""Bones and offsets are solved from at most so many frames."""
SPACING, SPARSE_SPACING, DENSE = 0.1, 1.0, 16
"""Seconds between these frames, at least, with `DENSE` markers or more (48 coordinates, half more
than a frame has unknowns), and with fewer. Motion is smoother than the angles' prior; closer frames
make bones and offsets pay for that, the more the less the markers say."""
BLOCK = 1200
"""Frames solved at once when bones and offsets are known. Smoothness ends at a block's edge."""
NOISES = (15e-3, 5e-3)
"""Metres: the noise of the first rounds. Far from the answer a small one takes all for ghosts."""
ROUNDS, SETTLED = 8, 0.02
"""Rounds of noise estimation, at most, and the relative change that ends them."""
LEAST_NOISE = 0.1e-3
"""Metres: no markers are better than this."""

NARROWED = 0.7
"""An unknown is observed if its standard deviation is below this part of what the priors leave when
all others are known."""
FLEXIONS, MOVED = (0, 3), np.radians(20)
"""A finger is seen once two of its angles, the flexions of its first and second joint, have both
gone through this much."""
NEAR = 1e-2, 4e-2
"""Metres: how far markers are off before they count for less in the first registration, and no
longer count in the first choice of a posture."""
UNUSUAL = (5e-3) ** 2
"""Square metres that a posture one standard deviation off may be worse, in that choice."""


class Unknowns(NamedTuple):
    """One number or flag for every unknown."""

    bone_lengths: Array
    """`[21]` by point, from its parent; the wrist has none."""
    offsets: Array
    """`[M, 3]`."""
    angles: Array
    """`[T, 26]`."""
    wrist_rotation: Array
    """`[T, 3]` about the world's axes."""
    wrist_position: Array
    """`[T, 3]`."""


class Calibration(NamedTuple):
    """A person's hand, and how it moved. float64."""

    hand: Hand
    """The given markers on the person's bones and at their own offsets; the template follows."""
    angles: Array
    """`[T, 26]` radians, in the order of `hand.ANGLES`."""
    wrist_rotation: Array
    """`[T, 3, 3]` world_from_wrist."""
    wrist_position: Array
    """`[T, 3]` metres, world."""
    residual: Array
    """`[T, M]` metres from measured to fitted marker; NaN where nothing was measured."""
    accepted: Array
    """`[T, M]` True where measured and not taken for a ghost."""
    noise: float
    """Metres per axis: standard deviation of what was accepted, estimated or as given."""
    interval: Unknowns
    """Half of each unknown's 95 % interval, metres and radians; 0 for what was fixed."""
    observed: Unknowns
    """False where the markers say little more than the priors, or nothing."""
    tracked: Array
    """`[T]` False where the accepted markers are fewer than three, or in line: there the wrist
    follows the frames before and after, and the angles them and the priors."""
    seen: Array
    """`[5]` by finger: True once it has moved enough to know how far it reaches."""


def calibrate(
    hand: Hand,
    markers: Array,
    *,
    rate: float = 60.0,
    starts: Sequence[int] = (),
    fixed: Collection[Literal["bones", "offsets"]] = (),
    priors: Priors | None = None,
    noise: float | None = None,
    smoothness: float = 1.0,
) -> Calibration:
    """Fits a hand to a recording: bones, offsets, angles and the wrist's pose.

    A measurement is Gaussian about the model, or a ghost that lies anywhere; which of both follows
    from the fit, round after round. Bones keep their directions in the flat hand, but a finger's
    base may be off in any. Intervals are those of linearised least squares. They know of the
    priors, the noise and each other, but take a hand for what this model says it is: skin that
    slides over the bones is not in them. With few markers, as on `glove9`, joints that share a
    motion are told apart by the angles' prior alone, and intervals are too narrow, the more so the
    longer the recording.

    Args:
        hand: the markers, and the means of the priors.
        markers: `[T, M, 3]` metres, of a canonical left hand. Not finite: not measured.
        rate: frames per second.
        starts: frames at which another recording of the same hand begins.
        fixed: what to leave as `hand` has it.
        priors: how far bones and offsets may be from `hand`; default `Priors()`.
        noise: metres per axis, standard deviation of a measurement; None to estimate it.
        smoothness: seconds for which angles remember (an Ornstein-Uhlenbeck process about a mean
            posture); 0 for frames that do not depend on each other, the wrist's neither.

    Raises:
        ValueError: another shape, no frame, a rate or noise not above 0, a smoothness below it, an
            unknown entry of `fixed`, or nowhere three alignment markers that are not in line.
    """
    markers = np.array(floats(markers))
    _check(hand, markers, rate, fixed, noise, smoothness)
    markers[~np.isfinite(markers).all(-1)] = np.nan
    frames = np.arange(len(markers))
    # A cut is an eternity: nothing follows on what was before it.
    time = frames / rate + 1e6 * np.isin(frames, starts).cumsum()
    widths = [arrow.WIDTHS.sum(), 3 * len(hand)]
    free = np.repeat(["bones" not in fixed, "offsets" not in fixed], widths)
    whole = Problem(hand, markers, time, free, priors or Priors(), smoothness)

    start = _posed(whole)
    spacing = SPACING if len(hand) >= DENSE else SPARSE_SPACING
    chosen = _telling(markers, max(1, round(spacing * rate)))
    start.angles[chosen] = _postures(whole.at(chosen), start.at(chosen))
    chosen = chosen[_differing(start.angles[chosen])]
    point, noise = _fitted(whole.at(chosen), start.at(chosen), noise)
    shared = arrow.covariance(point.arrow).shared

    near = _nearest(time[chosen], time)
    known = start._replace(
        bones=point.state.bones, offsets=point.state.offsets, angles=point.state.angles[near]
    )
    blocks = [frames[i : i + BLOCK] for i in range(0, len(frames), BLOCK)]
    done = [_followed(whole.at(block), known.at(block), noise, shared) for block in blocks]
    return _report(whole, done, noise, shared)


def _check(
    hand: Hand,
    markers: Array,
    rate: float,
    fixed: Collection[str],
    noise: float | None,
    smoothness: float,
) -> None:
    if markers.ndim != 3 or not len(markers) or markers.shape[1:] != (len(hand), 3):
        expected = f"[T, {len(hand)}, 3] with T above 0"
        raise ValueError(f"markers: expected shape {expected}, got {list(markers.shape)}")
    for name, value in (("rate", rate), ("noise", noise or (1 if noise is None else 0))):
        if not 0 < value < np.inf:
            raise ValueError(f"{name}: expected a number above 0, got {value}")
    if not 0 <= smoothness < np.inf:
        raise ValueError(f"smoothness: expected a number not below 0, got {smoothness}")
    if unknown := sorted(set(fixed) - {"bones", "offsets"}):
        raise ValueError(f"fixed: expected 'bones' and 'offsets', got {unknown}")


def _posed(problem: Problem) -> State:
    """The hand in its size and a mean posture, held to the alignment markers; where these are too
    few, as in the nearest frame where they are not."""
    hand, markers = problem.hand, np.nan_to_num(problem.markers)
    weight = np.isfinite(problem.markers[..., 0]) * hand.alignment_weight.astype(np.float64)
    good = geometry.second_extent(markers, weight) > DETERMINED_EXTENT
    if not good.any():
        raise ValueError("markers: no frame with three alignment markers that are not in line")
    bones, aligned = np.zeros(arrow.WIDTHS.sum()), list(hand.alignment)
    complete = weight[:, aligned].all(-1)
    if problem.free[0] and complete.any():
        extents = markers[complete][:, aligned].var(-2).sum(-1)
        ratio = np.median(extents) / hand.template[aligned].var(-2).sum(-1)
        bones[0] = np.clip(np.log(ratio) / 2, -0.2, 0.2)
    template = hand.template * np.exp(bones[0])
    robust, prior = weight, np.broadcast_to(np.eye(3), (len(markers), 3, 3))
    for _ in range(4):
        rotation, position = geometry.kabsch(template, markers, robust, prior)
        off = np.linalg.norm(geometry.transform(rotation, position, template) - markers, axis=-1)
        robust = weight / (1 + (off / NEAR[0]) ** 2) ** 2
    near = np.flatnonzero(good)[_nearest(problem.time[good], problem.time)]
    mean = np.linalg.solve(arrow.MIX, arrow.MEAN)
    angles = np.repeat(mean[None], len(markers), 0)
    return State(bones, hand.offsets, angles, rotation[near], position[near])


def _postures(problem: Problem, state: State) -> Array:
    """`[T, 26]` the best of some fifty coarse postures of each finger."""
    size = np.exp(state.bones[0])
    hand = problem.hand.with_skeleton(problem.hand.skeleton * size)
    local = geometry.untransform(state.rotation, state.position, problem.markers)
    angles = state.angles.copy()
    for finger in range(len(FINGERS)):
        mine = finger == FINGER_OF_ANGLE
        tried: list[tuple[int, ...]] = [(-15, 15, 45, 80), (-15, 0, 15), (0,), (5, 40, 75, 105)]
        if finger == 0:
            tried = [(-20, 15, 45), (-25, 5, 35), (0,), (-5, 35), (0,), (0, 50)]
        grid = np.radians(np.stack(np.meshgrid(*tried), -1).reshape(-1, len(tried)))
        if finger:
            grid = np.concatenate([grid, DIP_SHARE * grid[:, -1:]], -1)
        postures = np.zeros((len(grid), len(ANGLES)))
        postures[:, mine] = grid
        turns = runtime.rotations_from_angles(postures)
        points = runtime.forward_kinematics(hand.skeleton, turns, np.eye(3), np.zeros(3))
        places = runtime.marker_positions(hand, *points)
        unusual = ((postures @ arrow.MIX.T - arrow.MEAN) / arrow.DEVIATION) ** 2
        cost = np.repeat(UNUSUAL * unusual[None, :, mine].sum(-1), len(local), 0)
        for marker in np.flatnonzero(FINGER_OF_POINT[list(hand.joints)] == finger):
            square = ((local[:, None, marker] - places[:, marker]) ** 2).sum(-1)
            # Without a marker, and with a ghost, all postures are equal.
            cost += np.nan_to_num(np.minimum(square, NEAR[1] ** 2))
        angles[:, mine] = grid[cost.argmin(-1)]
    return angles


def _telling(markers: Array, stride: int) -> Array:
    """Of every `stride` frames the first with most markers, unless there are none."""
    count = np.isfinite(markers[..., 0]).sum(-1)
    best = [i + int(count[i : i + stride].argmax()) for i in range(0, len(count), stride)]
    return np.array([i for i in best if count[i]])


def _differing(angles: Array) -> Array:
    """`FRAMES` rows or fewer, in order: the next is always that farthest from all before."""
    if len(angles) <= FRAMES:
        return np.arange(len(angles))
    # Time counts a little, so that a still hand is not sampled from its first second.
    rows = np.concatenate([angles, np.linspace(0, 1, len(angles))[:, None]], -1)
    chosen, far = [0], np.full(len(rows), np.inf)
    for _ in range(FRAMES - 1):
        far = np.minimum(far, ((rows - rows[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(far.argmax()))
    return np.sort(chosen)


def _nearest(among: Array, time: Array) -> Array:
    """`[T]` index of the nearest of the sorted times `among`."""
    after = np.minimum(np.searchsorted(among, time), len(among) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(time - among[before] < np.abs(among[after] - time), before, after)


def _fitted(problem: Problem, state: State, noise: float | None) -> tuple[arrow.Point, float]:
    """The fit, and the noise that it was made with."""
    for now in NOISES:
        point = arrow.descend(problem, state, now)
        state = point.state
    for _ in range(ROUNDS):
        before, now = now, noise or max(_noise(point), now / 3, LEAST_NOISE)
        point = arrow.descend(problem, point.state, now)
        if noise or abs(now / before - 1) < SETTLED:
            break
    return point, now


def _noise(point: arrow.Point) -> float:
    """Metres per axis: root mean square residual, less the freedom that the fit has used up (the
    trace of its hat matrix)."""
    of, data = arrow.covariance(point.arrow), point.data
    used = (of.frames * data.frames).sum() + (of.shared * data.shared).sum()
    used += 2 * (of.border * data.border).sum()
    square = (point.weight[..., None] * point.residual**2).sum()
    return float(np.sqrt(square / max(3 * point.weight.sum() - used, 1)))


def _followed(
    problem: Problem, state: State, noise: float, shared: Array
) -> tuple[arrow.Point, Array]:
    """The fit of frames to known bones and offsets, and standard deviations `[T, 32]` that know of
    the doubt about those, `shared [s, s]`."""
    known = problem._replace(free=np.zeros_like(problem.free))
    for now in (NOISES[-1], noise):
        state = arrow.descend(known, state, now).state
    point = arrow.evaluate(problem, state, noise)
    variance = np.diagonal(arrow.covariance(point.arrow, shared).frames, 0, 1, 2)
    return point, np.sqrt(variance)


def _report(
    problem: Problem, done: list[tuple[arrow.Point, Array]], noise: float, shared: Array
) -> Calibration:
    hand, priors, bones = problem.hand, problem.priors, done[0][0].state.bones
    angles, rotation, position = (
        np.concatenate(arrays)
        for arrays in list(zip(*(point.state for point, _ in done), strict=True))[2:]
    )
    residual = np.concatenate([np.linalg.norm(point.residual, axis=-1) for point, _ in done])
    accepted = np.concatenate([point.weight > 0.5 for point, _ in done])
    frames = np.concatenate([deviation for _, deviation in done])
    every = np.zeros((len(problem.free),) * 2)
    every[np.ix_(problem.free, problem.free)] = shared
    measured, flat = np.isfinite(problem.markers[..., 0]), np.float32(hand.skeleton)
    extent = geometry.second_extent(np.nan_to_num(problem.markers), accepted * 1.0)
    tracked = extent > DETERMINED_EXTENT

    skeleton = np.asarray(arrow.skeleton(flat, np.float32(bones)), np.float64)
    by_bones = np.asarray(jax.jacfwd(arrow.skeleton, 1)(flat, np.float32(bones)), np.float64)
    fitted = replace(hand, offsets=done[0][0].state.offsets).with_skeleton(skeleton)
    lengths = np.linalg.norm(skeleton, axis=-1)
    along = np.einsum("pi,pis->ps", skeleton / np.maximum(lengths, 1e-9)[:, None], by_bones)
    in_length = np.sqrt(np.einsum("ps,st,pt->p", along, every[: len(bones), : len(bones)], along))
    in_offset = np.sqrt(np.diagonal(every)[len(bones) :]).reshape(-1, 3)

    def unknowns(lengths: Array, offsets: Array, of_frames: Array) -> Unknowns:
        return Unknowns(lengths, offsets, *np.split(of_frames, [len(ANGLES), len(ANGLES) + 3], -1))

    narrow = frames[:, : len(ANGLES)] < NARROWED * arrow.DEVIATION
    wrist = np.repeat(tracked[:, None], 6, -1)
    return Calibration(
        hand=fitted,
        angles=angles,
        wrist_rotation=rotation,
        wrist_position=position,
        residual=np.where(measured, residual, np.nan),
        accepted=accepted,
        noise=noise,
        interval=unknowns(1.96 * in_length, 1.96 * in_offset, 1.96 * frames),
        observed=unknowns(
            (in_length < NARROWED * priors.bone * lengths) & problem.free[0],
            (in_offset < NARROWED * priors.offset) & problem.free[-1],
            np.concatenate([narrow, wrist], -1),
        ),
        tracked=tracked,
        seen=_seen(problem, fitted, angles, accepted, every, by_bones),
    )


def _seen(
    problem: Problem, fitted: Hand, angles: Array, accepted: Array, every: Array, by_bones: Array
) -> Array:
    """`[5]` whether a finger has bent, and how far it reaches is known better than before: the way
    from its base to its farthest marker, with the finger straight.

    Args:
        problem, fitted, angles, accepted: what was fitted, and how.
        every: `[31 + 3 M, 31 + 3 M]` covariance of the shared unknowns.
        by_bones: `[21, 3, 31]` derivative of the skeleton.
    """
    seen, prior = np.zeros(len(FINGERS), bool), 1 / arrow.precision(problem)
    joints = np.array(fitted.joints)
    for finger, (base, *chain) in enumerate(CHAINS):
        mine = np.flatnonzero(np.isin(joints, chain))
        shown = accepted[:, mine].any(-1)
        if not shown.any():
            continue
        far = fitted.template[mine] - fitted.skeleton[base]
        last = mine[np.linalg.norm(far, axis=-1).argmax()]
        way = chain[: chain.index(joints[last]) + 1]
        by_offset = np.zeros((3, len(fitted), 3))
        by_offset[:, last] = np.eye(3)
        by_place = np.concatenate([by_bones[way].sum(0), by_offset.reshape(3, -1)], -1)
        reach = (fitted.template[last] - fitted.skeleton[base]) @ by_place
        known = reach @ every @ reach < NARROWED**2 * (reach**2 @ prior)
        flexions = (finger == FINGER_OF_ANGLE) & np.isin(SLOT_OF_ANGLE, FLEXIONS)
        few, most = np.quantile(angles[np.ix_(shown, flexions)], [0.05, 0.95], axis=0)
        seen[finger] = known and (most - few > MOVED).all()
    return seen
