"""The command `jaxhand`: the verbs that need numpy alone; hands the others over to the JAX side."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import Any

import numpy as np

from numpy_infer import wearer
from numpy_infer.arrays import Array
from numpy_infer.formats.units import metres
from numpy_infer.hand import ANGLES, HIGH, LOW, POINTS, Hand, bundled, load_hand
from numpy_infer.labels import (
    doubted_unit,
    doubts,
    fitting_hand,
    labels_of,
    prefixed,
    unfitting,
    unusual_size,
    without,
)
from numpy_infer.model import Model, load
from numpy_infer.model import bundled as bundled_models
from numpy_infer.one_euro import Smoothing
from numpy_infer.pose import Notice, Status, TrackingState
from numpy_infer.predictors import BASELINES, PREDICTORS
from numpy_infer.recordings import (
    Recording,
    doubted_time,
    load_label_map,
    read,
    without_side,
    write_all,
    writer_of,
)
from numpy_infer.tracking import Tracked, as_measured, track, track_hands

STRAINED = 8.0
"""Degrees out of its range that an angle at a knuckle, or at the thumb's base, may be half of the
time. Of 51 recordings of their own side, SIG18's users 1 to 3, none was more than 6 out, of the
other side four were less; of 72 simulated hands none, and ten."""
_BLANK = -1
"""In place of a status: nothing was written."""
_KNUCKLES = [i for i, a in enumerate(ANGLES) if a.joint.endswith(("cmc", "mcp"))]

VERBS = {
    "train": "train both networks on recordings of hands",
    "evaluate": "measure a model beside the baselines (the paper's Table 3)",
    "calibrate": "find the bones of whoever wears the glove, for the tracker",
    "hand": "describe a new glove out of a recording, as a hand file",
    "occlusions": "count the gaps of recordings: how many markers at once, and how long",
    "demo": "the whole line on simulated hands, in a few minutes and with no data",
}
"""Verbs of the JAX side, found through the entry points `jaxhand.verbs`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs one command; returns the exit status: 0, 2 after one line on stderr, or 1 if whoever
    reads what is printed has gone."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments and arguments[0] in VERBS:
        return _hand_over(arguments[0], arguments[1:])
    options = parser().parse_args(arguments)
    try:
        run: Callable[[argparse.Namespace], None] = options.run
        run(options)
        sys.stdout.flush()
    except BrokenPipeError:  # `| head` has read enough; Python would flush once more at the end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError) as error:
        print(f"jaxhand {options.verb}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"\njaxhand {options.verb}: stopped; no file was changed", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    """The command line of the numpy side."""
    top = argparse.ArgumentParser(
        prog="jaxhand",
        description="Tracks hands from labelled optical markers, with holes.",
        epilog="jaxhand VERB --help tells more. " + _sources(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action="version", version=version("jaxhand"))
    verbs = top.add_subparsers(dest="verb", required=True, metavar="VERB")

    inspect = verbs.add_parser(
        "inspect",
        help="what is in a marker file, and which hand fits it",
        description="Prints labels, rate, unit, the gaps of every marker, and which bundled hand "
        "fits. Example: jaxhand inspect take.trc",
    )
    _add_file(inspect)
    inspect.add_argument("--json", action="store_true", help="print JSON instead of text")
    inspect.set_defaults(run=_inspect)

    tracked = verbs.add_parser(
        "track",
        help="fill the holes of a recording, and solve the joints",
        description="Runs the tracker over a recording and writes all markers; a .csv also holds "
        "the joint angles, the wrist's pose (metres, and a quaternion) and, of each marker, what "
        "it rests on (NAME.status, as its first lines say) and the metres that it is expected to "
        "be off (NAME.expected_error). "
        "Example: jaxhand track take.trc --model model.npz -o filled.csv",
    )
    _add_file(tracked)
    tracked.add_argument(
        "--model",
        metavar="M",
        help=f"a model file, a bundled model ({', '.join(bundled_models())}; default the one that "
        f"fits the labels), or a baseline: {', '.join(BASELINES)}",
    )
    tracked.add_argument(
        "-o", "--output", required=True, type=Path, help="OUT.csv, .trc, .tsv or .c3d"
    )
    tracked.add_argument(
        "--hand",
        help=f"for a baseline: a hand file, or one of {', '.join(bundled())}; default the one "
        "that fits the labels",
    )
    tracked.add_argument("--right", action="store_true", help="it is a right hand")
    tracked.add_argument(
        "--left-prefix", metavar="P", help="what a left hand's labels begin with, such as L_"
    )
    tracked.add_argument(
        "--right-prefix",
        metavar="P",
        help="the same of a right hand; with both, either hand is tracked and written to "
        "OUT_left and OUT_right",
    )
    tracked.add_argument(
        "--predictor", choices=tuple(PREDICTORS), help="instead of the model's; none: fill nothing"
    )
    tracked.add_argument("--joints", choices=("learned", "none"), help="instead of the model's")
    tracked.add_argument(
        "--calibration", type=Path, metavar="ME", help="the wearer's file from jaxhand calibrate"
    )
    tracked.add_argument(
        "--no-alignment", action="store_true", help="do not turn fingers towards their markers"
    )
    tracked.add_argument(
        "--no-gate", action="store_true", help="believe every measurement, wrong ones, too"
    )
    tracked.add_argument(
        "--smooth",
        nargs="?",
        type=float,
        const=Smoothing().min_cutoff,
        metavar="HZ",
        help="let less jitter through, for some lag; HZ is the cutoff at rest (default "
        f"{Smoothing().min_cutoff:g})",
    )
    tracked.add_argument(
        "--as-measured",
        action="store_true",
        help="write what was measured as it was, also just after a gap: a marker that comes back "
        "then jumps to where it is instead of being led there",
    )
    tracked.add_argument("--overwrite", action="store_true", help="replace OUT if it exists")
    tracked.set_defaults(run=_track)

    hands = verbs.add_parser(
        "hands",
        help="the hands that come with the package",
        description="Lists the bundled hands with their markers; with a NAME prints its file, to "
        "start a hand of your own from. Example: jaxhand hands glove9 > my_glove.json",
    )
    hands.add_argument("name", nargs="?", help="print this hand's file")
    hands.set_defaults(run=_hands)
    for verb, text in VERBS.items():
        verbs.add_parser(verb, help=text, add_help=False)
    return top


def check_output(path: Path, *, overwrite: bool, inputs: Collection[Path] = ()) -> None:
    """Refuses, before the work, a file that could not be written after it.

    Args:
        path: the file to write.
        overwrite: it may be there already.
        inputs: what is read, which it may not be.

    Raises:
        ValueError: it exists, it is a folder or an input, or it would stand in none, or where
            nothing may be written.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path.parent} is no folder: make it first")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise ValueError(f"{path.parent} is a folder that nothing may be written to")
    if path.is_dir():
        raise ValueError(f"{path} is a folder: choose another name")
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists: choose another name, or pass --overwrite")
    if path.exists() and any(own.exists() and path.samefile(own) for own in inputs):
        raise ValueError(f"{path} is the recording itself: choose another name")


