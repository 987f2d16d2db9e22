"""Statistics of gaps are counts, files of them come back the same, and drawing follows them."""

from __future__ import annotations

import copy
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra import numpy as hnp

jax = pytest.importorskip("jax")
pytest.importorskip("rich")

import strategies  # noqa: E402
from rich.console import Console  # noqa: E402

from jaxhand import occlusions  # noqa: E402
from jaxhand.motion import HOME, Motion  # noqa: E402
from jaxhand.occlusions import (  # noqa: E402
    FEWEST_LEFT,
    ONE,
    QUANTILES,
    TWO,
    Occlusions,
    OcclusionsConfig,
    draw,
    statistics,
)
from numpy_infer.hand import ANGLES, load_hand  # noqa: E402
from numpy_infer.recordings import Recording, write  # noqa: E402

GLOVE = load_hand("glove9")
NAMES = ("a", "b", "c", "d", "e", "f")


def seen(*rows: str) -> np.ndarray:
    """`[T, M]` out of a row for each marker: a dot where it is hidden."""
    return np.array([[letter != "." for letter in row] for row in rows]).T


def gappy(seed: int = 0, frames: int = 400, markers: int = 6) -> np.ndarray:
    """Visibility with gaps of all lengths, of some markers more than of others."""
    random = np.random.default_rng(seed)
    walk = np.cumsum(random.standard_normal((frames, markers)), 0)
    return walk > np.quantile(walk, np.linspace(0.02, 0.4, markers), axis=0).diagonal()


@pytest.fixture(scope="module")
def table() -> Occlusions:
    return statistics(NAMES, 100.0, [gappy(0), gappy(1, 300)])


# -- counting ----------------------------------------------------------------------------------


def test_a_recording_made_by_hand_is_counted_exactly() -> None:
    first = seen("xx..xxx.xx", "xxxxxxxxxx", "......x...")
    found = statistics(("a", "b", "c"), 50.0, [first, seen("x.x", "xxx", "xxx")])
    assert found == Occlusions(
        markers=("a", "b", "c"),
        rate=50.0,
        frames=13,
        hidden=(3 / 13, 7 / 13, 3 / 13, 0.0),
        missing=(4 / 13, 0.0, 9 / 13),
        gaps=5,
        # 1, 1, 2, 3 and 6 frames, of 13 together.
        lengths=(1, 1, 1, 2, 3, 6, 6, 6),
        weighted=(1, 1, 2, 3, 6, 6, 6, 6),
        histogram=(2, 2, 1),
    )


def test_nothing_hidden_has_no_gap() -> None:
    found = statistics(NAMES, 60.0, [np.ones((5, 6), bool)])
    assert (found.gaps, found.hidden[0], found.lengths) == (0, 1.0, (0,) * len(QUANTILES))
    assert found.histogram == (0,)
    assert occlusions.occlusions_from_json(found.to_json()) == found


@given(hnp.arrays(bool, (12, 4)), hnp.arrays(bool, (5, 4)))
def test_counts_agree_with_going_through_the_frames(one: np.ndarray, other: np.ndarray) -> None:
    found = statistics("abcd", 10.0, [one, other])
    lengths = []
    for visible in (one, other):
        for marker in visible.T:
            runs = "".join("x" if v else "." for v in marker).split("x")
            lengths += [len(run) for run in runs if run]
    assert found.gaps == len(lengths)
    everything = np.concatenate([one, other])
    np.testing.assert_allclose(found.missing, 1 - everything.mean(0))
    for number, share in enumerate(found.hidden):
        assert share == pytest.approx(((~everything).sum(1) == number).mean())
    for quantile, length, weighted in zip(QUANTILES, found.lengths, found.weighted, strict=True):
        if lengths:
            below = [x for x in lengths if x <= length]
            assert len(below) >= quantile * len(lengths) - 1e-6
            assert len([x for x in lengths if x < length]) < quantile * len(lengths)
            assert sum(x for x in lengths if x <= weighted) >= quantile * sum(lengths) - 1e-6
            assert sum(x for x in lengths if x < weighted) < quantile * sum(lengths)
    for i, count in enumerate(found.histogram):
        assert count == sum(2**i <= x < 2 ** (i + 1) for x in lengths)


def test_the_order_of_hands_and_frames_in_several_files_do_not_matter(table: Occlusions) -> None:
    assert statistics(NAMES, 100.0, [gappy(1, 300), gappy(0)]) == table
    backward = statistics(NAMES, 100.0, [gappy(0)[::-1], gappy(1, 300)[::-1]])
    assert backward == table


