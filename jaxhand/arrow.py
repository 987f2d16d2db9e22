"""Least squares over a hand's recording: 32 unknowns of each frame, which meet those of the next
frame, and bones and offsets, which all frames share. The matrix is block-tridiagonal with a border,
an arrow, and every cost here is linear in the number of frames.

JAX differentiates the model; the matrix is made and solved on the host in float64: what the shared
unknowns owe to one frame is the small difference of large numbers (the Schur complement), and
blocks of 32 are too small for a device.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.geometry import product
from jaxhand.motion import DIP_SHARE
from jaxhand.skeleton import forward_kinematics, rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.geometry import rotation_from_vector
from numpy_infer.hand import (
    ANGLES,
    CHAINS,
    FINGER_OF_ANGLE,
    FINGER_OF_POINT,
    HIGH,
    LOW,
    POINTS,
    SLOT_OF_ANGLE,
    Hand,
)

CHUNK = 240
"""Frames differentiated in one call: a fixed number, so that one compilation serves all."""
STEPS = 25
"""At most."""
TOLERANCE = 0.5
"""Of the cost, −2 log posterior: one unknown that is 0.7 standard deviations off."""
LARGEST_DAMPING = 1e6

GHOST_SHARE, GHOST_SIZE = 0.02, 0.1
"""Share of measurements that are of something else, and metres: the edge of the cube in which they
then lie anywhere."""
SPEED, TURN_SPEED = 1.0, 5.0
"""Metres and radians a second: standard deviations of the wrist's motion, to bridge gaps."""
RANGE_PRIOR = 0.05
"""Radians: an angle's range ends as softly as this; well beyond, it is a standard deviation."""
FAR = 100.0
"""Metres and radians: how far a wrist may be that nothing at all determines."""
TURN_SCALE, SHIFT_SCALE = 0.1, 0.05
"""Radians and metres within which the cost is about a parabola in the wrist's pose."""

POSTURES = {
    "thumb_cmc_flexion": (15, 20),
    "thumb_cmc_abduction": (5, 20),
    "thumb_cmc_twist": (-20, 25),
    "thumb_mcp_flexion": (12, 20),
    "thumb_ip_flexion": (15, 25),
    "mcp_flexion": (30, 35),
    "mcp_abduction": (0, 10),
    "mcp_twist": (0, 10),
    "pip_flexion": (40, 35),
    "dip_flexion": (0, 10),
}
"""Degrees: mean and standard deviation in free motion, rounded from `simulation.POSE_KINDS`, of an
angle of the thumb or of all fingers; of a DIP joint what it flexes beside `DIP_SHARE` of its PIP
joint."""
MEAN, DEVIATION = np.radians(
    [POSTURES.get(a.name) or POSTURES[a.name.split("_", 1)[1]] for a in ANGLES]
).T
MIX = np.eye(len(ANGLES))
"""`[26, 26]` takes angles to those of `POSTURES`."""
for _dip in (i for i, angle in enumerate(ANGLES) if angle.name.endswith("_dip_flexion")):
    MIX[_dip, _dip - 1] = -DIP_SHARE

TURN, SHIFT = slice(len(ANGLES), len(ANGLES) + 3), slice(len(ANGLES) + 3, len(ANGLES) + 6)
"""Of a frame's unknowns, after its angles: turn about the world's axes, and shift of the wrist."""
_JOINTS, _FRAME = slice(len(ANGLES)), SHIFT.stop


_BASES = np.array(CHAINS)[:, 0]
_BONES = np.array([i for i in range(1, len(POINTS)) if i not in _BASES])
WIDTHS = np.array([1, len(_BONES), 3 * len(_BASES)])
"""How many unknowns of a skeleton are the hand's size, bones' lengths, places of fingers' bases."""


class Priors(NamedTuple):
    """Standard deviations of what is known of a hand before it is measured."""

    size: float = 0.06
    """Of the logarithm of the hand's size against the given hand's: our choice, somewhat less than
    among people, see `anthropometry.SIZE_SPREAD`."""
    bone: float = 0.03
    """Of the logarithm of a bone's length beside it; a finger's base is as far off in any
    direction."""
    offset: float = 5e-3
    """Metres: of each coordinate of a marker's offset about the given hand's."""


