"""Pictures for people: Table 3 as curves, and what a tracker makes of a stream with holes.

Needs matplotlib, the extra `plot`. Figures are made without pyplot, so no global state is touched
and nothing stays open.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.cli import check_output
from numpy_infer.geometry import untransform
from numpy_infer.hand import CHAINS, JOINTS, Hand
from numpy_infer.pose import HandPose

METHODS = {
    "last_known": ("last known position", "#8c8c8c", "s"),
    "moving_average": ("moving average", "#cc79a7", "v"),
    "affine": ("affine combination", "#e69f00", "D"),
    "learned": ("learned", "#0072b2", "o"),
    "learned_no_offset": ("learned, without continuity", "#56b4e9", "^"),
    "ik": ("inverse kinematics", "#8c8c8c", "s"),
    "ik_tuned": ("inverse kinematics, fine-tuned", "#e69f00", "D"),
    "least_squares": ("least squares", "#cc79a7", "v"),
    "learned_uncalibrated": ("learned, bones of others", "#56b4e9", "^"),
    "learned_unaligned": ("learned, not aligned", "#d55e00", "X"),
    "learned_paper": ("learned, plain recipe", "#009e73", "P"),
}
"""Name, colour and sign of each method. The colours stay apart for the colour-blind (Okabe & Ito
2008), the signs in black and white."""

TRUTH, OUTPUT, FILLED, BONE, GAP = "#1a1a1a", "#0072b2", "#d55e00", "#a9c7de", "#f6dfd0"
"""Colours of what is true, of the output, of its filled markers, of its bones and of gaps."""

OTHER = "#000000", "x"
"""Colour and sign of a method without its own."""

UNHIDDEN = 0.05
"""Where, on the axis of seconds, the error with nothing hidden is drawn."""

BLIND = ("last_known", "moving_average")
"""Methods that do not look at the frame. Where the hand moves a lot they would press all other
curves to the ground, so the axis of errors is made for those, and what is beyond is said."""
HEADROOM = 1.4
"""How far the axis goes beyond them."""

_YAW, _RISE = np.radians([35, 40])
VIEW = np.array(
    [
        [np.cos(_YAW), 0, -np.sin(_YAW)],
        [-np.sin(_YAW) * np.sin(_RISE), np.cos(_RISE), -np.cos(_YAW) * np.sin(_RISE)],
    ]
)
"""`[2, 3]` the picture's axes in the hand frame: the hand seen from the thumb's side and above, so
that fingers bend down."""

PALM = (0, 1, 4, 7, 10, 13)
"""Its corners: indices into `hand.POINTS`."""


def table_picture(table: Mapping[str, Any], path: str | Path, *, overwrite: bool = False) -> None:
    """Draws error against duration, a panel for each number of hidden markers (paper, Fig. 15).

    Args:
        table: Table 3 or 4, `{METHOD: {"1".."4": {"0.1".."2.0": CELL}}}` as `jaxhand evaluate`
            gives it; CELL is `mean`, `low`, `high` in cm, which may be None, and `n`. Where a
            method has a CELL at `"0"`, nothing hidden, all its curves begin there.
        path: the picture; its ending is the format.
        overwrite: replace the file if there is one.

    Raises:
        ValueError: as `check_picture`.
    """
    figure = _figure(path, overwrite, (12, 3.9))
    table = {method: _from_unhidden(rows) for method, rows in table.items()}
    counts = list(next(iter(table.values())))
    panels = figure.subplots(1, len(counts), sharey=True, squeeze=False)[0]
    others = [rows for method, rows in table.items() if method not in BLIND]
    top = HEADROOM * (max(map(_largest, others or table.values())) or 1.0)
    for panel, count in zip(panels, counts, strict=True):
        for method, rows in table.items():
            _curve(panel, method, rows[count])
        _duration_axis(panel, list(next(iter(table.values()))[count]))
        panel.set_title(f"{count} marker{'s' * (count != '1')} hidden", fontsize=11)
        panel.set_ylim(0, top)
        _off_scale(panel, table, count, top)
    panels[0].set_ylabel("error on the last hidden frame (cm)")
    _legend(figure, panels)
    _save(figure, path)


def _from_unhidden(rows: Mapping[str, Any]) -> dict[str, Any]:
    """One method's part of a table, with what it has at `"0"` at the start of every curve."""
    start = {} if "0" not in rows else {str(UNHIDDEN): rows["0"]}
    return {count: start | row for count, row in rows.items() if count != "0"}


