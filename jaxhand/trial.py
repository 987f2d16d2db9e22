"""A tracker on trial: its way through a stream, words for what is wrong, the search for it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, NoReturn, Protocol

import numpy as np
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from hypothesis.errors import Flaky

import numpy_infer.tracker
from jaxhand.strategies import Motion, Stream, describe
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, JOINTS, POINTS, Hand
from numpy_infer.model import Model
from numpy_infer.pose import TrackingState
from numpy_infer.predictors import MovingAverageState

MARKERS = ("markers", "status", "expected_error")
PLACES = ("markers", "wrist_position", "positions")
TURNS = ("wrist_rotation", "rotations")
FIELDS = (*MARKERS, *PLACES[1:], *TURNS, "angles", "state", "notice")
"""What laws look at in an output. It must have `markers` and `state`; see `pose.HandPose`."""


SOLID_EXTENT = 0.02
"""Metres: markers whose third extent is larger are far from coplanar. An affine combination with
the λ = 1e-8 m² of the paper's equation 8 is then right to 3e-6 m."""


class Tracker(Protocol):
    """What laws are about. The pair is pure; `step` gives a state and an output, whose attributes
    are those of `FIELDS` that it has, `markers` and `state` at least.

    It may have a method `drift(state, dt)`: `[..., M]` metres that it lets hidden markers move on
    their own, as a moving average does; continuity then allows for it.
    """

    @property
    def hand(self) -> Hand: ...

    def init(self, batch: tuple[int, ...] = (), right: Any = False) -> Any: ...

    def step(self, state: Any, markers: Array, visible: Array, dt: Array) -> tuple[Any, Any]: ...


@dataclass(frozen=True)
class ModelTracker:
    """A model run by a module with the functions of `numpy_infer.tracker`; see `tracker`."""

    model: Model
    module: Any
    compiled: Callable[[Any], Any]

    @property
    def hand(self) -> Hand:
        return self.model.hand

    def init(self, batch: tuple[int, ...] = (), right: Any = False) -> Any:
        return self.module.init(self.model, batch, np.asarray(right))

    @cached_property
    def _step(self) -> Any:
        return self.compiled(self.module.step)

    def step(self, state: Any, markers: Array, visible: Array, dt: Array) -> tuple[Any, Any]:
        return self._step(self.model, state, markers, visible, dt)

    def drift(self, state: Any, dt: Array) -> Array:
        """`[..., M]` metres that the moving average moves a hidden marker: that is what it is, also
        if the true hand has stopped unseen. Other predictors have no leave to move."""
        own = state.predictor
        if not isinstance(own, MovingAverageState):
            return np.zeros(np.shape(state.visible))
        length = np.linalg.norm(np.asarray(own.path), axis=-1)
        speed = length / np.where(own.span > 0, own.span, 1)
        return np.where(state.visible, 0, speed) * np.maximum(dt, 0)[..., None]


def tracker(
    model: Model,
    module: Any = numpy_infer.tracker,
    compiled: Callable[[Any], Any] = lambda step: step,
) -> ModelTracker:
    """The pipeline around a model, and so around any predictor registered in `PREDICTORS`, as a
    tracker for the laws. The JAX side: `tracker(model, jaxhand.tracker, jax.jit)`."""
    return ModelTracker(model, module, compiled)


SPOILT = 7
"""What is written over what a tracker has given back, and over markers that it was given."""


class Run(NamedTuple):
    """A tracker's way through a stream."""

    poses: dict[str, Array]
    """`[T, ...]` each of the `FIELDS` that the outputs have."""
    states: list[Any]
    """`[T]` the state after each frame."""

    @property
    def tracked(self) -> Array:
        """`[T, ...]` True from the first frame with state `tracking` on."""
        return np.logical_or.accumulate(self.poses["state"] == TrackingState.TRACKING, 0)


