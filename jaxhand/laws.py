"""The laws that any tracker of hands should obey, as functions for anyone's own tests.

A tracker is anything with `hand`, `init` and `step`, see `trial.Tracker`: `init(batch, right)`
gives a state, `step(state, markers, visible, dt)` a state and an output with the attributes
`markers` and `state`, and what else of a `HandPose` it has. `tracker(model)` makes one of a model.
Each `check_…` takes a tracker and a stream, and raises AssertionError with law, marker, frame and
size of what is wrong. `check_all` lets Hypothesis look for a small stream that breaks a law:

    laws.check_all(laws.tracker(Model(load_hand("glove9"), "mine")))

Laws hold from the first frame with state `tracking`, within 1e-5 m and 1e-4 rad, or bit for bit.
Needs numpy and hypothesis, never JAX.
"""

from __future__ import annotations

import copy
import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace

import numpy as np
from hypothesis import strategies as st

from jaxhand.strategies import Motion, Stream, complete_first, rigid_motions, streams
from jaxhand.trial import FIELDS, PLACES, TURNS, Tracker, Trial, extents, falsify, run, solid_core
from jaxhand.trial import tracker as tracker
from numpy_infer.arrays import Array
from numpy_infer.continuity import SHRINK_SPEED
from numpy_infer.geometry import kabsch, mirror, mirror_rotation
from numpy_infer.hand import Hand
from numpy_infer.pose import DETERMINED_EXTENT, Status, TrackingState

METRES, RADIANS = 1e-5, 1e-4
"""What the laws promise where they do not promise the very bits."""

REFLECTED: Mapping[str, Callable[[Array], Array]] = {
    **dict.fromkeys(PLACES, mirror),
    **dict.fromkeys(TURNS, mirror_rotation),
}
"""What the mirror does to an output; all else stays as it is."""


def check_rigid(
    tracker: Tracker,
    stream: Stream,
    motion: Motion,
    *,
    metres: float = METRES,
    radians: float = RADIANS,
) -> None:
    """One rigid motion of the whole stream moves every output by it and changes no angle."""
    one = run(tracker, stream)
    found = run(tracker, stream._replace(truth=motion(stream.truth))).poses
    turned = {name: motion.rotation @ one.poses[name] for name in TURNS if name in one.poses}
    placed = {name: motion(one.poses[name]) for name in PLACES if name in one.poses}
    expected = one.poses | turned | placed
    trial, since = Trial("rigid", tracker, stream, motion), one.tracked
    trial.same(found, expected, ("state", "status"))
    trial.same(found, expected, ("markers",), within=metres, where=since)
    # A fingertip is as far from the wrist as the alignment markers from each other, and more.
    trial.same(found, expected, PLACES[1:], within=10 * metres, where=since)
    trial.same(found, expected, ("angles", *TURNS), within=radians, where=since)


def check_carried(
    tracker: Tracker, stream: Stream, *, flat: bool = False, metres: float = METRES
) -> None:
    """A fixed posture, that of the first frame, carried along any path, that of the stream, is
    filled exactly. So it is by predictors that know of the posture (affine) or of hands (learned),
    not by those that go by each marker alone.

    The first frame is made complete, as is each whose markers do not determine the rotation; and
    five that are far from coplanar are always in sight, as an affine combination needs them, unless
    `flat`.
    """
    eye = np.broadcast_to(np.eye(3), (*stream.dt.shape, 3, 3))
    posture = np.broadcast_to(stream.truth[:1], stream.truth.shape)
    rotation, shift = kabsch(posture, stream.truth, np.ones(stream.visible.shape), eye)
    carried = posture @ np.swapaxes(rotation, -1, -2) + shift[..., None, :]
    visible = stream.visible.copy()
    visible[0] = True
    if not flat:
        for hand in np.ndindex(*visible.shape[1:-1]):
            visible[:, *hand] |= solid_core(posture[0, *hand], ~visible[:, *hand])
    visible |= (extents(carried, visible)[..., 1] < 2 * DETERMINED_EXTENT)[..., None]
    shown = Stream(carried, visible, stream.dt)
    found = run(tracker, shown).poses
    Trial("carried", tracker, shown).same(found, {"markers": carried}, within=metres)


def check_mirror(tracker: Tracker, stream: Stream) -> None:
    """A stream of a left hand reflected in x and given as a right hand's comes back reflected in x,
    with the same angles, bit for bit (but for the sign of a zero)."""
    left = run(tracker, stream).poses
    right = run(tracker, stream._replace(truth=mirror(stream.truth)), right=True).poses
    expected = {name: REFLECTED.get(name, np.asarray)(value) for name, value in left.items()}
    Trial("mirror", tracker, stream).same(right, expected)


