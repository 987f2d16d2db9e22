"""Labels tell the hand they are of, whatever else is in the file; a few may be missing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from shlex import quote

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxhand.strategies import Motion, rigid_motions
from numpy_infer.arrays import Array
from numpy_infer.geometry import transform
from numpy_infer.hand import HIGH, LOW, Hand, bundled, load_hand
from numpy_infer.labels import (
    DISPENSABLE,
    advice,
    beginnings,
    doubted_unit,
    fitting_hand,
    lacking,
    meant,
    prefixed,
    tracked_without,
    unfitting,
    unusual_size,
)
from numpy_infer.recordings import Recording, load_label_map, read
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

HANDS = [load_hand(name) for name in bundled()]
GLOVE = load_hand("glove9")
hands = st.sampled_from(HANDS)


def recording(names: tuple[str, ...], markers: Array) -> Recording:
    return Recording(names, markers, np.arange(len(markers)) / 60, 60.0, "made up", unit=0.01)


# -- which hand ----------------------------------------------------------------------------------


@given(hands, st.data())
def test_labels_in_any_order_beside_others_are_of_their_hand(
    hand: Hand, data: st.DataObject
) -> None:
    most = int(DISPENSABLE * len(hand))
    absent = data.draw(st.lists(st.sampled_from(hand.markers), max_size=most, unique=True))
    others = [f"pillow{i}" for i in range(data.draw(st.integers(0, 30)))]
    labels = data.draw(st.permutations([*lacking(hand, absent), *others]))
    found = fitting_hand(labels)
    assert found is not None
    assert found.name == hand.name
    assert lacking(hand, labels) == [name for name in hand.markers if name in absent]


def test_a_hand_that_is_whole_is_taken_before_a_larger_one_that_is_not() -> None:
    dense = load_hand("dense19")
    for labels, name in ((dense.markers[1:], "glove9"), (dense.markers, "dense19")):
        found = fitting_hand([*GLOVE.markers, *labels])
        assert found is not None
        assert found.name == name
    assert fitting_hand(["pillow", *GLOVE.markers[:5]]) is None


@pytest.mark.parametrize("hand", HANDS, ids=lambda hand: hand.name)
def test_a_third_of_the_markers_can_be_done_without_and_no_more(hand: Hand) -> None:
    most = int(DISPENSABLE * len(hand))
    rng = np.random.default_rng(0)
    some = [rng.permutation(hand.markers)[:most].tolist() for _ in range(200)]
    assert all(tracked_without(hand, absent) for absent in some)
    assert not tracked_without(hand, hand.markers[: most + 1])


def test_what_is_left_determines_where_the_hand_is() -> None:
    """Of four markers any may be missing, unless the others are in line."""
    four = replace(GLOVE, markers=GLOVE.markers[:4], template=np.eye(4, 3) * 0.05)
    assert all(tracked_without(four, [name]) for name in four.markers)
    line = np.array([[0.0, 0, 0], [0.05, 0, 0], [0.1, 0, 0], [0, 0.05, 0]])
    told = [tracked_without(replace(four, template=line), [name]) for name in four.markers]
    assert told == [True, True, True, False]


# -- what was meant -----------------------------------------------------------------------------


def misspelt(name: str, way: int, at: int) -> str:
    """In one of several ways: other signs and cases, or a letter too many, too few, exchanged."""
    at = 1 + at % (len(name) - 1)
    return (
        name.upper(),
        name.replace("_", " "),
        name.title().replace("_", "-"),
        name[:at] + name[at - 1] + name[at:],
        name[:at] + name[at + 1 :],
        name[:at] + "x" + name[at + 1 :],
    )[way]


@given(hands, st.data(), st.integers(0, 5), st.integers(0, 11))
def test_a_misspelt_label_is_taken_for_the_marker_that_is_lacking(
    hand: Hand, data: st.DataObject, way: int, at: int
) -> None:
    name = data.draw(st.sampled_from(hand.markers))
    label = misspelt(name, way, at)
    labels = data.draw(st.permutations([*lacking(hand, [name]), label, "pillow"]))
    taken = {one for known in HANDS for one in known.markers}
    numbers = [[sign for sign in text if sign.isdigit()] for text in (name, label)]
    if numbers[0] != numbers[1] or label == name or label in taken:
        assert meant(hand, labels).get(label) in (None, name)
        return
    assert meant(hand, labels) == {label: name}
    assert advice(labels, hand) == [f"did you mean {name} by {label}? (--map renames)"]
    assert advice(labels) == advice(labels, hand)


@pytest.mark.parametrize("hand", HANDS, ids=lambda hand: hand.name)
def test_a_letter_too_few_anywhere_is_asked_about(hand: Hand) -> None:
    """Also where a name says a word twice."""
    for name in hand.markers:
        for at in range(1, len(name)):
            label = name[:at] + name[at + 1 :]
            if not any(sign.isdigit() for sign in name[at]):
                assert meant(hand, [*lacking(hand, [name]), label]) == {label: name}


def test_every_name_may_be_written_in_another_way() -> None:
    for hand in HANDS:
        for way in range(3):
            labels = {misspelt(name, way, 0): name for name in hand.markers}
            if set(labels) != set(hand.markers):
                assert meant(hand, labels) == {k: v for k, v in labels.items() if k != v}


@pytest.mark.parametrize("hand", HANDS, ids=lambda hand: hand.name)
def test_what_is_something_else_is_not_taken_for_a_marker(hand: Hand) -> None:
    """Names of other markers, other numbers, the other hand."""
    others = {name for known in HANDS for name in known.markers}
    for name in hand.markers:
        labels = [*lacking(hand, [name]), *sorted(others - {name})]
        for label in meant(hand, labels):
            one, other = (text.lower().replace("_", "") for text in (label, name))
            assert one == other
    assert not meant(replace(GLOVE, markers=(*GLOVE.markers[1:], "m 1")), [*GLOVE.markers, "m 2"])
    right = [f"R_{name}" for name in hand.markers]
    assert not advice([*hand.markers[1:], *right], hand)


@given(hands, st.sampled_from([("L_",), ("R_", "L_"), ("Left ", "Right "), ("a_", "b_")]))
def test_what_the_labels_of_a_hand_begin_with_is_found(
    hand: Hand, prefixes: tuple[str, ...]
) -> None:
    labels = [prefix + name for prefix in prefixes for name in hand.markers[1:]]
    assert list(beginnings(["pillow", *labels])) == list(prefixes)
    (told,) = advice(labels)
    assert told.startswith(f"labels of a hand begin with {' and '.join(prefixes)}: see --")
    sides = {"L": "left", "R": "right"}
    if prefixes[0][0] in sides:
        options = [f"--{sides[prefix[0]]}-prefix {quote(prefix)}" for prefix in prefixes]
        assert told.endswith(f"see {' '.join(options)}")
    else:
        assert told.endswith("see --left-prefix and --right-prefix")
    assert not beginnings(hand.markers)
    assert not beginnings([f"L_{name}" for name in hand.markers[:3]])


def test_one_hand_of_an_unknown_side_may_be_either() -> None:
    (told,) = advice([f"Bob {name}" for name in GLOVE.markers])
    assert told.endswith("see --left-prefix 'Bob ' or --right-prefix 'Bob '")


@pytest.mark.parametrize("begun", ["L", "L_h"])
def test_a_prefix_that_is_cut_short_is_made_whole(begun: str) -> None:
    rest = "L_hand_".removeprefix(begun)
    labels = [rest + name for name in GLOVE.markers]
    whole = begun + rest
    told = unfitting(labels, "--model FILE", begun)
    assert f"no bundled hand fits the labels {whole}{GLOVE.markers[0]}, " in told
    assert told.endswith(f"labels of a hand begin with {whole}: see --left-prefix {whole}")
    absent = ", ".join(begun + name for name in GLOVE.markers[5:])
    assert f"; glove9 lacks {absent}" in unfitting(GLOVE.markers[:5], "--model FILE", begun)


def test_a_label_map_is_read_from_json(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    path.write_text(json.dumps({"LTHF": "thumb_tip", "LEHAL": "wrist"}))
    assert load_label_map(path) == {"LTHF": "thumb_tip", "LEHAL": "wrist"}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": "b",\n}', r"map\.json:2: not JSON"),
        ('["a"]', "expected an object"),
        ('{"a": 1}', "'a': expected a name, got 1"),
        ('{"a": "b", "a": "c"}', "duplicate entry 'a'"),
        ('{"a": "c", "b": "c"}', "duplicate name 'c'"),
    ],
)
def test_a_broken_label_map_is_refused(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_label_map(path)


# -- its markers ---------------------------------------------------------------------------------


@given(hands, st.sampled_from(["", "L_"]), st.data())
def test_markers_come_by_name_and_what_has_no_label_is_never_seen(
    hand: Hand, prefix: str, data: st.DataObject
) -> None:
    absent = data.draw(st.lists(st.sampled_from(hand.markers), max_size=len(hand) - 1, unique=True))
    labels = data.draw(st.permutations([*lacking(hand, absent), "pillow"]))
    rng = np.random.default_rng(0)
    names = (*(prefix + label for label in labels), "elsewhere")
    file = replace(recording(names, rng.normal(size=(4, len(names), 3))), filled=names[:2])
    if not tracked_without(hand, absent):
        with pytest.raises(ValueError, match="made up: no marker ") as error:
            prefixed(file, prefix, hand)
        named, there = str(error.value).split("; there are ")
        missing = [prefix + name for name in hand.markers if name in absent]
        assert named == f"made up: no marker {', '.join(missing)}"
        assert there == ", ".join(names)
        return
    own = prefixed(file, prefix, hand)
    assert own.names == hand.markers
    assert set(own.filled) == set(labels[:2]) - {"pillow"}
    for name, markers in zip(own.names, own.markers.swapaxes(0, 1), strict=True):
        known = name not in absent
        wanted = file.markers[:, names.index(prefix + name)] if known else np.nan
        np.testing.assert_array_equal(markers, np.broadcast_to(wanted, (4, 3)))


def test_what_was_tracked_once_may_lack_labels_as_well() -> None:
    said = np.zeros((1, len(GLOVE)))
    file = replace(recording(GLOVE.markers, GLOVE.template[None]), status=said, expected_error=said)
    own = prefixed(file.select(GLOVE.markers[1:]), "", GLOVE)
    assert own.names == GLOVE.markers
    assert own.status is None


def test_a_prefix_that_no_label_has_is_an_error() -> None:
    file = recording(GLOVE.markers, GLOVE.template[None])
    with pytest.raises(ValueError, match="no label begins with 'L_'; there are pinky_base, "):
        prefixed(file, "L_", GLOVE)


# -- its size ------------------------------------------------------------------------------------


def postures(hand: Hand, seed: int, frames: int = 8) -> Array:
    """`[T, M, 3]` metres: angles anywhere in their ranges."""
    angles = np.random.default_rng(seed).uniform(LOW, HIGH, (frames, len(LOW)))
    wrist = np.broadcast_to(np.eye(3), (frames, 3, 3)), np.zeros((frames, 3))
    points, rotations = forward_kinematics(hand.skeleton, rotations_from_angles(angles), *wrist)
    markers: Array = marker_positions(hand, points, rotations)
    return markers


@given(hands, st.integers(-3, 3), st.integers(0, 99), rigid_motions(), st.floats(0.85, 1.2))
def test_a_unit_that_is_wrong_by_tens_is_doubted_and_the_right_one_named(
    hand: Hand, power: int, seed: int, motion: Motion, size: float
) -> None:
    """Of small people and tall ones, wherever they are, with gaps, a ghost and more labels."""
    rng = np.random.default_rng(seed)
    markers = transform(*motion, size * postures(hand, seed))
    markers[rng.random(markers.shape[:2]) < 0.3] = np.nan
    markers[:, seed % len(hand)] += 2.0
    file = recording(hand.markers, 10.0**power * markers)
    order = rng.permutation(len(hand))
    file = file.select([hand.markers[i] for i in order])
    told = doubted_unit(file, hand)
    if power == 0:
        assert told is None
        assert unusual_size(file, hand) is None
        return
    assert told is not None
    much = "large" if power > 0 else "small"
    assert told.startswith(f"the markers are {10 ** abs(power)} times too {much} for a hand: ")
    assert "is the unit, 0.01 m by" in told
    assert told.endswith(f" {0.01 / 10**power:g} m would do")


@given(hands, st.sampled_from([0.0254, 0.3048]), st.sampled_from([1e-3, 1e-4]), st.integers(0, 99))
def test_the_unit_that_would_do_is_metric(
    hand: Hand, wrong: float, right: float, seed: int
) -> None:
    markers = wrong / right * postures(hand, seed)
    file = replace(recording(hand.markers, markers), unit=wrong)
    told = doubted_unit(file, hand)
    assert told is not None
    assert told.endswith(f" {right:g} m would do")


def test_what_is_not_seen_has_no_size() -> None:
    nothing = np.full((3, 9, 3), np.nan)
    assert doubted_unit(recording(GLOVE.markers, nothing), GLOVE) is None
    nothing[:, 0] = 5.0
    assert doubted_unit(recording(GLOVE.markers, nothing), GLOVE) is None
    nothing[:] = 5.0
    assert doubted_unit(recording(GLOVE.markers, nothing), GLOVE) is None, "all at one place"


def test_no_real_recording_is_doubted(data_root: Path) -> None:
    files = [data_root / "qualisys" / "recording.tsv"]
    for user in ("User1", "User2", "User3"):
        files += sorted((data_root / "sig18" / user).glob("*/*.trc"))[::20]
    for file in files:
        found = read(file)
        hand = fitting_hand(found.names)
        assert hand is not None
        assert doubted_unit(found, hand) is None
        assert unusual_size(found, hand) is None
        smaller = replace(found, markers=0.1 * found.markers)
        assert "10 times too small" in str(doubted_unit(smaller, hand))