def _add_file(verb: argparse.ArgumentParser) -> None:
    verb.add_argument("file", type=Path, help="TRC, Qualisys TSV, CSV, Motive CSV, BVH, C3D, …")
    verb.add_argument("--map", type=Path, help='JSON file {"label in the file": "marker"}')
    verb.add_argument(
        "--unit",
        metavar="U",
        help="the file's, where it does not say: mm, cm, m, in, or a number of metres",
    )
    verb.add_argument(
        "--left-handed", action="store_true", help="the file's coordinates are left-handed"
    )


def _read(options: argparse.Namespace, prefixes: Collection[str] = ()) -> Recording:
    return read(
        options.file,
        unit=None if options.unit is None else metres(options.unit),
        left_handed=options.left_handed,
        label_map=load_label_map(options.map) if options.map else None,
        prefixes=prefixes,
    ).measured()


def _inspect(options: argparse.Namespace) -> None:
    recording = _read(options)
    report = describe(recording)
    if options.json:
        print(json.dumps(report, indent=1))
        return
    print(f"{report['file']}: {report['frames']} frames, {report['seconds']:.1f} s")
    print(f"rate {report['rate']:g} Hz, file unit {report['unit_m']:g} m")
    for note in report["notes"]:
        print(f"note: {note}")
    width = max(len(name) for name in recording.names)
    print(f"\n{'marker':{width}}  missing  gaps  longest")
    for name, marker in report["markers"].items():
        mark = "  partly filled in, not measured" if marker["filled"] else ""
        print(
            f"{name:{width}}  {100 * marker['missing']:6.1f}%  {marker['gaps']:4d}  "
            f"{marker['longest_s']:6.2f}s{mark}"
        )
    print()
    for name, missing in report["hands"].items():
        lacks = f"lacks {', '.join(missing)}" if missing else "fits"
        if len(missing) == len(load_hand(name)):
            lacks = f"has none of its {len(missing)} labels here"
        print(f"hand {name}: {lacks}")