def check_hidden_cannot_matter(
    tracker: Tracker, stream: Stream, garbage: float | Array = 1e30
) -> None:
    """Whatever stands in a hidden coordinate changes no bit; and a coordinate that is not finite
    hides its marker, whatever `visible` says.

    Args:
        tracker: what is checked.
        stream: what is seen.
        garbage: `[T, ..., M, 3]`, or one number: what stands in hidden coordinates.
    """
    trial = Trial("hidden cannot matter", tracker, stream)
    clean, shown = run(tracker, stream), stream.visible[..., None]
    filled = np.where(shown, stream.truth, garbage)
    said = stream._replace(visible=np.ones_like(stream.visible))
    axis = np.arange(stream.visible.size).reshape(stream.visible.shape) % 3
    hole = ~shown & (axis[..., None] == np.arange(3))
    holed = [np.where(hole, value, stream.truth) for value in (np.nan, -np.inf)]
    for given_, markers in ((stream, filled), (said, holed[0]), (said, holed[1])):
        found = run(tracker, given_, markers=markers)
        trial.same(found.poses, clean.poses)
        trial.same_state(found.states[-1], clean.states[-1])


def check_unchanged(tracker: Tracker, stream: Stream, *, metres: float = METRES) -> None:
    """If nothing was ever hidden, markers come back bit for bit; and after a re-entry, here of all
    markers half-way, once the correction has died, which shrinks by 25 cm a second."""
    full = stream._replace(visible=np.ones_like(stream.visible))
    poses = run(tracker, full).poses
    truth = stream.truth.astype(poses["markers"].dtype)
    nothing = np.zeros(stream.visible.shape)
    measured = {"markers": truth, "status": nothing, "expected_error": nothing}
    trial = Trial("unchanged", tracker, full)
    trial.same(poses, {name: measured[name] for name in measured if name in poses})

    half = len(truth) // 2
    again = stream._replace(visible=stream.visible.copy())
    again.visible[0], again.visible[half:] = True, True
    trial, truth = Trial("unchanged", tracker, again, start=half), truth[half:]
    back = {"markers": run(tracker, again).poses["markers"][half:]}
    # As the hand's own frame sees it: how far the output is off at the first complete frame is
    # what has to shrink, at most, and one frame's shrinking has been done.
    size = np.linalg.norm(back["markers"][0] - truth[0], axis=-1)
    elapsed = np.concatenate([np.zeros_like(stream.dt[:1]), np.cumsum(stream.dt[half + 1 :], 0)])
    dead = elapsed[..., None] > size / SHRINK_SPEED * 1.001 + 1e-4
    trial.same(back, {"markers": truth}, where=dead)
    left = np.maximum(size - SHRINK_SPEED * elapsed[..., None], 0)
    expected = {"markers": _at_distance(left, truth, back["markers"])}
    trial.same(back, expected, within=metres)


