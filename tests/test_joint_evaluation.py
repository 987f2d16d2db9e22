"""Laws of Table 4 and of what stands beside it, on simulated hands with joint truth."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

from simulated import motion, worn
from streams import a_model

from jaxhand import joint_evaluation as evaluation
from jaxhand import report
from jaxhand.joint_evaluation import Row
from jaxhand.report import EvaluationConfig
from jaxhand.sequences import Dataset, Sequence
from jaxhand.sparse_fit import prior_of
from numpy_infer import HandTracker, load_hand, tracker
from numpy_infer.arrays import Array
from numpy_infer.model import load, save

GLOVE = load_hand("glove9")
FRAMES, LARGER = 70, 1.1


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    """Two hands of a person 10 % larger than the bundled one."""
    hand = GLOVE.with_skeleton(LARGER * GLOVE.skeleton)
    move = motion(0, FRAMES, 60.0, (2,))
    arrays = zip(*worn(hand, move), move.angles, strict=True)
    sequences = tuple(Sequence(f"take/{i}", "take", 60.0, *parts) for i, parts in enumerate(arrays))
    return Dataset("simulated", hand, sequences)


def with_posture(dataset: Dataset) -> object:
    model = a_model("learned", dtype=np.float32, joints=True, alignment=False)
    angles = np.concatenate([s.angles for s in dataset.sequences])
    posture = {k: v.tolist() for k, v in prior_of(angles)._asdict().items()}
    return replace(model, training={"posture": posture})


def test_rows_stand_on_the_data_sets_bones_but_the_uncalibrated_one(dataset: Dataset) -> None:
    rows = evaluation.rows(with_posture(dataset), dataset, {"learned_paper": with_posture(dataset)})
    assert list(rows) == [
        *("ik", "ik_tuned", "least_squares"),
        *("learned", "learned_unaligned", "learned_uncalibrated", "learned_paper"),
    ]
    for name, row in rows.items():
        calibrated = name != "learned_uncalibrated"
        bones = dataset.hand.skeleton if calibrated else GLOVE.skeleton
        # In the size that they know: what the networks take for their own hand has the person's.
        assert row.model.hand.size == pytest.approx((LARGER if calibrated else 1) * GLOVE.size)
        if row.solve is None:
            np.testing.assert_array_equal(row.model.body.skeleton, bones)
            assert row.model.alignment == (name != "learned_unaligned")
    plain = a_model("learned", joints=True)
    assert "least_squares" not in evaluation.rows(plain, dataset)


def test_rows_stand_on_the_data_sets_markers_too(dataset: Dataset) -> None:
    moved = replace(dataset.hand, offsets=dataset.hand.offsets + 1e-3)
    worn = replace(dataset, hand=moved.with_skeleton(dataset.hand.skeleton))
    rows = evaluation.rows(with_posture(dataset), worn, {"other": with_posture(dataset)})
    for name in ("learned", "other"):
        np.testing.assert_array_equal(rows[name].model.body.offsets, worn.hand.offsets)
        np.testing.assert_array_equal(rows[name].model.body.template, worn.hand.template)


def test_without_alignment_the_joints_are_measured_with_nothing_hidden(dataset: Dataset) -> None:
    row, told = evaluation.rows(with_posture(dataset), dataset)["learned_unaligned"], []
    table = evaluation.table4(
        {"learned_unaligned": row}, dataset, seeds=1, report=lambda *of: told.append(of)
    )["learned_unaligned"]
    assert told == [("learned_unaligned", 1.0)], "its bar is full"
    cells = [cell for count in "1234" for cell in table[count].values()]
    assert len(cells) == 4 * 5
    assert {cell["n"] for cell in cells} == {0}

    markers, truth = (
        np.concatenate([getattr(s, name)[25:] for s in dataset.sequences])
        for name in ("markers", "positions")
    )
    seen, dt = np.ones(markers.shape[:-1], bool), np.full(len(markers), 1 / 60)
    off = []
    for alignment in (False, True):
        model = replace(row.model, alignment=alignment)
        start = tracker.init(model, (len(markers),))
        positions = tracker.step(model, start, markers, seen, dt)[1].positions
        off.append(1e2 * np.linalg.norm(positions - truth, axis=-1)[:, evaluation.POINTS].mean())
    assert table["0"]["n"] == len(markers)
    assert table["0"]["mean"] == pytest.approx(off[0], rel=1e-4)
    assert table["0"]["mean"] != pytest.approx(off[1], rel=0.01)


def test_the_noise_floor_is_a_row_with_nothing_hidden(dataset: Dataset) -> None:
    floor = {f"take{i}": np.full(30 + i, 2e-3) for i in range(12)}
    floor["take3"][4] = np.nan
    row = evaluation.noise_floor_row(replace(dataset, noise_floor=floor))
    assert row["0"]["mean"] == pytest.approx(0.2)
    assert row["0"]["low"] == pytest.approx(0.2)
    assert row["0"]["n"] == sum(map(len, floor.values())) - 1
    assert {cell["mean"] for count in "1234" for cell in row[count].values()} == {None}
    assert set(row["4"]) == {"0.1", "0.2", "0.5", "1.0", "2.0"}


def test_what_solves_exactly_has_no_error_and_what_errs_has_its_own(dataset: Dataset) -> None:
    truth = np.concatenate([s.positions for s in dataset.sequences])
    frames = np.concatenate([s.markers for s in dataset.sequences])

    def known(markers: Array) -> Array:
        """The truth of the frame whose visible markers these are, 1 cm off."""
        near = np.abs(markers[:, None] - frames).sum(-1)
        frame = np.median(near, -1).argmin(-1)
        return truth[frame] + np.array([0.01, 0, 0])

    model = replace(a_model("affine", dtype=np.float32), joints="none")
    table = evaluation.table4({"off": Row(model, known)}, dataset, seeds=1)["off"]
    assert set(table) == {"0", "1", "2", "3", "4"}
    assert table["0"]["mean"] == pytest.approx(1.0, abs=1e-4)
    assert table["1"]["0.1"]["mean"] == pytest.approx(1.0, abs=1e-4)
    assert table["1"]["2.0"]["n"] == 0
    starts = 2 * (FRAMES - 19 - 6)
    assert table["0"]["n"] == -(-starts // evaluation.SOLVED_EVERY)
    json.dumps(table)


def test_frames_without_truth_are_left_out(dataset: Dataset) -> None:
    first, second = dataset.sequences
    positions = first.positions.copy()
    positions[30:40] = np.nan
    holed = replace(dataset, sequences=(replace(first, positions=positions), second))
    model = replace(a_model("affine", dtype=np.float32), joints="none")
    still = np.zeros((21, 3), np.float32)
    row = Row(model, lambda markers: np.broadcast_to(still, (len(markers), 21, 3)))
    whole, less = (evaluation.table4({"any": row}, d, seeds=1)["any"] for d in (dataset, holed))
    assert less["0"]["n"] == whole["0"]["n"] - 1
    assert np.isfinite(less["0"]["mean"])
    assert less["1"]["0.1"]["n"] < whole["1"]["0.1"]["n"]


def test_the_wrist_is_exact_with_nothing_hidden_and_worse_the_more_is(dataset: Dataset) -> None:
    model = replace(a_model("affine", dtype=np.float32), wearer=dataset.hand)
    errors = evaluation.wrist_errors(model, dataset, seeds=1)
    assert set(errors) == {"0", "1", "2", "3"}
    assert errors["0"]["mm"]["mean"] < 0.01
    assert errors["0"]["deg"]["mean"] < 0.01
    assert errors["3"]["mm"]["mean"] > errors["1"]["mm"]["mean"] > 0


def test_angles_between_rotations_are_right_near_none_and_near_half_a_turn() -> None:
    def about_x(degrees: float) -> Array:
        angle = np.radians(degrees)
        cosine, sine = np.cos(angle), np.sin(angle)
        return np.array([[1, 0, 0], [0, cosine, -sine], [0, sine, cosine]])

    for degrees in (0, 1e-4, 0.01, 10, 179.9):
        found = evaluation._degrees(about_x(30), about_x(30 + degrees))
        assert found == pytest.approx(degrees, abs=1e-6)


def test_steadiness_and_tip_distances_are_of_the_output(dataset: Dataset) -> None:
    model = replace(with_posture(dataset), wearer=dataset.hand)
    quiet = evaluation.steadiness(model, dataset)
    own = [evaluation._third(s.positions).mean() for s in dataset.sequences]
    assert quiet["jitter_of_truth"] == pytest.approx(np.mean(own))
    assert quiet["still"] > 0.1
    cell = evaluation.tip_distance_errors(model, dataset)
    near = [(evaluation._tip_distances(s.positions) < 0.03).sum() for s in dataset.sequences]
    assert cell["n"] == sum(near)


def holed(dataset: Dataset, field: str, frames: slice) -> Dataset:
    """The data set with nothing known of some frames of both sequences."""
    parts = [getattr(s, field).copy() for s in dataset.sequences]
    for part in parts:
        part[frames] = np.nan
    sequences = [replace(s, **{field: p}) for s, p in zip(dataset.sequences, parts, strict=True)]
    return replace(dataset, sequences=tuple(sequences))


@pytest.mark.parametrize("field", ["markers", "positions"])
def test_steadiness_is_that_of_the_frames_that_are_known(dataset: Dataset, field: str) -> None:
    """Not of the template, which stands in for what is not."""
    model = replace(with_posture(dataset), wearer=dataset.hand)
    begins_later = evaluation.steadiness(model, holed(dataset, field, slice(1)))
    shortened = [
        replace(
            s, **{f: getattr(s, f)[1:] for f in ("markers", "positions", "rotations", "angles")}
        )
        for s in dataset.sequences
    ]
    assert begins_later == evaluation.steadiness(model, replace(dataset, sequences=shortened))
    between = evaluation.steadiness(model, holed(dataset, field, slice(30, 31)))
    own = [evaluation._third(s.positions) for s in dataset.sequences]
    kept = np.r_[:27, 31:67]
    assert between["jitter_of_truth"] == pytest.approx(np.mean([part[kept] for part in own]))
    few = evaluation.steadiness(model, holed(dataset, field, slice(None, None, 4)))
    assert few["jitter"] is few["jitter_of_truth"] is None
    assert few["still"] > 0.1


@pytest.mark.parametrize("field", ["markers", "positions", "angles"])
def test_without_a_frame_that_is_known_there_is_no_table(dataset: Dataset, field: str) -> None:
    model, nothing = with_posture(dataset), holed(dataset, field, slice(None))
    for measure in (
        evaluation.joint_errors,
        evaluation.steadiness,
        evaluation.tip_distance_errors,
        lambda model, dataset: evaluation.table4({"any": Row(model)}, dataset),
    ):
        with pytest.raises(ValueError, match="no frame with all markers and joint truth"):
            measure(model, nothing)


@pytest.mark.parametrize("alignment", [False, True])
def test_poses_are_those_of_the_tracker(dataset: Dataset, alignment: bool) -> None:
    model, markers = with_posture(dataset), dataset.sequences[0].markers[:5].copy()
    # What the alignment markers leave open, the others say.
    corners = list(model.hand.alignment)
    markers[4, corners] = markers[4, corners[0]] + np.outer(range(len(corners)), [0, 0.02, 0])
    model = replace(model, alignment=alignment, gate=True)
    found = evaluation.evaluate_poses(model, markers)
    for i, frame in enumerate(markers):
        expected = HandTracker(model).step(frame, 1 / 60)
        atol = 1e-3 if i == 4 else 1e-4  # rounding tells more near a line
        for name, value in found._asdict().items():
            np.testing.assert_allclose(value[i], getattr(expected, name), atol=atol, err_msg=name)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ({"model": "affine"}, "Table 4 needs a model with both networks"),
        ({"model": "BARE"}, "Table 4 needs a model with both networks"),
        ({"also": ("mine=BARE",)}, "also mine: Table 4 needs a model with both networks"),
        ({"also": ("mine=dense19",)}, "also mine: a model for other markers than glove9"),
        ({"also": ("learned=glove9",)}, "a row 'learned' is there already"),
        ({"also": ("mine=glove9", "mine=glove9")}, "a row 'mine' is there already"),
        ({"also": ("mine=glove9",), "table": 3}, "are for --table 4"),
    ],
)
def test_what_would_be_no_row_of_its_own_is_refused_before_the_data_are_read(
    said: dict[str, object], message: str, tmp_path: Path
) -> None:
    bare = tmp_path / "bare.npz"
    save(replace(load("glove9"), joints="none", joint_network=None), bare)
    told = {k: str(bare) if v == "BARE" else v for k, v in {"model": "glove9", **said}.items()}
    if "also" in told:
        told["also"] = tuple(text.replace("BARE", str(bare)) for text in told["also"])
    with pytest.raises(ValueError, match=message):
        report.evaluate(EvaluationConfig(("nowhere:no",), **{"table": 4, **told}))


def test_rows_have_the_names_that_are_taken(dataset: Dataset) -> None:
    taken = {*evaluation.rows(with_posture(dataset), dataset), "noise_floor"}
    assert taken == set(evaluation.ROWS)


def test_without_joint_truth_there_is_no_table(dataset: Dataset) -> None:
    bare = replace(dataset, sequences=tuple(replace(s, positions=None) for s in dataset.sequences))
    model = replace(a_model("affine", dtype=np.float32), joints="none")
    with pytest.raises(ValueError, match="no joint truth"):
        evaluation.table4({"any": Row(model, lambda m: m)}, bare)


def test_the_printed_table_holds_the_figures() -> None:
    from rich.console import Console

    cell = {"mean": 0.123, "low": 0.1, "high": 0.2, "n": 9}
    row = {"0": cell, **{k: {f"{d:.1f}": cell for d in report.DURATIONS} for k in "1234"}}
    console = Console(width=80, record=True)
    report.print_table4({"learned": row}, console)
    assert console.export_text().count("0.12 ±0.05") == 21
    nothing_hidden = {"0": cell, **evaluation._not_measured()}
    report.print_table4({"alone": nothing_hidden, "learned": row}, console)
    text = console.export_text()
    assert text.count("0.12 ±0.05") == 22
    assert "–" not in text, "what is not measured takes no lines"