def run(
    tracker: Tracker,
    stream: Stream,
    *,
    right: Any = False,
    markers: Array | None = None,
    state: Any = None,
) -> Run:
    """Tracks a stream, from the beginning or from `state` on. `markers [T, ..., M, 3]`: to measure
    these instead of the stream's own.

    Raises:
        AssertionError: an output, or an input, that the caller cannot call his own, or an output
            with a number in it that is not finite.
        ValueError: an output without `markers` and `state`, or with markers of another shape.
    """
    measured = stream.markers if markers is None else markers
    if state is None:
        state = tracker.init(stream.visible.shape[1:-1], right)
    frames, states = [], []
    before: list[tuple[str, Array]] = []
    for t, frame in enumerate(zip(measured, stream.visible, stream.dt, strict=True)):
        given = {"markers": frame[0].copy(), "visible": frame[1].copy(), "dt": frame[2].copy()}
        state, pose = tracker.step(state, *given.values())
        found = {name: getattr(pose, name, None) for name in FIELDS}
        _check_output(pose, found, frame[0].shape)
        frames.append({k: np.array(v) for k, v in found.items() if v is not None})
        states.append(state)
        refuse = Trial("prefix", tracker, stream).refuse
        for (name, value), own in zip(given.items(), frame, strict=True):
            if not np.array_equal(value, own, equal_nan=True):
                refuse(f"step changes the {name} that it is given, in frame {t}")
        # What the caller does with what is his own cannot matter.
        own = [(k, v) for k, v in found.items() if isinstance(v, np.ndarray) and v.ndim]
        for name, value in own:
            if not value.flags.writeable:
                refuse(f"{name} in frame {t}: read-only")
        kept = {_owner(leaf): leaf for leaf in leaves(state)}
        for name, value in (*own, *given.items()):
            if _owner(value) in kept and any(np.shares_memory(value, x) for x in kept.values()):
                whose = "given" if value is given.get(name) else "given back"
                refuse(f"the state holds the {name} {whose} in frame {t}, not a copy")
        for name, value in before:
            if (value != SPOILT).any():
                refuse(f"the {name} given back in frame {t - 1} change in frame {t}")
        for _, value in own:
            value.fill(SPOILT)
        given["markers"].fill(SPOILT)
        np.logical_not(frame[1], out=given["visible"])
        before = own
        for name in found:
            if not np.isfinite(frames[-1].get(name, 0)).all():
                Trial("few visible", tracker, stream).refuse(f"{name} in frame {t}: not finite")
    return Run({name: np.stack([frame[name] for frame in frames]) for name in frames[0]}, states)


def _check_output(pose: Any, found: Mapping[str, Any], shape: tuple[int, ...]) -> None:
    for name in ("markers", "state"):
        if found[name] is None:
            raise ValueError(
                f"a {type(pose).__name__} came back from step, without {name}: expected a state, "
                "and an output with markers and state as numpy_infer.HandPose has them"
            )
    if np.shape(found["markers"]) != shape:
        raise ValueError(f"markers: expected shape {shape}, received {np.shape(found['markers'])}")