def test_long_gaps_are_cut_in_their_lengths_only(table: Occlusions) -> None:
    cut = statistics(NAMES, 100.0, [gappy(0), gappy(1, 300)], longest=5)
    assert cut.lengths[-1] == cut.weighted[-1] == 5 < table.lengths[-1]
    assert (cut.gaps, cut.missing, cut.hidden) == (table.gaps, table.missing, table.hidden)


@pytest.mark.parametrize(
    ("hands", "message"),
    [
        ([], "at least one frame"),
        ([np.ones((0, 6), bool)], "at least one frame"),
        ([np.ones((5, 4), bool)], r"expected \[T, 6\] each, found \[5, 4\]"),
        ([np.ones(6, bool)], r"found \[6\]"),
    ],
)
def test_what_is_no_visibility_is_refused(hands: list[np.ndarray], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        statistics(NAMES, 60.0, hands)


# -- files -------------------------------------------------------------------------------------


def test_a_file_comes_back_the_same(table: Occlusions, tmp_path: Path) -> None:
    path = tmp_path / "stats.json"
    tables = {ONE: table, TWO: statistics(NAMES, 60.0, [gappy(3)])}
    occlusions.save(tables, path)
    assert occlusions.load(path) == tables
    with pytest.raises(ValueError, match="exists"):
        occlusions.save(tables, path)
    occlusions.save({ONE: table}, path, overwrite=True)
    assert occlusions.load(path) == {ONE: table}


def put(name: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda row: row.update({name: value})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda row: row.pop("missing"), "expected the entries"),
        (put("colour", 1), "colour"),
        (put("rate", "fast"), "rate: expected a number"),
        (put("rate", 0), "rate: expected a positive number"),
        (put("rate", float("nan")), "rate"),
        (put("frames", 1.5), "frames: expected a whole number"),
        (put("frames", True), "frames"),
        (put("markers", ["a"] * 6), "markers: expected different names"),
        (put("markers", "abcdef"), "markers: expected a list"),
        (put("hidden", [1.0]), "hidden: expected 7 numbers"),
        (put("hidden", [0.5, 0.4, 0, 0, 0, 0, 0]), "hidden: expected parts that sum to 1"),
        (put("hidden", [1.0, 0, 0, 0, 0, 0, 0]), "missing: expected rates that sum to"),
        (put("missing", [2.0, 0, 0, 0, 0, 0]), "missing: expected 6 numbers from 0 to 1"),
        (put("gaps", 7), "histogram: expected numbers that sum to 7"),
        (put("lengths", {"0.5": 3}), "lengths: expected the entries"),
        (lambda row: row["lengths"].update({"0.05": 10**6}), "lengths: expected 8 growing"),
        (lambda row: row["weighted"].update({"0.99": 0}), "weighted: expected 8 growing"),
        (put("histogram", {"1-2": 3}), "histogram: expected the entries 1-1"),
        (put("histogram", [1, 2]), "histogram: expected an object"),
    ],
)
def test_a_spoilt_file_is_refused_and_told_why(
    table: Occlusions, tmp_path: Path, spoil: Callable[[dict[str, Any]], None], message: str
) -> None:
    row = copy.deepcopy(table.to_json())
    spoil(row)
    with pytest.raises(ValueError, match=message):
        occlusions.occlusions_from_json(row)
    path = tmp_path / "stats.json"
    data = {"format": "jaxhand-occlusions", "version": 1, "tables": {ONE: row}}
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=f"stats.json: one hand: .*{message}"):
        occlusions.load(path)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "x", "version": 1, "tables": {}}'])
def test_another_file_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "stats.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"stats\.json: "):
        occlusions.load(path)


# -- drawing -----------------------------------------------------------------------------------


def test_as_many_are_hidden_at_once_as_in_the_statistics(table: Occlusions) -> None:
    visible = np.asarray(draw(jax.random.key(0), table, (40000, 6)))
    assert visible.shape == (40000, 6)
    assert visible.dtype == bool
    number = (~visible).sum(-1)
    assert number.min() == 1
    assert visible.sum(-1).min() >= FEWEST_LEFT
    wanted = np.array(table.hidden[1 : len(NAMES) - FEWEST_LEFT + 1])
    assert (wanted > 0.01).all()
    shares = np.bincount(number, minlength=4)[1:] / len(number)
    np.testing.assert_allclose(shares, wanted / wanted.sum(), atol=0.01)


