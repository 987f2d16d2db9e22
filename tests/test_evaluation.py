"""Laws of the protocol of Table 3 and of its intervals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

from rich.console import Console

from jaxhand import evaluation, expected_error, report
from jaxhand.cli import evaluate
from jaxhand.predictors import PREDICTORS
from jaxhand.sequences import Sequence
from jaxhand.training import TrainingConfig
from jaxhand.training_data import collect
from numpy_infer import tracker
from numpy_infer.hand import load_hand
from numpy_infer.model import Model
from numpy_infer.networks import Dense, Network, array_shapes
from numpy_infer.one_euro import Smoothing
from numpy_infer.recordings import Recording, write

HAND = load_hand("glove9")
SPEC = (Dense(16), Dense(27, "linear"))


def learned() -> Model:
    """A model with a random marker network: bad, but no worse in one path than in the other."""
    rng = np.random.default_rng(0)
    arrays = {
        name: (0.3 * rng.standard_normal(shape)).astype(np.float32)
        for name, shape in array_shapes(SPEC, 27).items()
    }
    mean = HAND.template.reshape(-1).astype(np.float32)
    scale = np.full(27, 0.05, np.float32)
    return Model(
        HAND, "learned", marker_network=Network(SPEC, arrays, mean, scale, mean, scale / 5)
    )


def wriggling(frames: int, seed: int, take: str = "take") -> Sequence:
    """A hand whose markers wander smoothly, each by itself, on a turning hand."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None, None] / 60
    phase, speed = rng.uniform(0, 6, (9, 3)), rng.uniform(1, 4, (9, 3))
    markers = HAND.template + 0.01 * np.sin(phase + speed * time)
    angle = 0.7 * time[:, 0, 0]
    turn = np.zeros((frames, 3, 3))
    turn[:, 0, 0], turn[:, 0, 1] = np.cos(angle), -np.sin(angle)
    turn[:, 1, 0], turn[:, 1, 1] = np.sin(angle), np.cos(angle)
    turn[:, 2, 2] = 1
    moved = markers @ np.swapaxes(turn, -1, -2) + np.array([0.2, 1, 0]) * time
    return Sequence(f"{take}/{seed}", take, 60.0, moved.astype(np.float32))


@pytest.mark.parametrize("name", ["last_known", "moving_average", "affine", "learned"])
def test_the_shortcut_equals_the_run_frame_by_frame(name: str) -> None:
    """`evaluation` goes from the last visible frame to the last hidden one in a single step."""
    model = replace(learned(), predictor=name)
    markers = wriggling(60, 3).markers.astype(np.float64)
    for frames, hidden in ((6, [3]), (30, [0, 4, 8]), (12, [1, 2, 5, 7])):
        visible = np.ones((len(markers), 9), bool)
        visible[evaluation.VISIBLE_BEFORE :, hidden] = False
        state, jump = tracker.init(model), None
        for i in range(evaluation.VISIBLE_BEFORE + frames):
            if i == evaluation.VISIBLE_BEFORE:
                jump = state
            state, pose = tracker.step(model, state, markers[i], visible[i], np.asarray(1 / 60))
        last = evaluation.VISIBLE_BEFORE + frames - 1
        _, short = tracker.step(model, jump, markers[last], visible[last], np.asarray(frames / 60))
        assert np.abs(short.markers - pose.markers).max() < 1e-6