class Problem(NamedTuple):
    """What a hand is fitted to."""

    hand: Hand
    """The means of the priors."""
    markers: Array
    """`[T, M, 3]` metres, NaN where not measured."""
    time: Array
    """`[T]` seconds."""
    free: Array
    """`[31 + 3 M]` True for bones and offsets that are to be found."""
    priors: Priors
    smoothness: float
    """Seconds for which angles remember; 0 for frames that do not depend on each other."""

    def at(self, frames: Array) -> Problem:
        """Some of the frames."""
        return self._replace(markers=self.markers[frames], time=self.time[frames])


class State(NamedTuple):
    """The unknowns, float64."""

    bones: Array
    """`[31]` see `skeleton`."""
    offsets: Array
    """`[M, 3]` metres."""
    angles: Array
    """`[T, 26]` radians."""
    rotation: Array
    """`[T, 3, 3]` world_from_wrist."""
    position: Array
    """`[T, 3]` metres, world."""

    def at(self, frames: Array) -> State:
        """Some of the frames."""
        return State(*self[:2], *(array[frames] for array in self[2:]))


class Arrow(NamedTuple):
    """A symmetric positive definite matrix over T frames of n unknowns and s shared ones."""

    frames: Array
    """`[T, n, n]` each frame's own block."""
    links: Array
    """`[T - 1, n, n]` rows of a frame, columns of the next."""
    border: Array
    """`[T, n, s]` rows of a frame, columns of the shared unknowns."""
    shared: Array
    """`[s, s]`."""


class Covariance(NamedTuple):
    """Blocks of an arrow's inverse, as they stand in the arrow, without those of two frames."""

    frames: Array
    border: Array
    shared: Array


class Point(NamedTuple):
    """The cost at a state."""

    state: State
    cost: float
    """−2 log posterior, but for a constant."""
    arrow: Arrow
    """Half of its second derivatives, Gauss and Newton's."""
    frames: Array
    shared: Array
    """`[T, n]`, `[s]` half of its gradient."""
    data: Arrow
    """The markers' part of the arrow; no links."""
    residual: Array
    """`[T, M, 3]` metres from measured to fitted; 0 where not measured."""
    weight: Array
    """`[T, M]` probability that it was measured and is no ghost."""


def solve(arrow: Arrow, frames: Array, shared: Array) -> tuple[Array, Array]:
    """`[T, n]`, `[s]` the solution for a right-hand side of these shapes: the frames are eliminated
    (Triggs et al., *Bundle adjustment, a modern synthesis*, 2000, section 6)."""
    inverses, right = _forward(arrow, np.concatenate([arrow.border, frames[..., None]], -1))
    both = _back(arrow.links, inverses, right)
    border, own = both[..., :-1], both[..., -1]
    schur = arrow.shared - _inner(arrow.border, border)
    answer = np.linalg.solve(schur, shared - _inner(arrow.border, own))
    return own - border @ answer, answer


def covariance(arrow: Arrow, shared: Array | None = None) -> Covariance:
    """Blocks of the inverse. `shared [s, s]`: the covariance of the shared unknowns, if other
    frames than these have determined it."""
    inverses, right = _forward(arrow, arrow.border)
    border = _back(arrow.links, inverses, right)
    if shared is None:
        shared = np.linalg.inv(arrow.shared - _inner(arrow.border, border))
    cross, own = -border @ shared, inverses
    for t in range(len(arrow.links) - 1, -1, -1):
        gain = inverses[t] @ arrow.links[t]
        own[t] += gain @ own[t + 1] @ gain.T
    return Covariance(own - cross @ border.swapaxes(-1, -2), cross, shared)


