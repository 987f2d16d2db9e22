"""Joint truth out of an inertial glove and markers (paper, section 2.2).

The glove feels every bend at once, but drifts, and feels flexion alone; the markers are absolute,
but have gaps and say nothing of a finger's middle. `paper_fuse` is the paper's route: the pose from
the alignment markers, then each finger turned as a whole towards its marker. `fuse` asks which
errors of the glove explain where the markers are: a Kalman filter of each finger's angles.

All hands are canonical left ones; a right hand's glove and markers are mirrored first.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxhand.networks  # noqa: F401  makes `Hand` an argument that jit understands
from jaxhand.geometry import kabsch, product, second_extent, transform, untransform
from jaxhand.ik import in_hand_frame
from jaxhand.skeleton import align_fingers, angles_from_rotations, rotations_from_angles
from numpy_infer.arrays import Array, floats
from numpy_infer.geometry import kabsch as numpy_kabsch
from numpy_infer.geometry import mirror, mirror_rotation, nearest_rotation, shortest_arc
from numpy_infer.hand import (
    ANGLE_AT,
    ANGLES,
    CHAINS,
    FINGER_OF_ANGLE,
    FINGERS,
    JOINTS,
    PARENTS,
    SLOT_OF_ANGLE,
    Hand,
    flat_points,
)
from numpy_infer.pose import DETERMINED_EXTENT
from numpy_infer.recordings import Recording

MARKER_NOISE = 2e-3
"""Metres per axis: the standard deviation of a marker from where hand and angles have it."""
FLEXION_OFFSET = math.radians(8)
"""Standard deviation of the error that a flexion of the glove starts with."""
FLEXION_WALK = math.radians(1)
"""By how much that error changes in a second: a random walk."""
ABDUCTION_SPREAD = math.radians(12)
"""Standard deviation of an abduction from what the glove says, which is 0 if it feels none."""
TWIST_SPREAD = math.radians(8)
"""The same for a twist. It shares with abduction what moves a bent finger's tip aside: without it a
fist's PIP joints are up to 12 mm off."""
UNFELT_SECONDS = 0.5
"""How long it is of use to know what an abduction or twist was."""
SLEW = 2.5
"""Radians per second: no angle's correction changes faster. That is the paper's 25 cm/s of a marker
that comes back (section 3.2.2), for the tip of a straight finger."""
POSE_SHARE, POSE_NOISE = 0.1, 6e-3
"""Where the alignment markers do not determine the pose: the weight of a finger's marker in it,
beside 1 of theirs, and `MARKER_NOISE` then."""

AUTHORS_JOINTS = {
    f"l_{finger}{i + 1}": JOINTS[chain[i]]
    for finger, chain in zip(FINGERS, CHAINS, strict=True)
    for i in range(3)
}
"""The joints of the paper authors' files → ours."""

_WIDTH = ANGLE_AT.shape[1]
_BASES = np.array(CHAINS)[:, 0]
_PARENTS = np.array(PARENTS)[1 : len(JOINTS)]

_KIND = np.array([angle.name.rpartition("_")[2] for angle in ANGLES] + ["none"])
_FLEXION = _KIND[:-1] == "flexion"
_FELT = (_KIND == "flexion")[ANGLE_AT]
"""`[5, 6]` True for flexions, which a glove feels."""
_SPREAD = {"abduction": ABDUCTION_SPREAD, "twist": TWIST_SPREAD}
_UNFELT_VARIANCE = np.array([_SPREAD.get(k, 0) ** 2 for k in _KIND], np.float32)[ANGLE_AT]
"""`[5, 6]` of the others, about what the glove says."""


class Fused(NamedTuple):
    """A hand over time, as glove and markers have it together; float32."""

    rotations: Array
    """`[T, 15, 3, 3]` parent_from_joint."""
    angles: Array
    """`[T, 26]` radians, order of `hand.ANGLES`, read from the rotations."""
    wrist_rotation: Array
    """`[T, 3, 3]` world_from_wrist."""
    wrist_position: Array
    """`[T, 3]` metres, world."""
    corrected: Array
    """`[T, 5]` True where a marker of the finger was seen. Elsewhere it keeps its correction."""
    residual: Array
    """`[T, 5]` metres: distance of the finger's seen markers from where the result has them, root
    mean square; NaN where none was seen."""