def test_what_a_model_is_run_with_live_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gate and output filter go by time, which trials leap over."""
    monkeypatch.setattr(expected_error, "AT_ONCE", 16)
    monkeypatch.setattr(expected_error, "STREAMS", 16)
    live = replace(learned(), gate=True, smoothing=Smoothing())
    sequences = [wriggling(60, 1)]
    tables = evaluation.table3({"bare": learned(), "live": live}, sequences, seeds=1)
    assert tables["bare"] == tables["live"]
    one, other = (expected_error.measure(model, sequences) for model in (learned(), live))
    assert len(one.measured)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_starts_have_twenty_complete_frames_before_and_room_after() -> None:
    sequence = wriggling(80, 0)
    sequence.markers[40, 2] = np.nan
    starts = evaluation.find_starts([sequence])
    assert starts.start.tolist() == [*range(19, 34), *range(60, 74)]
    assert starts.room.tolist() == [*range(20, 5, -1), *range(19, 5, -1)]


def test_starts_never_cross_sequences() -> None:
    starts = evaluation.find_starts([wriggling(30, 0), wriggling(31, 1)])
    assert starts.start.tolist() == [*range(19, 24), *range(49, 55)]


def test_sequences_too_short_are_an_error_that_says_what_is_needed() -> None:
    with pytest.raises(ValueError, match="at least 20 frames with all markers"):
        evaluation.find_starts([wriggling(25, 0)])


def test_hiding_hides_just_so_many_and_every_marker_alike() -> None:
    for count in evaluation.COUNTS:
        hidden = evaluation.hide(np.random.default_rng(count), 9000, 9, count)
        assert (hidden.sum(-1) == count).all()
        assert np.abs(hidden.mean(0) - count / 9).max() < 0.03


def test_both_hands_of_a_take_share_their_blocks() -> None:
    both = [wriggling(600, 0, "a"), wriggling(600, 1, "a"), wriggling(600, 2, "b")]
    starts = evaluation.find_starts(both)
    sets = [set(starts.block[starts.start // 600 == i]) for i in range(3)]
    assert sets[0] == sets[1]
    assert not sets[0] & sets[2]
    assert len(sets[0]) == 3


def test_an_interval_covers_and_needs_ten_blocks() -> None:
    rng = np.random.default_rng(0)
    covered = 0
    for _ in range(200):
        block_means = 1 + 0.3 * rng.standard_normal(40)
        cell = evaluation.interval(50 * block_means, np.full(40, 50))
        covered += cell["low"] <= 1 <= cell["high"]
    assert 0.88 * 200 <= covered <= 0.99 * 200
    few = evaluation.interval(np.ones(9), np.ones(9, int))
    assert few == {"mean": 1.0, "low": None, "high": None, "n": 9}
    assert evaluation.interval(np.zeros(3), np.zeros(3, int))["mean"] is None


def test_a_table_is_the_same_every_time_and_orders_the_methods(tmp_path: Path) -> None:
    """One small evaluation: determinism, the shape of the result, and that the affine baseline
    beats holding still on a moving hand."""
    sequences = [wriggling(70, 0), wriggling(44, 1)]
    models = evaluation.methods(Model(HAND))
    del models["moving_average"]
    tables = [evaluation.table3(models, sequences, seeds=1) for _ in range(2)]
    assert tables[0] == tables[1]
    table = tables[0]
    assert set(table) == {"last_known", "affine"}
    assert set(table["affine"]) == {"1", "2", "3", "4"}
    assert set(table["affine"]["1"]) == {"0.1", "0.2", "0.5", "1.0", "2.0"}
    assert table["affine"]["1"]["2.0"]["n"] == 0
    assert table["affine"]["1"]["0.1"]["n"] == (70 - 19 - 6) + (44 - 19 - 6)
    assert table["affine"]["1"]["0.5"]["mean"] < table["last_known"]["1"]["0.5"]["mean"] / 3
    json.dumps(table)
    assert evaluation.mean_ratio(table, "affine", "affine") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "recordings:DIR"], "holds no takes"),
        (["--data", "recordings:DIR", "--model", "nothing.npz"], "no model file nothing.npz"),
        (["--data", "nowhere:DIR", "--model", "affine"], "nowhere"),
        (["--data", "recordings:DIR", "--model", "affine", "--json", "HERE"], "--overwrite"),
        (["--data", "nowhere:DIR", "--json", "no/t.json"], "no is no folder: make it first"),
        (["--data", "nowhere:DIR", "--plot", "no/t.png"], "no is no folder: make it first"),
        (["--data", "nowhere:DIR", "--plot", "t.xyz"], "t.xyz: cannot draw '.xyz'; known: ."),
        (["--data", "recordings:DIR", "--model", "affine", "--seeds", "0"], "seeds"),
        (["--data", "a:b", "--data", "c:d", "--model", "affine"], "one --data, found 2"),
        (["--model", "affine"], "one --data, found 0"),
    ],
)
def test_a_mistake_is_one_clear_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    here = tmp_path / "here.json"
    here.write_text("{}")
    named = [a.replace("DIR", str(tmp_path)).replace("HERE", str(here)) for a in arguments]
    assert evaluate(named) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert here.read_text() == "{}"


def test_a_command_writes_its_table_and_its_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = tmp_path / "takes"
    take.mkdir()
    markers = wriggling(70, 0).markers
    time = np.arange(len(markers)) / 60
    write(Recording(HAND.markers, markers, time, 60.0, source=""), take / "one.csv")
    names = ["--json", str(tmp_path / "t3.json"), "--plot", str(tmp_path / "t3.png")]
    data = ["--data", f"recordings:{take}", "--test", "one", "--model", "affine", "--seeds", "1"]
    assert evaluate([*data, *names]) == 0
    printed = capsys.readouterr().out
    written = json.loads((tmp_path / "t3.json").read_text())
    assert set(written) == {"table3", "joints"}
    assert f"{written['table3']['affine']['1']['0.1']['mean']:.2f}" in printed
    assert (tmp_path / "t3.png").read_bytes().startswith(b"\x89PNG")


def test_a_predictor_of_ones_own_is_named_like_a_baseline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    time = np.arange(70) / 60
    write(Recording(HAND.markers, wriggling(70, 0).markers, time, 60.0, ""), tmp_path / "one.csv")
    monkeypatch.setitem(PREDICTORS, "mine", PREDICTORS["affine"])
    monkeypatch.setattr(report, "_markers_report", lambda model, *_: {"of": model.predictor})
    data = (f"recordings:{tmp_path}",)
    config = report.EvaluationConfig(data=data, model="mine", test=("one",))
    assert report.evaluate(config, Console(quiet=True)) == {"of": "mine"}
    with pytest.raises(ValueError, match="no model file learned"):
        report.evaluate(replace(config, model="learned"), Console(quiet=True))


def test_what_files_do_not_say_can_be_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Left-handed millimetres of which the file says nothing, to train on and to test on."""
    take = tmp_path / "one.csv"
    markers = wriggling(70, 0).markers
    time = np.arange(len(markers)) / 60
    foreign = Recording(HAND.markers, 1e3 * markers * [1, 1, -1], time, 60.0, source="")
    write(foreign, take)
    take.write_text(take.read_text().replace("# unit: m\n", ""))
    of = {"data": (f"recordings:{tmp_path}",), "unit": 1e-3, "left_handed": True}
    names = {"train": ("one",), "validation": ("one",), "hand": "glove9"}
    given = collect(TrainingConfig(**of, **names, out=tmp_path / "run"))
    np.testing.assert_allclose(given.training.markers, markers, atol=1e-6)

    tested = []
    monkeypatch.setattr(
        report, "_markers_report", lambda model, dataset, *_: tested.append(dataset) or {}
    )
    config = report.EvaluationConfig(**of, test=("one",), model="affine")
    report.evaluate(config, Console(quiet=True))
    np.testing.assert_allclose(tested[0].sequences[0].markers, markers, atol=1e-6)
    with pytest.raises(ValueError, match="does not state its unit"):
        report.evaluate(replace(config, unit=None), Console(quiet=True))
    for said in ({"unit": 1e-3}, {"left_handed": True}):
        known = report.EvaluationConfig(data=(f"sig18:{tmp_path}",), **said)
        with pytest.raises(ValueError, match="are for recordings: files of sig18 are known"):
            report.evaluate(known, Console(quiet=True))


def test_the_printed_table_holds_the_figures() -> None:
    cell = {"mean": 0.123, "low": 0.1, "high": 0.2, "n": 9}
    row = {f"{d:.1f}": cell for d in evaluation.DURATIONS}
    table = {name: {str(c): row for c in evaluation.COUNTS} for name in ("affine", "learned")}
    console = Console(width=80, record=True)
    report.print_table3(table, console)
    text = console.export_text()
    assert "0.12 ±0.05" in text
    assert "mean of the cells: 1.000" in text