def stream_picture(
    hand: Hand,
    markers: Array,
    seen: Array,
    poses: HandPose,
    time: Array,
    path: str | Path,
    *,
    overwrite: bool = False,
) -> None:
    """Draws what a tracker made of a stream with holes: the hand at the end of three gaps, and the
    two fingertips that are hidden longest over time.

    Args:
        hand: whose markers these are.
        markers: `[T, M, 3]` metres, world: the truth.
        seen: the same as the tracker was shown it, NaN where hidden.
        poses: its output, each field with a leading T, with joint positions.
        time: `[T]` seconds, at least three frames.
        path: the picture; its ending is the format.
        overwrite: replace the file if there is one.

    Raises:
        ValueError: the output has no joints, or as `check_picture`.
    """
    if poses.positions is None:
        raise ValueError("the picture shows joints, and the model has no joint stage")
    visible = np.isfinite(seen).all(-1)
    frames, tips = _busiest(visible), _longest_hidden(hand, visible)
    truth, output, joints = (
        untransform(poses.wrist_rotation, poses.wrist_position, points)
        for points in (markers, poses.markers, poses.positions)
    )
    figure = _figure(path, overwrite, (12, 7))
    above, below = figure.subfigures(2, 1, height_ratios=(1.35, 1))
    panels = above.subplots(1, len(frames), sharex=True, sharey=True)
    for panel, frame in zip(panels, frames, strict=True):
        _bones(panel, joints[frame])
        _markers(panel, truth[frame], output[frame], visible[frame])
        hidden = int((~visible[frame]).sum())
        panel.set_title(f"{time[frame]:.1f} s: {hidden} of {len(hand)} markers hidden", fontsize=11)
        panel.set_aspect("equal")
        panel.axis("off")
    _scale_bar(panels[0])
    _legend(above, panels)
    rows = below.subplots(len(tips), 1, sharex=True)
    for panel, tip in zip(rows, tips, strict=True):
        _height(panel, hand.markers[tip], truth[:, tip], output[:, tip], visible[:, tip], time)
        for frame in frames:
            panel.axvline(time[frame], color=TRUTH, linewidth=0.8, linestyle=":")
    rows[-1].set_xlabel("time (s); dotted: the moments above")
    below.supylabel("height over the wrist (cm)", fontsize=10)
    _legend(below, rows)
    _save(figure, path)