def test_one_marker_rather_than_another_by_how_often_it_was_missing(table: Occlusions) -> None:
    visible = np.asarray(draw(jax.random.key(1), table, (60000, 6)))
    alone = ~visible[(~visible).sum(-1) == 1]
    rates = np.array(table.missing)
    np.testing.assert_allclose(alone.mean(0), rates / rates.sum(), atol=0.012)
    # Of two the second is drawn among those that are left.
    pairs = ~visible[(~visible).sum(-1) == 2]
    part = rates / rates.sum()
    second = part * ((part / (1 - part)).sum() - part / (1 - part))
    np.testing.assert_allclose(pairs.mean(0), part + second, atol=0.015)


def test_the_same_key_hides_the_same_and_what_never_was_missing_stays(table: Occlusions) -> None:
    once, again = (np.asarray(draw(jax.random.key(2), table, (500, 6))) for _ in range(2))
    np.testing.assert_array_equal(once, again)
    assert (once != np.asarray(draw(jax.random.key(3), table, (500, 6)))).any()
    some = statistics(NAMES, 60.0, [seen("x.x.", "x..x", "xxxx", "xxxx", "xxxx", "xxxx")])
    assert np.asarray(draw(jax.random.key(2), some, (500, 6)))[:, 2:].all()


def test_frames_with_too_few_left_are_not_drawn_from() -> None:
    lost = statistics(NAMES, 60.0, [seen(*["xx.."] * 6)])
    with pytest.raises(ValueError, match="no frame with a hidden marker and 3 visible"):
        draw(jax.random.key(0), lost, (5, 6))
    some = statistics(NAMES, 60.0, [seen("xx..", *["xx.x"] * 5)])
    assert (np.asarray(draw(jax.random.key(0), some, (50, 6))).sum(-1) == 5).all()


def test_training_takes_the_table_of_two_hands_in_its_own_order(
    table: Occlusions, tmp_path: Path
) -> None:
    path, other = tmp_path / "stats.json", statistics(NAMES, 60.0, [gappy(3)])
    occlusions.save({ONE: other, TWO: table}, path)
    assert occlusions.of_layout(path, NAMES) == table
    found = occlusions.of_layout(path, NAMES[::-1])
    assert (found.markers, found.missing) == (NAMES[::-1], table.missing[::-1])
    with pytest.raises(ValueError, match=r"stats\.json: expected the markers a, g, found"):
        occlusions.of_layout(path, "ag")


# -- recordings --------------------------------------------------------------------------------


def recorded(path: Path, visible: dict[str, np.ndarray], rate: float = 60.0) -> Path:
    """A file whose labels are these prefixes with the glove's markers."""
    names = [prefix + marker for prefix in visible for marker in GLOVE.markers]
    shown = np.concatenate(list(visible.values()), 1)
    markers = np.where(shown[..., None], np.random.default_rng(0).random((*shown.shape, 3)), np.nan)
    write(Recording(tuple(names), markers, np.arange(len(shown)) / rate, rate, "made"), path)
    return path


def run(*files: Path | str, **options: Any) -> tuple[dict[str, Occlusions], str]:
    out = io.StringIO()
    config = OcclusionsConfig(files=tuple(map(str, files)), **options)
    tables = occlusions.occlusions(config, Console(file=out, width=100))
    return tables, out.getvalue()


def test_one_hand_and_two_hands_of_files_are_counted_apart(tmp_path: Path) -> None:
    one, left, right = (gappy(seed, 200, 9) for seed in range(3))
    alone = recorded(tmp_path / "alone.trc", {"L_": one})
    both = recorded(tmp_path / "both.trc", {"L_": left, "R_": right})
    prefixes = {"left_prefix": "L_", "right_prefix": "R_"}
    tables, text = run(alone, both, json=tmp_path / "stats.json", **prefixes)
    assert tables == {
        ONE: statistics(GLOVE.markers, 60.0, [one]),
        TWO: statistics(GLOVE.markers, 60.0, [left, right]),
    }
    assert occlusions.load(tmp_path / "stats.json") == tables
    for part in ("both.trc: 2 × glove9", "ring_tip", "one hand", "two hands", "1-1", "0.99"):
        assert part in text
    with pytest.raises(ValueError, match="exists"):
        run(alone, json=tmp_path / "stats.json", **prefixes)