def describe(recording: Recording) -> dict[str, Any]:
    """What `jaxhand inspect --json` prints: plain data about a recording and its gaps."""
    visible = recording.visible
    markers = {}
    for name, seen in zip(recording.names, visible.T, strict=True):
        edges = np.flatnonzero(np.diff(np.r_[False, ~seen, False].astype(int)))
        lengths = edges[1::2] - edges[::2]
        markers[name] = {
            "missing": float(1 - seen.mean()),
            "gaps": len(lengths),
            "longest_s": float(lengths.max(initial=0) / recording.rate),
            "filled": name in recording.filled,
        }
    return {
        "file": recording.source,
        "frames": len(recording.time),
        "seconds": float(recording.time[-1] - recording.time[0]),
        "rate": recording.rate,
        "unit_m": recording.unit,
        "notes": [*recording.notes, *doubts(recording)],
        "markers": markers,
        "hands": {
            name: [m for m in load_hand(name).markers if m not in recording.names]
            for name in bundled()
        },
    }


def _track(options: argparse.Namespace) -> None:
    if options.smooth is not None and not 0 < options.smooth < np.inf:
        raise ValueError(f"--smooth: expected a cutoff above 0 Hz, got {options.smooth:g}")
    if options.smooth is not None and options.as_measured:
        raise ValueError("--as-measured writes what --smooth would smooth: leave one of them out")
    outputs = _outputs(options)
    for output in outputs.values():
        writer_of(output)
        check_output(output, overwrite=options.overwrite, inputs=[options.file])
    prefixes = {"left": options.left_prefix or "", "right": options.right_prefix or ""}
    recording = _read(options, prefixes.values())
    for note in recording.notes:
        print(f"jaxhand track: {note}", file=sys.stderr)
    labels = [labels_of(recording, prefixes[side]) for side in outputs]
    model = _model(options, labels[0], prefixes[next(iter(outputs))])
    if options.predictor:
        model = replace(model, predictor=options.predictor)
    if options.joints:
        model = replace(model, joints=options.joints)
    model = replace(model, alignment=not options.no_alignment, gate=not options.no_gate)
    if options.smooth is not None:
        smoothing = Smoothing(options.smooth)
        model = replace(model, smoothing=smoothing)
        at_rest, moving = (1e3 * smoothing.lag(speed) for speed in (0, 1))
        print(f"smoothed: {at_rest:.0f} ms late at rest, {moving:.0f} ms at a steady 1 m/s")
    if options.calibration:
        model = wearer.calibrated(model, wearer.load(options.calibration))
    show = sys.stderr.isatty()

    def report(share: float) -> None:
        if show:
            print(f"\rtracking {100 * share:3.0f} %", end="", file=sys.stderr, flush=True)

    hands = [prefixed(recording, prefixes[side], model.hand) for side in outputs]
    for side, own in zip(outputs, labels, strict=True):
        if told := without(model.hand, own, prefixes[side]):
            print(f"jaxhand track: {told}", file=sys.stderr)
    for hand in hands:
        if doubt := doubted_unit(hand, model.body):
            raise ValueError(f"{options.file}: {doubt}")
        if told := unusual_size(hand, model.body):
            print(f"jaxhand track: {told}", file=sys.stderr)
    if told := doubted_time(recording):
        print(f"jaxhand track: {told}", file=sys.stderr)
    if len(hands) == 1:
        results = [track(hands[0], model, right="right" in outputs, report=report)]
    else:
        sides = [side == "right" for side in outputs]
        results = track_hands(hands, model, right=sides, report=report)
    if show:
        print(file=sys.stderr)
    if options.as_measured:
        results = [as_measured(result, hand) for result, hand in zip(results, hands, strict=True)]
    filled = [result.recording for result in results]
    write_all(dict(zip(outputs.values(), filled, strict=True)), overwrite=options.overwrite)
    for (side, output), result in zip(outputs.items(), results, strict=True):
        if len(outputs) > 1:
            print(f"{side} hand")
        elif side == "left" and without_side(options.file.stem)[1] == "right":
            print("tracked as a left hand, though the file's name says right: see --right")
        print(_summary(result))
        print(f"wrote {output}")