def descend(problem: Problem, state: State, noise: float) -> Point:
    """Damped Gauss-Newton (Levenberg 1944, Marquardt 1963) from `state`, until a step gains less
    than `TOLERANCE`. `noise`: metres per axis, a measurement's standard deviation."""
    wrist = np.repeat([TURN_SCALE**-2, SHIFT_SCALE**-2], 3)
    # An unknown is damped in units of its own prior: in those of the diagonal, what the markers
    # determine only together would hardly move.
    scale = np.concatenate([DEVIATION**-2, wrist]), precision(problem)[problem.free]
    point, damping = evaluate(problem, state, noise), 1.0
    for _ in range(STEPS):
        frames, shared = (damping * np.diag(of) for of in scale)
        damped = point.arrow._replace(
            frames=point.arrow.frames + frames, shared=point.arrow.shared + shared
        )
        step = solve(damped, -point.frames, -point.shared)
        trial = evaluate(problem, moved(problem, point.state, *step), noise)
        gain = point.cost - trial.cost
        if gain > 0:
            point = trial
        if 0 < gain < TOLERANCE or damping > LARGEST_DAMPING:
            break
        damping *= 0.1 if gain > 0 else 10
    return point


def moved(problem: Problem, state: State, frames: Array, shared: Array) -> State:
    """The state after a step `[T, 32]`, `[s]`."""
    step = np.zeros(len(problem.free))
    step[problem.free] = shared
    bones, offsets = np.split(step, [len(state.bones)])
    return State(
        state.bones + bones,
        state.offsets + offsets.reshape(-1, 3),
        state.angles + frames[:, _JOINTS],
        rotation_from_vector(frames[:, TURN]) @ state.rotation,
        state.position + frames[:, SHIFT],
    )


def precision(problem: Problem) -> Array:
    """`[31 + 3 M]` 1 / variance that the priors give to the shared unknowns."""
    size, bone, offset = problem.priors
    widths = [*WIDTHS, 3 * len(problem.hand)]
    return np.repeat([size, bone, bone, offset], widths) ** -2.0


def evaluate(problem: Problem, state: State, noise: float) -> Point:
    """Cost and derivatives. Each measurement is Gaussian about the model, or a ghost anywhere; the
    arrow weighs it by the probability of the first (expectation-maximisation)."""
    hand, seen = problem.hand, np.isfinite(problem.markers[..., 0])
    by_frame, by_shared, places = _differentiated(problem, state)
    off = places + state.position[:, None] - problem.markers
    residual = np.where(seen[..., None], off, 0)
    square = (residual**2).sum(-1) / noise**2
    # The square at which both kinds are equally likely.
    gate = 2 * np.log(1 / GHOST_SHARE - 1) + 6 * np.log(GHOST_SIZE / noise) - 3 * np.log(2 * np.pi)
    either = np.logaddexp(-square / 2, -gate / 2)
    weight = np.where(seen, np.exp(-square / 2 - either), 0)

    rows = len(state.angles), 3 * len(hand)
    by_frame, by_shared = (by.reshape(*rows, by.shape[-1]) for by in (by_frame, by_shared))
    weights = np.repeat(weight, 3, -1)[..., None] / noise**2
    transposed, weighed = (by_frame * weights).swapaxes(-1, -2), by_shared * weights
    own, right = transposed @ by_frame, residual.reshape(*rows, 1)
    data = Arrow(own, own[:0], transposed @ by_shared, _inner(weighed, by_shared))

    prior, frames, links, gradient = _process(problem, state)
    beyond, slope = _trespass(state.angles)
    gradient[:, _JOINTS] += beyond * slope
    frames[:, range(len(ANGLES)), range(len(ANGLES))] += slope**2
    weight_of = precision(problem)
    shared = np.concatenate([state.bones, (state.offsets - hand.offsets).ravel()])
    prior += (beyond**2).sum() + (weight_of * shared**2).sum()
    known = np.diag(weight_of[problem.free])
    return Point(
        state,
        prior - 2 * either[seen].sum(),
        Arrow(data.frames + frames, links, data.border, data.shared + known),
        (transposed @ right)[..., 0] + gradient,
        _inner(weighed, right[..., 0]) + (weight_of * shared)[problem.free],
        data,
        residual,
        weight,
    )