def fuse(hand: Hand, imu_rotations: Array, markers: Array, dt: Array | float) -> Fused:
    """Finds the errors of the glove's angles from the markers, and takes them away.

    A finger's unknowns are what must be added to the glove's angles: to flexions an error that
    wanders slowly, to abductions and twists all that the glove does not feel. Where its marker
    stands from its base gives three of them, the finger's changing posture the rest: an extended
    Kalman filter (Jazwinski 1970) with the glove as its prior. A hidden finger keeps its
    correction; how fast corrections change is limited, see `SLEW`.

    Where the alignment markers do not determine the pose, the fingers help out, as they were
    modelled, and are corrected with less trust. Only before they first do, anything looks ahead.

    Args:
        hand: with the skeleton of the person in the glove.
        imu_rotations: `[T, 15, 3, 3]` parent_from_joint. Where it is not finite a joint's last one
            is taken; before there is one, the flat hand's.
        markers: `[T, M, 3]` metres, world; NaN where hidden.
        dt: `[T]` seconds since the frame before, or one number for all. Below 0 counts as 0.

    Raises:
        ValueError: an argument of another shape, or a `dt` that is not finite.
    """
    return _run(_fuse, hand, imu_rotations, markers, dt)


def paper_fuse(hand: Hand, imu_rotations: Array, markers: Array, dt: Array | float) -> Fused:
    """The paper's plain route, to compare `fuse` with: each finger of the glove is turned about its
    base by `align_fingers`. While its outermost marker, or the pose, is not seen, the turn is held;
    before, it is the first one. Errors of flexion stay in the finger's shape. Arguments as of
    `fuse`."""
    return _run(_paper_fuse, hand, imu_rotations, markers, dt)


def kalman_update(
    mean: Array, covariance: Array, away: Array, rows: Array, noise: Array
) -> tuple[Array, Array]:
    """Mean and covariance of K unknowns after N measurements, each finger by itself (Kalman 1960).
    One measurement goes in after the other, so that nothing has to be inverted.

    Args:
        mean, covariance: `[5, K]` and `[5, K, K]` before them.
        away: `[5, N]` from where they were expected at `mean` to where they are.
        rows: `[5, N, K]` derivatives of the expected; 0 for what was not measured.
        noise: standard deviation of each, in the units of `away`.
    """
    move = jnp.zeros_like(mean)
    for i in range(rows.shape[1]):
        row = rows[:, i]
        ahead = (covariance * row[:, None]).sum(-1)
        gain = ahead / ((ahead * row).sum(-1) + noise**2)[:, None]
        move = move + gain * (away[:, i] - (row * move).sum(-1))[:, None]
        covariance = covariance - gain[..., None] * ahead[:, None]
    return mean + move, covariance


def imu_from_recording(
    recording: Recording,
    hand: Hand,
    joint_map: Mapping[str, str] | None = None,
    *,
    flat: Array | None = None,
    right: bool = False,
) -> Array:
    """`[T, 15, 3, 3]` parent_from_joint as `fuse` takes it, out of a file's joint rotations.

    The file's wrist is aligned by the places of the finger bases. Every other joint's axes are a
    constant turn off ours. With `flat` it is the one that makes that pose our flat hand (paper,
    section 2.2, calibration). Without, the joint is turned from its mean by the shortest arc that
    lays its bone where our flat hand has it: twists are then from their mean over the recording. A
    last joint's bone is taken to lie in its axes as the one before in its own.

    Args:
        recording: with joint truth, "world" (BVH) or "local" (the authors' pairs).
        hand: whose flat hand to align to.
        joint_map: {joint in the file: our joint}: all 15, and the wrist if the file is "world";
            default `AUTHORS_JOINTS`.
        flat: `[N]` indices, or `[T]` True, of frames in which the hand was held flat.
        right: the recording is of a right hand, and is mirrored.

    Raises:
        ValueError: no joint truth; a joint that is missing or unknown; no complete frame to align.
    """
    turns, points = _in_wrist(recording, AUTHORS_JOINTS if joint_map is None else joint_map)
    if right:
        turns, points = mirror_rotation(turns), mirror(points)
    local = np.swapaxes(turns[:, _PARENTS], -1, -2) @ turns[:, 1:]
    chosen = np.full(len(turns), flat is None)
    if flat is not None:
        chosen[flat] = True
    chosen &= np.isfinite(points).all((-1, -2)) & np.isfinite(turns).all((-1, -2, -3))
    if not chosen.any():
        raise ValueError(f"{recording.source}: no complete frame to align by")
    bases = np.array([0, *_BASES])
    seen, wanted = points[chosen][:, bases].mean(0), flat_points(hand.skeleton)[bases]
    rest = nearest_rotation(local[chosen].mean(0))
    ours = np.empty((len(JOINTS), 3, 3))  # at each joint: from the file's axes to ours
    ours[0] = numpy_kabsch(seen, wanted, np.ones(len(bases)), np.eye(3))[0]
    for joint, parent in enumerate(_PARENTS, start=1):
        ours[joint] = ours[parent] @ rest[joint - 1]
        if flat is None:
            if PARENTS[joint + 1] == joint:  # else a last joint: its bone lies as the one before
                bone = (points[chosen, joint + 1] - points[chosen, joint])[:, None]
                along = (bone @ turns[chosen, joint]).mean((0, 1))
            straight = hand.skeleton[PARENTS.index(joint)]
            arc = shortest_arc(ours[joint] @ along, straight, np.ones(()))
            ours[joint] = arc @ ours[joint]
    rotations: Array = ours[_PARENTS] @ local @ np.swapaxes(ours[1:], -1, -2)
    return rotations.astype(np.float32)