def occlusions_picture(
    tables: Mapping[str, Any], path: str | Path, *, overwrite: bool = False
) -> None:
    """Draws how many markers are hidden at once, and for how long (paper, Fig. 13 and 14).

    Args:
        tables: `occlusions.Occlusions` by name, such as one hand and two hands.
        path: the picture; its ending is the format.
        overwrite: replace the file if there is one.

    Raises:
        ValueError: as `check_picture`.
    """
    from jaxhand.occlusions import QUANTILES

    figure = _figure(path, overwrite, (10, 3.6))
    number, duration = figure.subplots(1, 2)
    width = 0.8 / len(tables)
    for i, (name, table) in enumerate(tables.items()):
        colour = (OUTPUT, FILLED, BONE)[i % 3]
        places = np.arange(len(table.hidden)) + width * (i - (len(tables) - 1) / 2)
        number.bar(places, table.hidden, width, color=colour, label=name)
        edges = 2.0 ** np.arange(len(table.histogram) + 1) / table.rate
        most = table.lengths[QUANTILES.index(0.9)] / table.rate
        label = f"{name}: 90 % within {most:.2f} s"
        shares = np.array(table.histogram) / max(table.gaps, 1)
        duration.stairs(shares, edges, color=colour, linewidth=2, label=label)
    number.set(xlabel="markers hidden at once", ylabel="share of frames", yscale="log")
    duration.set(xlabel="gap (s)", ylabel="share of gaps", xscale="log", yscale="log")
    most = max(np.flatnonzero(table.hidden).max(initial=0) for table in tables.values())
    number.set(xlim=(-0.6, most + 0.6), xticks=range(most + 1))
    least = min(1 / max(table.gaps, 10) for table in tables.values())
    duration.set_ylim(10 ** np.floor(np.log10(least)), 4)
    for panel in (number, duration):
        panel.spines[["top", "right"]].set_visible(False)
        panel.legend(frameon=False, fontsize=10, loc="upper right")
    for axis in (number.yaxis, duration.yaxis, duration.xaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("")
    _save(figure, path)


def check_picture(path: str | Path, *, overwrite: bool) -> None:
    """Refuses, before the work, a picture that could not be drawn after it.

    Args:
        path: the picture; its ending is the format.
        overwrite: it may be there already.

    Raises:
        ValueError: matplotlib is missing or does not know the ending, or as `cli.check_output`.
    """
    path = Path(path)
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise ValueError("pictures need matplotlib: pip install 'jaxhand[plot]'") from None
    known = Figure().canvas.get_supported_filetypes()
    if path.suffix[1:].lower() not in known:
        endings = ", ".join(f".{ending}" for ending in sorted(known))
        raise ValueError(f"{path}: cannot draw {path.suffix!r}; known: {endings}")
    check_output(path, overwrite=overwrite)


def _figure(path: str | Path, overwrite: bool, inches: tuple[float, float]) -> Any:
    check_picture(path, overwrite=overwrite)
    from matplotlib.figure import Figure

    return Figure(figsize=inches, layout="constrained")


def _save(figure: Any, path: str | Path) -> None:
    # A figure made without pyplot draws itself with Agg, or with what the ending asks for.
    figure.savefig(path, dpi=150, facecolor="white")


def _legend(figure: Any, panels: Any) -> None:
    """One for all panels, with each label once."""
    entries: dict[str, Any] = {}
    for panel in panels:
        handles, labels = panel.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(
        entries.values(),
        entries,
        loc="outside lower center",
        ncols=len(entries),
        frameon=False,
        fontsize=10,
    )


def _largest(rows: Mapping[str, Any]) -> float:
    """The largest mean or upper bound in one method's part of the table; 0 if it is empty."""
    cells = [cell for row in rows.values() for cell in row.values()]
    return max((c[k] for c in cells for k in ("mean", "high") if c[k] is not None), default=0.0)


def _curve(panel: Any, method: str, row: Mapping[str, Any]) -> None:
    """One method's error over duration, with its interval."""
    label, colour, sign = METHODS.get(method, (method, *OTHER))
    cells = {float(duration): c for duration, c in row.items() if c["mean"] is not None}
    means = [cell["mean"] for cell in cells.values()]
    panel.plot(list(cells), means, color=colour, marker=sign, markersize=4.5, label=label)
    known = {d: c for d, c in cells.items() if c["low"] is not None}
    low, high = ([c[k] for c in known.values()] for k in ("low", "high"))
    panel.fill_between(list(known), low, high, color=colour, alpha=0.18, linewidth=0)


def _off_scale(panel: Any, table: Mapping[str, Any], count: str, top: float) -> None:
    """Says what the curves come to that leave the panel."""
    lines = []
    for method, rows in table.items():
        means = {float(d): c["mean"] for d, c in rows[count].items() if c["mean"] is not None}
        if means and max(means.values()) > top:
            duration = max(means, key=lambda d: means[d])
            lines.append(
                f"{METHODS.get(method, (method,))[0]}: {means[duration]:.0f} cm at {duration:g} s"
            )
    if lines:
        text = "\n".join(["off scale", *lines])
        box = {"facecolor": "white", "edgecolor": "none", "alpha": 0.85, "pad": 1}
        style = {"ha": "right", "va": "top", "fontsize": 8, "bbox": box}
        panel.text(0.99, 0.99, text, transform=panel.transAxes, **style)


def _duration_axis(panel: Any, durations: list[str]) -> None:
    panel.set_xscale("log")
    labels = ["0" if float(d) == UNHIDDEN else f"{float(d):g}" for d in durations]
    panel.set_xticks([float(d) for d in durations], labels)
    panel.minorticks_off()
    panel.set_xlabel("hidden for (s)")
    panel.grid(color="#e5e5e5", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)


def _busiest(visible: Array) -> Array:
    """In each third of the stream the last frame of those with most, but at most 4, hidden."""
    hidden = (~visible).sum(-1)
    score = np.where(hidden <= 4, hidden, 0)
    thirds = np.array_split(np.arange(len(score)), 3)
    return np.array([third[::-1][np.argmax(score[third][::-1])] for third in thirds])


def _longest_hidden(hand: Hand, visible: Array) -> Array:
    """The two markers on fingertips, or else of all, that are hidden in most frames."""
    tips = [i for i, joint in enumerate(hand.joints) if joint >= len(JOINTS)]
    candidates = np.array(tips if len(tips) > 1 else range(len(hand)))
    frames = (~visible).sum(0)[candidates]
    return candidates[np.argsort(-frames, kind="stable")[:2]]


def _bones(panel: Any, joints: Array) -> None:
    """The hand `[21, 3]`, hand frame, metres."""
    points = joints @ VIEW.T * 100
    panel.fill(*points[list(PALM)].T, facecolor=BONE, alpha=0.35, linewidth=0)
    for chain in CHAINS:
        line = points[[0, *chain]]
        panel.plot(*line.T, color=BONE, linewidth=5, solid_capstyle="round", zorder=1)


def _markers(panel: Any, truth: Array, output: Array, visible: Array) -> None:
    """`[M, 3]` truth and output, hand frame, metres."""
    truth, output = truth @ VIEW.T * 100, output @ VIEW.T * 100
    for start, end in zip(truth[~visible], output[~visible], strict=True):
        panel.plot(*np.stack([start, end]).T, color=FILLED, linewidth=1.2, zorder=2)
    dot = {"linestyle": "none", "zorder": 3}
    panel.plot(*output[visible].T, "o", color=OUTPUT, markersize=6, label="marker seen", **dot)
    panel.plot(
        *output[~visible].T,
        "o",
        markerfacecolor="white",
        markeredgecolor=FILLED,
        markeredgewidth=2,
        markersize=8,
        label="marker hidden, as predicted",
        **dot,
    )
    label = "where it truly is"
    panel.plot(*truth[~visible].T, "x", color=TRUTH, markersize=6, label=label, **dot)


def _scale_bar(panel: Any) -> None:
    """5 cm, below the hand."""
    left, bottom = panel.get_xlim()[0], panel.get_ylim()[0]
    panel.plot([left, left + 5], [bottom, bottom], color=TRUTH, linewidth=2)
    panel.text(left + 2.5, bottom - 0.3, "5 cm", ha="center", va="top", fontsize=9)


def _height(
    panel: Any, name: str, truth: Array, output: Array, visible: Array, time: Array
) -> None:
    """`[T, 3]` truth and output of one marker, hand frame, metres: its height over the
    wrist, across the back of the hand."""
    step = time[1] - time[0]
    edges = np.flatnonzero(np.diff(np.concatenate([[True], visible, [True]])))
    for begin, end in edges.reshape(-1, 2):
        panel.axvspan(
            time[begin],
            time[0] + step * end,
            color=GAP,
            linewidth=0,
            label="hidden from the tracker",
        )
    panel.plot(time, 100 * output[:, 1], color=OUTPUT, linewidth=2.4, label="jaxhand")
    panel.plot(time, 100 * truth[:, 1], color=TRUTH, linewidth=0.9, label="truth")
    panel.set_title(name.replace("_", " "), loc="left", fontsize=10)
    panel.set_xlim(time[0], time[-1])
    panel.spines[["top", "right"]].set_visible(False)