def skeleton(flat: Array, bones: Array) -> Array:
    """`[21, 3]` metres: a skeleton like `flat [21, 3]`, by the logarithm of its size, those of the
    other bones' lengths beside it, and what the fingers' bases are off as parts of their distance
    from the wrist: `bones [31]`."""
    size, own, aside = jnp.split(bones, np.cumsum(WIDTHS)[:-1])
    scale = jnp.zeros(len(POINTS), flat.dtype).at[_BONES].set(own) + size
    distance = jnp.linalg.norm(flat[_BASES], axis=-1, keepdims=True)
    return (flat * jnp.exp(scale)[:, None]).at[_BASES].add(aside.reshape(-1, 3) * distance)


def cross_matrix(vector: Array) -> Array:
    """`[..., 3, 3]` what multiplies by the cross product with `vector [..., 3]`."""
    return np.cross(vector[..., None, :], np.eye(3)).swapaxes(-1, -2)


def axial(matrix: Array) -> Array:
    """`[..., 3]` the inverse of `cross_matrix` on the skew part of `[..., 3, 3]`: of a rotation its
    axis times the sine of its angle."""
    skew = (matrix - matrix.swapaxes(-1, -2)) / 2
    return np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


def _process(problem: Problem, state: State) -> tuple[float, Array, Array, Array]:
    """Cost, blocks `[T, 32, 32]`, links and half gradient `[T, 32]` of a hand that moves by itself:
    angles forget as Ornstein and Uhlenbeck's process, the wrist wanders."""
    gap = np.diff(problem.time)
    if problem.smoothness == 0:
        gap = np.full_like(gap, np.inf)
    kept = np.ones((len(gap), _FRAME))
    kept[:, _JOINTS] = np.exp(-gap / max(problem.smoothness, 1e-9))[:, None]
    weight = np.empty_like(kept)
    weight[:, _JOINTS] = 1 / (DEVIATION**2 * (1 - kept[:, _JOINTS] ** 2))
    weight[:, TURN], weight[:, SHIFT] = ((v * gap[:, None]) ** -2 for v in (TURN_SPEED, SPEED))
    off = state.angles @ MIX.T - MEAN
    turn = axial(state.rotation[1:] @ state.rotation[:-1].swapaxes(-1, -2))
    hinge = off[1:] - kept[:, _JOINTS] * off[:-1]
    step = np.concatenate([hinge, turn, np.diff(state.position, axis=0)], -1)

    square, gradient = np.zeros((2, len(off), _FRAME))
    square[0, _JOINTS] = DEVIATION**-2
    square[:, _JOINTS.stop :] = FAR**-2
    square[1:] += weight
    square[:-1] += kept**2 * weight
    gradient[0, _JOINTS] = off[0] / DEVIATION**2
    gradient[1:] += weight * step
    gradient[:-1] -= kept * weight * step
    mix = np.eye(_FRAME)
    mix[_JOINTS, _JOINTS] = MIX
    frames, links = (mix.T @ (of[..., None] * mix) for of in (square, -kept * weight))
    cost = ((off[0] / DEVIATION) ** 2).sum() + (weight * step**2).sum()
    return float(cost), frames, links, gradient @ mix


def _trespass(angles: Array) -> tuple[Array, Array]:
    """`[T, 26]` how far an angle is out of its range, softly, in `RANGE_PRIOR`; its derivative."""
    above = angles - HIGH > LOW - angles
    far = np.where(above, angles - HIGH, LOW - angles) / RANGE_PRIOR
    share = np.exp(-np.logaddexp(0, -far))
    return np.logaddexp(0, far), np.where(above, share, -share) / RANGE_PRIOR