def simulate_imu(
    key: Array,
    angles: Array,
    rate: float,
    drift: float = math.radians(0.5),
    offset: float = math.radians(5),
) -> Array:
    """`[T, 15, 3, 3]` parent_from_joint as a glove like the paper's has it. It feels flexions only,
    each with a constant offset and a drift of constant speed, up or down; all else reads 0.

    Args:
        key: what offsets and signs are drawn from.
        angles: `[T, 26]` radians, the truth.
        rate: frames per second.
        drift: radians per second.
        offset: radians, standard deviation.
    """
    offset_key, sign_key = jax.random.split(key)
    start = offset * jax.random.normal(offset_key, (len(ANGLES),))
    speed = drift * jax.random.rademacher(sign_key, (len(ANGLES),), jnp.float32)
    time = jnp.arange(len(angles), dtype=jnp.float32)[:, None] / rate
    return rotations_from_angles(jnp.where(_FLEXION, angles + start + speed * time, 0))


def _run(method: Callable[..., Fused], hand: Hand, imu: Array, markers: Array, dt: Array) -> Fused:
    markers, imu, dt = floats(markers), floats(imu), np.asarray(dt)
    frames = markers.shape[:1]
    for name, array, shape in (
        ("markers", markers, (*frames, len(hand), 3)),
        ("imu_rotations", imu, (*frames, len(JOINTS) - 1, 3, 3)),
        ("dt", dt, frames if dt.ndim else ()),
    ):
        if array.shape != shape or not all(frames):
            raise ValueError(f"{name}: expected shape {list(shape)}, got {list(array.shape)}")
    if not np.isfinite(dt).all():
        raise ValueError("dt: expected finite seconds")
    seen = np.isfinite(markers).all(-1)
    arrays = (
        _last_finite(imu),
        np.where(seen[..., None], markers, 0).astype(np.float32),
        seen,
        np.broadcast_to(np.maximum(dt, 0).astype(np.float32), frames),
    )
    # Small matrices, frame after frame: nothing for an accelerator.
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        return Fused(*map(np.asarray, method(jax.tree.map(np.float32, hand), *arrays)))


def _last_finite(rotations: Array) -> Array:
    """`[T, 15, 3, 3]` of each joint the last finite rotation; before there is one, the identity."""
    number = np.arange(1, len(rotations) + 1)[:, None]
    finite = np.isfinite(rotations).all((-1, -2))
    last = np.maximum.accumulate(np.where(finite, number, 0))
    padded = np.concatenate([np.broadcast_to(np.eye(3), (1, *rotations.shape[1:])), rotations])
    return np.take_along_axis(padded, last[..., None, None], 0).astype(np.float32)


class _Filter(NamedTuple):
    """Corrections `[5, 6]`, radians to add to the glove's angles: as estimated, with covariance
    `[5, 6, 6]`, and as put out, which follows the estimate at `SLEW`. The last pose."""

    mean: Array
    covariance: Array
    output: Array
    rotation: Array
    position: Array