def _outputs(options: argparse.Namespace) -> dict[str, Path]:
    """The file to write of each side that is tracked."""
    out: Path = options.output
    if options.right and options.left_prefix:
        raise ValueError(
            "--right says nothing beside --left-prefix: pass --right-prefix for the other"
        )
    if options.left_prefix and options.left_prefix == options.right_prefix:
        raise ValueError("--left-prefix and --right-prefix are the same: which hand is it?")
    if options.left_prefix and options.right_prefix:
        return {side: out.with_stem(f"{out.stem}_{side}") for side in ("left", "right")}
    return {"right" if options.right or options.right_prefix else "left": out}


def _summary(result: Tracked) -> str:
    """What is said of a hand that was tracked."""
    state, there = result.state, result.recording.visible
    status = np.where(there, result.status, _BLANK)
    lines = [f"{len(state)} frames, {len(result.recording.names)} markers"]
    for name, text in (
        (Status.OBSERVED, "measured"),
        (Status.PREDICTED, "filled from what was seen in the frame"),
        (Status.HELD, "held: nothing in the frame determined them, or says how far off they are"),
        (Status.REJECTED, "measured at a wrong place, it seems, and filled (see --no-gate)"),
        (_BLANK, "left blank: nothing fills them, or the hand had not been tracked yet"),
    ):
        share = 100 * (status == name).mean()
        if share or name == Status.OBSERVED:
            lines.append(f"{share:6.2f} % of the markers {text}")
    far = (result.notice & Notice.SUSPECTED_MILLIMETRES) > 0
    if far.any():
        lines.append(
            f"{100 * far.mean():6.2f} % of the frames have a marker over a metre from the others"
        )
    late = (result.notice & Notice.NON_POSITIVE_DT) > 0
    if late.any():
        lines.append(
            f"{100 * late.mean():6.2f} % of the frames come no later than the one before: is the "
            "file's time in order?"
        )
    # What to expect was measured of markers that had been seen.
    seen = np.logical_or.accumulate(status == Status.OBSERVED)
    hidden = seen & ((status == Status.PREDICTED) | (status == Status.REJECTED))
    if hidden.any():
        error = 1e3 * result.expected_error[hidden].mean()
        lines.append(f"filled ones, seen before, are expected to be {error:.0f} mm off on average")
    never = ~seen[-1] & there.any(0)
    if never.any():
        names = np.array(result.recording.names)[never]
        lines.append(f"never seen: {', '.join(names)}; filled all the same, centimetres off maybe")
    angles = result.recording.angles
    tracking = state == TrackingState.TRACKING
    if angles is None:
        lines.append("no joint angles: the model has no joint network, or is not to use it")
    elif tracking.any() and _strain(angles[tracking]) > STRAINED:
        lines.append(
            "the knuckles are out of their range: is it a hand of the other side (--right), and do "
            "the markers sit where the model has them (jaxhand hand)?"
        )
    for value, text in ((TrackingState.DEGRADED, "degraded"), (TrackingState.LOST, "lost")):
        if (state == value).any():
            lines.append(f"{100 * (state == value).mean():6.2f} % of the frames {text}")
    return "\n".join(lines)