def test_labels_are_renamed_by_a_map_and_a_hand_that_does_not_fit_is_told(tmp_path: Path) -> None:
    visible = gappy(0, 50, 9)
    file = recorded(tmp_path / "take.trc", {"": visible})
    tables, _ = run(file)
    assert tables == {ONE: statistics(GLOVE.markers, 60.0, [visible])}
    renamed = tmp_path / "map.json"
    renamed.write_text(json.dumps({"ring_tip": "r4"}))
    with pytest.raises(ValueError, match="no hand fits the labels pinky_base, wrist"):
        run(file, map=renamed)
    with pytest.raises(ValueError, match="no marker ring_tip; there are pinky_base"):
        run(file, map=renamed, hand="glove9")
    with pytest.raises(ValueError, match="no marker hand_top, hand_left"):
        run(file, hand="qualisys13")
    with pytest.raises(ValueError, match="no hand fits the labels"):
        run(file, hand="dense19")
    with pytest.raises(ValueError, match="nodir is no folder: make it first"):
        run(file, json=tmp_path / "nodir" / "stats.json")
    with pytest.raises(ValueError, match=r"gaps\.xyz: cannot draw '\.xyz'; known: .*\.png, "):
        run(file, picture=tmp_path / "gaps.xyz")
    with pytest.raises(ValueError, match="expected marker files, or the word simulated"):
        run()


def test_recordings_that_do_not_go_together_are_refused(tmp_path: Path) -> None:
    slow = recorded(tmp_path / "slow.trc", {"": gappy(0, 50, 9)})
    fast = recorded(tmp_path / "fast.trc", {"": gappy(0, 50, 9)}, rate=120.0)
    with pytest.raises(ValueError, match=r"fast\.trc: 120 Hz, and 60 in the files before"):
        run(slow, fast)
    rounded = recorded(tmp_path / "rounded.trc", {"": gappy(1, 50, 9)}, rate=59.998)
    tables, _ = run(slow, rounded)
    assert tables[ONE].frames == 100
    with pytest.raises(ValueError, match=r"slow\.trc is the recording itself"):
        run(slow, json=slow, overwrite=True)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"rate": 60.0', f'"rate": 1{"0" * 400}', "rate: expected a number"),
        ('"version": 1', '"version": 1, "version": 1', "duplicate entry 'version'"),
    ],
)
def test_a_file_of_gaps_is_read_as_any_json(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "gaps.json"
    occlusions.save({ONE: statistics(GLOVE.markers, 60.0, [gappy(0, 50, 9)])}, path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=rf"gaps\.json: .*{message}"):
        occlusions.load(path)


def test_a_raw_recording_of_a_right_hand(data_root: Path) -> None:
    tables, text = run(data_root / "qualisys" / "recording.tsv")
    assert "1 × qualisys13, 100 Hz" in text
    (found,) = tables.values()
    assert found.frames == 6000
    # 20 real gaps of three fingertips; the longer half of them holds most missing frames.
    assert found.gaps == sum(found.histogram) == 20
    assert sum(rate > 0 for rate in found.missing) == 3
    assert found.lengths[QUANTILES.index(0.5)] < found.weighted[QUANTILES.index(0.5)]


def near_each_other(
    key: Any, frames: int, rate: float, batch: tuple[int, ...], people: Any
) -> tuple[Motion, Motion]:
    """In the place of `two_hands`, which takes long to compile: palms together, fingers bending."""
    time = jax.numpy.arange(frames, dtype="float32") / rate
    phase = jax.random.uniform(key, (2, *batch, 1, len(ANGLES)), maxval=6.0)
    angles = 0.4 + 0.4 * jax.numpy.sin(phase + 3 * time[:, None])
    hands = []
    for side, x in enumerate((-0.05, 0.05)):
        inward = strategies.turn([0, 0, 1], (0.5 - side) * np.pi).astype(np.float32)
        place = np.float32(np.add(HOME, [x, 0, 0]))
        wrist = [np.broadcast_to(part, (*batch, frames, *part.shape)) for part in (inward, place)]
        hands.append(Motion(angles[side], *wrist))
    return hands[0], hands[1]


def test_simulated_hands_hide_each_other(monkeypatch: pytest.MonkeyPatch) -> None:
    call = (jax.random.key(0), 120, 120.0, (occlusions.RECORDINGS,), None)
    real, ours = (
        jax.eval_shape(lambda f=f: f(*call)) for f in (occlusions.two_hands, near_each_other)
    )
    assert [x.shape for x in jax.tree.leaves(real)] == [x.shape for x in jax.tree.leaves(ours)]
    monkeypatch.setattr(occlusions, "two_hands", near_each_other)
    tables, text = run("simulated", seconds=1.0, cameras=6)
    one, two = tables[ONE], tables[TWO]
    assert one.frames == two.frames == 2 * occlusions.RECORDINGS * 120
    # Each marker has the same cameras, flicker and drop-outs in both.
    assert all(b >= a for a, b in zip(one.missing, two.missing, strict=True))
    assert sum(two.missing) > 1.2 * sum(one.missing) > 0
    assert "two hands" in text
    with pytest.raises(ValueError, match="seconds, cameras: expected at least one"):
        run("simulated", seconds=0.0)
