"""The verbs `calibrate` and `hand`: a person's bones for the tracker, a file for a new glove."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.console import Console

from jaxhand.calibration import DENSE, Calibration, Priors, calibrate
from jaxhand.hand_size import ALIKE, SIZES, Size, hand_size
from jaxhand.hand_size import FAR as FARTHEST
from jaxhand.joint_evaluation import evaluate_poses
from jaxhand.options import Unit
from numpy_infer import wearer
from numpy_infer.arrays import Array
from numpy_infer.cli import check_output
from numpy_infer.geometry import mirror
from numpy_infer.hand import ANGLES, FINGER_OF_ANGLE, FINGERS, POINTS, Hand, load_hand
from numpy_infer.labels import doubted_unit, of_hand
from numpy_infer.model import Model
from numpy_infer.model import load as load_model
from numpy_infer.recordings import Recording, load_label_map, read
from numpy_infer.wearer import Wearer, worn_by

FAR, FAR_OF_MANY = 15e-3, 4e-3
"""Metres: markers that fit worse make a poor fit, of a glove with few markers (root mean square)
and with `DENSE` or more (mean). With `glove9` recorded hands are 11 to 13 mm off and simulated ones
5 to 15, for markers sit elsewhere on everybody; with `qualisys13` up to 18, but where they are more
than 15 off, the sizes found are worse than the model's own. Many are 3 mm off at most."""
ELSEWHERE = 10e-3
"""Metres: how far the markers of a new glove may be from those of one like it; standard deviation
per axis."""
FAR_OF_NEW, MOVED_FAR = 10e-3, 40e-3
"""Metres: what makes a poor description of a glove, a mean distance to the fitted markers, or a
marker so far from where the glove like it has it. Simulated gloves are 0.2 to 0.4 mm off and their
markers at most 24 mm away, recorded ones mostly 0.2 to 4 mm and 35 mm; of the other side, or with
labels exchanged on the back of the hand, nearly all are beyond one of the two."""
BENT = 20.0
"""Degrees by which the fingers' flexions may be off on average where a flat hand is to be held. On
simulated people, with markers 5 mm per axis from where the bundled models have them, that was up to
14; while the hand moved freely, in half of the seconds above 33."""
_FLEXIONS = [
    i for i, a in enumerate(ANGLES) if a.name.endswith("_flexion") and FINGER_OF_ANGLE[i] > 0
]
OTHER_SIDE = 0.95
"""A hand that fits so much nearer as one of the other side is taken for one. Of recorded and
simulated hands, on their own side none was below 0.99, on the other most were below 0.93."""


@dataclass(frozen=True, kw_only=True)
class _File:
    recording: tyro.conf.Positional[Path]
    """A marker file (TRC, TSV, CSV, C3D, …)."""
    out: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """The file to write."""
    right: bool = False
    """It is a right hand."""
    left_prefix: str = ""
    """What its labels begin with, such as L_, where the file has other things beside it."""
    right_prefix: str = ""
    """The same of a right hand."""
    map: Path | None = None
    """JSON file {"label in the file": "marker"}."""
    unit: Unit = None
    """The file's unit, where it does not say."""
    left_handed: bool = False
    """The file's coordinates are left-handed."""
    overwrite: bool = False
    """Replace the file if it exists."""


@dataclass(frozen=True, kw_only=True)
class CalibrateConfig(_File):
    """The command line of `jaxhand calibrate`."""

    model: Path
    """The model that will track this person: a file, or the name of a bundled one."""
    flat: tuple[float, float] | None = None
    """Seconds from and to which a flat hand is held, fingers together: what the joint network makes
    of it is then taken off all it says (paper, section 2.2)."""


@dataclass(frozen=True, kw_only=True)
class HandConfig(_File):
    """The command line of `jaxhand hand`."""

    like: str = "glove9"
    """A bundled hand, or a hand file, with markers of the same names at roughly these places."""
    name: str | None = None
    """The new hand's name; by default that of the file it is written to."""