def check_prefix(
    tracker: Tracker,
    stream: Stream,
    *,
    whole: Callable[[Stream], Array] | None = None,
    metres: float = METRES,
) -> None:
    """Outputs depend on the past alone, bit for bit, and on nothing but the state: it can be taken
    up again, also after another future has been tried from it.

    `whole`: another path, which takes a stream at once and gives its markers `[T, ..., M, 3]`; it
    must agree within `metres`, on the stream and on its first half.
    """
    half = max(1, len(stream.dt) // 2)
    head, tail = Stream(*(a[:half] for a in stream)), Stream(*(a[half:] for a in stream))
    everything, states = run(tracker, stream)
    first = {name: value[:half] for name, value in everything.items()}
    rest = {name: value[half:] for name, value in everything.items()}
    start = run(tracker, head)
    trial = Trial("prefix", tracker, stream)
    trial.same(start.poses, first)
    if len(tail.dt):
        kept = copy.deepcopy(start.states[-1])
        run(tracker, tail._replace(truth=tail.truth + 1), state=start.states[-1])
        for state in (start.states[-1], kept):
            again = run(tracker, tail, state=state)
            replace(trial, start=half).same(again.poses, rest)
            trial.same_state(again.states[-1], states[-1])
    if whole is not None:
        for part, poses in ((stream, everything), (head, first)):
            found = {"markers": np.asarray(whole(part))}
            trial.same(found, poses, ("markers",), within=metres)


def check_continuity(tracker: Tracker, stream: Stream, *, metres: float = METRES) -> None:
    """Once the true hand stands still no output marker moves faster than 25 cm a second in any
    frame, whatever the visible set does. The stream's hand must come to rest, or nothing is said.

    Exempt is the frame in which the hand's motion since the frame before is read off a marker whose
    place in the hand is out of date: seen last before the hand came to rest, or before an earlier
    frame of this kind. That is so where such a marker is visible and those seen in both frames
    leave the rotation open: the rigid pose is then taken at once, as for a hand that comes back.
    Neither a return by markers seen at rest is exempt, nor a change of the set that leaves three in
    sight. A tracker's `drift`, if it has one, is allowed for.
    """
    poses, states = (ran := run(tracker, stream)).poses, ran.states
    tracking = poses["state"] == TrackingState.TRACKING
    truth, visible = stream.truth, stream.visible
    moves = (np.diff(truth, axis=0) != 0).any((-1, -2))
    moving = np.logical_or.accumulate(moves[::-1], 0)[::-1]
    drift = getattr(tracker, "drift", lambda state, dt: 0.0)
    markers, recent = poses["markers"], visible[0]
    expected, within = markers.astype(np.float64), np.full(visible.shape, np.inf)
    for t in range(1, len(truth)):
        twice = visible[t] & visible[t - 1] & tracking[t - 1][..., None]
        open_ = extents(truth[t], twice)[..., 1] < DETERMINED_EXTENT
        outdated = (visible[t] & ~recent).any(-1)
        exempt = moving[t - 1] | ~ran.tracked[t - 1] | (tracking[t] & open_ & outdated)
        recent = np.where(exempt[..., None], visible[t], recent | visible[t])
        elapsed = np.maximum(stream.dt[t], 0)
        allowed = SHRINK_SPEED * elapsed[..., None] + drift(states[t], elapsed) + metres / 2
        expected[t] = markers[t - 1]
        within[t] = np.where(exempt[..., None], np.inf, allowed)
    Trial("continuity", tracker, stream).same(poses, {"markers": expected}, within=within)


def check_few_visible(tracker: Tracker, stream: Stream, *, metres: float = METRES) -> None:
    """With 0, 1, 2 or collinear markers visible, hidden ones keep their last output, moved by the
    mean displacement of the markers seen in both frames, without a rotation. Before a hand was
    tracked the template stands at the mean of the markers seen."""
    ran = run(tracker, stream)
    poses, tracked = ran.poses, ran.tracked
    truth, visible = stream.truth, stream.visible
    second = extents(truth, visible)[..., 1]
    few = second < 0.99 * DETERMINED_EXTENT  # so near to it rounding decides
    expected = np.array(poses["markers"], np.float64)
    shown = visible[..., None]
    template = np.broadcast_to(tracker.hand.template, truth.shape)
    mean = ((truth - template) * shown).sum(-2) / np.maximum(shown.sum(-2), 1)
    placed = np.where(shown, truth, template + mean[..., None, :])
    untracked = ~tracked & visible.any(-1)
    expected = np.where(untracked[..., None, None], placed, expected)
    for t in range(1, len(truth)):
        both = (visible[t] & visible[t - 1])[..., None]
        shift = ((truth[t] - truth[t - 1]) * both).sum(-2) / np.maximum(both.sum(-2), 1)
        carried = poses["markers"][t - 1] + shift[..., None, :]
        held = (few[t] & tracked[t - 1])[..., None] & ~visible[t]
        expected[t] = np.where(held[..., None], carried, expected[t])
    trial = Trial("few visible", tracker, stream)
    trial.same(poses, {"markers": expected}, within=metres)
    some = np.where(tracked & visible.any(-1), TrackingState.DEGRADED, TrackingState.LOST)
    state = np.where(few, some, TrackingState.TRACKING)
    sure = few | (second > 1.01 * DETERMINED_EXTENT)
    trial.same(poses, {"state": state}, where=sure)
    if "status" in poses:
        held = np.full(visible.shape, int(Status.HELD))
        trial.same(poses, {"status": held}, where=few[..., None] & ~visible)


def check_return(
    tracker: Tracker,
    stream: Stream,
    motion: Motion,
    *,
    all_markers: bool = False,
    metres: float = METRES,
) -> None:
    """A hand that is lost at the stream's end, carried away by a motion meanwhile, and seen again
    by markers that were seen at the end, is where the motion has taken it, output and all: in its
    own frame nothing has moved faster than 25 cm a second.

    So are the markers seen; and with `all_markers` those too that are hidden still, which only
    predictors take along that go by the frame, and not by each marker alone.
    """
    gone, dt = 3, np.full(stream.dt.shape[1:], 1 / 60)
    back, last = stream.visible[-1], stream.truth[-1]
    at_loss = stream._replace(visible=stream.visible.copy())
    at_loss.visible[-1] |= stream.visible[0]
    shown = Stream(
        np.concatenate([at_loss.truth, np.stack([last] * gone), motion(last)[None]]),
        np.concatenate([at_loss.visible, np.stack([back & False] * gone), back[None]]),
        np.concatenate([at_loss.dt, np.stack([dt] * (gone + 1))]),
    )
    markers = run(tracker, shown).poses["markers"]
    clear = extents(last, back)[..., 1] > 2 * DETERMINED_EXTENT
    where = clear[..., None] & (back | all_markers)
    trial = Trial("return", tracker, shown, motion, start=len(shown.dt) - 1)
    expected = motion(markers[len(stream.dt) - 1])[None]
    within = SHRINK_SPEED / 60 + 2 * metres
    trial.same({"markers": markers[-1:]}, {"markers": expected}, within=within, where=where[None])


def check_batch(
    tracker: Tracker,
    stream: Stream,
    right: Array | None = None,
    *,
    metres: float = METRES,
    radians: float = RADIANS,
) -> None:
    """Any number of hands equals one at a time, left and right mixed. All are there twice.

    Args:
        tracker: what is checked; `init` takes the leading shape.
        stream: `[T, H, ...]` of several hands.
        right: `[H]` True for a right hand; by default every other one.
        metres, radians: tolerances; a network's products are rounded otherwise in a batch.
    """
    hands = stream.visible.shape[1]
    right = np.arange(hands) % 2 == 1 if right is None else right
    twice = Stream(*(np.concatenate([a, a], 1) for a in stream))
    together = run(tracker, twice, right=np.concatenate([right, right])).poses
    folded = Stream(*(a.reshape(len(a), 1, *a.shape[1:]) for a in stream))
    square = run(tracker, folded, right=right[None]).poses
    for hand in range(hands):
        alone = Stream(*(a[:, hand] for a in stream))
        one = run(tracker, alone, right=right[hand]).poses
        for of, many in (
            (f"{hand} of {2 * hands}", {k: v[:, hand] for k, v in together.items()}),
            (
                f"{hand + hands} of {2 * hands}",
                {k: v[:, hand + hands] for k, v in together.items()},
            ),
            (f"{hand} of {hands}", {k: v[:, 0, hand] for k, v in square.items()}),
        ):
            trial = Trial(f"batch, hand {of}", tracker, alone)
            trial.same(many, one, ("state", "status", "notice"))
            trial.same(many, one, (*PLACES, "expected_error"), within=metres)
            trial.same(many, one, ("angles", *TURNS), within=radians)
            for name, value in one.items():
                if many[name].dtype != value.dtype:
                    trial.refuse(f"{name}: {many[name].dtype} instead of {value.dtype}")


def check_parity(
    one: Tracker, other: Tracker, stream: Stream, *, metres: float = 1e-4, radians: float = 1e-3
) -> None:
    """Two trackers, such as JAX and numpy, say the same. Promised with at least four markers
    visible in each frame; not of angles, which near 90° of abduction are none of the rotations."""
    found, expected = run(one, stream).poses, run(other, stream).poses
    trial = Trial("parity", other, stream)
    trial.same(found, expected, ("state", "status"))
    trial.same(found, expected, (*PLACES, "expected_error"), within=metres)
    trial.same(found, expected, TURNS, within=radians)


def check_time(
    tracker: Tracker, stream: Stream, motion: Motion, late: float = 0.0, *, metres: float = METRES
) -> None:
    """No time (dt ≤ 0, or not a number) and the same markers change neither output nor state; with
    other markers, here the last ones moved, what is measured is taken, but no correction shrinks.

    `late`: the dt, of any size but positive. A hand never seen yet is exempt.
    """
    ran = run(tracker, stream)
    last = Stream(*(a[-1:] for a in stream))
    last = last._replace(dt=np.full(last.dt.shape, late))
    known = stream.visible.any((0, -1))
    trial = Trial(f"time, dt {late}", tracker, stream, start=len(stream.dt) - 1)
    again = run(tracker, last, state=ran.states[-1])
    before = {name: value[-1:] for name, value in ran.poses.items()}
    trial.same(again.poses, before, FIELDS[:-1], where=known[None])  # `notice` says: no time
    trial.same_state(again.states[-1], ran.states[-1], known)

    elsewhere = last._replace(truth=motion(last.truth))
    trial = replace(trial, motion=motion)
    moved = run(tracker, elsewhere, state=ran.states[-1]).poses
    stopped = elsewhere._replace(dt=np.zeros(last.dt.shape))
    trial.same(moved, run(tracker, stopped, state=ran.states[-1]).poses)
    off = np.linalg.norm(ran.poses["markers"][-1] - last.truth[0], axis=-1)
    tracking = extents(last.truth, last.visible)[..., 1] > 1.01 * DETERMINED_EXTENT
    where = last.visible & (tracking & ran.tracked[-1])[..., None]
    expected = _at_distance(off, elsewhere.truth, moved["markers"])
    trial.same(moved, {"markers": expected}, within=metres, where=where)


def _at_distance(distance: Array, start: Array, towards: Array) -> Array:
    """`[..., 3]` points at a distance `[...]` from where they start, towards others."""
    way = towards - start
    length = np.linalg.norm(way, axis=-1, keepdims=True)
    direction = np.where(length > 0, way / np.where(length > 0, length, 1), [1, 0, 0])
    return start + distance[..., None] * direction


# -- all of them --------------------------------------------------------------------------------

LAWS: Mapping[str, Callable[..., None]] = {
    "hidden cannot matter": check_hidden_cannot_matter,
    "unchanged": check_unchanged,
    "prefix": check_prefix,
    "time": check_time,
    "few visible": check_few_visible,
    "mirror": check_mirror,
    "rigid": check_rigid,
    "carried": check_carried,
    "continuity": check_continuity,
    "return": check_return,
    "batch": check_batch,
    "parity": check_parity,
}
"""Every law by name, in the order of `check_all`."""

GARBAGE = (0.0, np.inf, -np.inf, 1e30, 1e300)
"""What a hidden coordinate may hold."""

LATE = (0.0, -1 / 60, -np.inf, np.nan)
"""Seconds in which no time has passed."""


def check_all(
    tracker: Tracker,
    *,
    examples: int = 25,
    seed: int | None = None,
    carried: bool = False,
    twin: Tracker | None = None,
    laws: Collection[str] | str | None = None,
    frames: int = 16,
    metres: float = METRES,
    radians: float = RADIANS,
) -> None:
    """Lets Hypothesis look for a stream that breaks a law, and raises the first that is found, made
    as small as it can be.

    Args:
        tracker: what is checked.
        examples: how many streams for each law.
        seed: the same one draws the same streams; None leaves that to Hypothesis' settings.
        carried: also that a fixed posture is filled exactly, and goes with a hand that comes back;
            see `check_carried`.
        twin: another tracker that must say the same; see `check_parity`.
        laws: names in `LAWS`, or one of them, if not all that apply.
        frames: how many there are at most in a stream.
        metres: tolerance.
        radians: tolerance.

    Raises:
        AssertionError: a law is broken.
        ValueError: no such law, or no tracker.
    """
    for name in ("hand", "init", "step"):
        if not hasattr(tracker, name):
            raise ValueError(
                f"tracker: a {type(tracker).__name__} has no {name}; laws.tracker(model) makes a "
                "tracker of a model, such as hand_tracker.model"
            )
    asked = [*LAWS] if laws is None else [laws] if isinstance(laws, str) else laws
    if unknown := set(asked) - set(LAWS):
        raise ValueError(f"unknown laws {sorted(unknown)}: expected some of {', '.join(LAWS)}")
    fixed = {"metres": metres, "radians": radians, "all_markers": carried}
    applies = {"carried": carried, "parity": twin is not None}
    for name, law in LAWS.items():
        if name not in asked or not applies.get(name, True):
            continue
        drawn = {
            "stream": _streams(name, tracker.hand, frames),
            "motion": rigid_motions(),
            "garbage": st.sampled_from(GARBAGE),
            "late": st.sampled_from(LATE),
        }
        takes = inspect.signature(law).parameters.keys()
        check = functools.partial(law, tracker, **{key: fixed[key] for key in takes & fixed.keys()})
        if name == "parity":  # has a tolerance of its own
            check = functools.partial(law, twin, tracker)
        falsify(check, {key: drawn[key] for key in drawn if key in takes}, examples, seed)


def _streams(law: str, hand: Hand, frames: int) -> st.SearchStrategy[Stream]:
    if law == "batch":
        return streams(hand, frames, hands=2)
    if law == "few visible":
        few = streams(hand, frames, most=2)
        return st.one_of(few, few.map(complete_first), streams(hand, frames))
    return streams(hand, frames, least=4 if law == "parity" else 0)