@jax.jit
def _fuse(hand: Hand, imu: Array, markers: Array, seen: Array, dt: Array) -> Fused:
    felt = angles_from_rotations(imu)
    # What our angles cannot express stays as the glove has it.
    rest = product(jnp.swapaxes(rotations_from_angles(felt), -1, -2), imu)
    determined, rotations, positions = _poses(hand, markers, seen)
    own = np.array(hand.alignment)
    share = jnp.full(len(hand), POSE_SHARE).at[own].set(1)

    def frame(state: _Filter, now: tuple[Array, ...]) -> tuple[_Filter, tuple[Array, ...]]:
        felt, rest, markers, seen, dt, slew, determined, rotation, position = now

        def modelled(correction: Array) -> Array:
            angles = felt + correction[FINGER_OF_ANGLE, SLOT_OF_ANGLE]
            return in_hand_frame(hand, product(rotations_from_angles(angles), rest))[0]

        def helped_out() -> tuple[Array, Array]:
            points = modelled(state.output).at[own].set(hand.template[own])
            found = kabsch(points, markers, jnp.where(seen, share, 0), state.rotation)
            return found[0], jnp.where(seen.any(), found[1], state.position)

        rotation, position = jax.lax.cond(determined, lambda: (rotation, position), helped_out)
        measured = _by_finger(hand, untransform(rotation, position, markers))
        used = _by_finger(hand, seen[:, None])
        mean, covariance = _predict(state.mean, state.covariance, used.any((1, 2)), dt)

        def away(slots: Array) -> Array:
            # The fingers share no angle: one tangent moves the k-th of all five at once.
            off = measured - _by_finger(hand, modelled(mean + slots))
            return jnp.where(used, off, 0).reshape(len(FINGERS), -1)

        none = jnp.zeros(_WIDTH)
        noise = jnp.where(determined, MARKER_NOISE, POSE_NOISE)
        mean, covariance = kalman_update(
            mean, covariance, away(none), -jax.jacfwd(away)(none), noise
        )
        output = state.output + jnp.clip(mean - state.output, -slew, slew)
        return _Filter(mean, covariance, output, rotation, position), (output, rotation, position)

    none = jnp.zeros(ANGLE_AT.shape)
    variance = jnp.where(_FELT, FLEXION_OFFSET**2, _UNFELT_VARIANCE)
    first = jnp.argmax(determined)
    start = _Filter(
        mean=none,
        covariance=variance[..., None] * jnp.eye(_WIDTH),
        output=none,
        rotation=jnp.where(determined[first], rotations[first], jnp.eye(3)),
        position=jnp.where(determined[first], positions[first], 0),
    )
    # There is nothing before the first frame that it could jump from.
    slew = (SLEW * dt).at[0].set(jnp.inf)
    frames = (felt, rest, markers, seen, dt, slew, determined, rotations, positions)
    _, (correction, rotation, position) = jax.lax.scan(frame, start, frames)
    angles = felt + correction[:, FINGER_OF_ANGLE, SLOT_OF_ANGLE]
    fused = product(rotations_from_angles(angles), rest)
    return _result(hand, fused, rotation, position, markers, seen)


def _predict(mean: Array, covariance: Array, seen: Array, dt: Array) -> tuple[Array, Array]:
    """Time goes by. Flexion errors wander, and what the glove does not feel is forgotten. But only
    a finger that is `seen [5]` is drawn to the glove; a hidden one keeps its correction."""
    keep = jnp.where(_FELT, 1, jnp.exp(-dt / UNFELT_SECONDS))
    fresh = jnp.where(_FELT, FLEXION_WALK**2 * dt, (1 - keep**2) * _UNFELT_VARIANCE)
    covariance = keep[..., None] * covariance * keep[..., None, :]
    covariance = covariance + fresh[..., None] * jnp.eye(_WIDTH)
    return jnp.where(seen[:, None], keep * mean, mean), covariance