def calibrate_person(config: CalibrateConfig, console: Console | None = None) -> Wearer:
    """Finds the bones of whoever wears a glove out of 5 to 30 s of free motion, and writes them.
    A glove of many markers gives every bone, one of few the hand's size.

    Raises:
        ValueError: a file that is none, exists already or would stand in no folder, or a recording
            that does not determine a hand.
    """
    console = console or Console(soft_wrap=True, highlight=False)
    recording, model = _read(config), load_model(config.model)
    markers = _markers(recording, model.hand, config)
    held = None if config.flat is None else _held(model, recording, markers, config.flat)
    with console.status("fitting the hand"):
        if len(model.hand) >= DENSE:
            found = calibrate(model.hand, markers, rate=recording.rate)
            hand, seen, said = found.hand, found.seen, _bones(found, model.hand, config)
        else:
            size, other = (hand_size(model, side) for side in (markers, mirror(markers)))
            hand, seen, said = model.hand.resized(size.factor), size.seen, _of_size(size, config)
            if other.off < OTHER_SIDE * size.off:
                side, how = _other_side(config)
                off = 1e3 * other.off
                said.append(f"as a {side} hand they fit better, within {off:.1f} mm ({how})")
    unseen = tuple(finger for finger, known in zip(FINGERS, seen, strict=True) if not known)
    flat = None
    if held is not None:
        angles = _angles(worn_by(model, hand), markers[held])
        flat, bent = angles.mean(0), _bent(angles)
        if bent > BENT:
            said.append(
                f"--flat: in those seconds the fingers are bent by up to {bent:.0f}° on average "
                f"(usual: up to {BENT:.0f}°): was the hand flat? If not, all angles will be off"
            )
    person = Wearer(hand, flat, unseen)
    wearer.save(person, config.out, overwrite=config.overwrite)
    for line in said:
        console.print(line)
    for line in _unseen(seen):
        console.print(line)
    console.print(
        f"wrote {config.out}; HandTracker.load(…, calibration=…) and jaxhand track "
        "--calibration take it"
    )
    return person


def describe_glove(config: HandConfig, console: Console | None = None) -> None:
    """Writes a hand file for a new glove out of some ten seconds of flat and free motion.

    Raises:
        ValueError: as `calibrate_person`.
    """
    console = console or Console(soft_wrap=True, highlight=False)
    like, recording = load_hand(config.like), _read(config)
    markers = _markers(recording, like, config)
    with console.status("fitting bones, offsets, angles and poses"):
        found = calibrate(like, markers, rate=recording.rate, priors=Priors(offset=ELSEWHERE))
    hand = replace(
        found.hand,
        name=config.name or config.out.stem,
        sources=(f"fitted to a recording, from {like.name}",),
    )
    config.out.write_text(json.dumps(hand.to_json(), indent=1) + "\n", "utf-8")
    for line in _of_glove(found, like, config):
        console.print(line)
    console.print(f"wrote {config.out}")


def _read(config: _File) -> Recording:
    check_output(config.out, overwrite=config.overwrite, inputs=[config.recording])
    if config.left_prefix and (config.right or config.right_prefix):
        raise ValueError("one hand at a time: --left-prefix goes without --right, --right-prefix")
    return read(
        config.recording,
        unit=config.unit,
        left_handed=config.left_handed,
        label_map=load_label_map(config.map) if config.map else None,
        prefixes=(config.left_prefix, config.right_prefix),
    ).measured()


def _markers(recording: Recording, hand: Hand, config: _File) -> Array:
    """`[T, M, 3]` metres, of a canonical left hand, all of whose labels are there."""
    prefix = config.left_prefix or config.right_prefix
    own = of_hand(recording, prefix, hand)
    if doubt := doubted_unit(replace(own, names=hand.markers, filled=()), hand):
        raise ValueError(doubt)
    return mirror(own.markers) if _is_right(config) else own.markers


def _is_right(config: _File) -> bool:
    return config.right or bool(config.right_prefix)


def _other_side(config: _File) -> tuple[str, str]:
    """The side that the hand was not said to be of, and how to say it."""
    return ("left", "no --right, or --left-prefix") if _is_right(config) else ("right", "--right")


def _held(
    model: Model, recording: Recording, markers: Array, seconds: tuple[float, float]
) -> Array:
    """`[T]` True in the frames in which a flat hand is held, with all its markers."""
    if model.joint_network is None:
        raise ValueError("--flat: the model has no joint network to calibrate")
    since = recording.time - recording.time[0]
    held: Array = (since >= seconds[0]) & (since <= seconds[1])
    held &= np.isfinite(markers).all((-1, -2))
    if not held.any():
        raise ValueError(
            f"--flat: no frame with all markers from {seconds[0]:g} to {seconds[1]:g} s; the "
            f"recording lasts {since[-1]:.1f} s"
        )
    return held