def _differentiated(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Derivatives of the markers `[T, M, 3, 32]`, `[T, M, 3, s]`, and the markers from the wrist
    `[T, M, 3]`, in the world's axes."""
    hand, found = problem.hand, []
    shared = [np.float32(array) for array in (hand.skeleton, state.bones, state.offsets)]
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for i in range(0, len(state.angles), CHUNK):
            pick = np.minimum(np.arange(i, i + CHUNK), len(state.angles) - 1)
            frames = np.float32(state.angles[pick]), np.float32(state.rotation[pick])
            found.append(_derivatives((hand.joints, hand.links), *shared, frames))
    places, links, by_bones, by_slot = (
        np.concatenate(of, dtype=np.float64)[: len(state.angles)] for of in zip(*found, strict=True)
    )
    carrier = zip(hand.joints, hand.links, strict=True)
    moves = FINGER_OF_POINT[[joint or link for joint, link in carrier]][:, None] == FINGER_OF_ANGLE
    by_frame = np.empty((*places.shape, _FRAME))
    by_frame[..., _JOINTS] = by_slot[..., SLOT_OF_ANGLE] * moves[:, None]
    by_frame[..., TURN] = -cross_matrix(places)
    by_frame[..., SHIFT] = np.eye(3)
    by_offsets = links[..., None, :] * np.eye(len(hand))[:, None, :, None]
    by_shared = np.concatenate([by_bones, by_offsets.reshape(*places.shape, -1)], -1)
    return by_frame, by_shared[..., problem.free], places


@partial(jax.jit, static_argnums=0)
def _derivatives(layout: Any, flat: Array, bones: Array, offsets: Array, frames: Any) -> Any:
    """For each frame: markers from the wrist `[M, 3]`, their links' rotations `[M, 3, 3]`, and
    derivatives by bones `[M, 3, 31]` and by slot `[M, 3, 6]`.

    The fingers share no angle, so one tangent moves the k-th of all five at once. The markers are
    linear in the skeleton, so its tangents are moved like points. Frames are mapped, not vmapped,
    see `fitting`.
    """
    joints, links = (np.array(of) for of in layout)
    still, tangents = skeleton(flat, bones), jax.jacfwd(skeleton, 1)(flat, bones)

    def frame(of: Any) -> Any:
        angles, rotation = of

        def placed(points: Array, slots: Array) -> tuple[Array, Array]:
            turns = rotations_from_angles(angles + slots[SLOT_OF_ANGLE])
            at, turns = forward_kinematics(points, turns, rotation, jnp.zeros(3, angles.dtype))
            turned = turns[links]
            return at[joints] + product(turned, offsets[..., None])[..., 0], turned

        none = jnp.zeros(SLOT_OF_ANGLE.max() + 1, angles.dtype)

        def along(tangent: Array) -> Array:
            return jax.jvp(lambda points: placed(points, none)[0], (still,), (tangent,))[1]

        by_bones = jax.vmap(along, in_axes=-1, out_axes=-1)(tangents)
        by_slot = jax.jacfwd(lambda slots: placed(still, slots)[0])(none)
        return *placed(still, none), by_bones, by_slot

    return jax.lax.map(frame, frames)


def _forward(arrow: Arrow, right: Array) -> tuple[Array, Array]:
    """Frame after frame: `[T, n, n]` the inverse of what is left of each frame's block, and
    `[T, n, k]` what is left of its right-hand side."""
    inverses, right = np.empty_like(arrow.frames), right.copy()
    inverses[:1] = np.linalg.inv(arrow.frames[:1])
    for t, link in enumerate(arrow.links):
        gain = link.T @ inverses[t]
        inverses[t + 1] = np.linalg.inv(arrow.frames[t + 1] - gain @ link)
        right[t + 1] -= gain @ right[t]
    return inverses, right


def _back(links: Array, inverses: Array, right: Array) -> Array:
    """`[T, n, k]` the frames' solution, from the last frame to the first."""
    answer = inverses @ right
    for t in range(len(links) - 1, -1, -1):
        answer[t] -= inverses[t] @ (links[t] @ answer[t + 1])
    return answer


def _inner(a: Array, b: Array) -> Array:
    """`[T, n, i]`, `[T, n(, j)]` → `[i(, j)]`: sums over all rows of all frames."""
    return np.tensordot(a, b, ((0, 1), (0, 1)))