@jax.jit
def _paper_fuse(hand: Hand, imu: Array, markers: Array, seen: Array, _: Array) -> Fused:
    determined, rotation, position = _poses(hand, markers, seen)
    rotation, position = _held(rotation, determined), _held(position, determined)
    measured = untransform(rotation, position, markers)
    aimed = seen & determined[:, None]
    _, points, links = in_hand_frame(hand, imu)
    _, aligned = align_fingers(hand, points, links, measured, aimed.astype(imu.dtype))
    # Apart from what the glove felt then, the turn can be held.
    turn = product(aligned[:, 1::3], jnp.swapaxes(imu[:, ::3], -1, -2))
    turn = jax.vmap(_held, 1, 1)(turn, _by_finger(hand, aimed[..., None])[:, :, -1, 0])
    fused = imu.at[:, ::3].set(product(turn, imu[:, ::3]))
    return _result(hand, fused, rotation, position, markers, seen)


def _held(values: Array, known: Array) -> Array:
    """`[T, ...]` of each frame the last value that is `known [T]`; before any, the first known."""
    number = jnp.where(known, jnp.arange(len(known)), jnp.argmax(known))
    return values[jax.lax.cummax(number)]


def _poses(hand: Hand, markers: Array, seen: Array) -> tuple[Array, Array, Array]:
    """`[T]` True where the alignment markers determine the pose; it, `[T, 3, 3]` and `[T, 3]`."""
    own = np.array(hand.alignment)
    markers, weight = markers[:, own], seen[:, own].astype(markers.dtype)
    rotation, position = kabsch(hand.template[own], markers, weight, jnp.eye(3))
    return second_extent(markers, weight) > DETERMINED_EXTENT, rotation, position


def _by_finger(hand: Hand, of_markers: Array) -> Array:
    """`[..., M, N]` → `[..., 5, K, N]`: the markers that each finger carries, from base to tip; in
    front of them zeros where they are fewer than K."""
    width = max(1, *map(len, hand.finger_markers))
    rows = np.array([(*[len(hand)] * (width - len(own)), *own) for own in hand.finger_markers])
    none = jnp.zeros_like(of_markers[..., :1, :])
    return jnp.concatenate([of_markers, none], -2)[..., rows, :]


def _result(
    hand: Hand, fused: Array, rotation: Array, position: Array, markers: Array, seen: Array
) -> Fused:
    off = transform(rotation, position, in_hand_frame(hand, fused)[0]) - markers
    square = jnp.where(seen, (off * off).sum(-1), 0)
    both = jnp.stack([square, seen.astype(square.dtype)], -1)
    total, count = jnp.moveaxis(_by_finger(hand, both).sum(-2), -1, 0)
    return Fused(
        rotations=fused,
        angles=angles_from_rotations(fused),
        wrist_rotation=rotation,
        wrist_position=position,
        corrected=count > 0,
        residual=jnp.sqrt(total / jnp.where(count > 0, count, jnp.nan)),
    )


def _in_wrist(recording: Recording, joint_map: Mapping[str, str]) -> tuple[Array, Array]:
    """`[T, 16, 3, 3]` wrist_from_joint and `[T, 16, 3]` metres from the wrist, in file axes."""
    truth = recording.joints
    if truth is None:
        raise ValueError(f"{recording.source}: no joint rotations")
    world = truth.frame == "world"
    wanted = JOINTS if world else JOINTS[1:]
    file_of = {ours: theirs for theirs, ours in joint_map.items()}
    unknown = sorted((set(joint_map) - set(truth.names)) | (set(file_of) - set(JOINTS)))
    missing = [joint for joint in wanted if joint not in file_of]
    if unknown or missing:
        raise ValueError(
            f"{recording.source}: joint_map: unknown: {', '.join(unknown) or 'none'}; "
            f"missing: {', '.join(missing) or 'none'}; the file has {', '.join(truth.names)}"
        )
    columns = [truth.names.index(file_of[joint]) for joint in wanted]
    turns, points = truth.rotations[:, columns], truth.positions[:, columns]
    if world:
        wrist = turns[:, 0]
        return np.swapaxes(wrist, -1, -2)[:, None] @ turns, (points - points[:, :1]) @ wrist
    turns = np.concatenate([np.broadcast_to(np.eye(3), (len(turns), 1, 3, 3)), turns], 1)
    for joint, parent in enumerate(_PARENTS, start=1):
        turns[:, joint] = turns[:, parent] @ turns[:, joint]
    return turns, np.concatenate([np.zeros_like(points[:, :1]), points], 1)