def _angles(model: Model, markers: Array) -> Array:
    """`[N, 26]` radians: what the joint network says of frames `[N, M, 3]`, in metres. The model is
    the one that will run, on the person's own bones."""
    poses = evaluate_poses(replace(model, alignment=False), markers.astype(np.float32))
    angles: Array = poses.angles
    return angles


def _bent(angles: Array) -> float:
    """Degrees that the fingers, the thumb apart, are bent on average of their joints, or stretched
    too far, in all but a twentieth of frames `[N, 26]`."""
    bends = np.degrees(angles[:, _FLEXIONS].mean(-1))
    return float(np.quantile(np.abs(bends), 0.95))


def _unseen(seen: Array) -> list[str]:
    """What is said of fingers, `[5]` False where they moved too little."""
    return [
        f"not seen yet: the {finger}; bend and stretch it for a better fit"
        for finger, known in zip(FINGERS, seen, strict=True)
        if not known
    ]


def _of_glove(found: Calibration, like: Hand, config: _File) -> list[str]:
    """What is said of a new glove's markers, and of how well they fit."""
    moved = np.linalg.norm(found.hand.template - like.template, axis=-1)
    off = float(np.nanmean(found.residual))
    said = [
        f"{name}: {1e3 * distance:.0f} mm from where {like.name} has it"
        for name, distance in zip(like.markers, moved, strict=True)
    ]
    said.append(f"markers fit within {1e3 * off:.1f} mm on average (usual: up to 4 mm)")
    said += _unseen(found.seen)
    far = [name for name, distance in zip(like.markers, moved, strict=True) if distance > MOVED_FAR]
    if off > FAR_OF_NEW or far:
        where = f"; {', '.join(far)} far from where {like.name} has them" if far else ""
        side, how = _other_side(config)
        said.append(
            f"a poor fit, which may do harm{where}: are the labels right, is it a {side} hand "
            f"({how}), did every finger move?"
        )
    return said


def _bones(found: Calibration, model: Hand, config: _File) -> list[str]:
    """What is said of a fit of all bones."""
    now, before = (np.linalg.norm(hand.skeleton, axis=-1)[1:] for hand in (found.hand, model))
    off = float(np.nanmean(found.residual))
    return [
        f"{len(found.tracked)} frames; markers fit within {1e3 * off:.1f} mm on average (usual: up "
        "to 3 mm)",
        f"bones are {_larger(now.sum() / before.sum())} than the model's in all",
        *(
            f"  {point:11} {1e3 * new:5.1f} mm ({1e3 * (new - old):+.1f})"
            for point, new, old in zip(POINTS[1:], now, before, strict=True)
        ),
        *_poor(off > FAR_OF_MANY, found.hand.size / model.size, config),
    ]


def _of_size(size: Size, config: _File) -> list[str]:
    """What is said of a hand's size."""
    low, high = (100 * (end - 1) for end in size.interval)
    between = f"(95 %: {low:+.1f} to {high:+.1f})"
    text = f"the hand is {_larger(size.likeliest)} than the model's {between}"
    if not size.seen.any():
        text = "no finger moved enough to tell the hand's size: the model's own is kept"
    elif size.factor == 1:
        text += f": not surely {100 * ALIKE:g} % from the model's own, which is kept"
    return [
        text,
        f"markers fit within {1e3 * size.off:.1f} mm, root mean square (usual: 5 to 15 mm, and no "
        f"marker counts as more than {1e3 * FARTHEST:.0f})",
        *_poor(size.off > FAR, size.likeliest, config),
    ]


def _larger(factor: float) -> str:
    return f"{100 * abs(factor - 1):.1f} % {'larger' if factor > 1 else 'smaller'}"


def _poor(far: bool, factor: float, config: _File) -> list[str]:
    """What is said of a fit with markers far off, or of a hand as large or small as nobody's."""
    if not far and SIZES[1] < factor < SIZES[-2]:
        return []
    side, how = _other_side(config)
    return [
        f"a poor fit, which may do harm: are the labels right, is it a {side} hand ({how})? Where "
        "markers sit elsewhere than the model has them, jaxhand hand describes the glove"
    ]