def _strain(angles: Array) -> float:
    """Degrees that the median of some angle at a knuckle is out of its range, of `[T, 26]`."""
    usual = np.median(angles, 0)
    return float(np.degrees(np.maximum(LOW - usual, usual - HIGH)[_KNUCKLES].max()))


def _model(options: argparse.Namespace, labels: Sequence[str], prefix: str) -> Model:
    if options.model in BASELINES:
        hand = load_hand(options.hand) if options.hand else _fitting(labels, "--hand FILE", prefix)
        return Model(hand, predictor=options.model)
    if options.hand:
        raise ValueError(
            f"--hand goes with a baseline (--model {' or '.join(BASELINES)}); a model brings its "
            "own hand"
        )
    if options.model:
        return load(options.model)
    instead = "--model FILE, or a baseline: --model affine --hand FILE"
    name = _fitting(labels, instead, prefix).name
    if name not in bundled_models():
        raise ValueError(f"no model is bundled for {name}: name one with --model")
    print(f"tracked by the bundled model {name}")
    return load(name)


def _fitting(labels: Sequence[str], instead: str, prefix: str) -> Hand:
    hand = fitting_hand(labels)
    if hand is None:
        raise ValueError(unfitting(labels, instead, prefix))
    return hand


def _hands(options: argparse.Namespace) -> None:
    if options.name:
        print(json.dumps(load_hand(options.name).to_json(), indent=1))
        return
    for name in bundled():
        hand = load_hand(name)
        print(f"{name}: {len(hand)} markers; those that give the wrist's pose have a star")
        for i, marker in enumerate(hand.markers):
            star = "*" if i in hand.alignment else " "
            print(f"  {marker:14}{star} {_place(hand, i)}")


_WAYS = (("radial", "ulnar"), ("dorsal", "palmar"), ("proximal", "distal"))
"""What +x, +y and +z are called, and their opposites, of a left hand."""


def _place(hand: Hand, marker: int) -> str:
    """Where a marker sits: a joint or tip, and from there how far in which directions."""
    steps = [
        f"{abs(along) * 1e3:.0f} mm {ways[int(along < 0)]}"
        for along, ways in zip(hand.offsets[marker], _WAYS, strict=True)
        if abs(along) >= 0.5e-3
    ]
    return ", ".join([f"at {POINTS[hand.joints[marker]]}", *steps])


def _hand_over(verb: str, arguments: list[str]) -> int:
    found = entry_points(group="jaxhand.verbs", name=verb)
    try:
        status: int = next(iter(found)).load()(arguments)
    except ModuleNotFoundError as error:
        print(
            f"jaxhand {verb} needs more than numpy ({error.name} is not installed): "
            "pip install 'jaxhand[train]'",
            file=sys.stderr,
        )
        return 2
    return status


def _sources() -> str:
    return "Files are read in metres, right-handed; a gap stays a gap until a predictor fills it."


if __name__ == "__main__":
    sys.exit(main())