def _owner(array: Array) -> int:
    """Which array's memory it is in."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return id(array)


@dataclass(frozen=True)
class Trial:
    """A tracker and a stream before a law."""

    law: str
    tracker: Tracker
    stream: Stream
    motion: Motion | None = None
    start: int = 0
    """Frame of the stream that is the first of the outputs compared."""

    def refuse(self, text: str, hand: tuple[int, ...] = (), frame: int | None = None) -> NoReturn:
        """Raises AssertionError, which tells the stream of the hand up to the frame."""
        end = None if frame is None else frame + 1
        shown = Stream(*(part[:end, *hand] for part in self.stream))
        moved = "" if self.motion is None else f"\n  motion: {self.motion!r}"
        said = describe(shown, self.tracker.hand.markers)
        raise AssertionError(f"law '{self.law}': {text}{moved}\n  stream so far: {said}")

    def same(
        self,
        found: Mapping[str, Array],
        expected: Mapping[str, Array],
        fields: Collection[str] = FIELDS,
        *,
        within: float | Array = 0.0,
        where: Array | bool = True,
    ) -> None:
        """Compares outputs `[T, ...]`, and names what is worst in the first wrong frame. `within`
        0 asks for equal values, but for the sign of a zero; `where [T, ...]` to compare."""
        for name in fields:
            if name in expected:
                self._field(name, found[name], expected[name], within, np.asarray(where))

    def same_state(self, one: Any, other: Any, hands: Array | None = None) -> None:
        """Compares states array by array, bit for bit, of all hands or of `hands [...]`. Of states
        that are no tuples, lists or dicts of arrays it can say nothing."""
        for found, expected in zip(leaves(one), leaves(other), strict=True):
            if hands is not None and found.shape[: hands.ndim] == hands.shape:
                found, expected = found[hands], expected[hands]
            if found.dtype != expected.dtype or found.tobytes() != expected.tobytes():
                self.refuse("another state")

    def _field(
        self, name: str, found: Array, expected: Array, within: float | Array, where: Array
    ) -> None:
        off = np.abs(np.subtract(found, expected, dtype=np.float64))
        if name in PLACES:
            off = np.linalg.norm(off, axis=-1)
        elif name in TURNS:
            off = np.linalg.norm(off, axis=(-1, -2)) / np.sqrt(2)  # the angle, while it is small
        if where.ndim:
            where = where.reshape(where.shape + (1,) * (off.ndim - where.ndim))
        wrong = where & ~(off <= within)
        if not wrong.any():
            return
        hands = self.stream.visible.ndim - 2
        t = int(np.argmax(wrong.reshape(len(wrong), -1).any(-1)))
        worst = np.unravel_index(np.argmax(np.where(wrong[t], off[t], -1)), off[t].shape)
        hand, part = tuple(map(int, worst[:hands])), worst[hands:]
        size = f"off by {1000 * off[t][worst]:.4g} mm"
        if name in ("angles", *TURNS):
            size = f"off by {off[t][worst]:.4g} rad"
        if not np.any(within):
            size += ", where no bit may differ"
        if name in ("state", "status", "notice"):
            size = f"{found[t][worst]} instead of {expected[t][worst]}"
        of = f" of hand {', '.join(map(str, hand))}" if hand else ""
        item = f"{self._item(name, part[0])} " if part else ""
        frame = self.start + t
        self.refuse(f"{item}({name}){of} in frame {frame}: {size}", hand, frame)

    def _item(self, name: str, index: Any) -> str:
        if name in MARKERS:
            return f"marker {self.tracker.hand.markers[index]}"
        if name == "angles":
            return ANGLES[index].name
        return {"positions": POINTS, "rotations": JOINTS}[name][index]


def leaves(tree: Any) -> list[Array]:
    """The arrays of nested tuples, lists and dicts, in order; of other objects, nothing."""
    if isinstance(tree, Mapping):
        tree = list(tree.values())
    if isinstance(tree, tuple | list):
        return [leaf for part in tree for leaf in leaves(part)]
    array = np.asarray(tree)
    return [] if array.dtype == object else [array]


def extents(points: Array, visible: Array) -> Array:
    """`[..., 3]` metres: the singular values of the centred visible ones of `[..., M, 3]` points.
    The second is 0 for collinear points, the third for coplanar ones."""
    weight = visible[..., None]
    mean = (points * weight).sum(-2, keepdims=True) / np.maximum(weight.sum(-2, keepdims=True), 1)
    centred = (points - mean) * weight
    squares = np.linalg.eigvalsh(np.swapaxes(centred, -1, -2) @ centred)[..., ::-1]
    return np.sqrt(np.maximum(squares, 0))


def solid_core(posture: Array, hidden: Array) -> Array:
    """`[M]` five markers of a posture `[M, 3]`, far from coplanar, that of forty draws are hidden
    least in `[T, M]`; all markers where there are none such."""
    rng, count = np.random.default_rng(0), len(posture)
    draws = np.stack([rng.permutation(count) < 5 for _ in range(40)])
    solid = extents(np.broadcast_to(posture, (40, count, 3)), draws)[..., 2] > SOLID_EXTENT
    cost = np.where(solid, draws @ hidden.sum(0), np.inf)
    return draws[np.argmin(cost)] if solid.any() else np.ones(count, bool)


def falsify(
    law: Callable[..., None],
    strategies: dict[str, st.SearchStrategy[Any]],
    examples: int,
    seed: int | None,
) -> None:
    """Runs a law on drawn arguments; raises what it raises on the smallest that fail."""

    @settings(
        max_examples=examples,
        deadline=None,
        database=None,
        print_blob=False,
        report_multiple_bugs=False,
        phases=(Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.fixed_dictionaries(strategies))
    def check(arguments: dict[str, Any]) -> None:
        law(**arguments)

    try:
        (check if seed is None else seeded(seed)(check))()
    except Flaky as error:
        once = next(iter(getattr(error, "exceptions", ())), error)
        raise AssertionError(
            "law 'prefix': the same stream, from the beginning, once fails and once does not: the "
            f"tracker keeps something besides its state; when it failed, {once}"
        ) from error
