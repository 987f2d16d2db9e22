"""Laws of training: masks, targets, the plateau, the same numbers again, and what a run leaves."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

jax = pytest.importorskip("jax")
pytest.importorskip("tyro")

from simulated import quickly  # noqa: E402
from small_training import (  # noqa: E402
    CONFIG,
    HAND,
    TRAINING,
    VALIDATION,
    make_dataset,
    with_gaps,
)

from jaxhand import tasks, training, training_data  # noqa: E402
from jaxhand.networks import predict  # noqa: E402
from jaxhand.occlusions import save, statistics  # noqa: E402
from jaxhand.skeleton import (  # noqa: E402
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)
from jaxhand.tasks import Frames  # noqa: E402
from jaxhand.training import Plateau, TrainingConfig, fit_networks  # noqa: E402
from numpy_infer import model as model_file  # noqa: E402
from numpy_infer.geometry import kabsch, untransform  # noqa: E402
from numpy_infer.hand import ANGLES, FINGERS, JOINTS  # noqa: E402
from numpy_infer.networks import Dense  # noqa: E402

OCCLUSIONS = np.array(CONFIG.occlusions, np.float32)


def fit(config: TrainingConfig = CONFIG, **options: Any) -> tuple[Any, list[training.Metrics]]:
    metrics: list[training.Metrics] = []
    options = {"report": metrics.append, **options}
    return fit_networks(TRAINING, VALIDATION, HAND, config, **options), metrics


def assert_same_networks(a: Any, b: Any) -> None:
    for name in ("marker_network", "joint_network"):
        jax.tree.map(np.testing.assert_array_equal, getattr(a, name), getattr(b, name))


@pytest.fixture(scope="module")
def fitted() -> tuple[Any, list[training.Metrics]]:
    return fit()


def without_clock(metrics: dict[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in metrics.items() if k not in ("seconds", "frames_per_second")}


# --- what is learned


def visible_of(occlusions: tuple[float, ...], count: int = 20000, markers: int = 9) -> Any:
    probabilities = np.array(occlusions, np.float32)
    return np.asarray(
        tasks.draw_visible(jax.random.key(3), probabilities, np.ones((count, markers), bool))
    )


def test_as_many_markers_are_hidden_as_asked() -> None:
    hidden = (~visible_of(CONFIG.occlusions)).sum(-1)
    share = np.bincount(hidden, minlength=5)[1:] / len(hidden)
    np.testing.assert_allclose(share, CONFIG.occlusions, atol=0.015)


def test_every_marker_is_hidden_alike() -> None:
    hidden = ~visible_of((0, 0, 1.0, 0))
    assert (hidden.sum(-1) == 3).all()
    np.testing.assert_allclose(hidden.mean(0), 3 / 9, atol=0.015)


def test_three_markers_are_always_left() -> None:
    assert visible_of((0, 0, 0, 1.0), markers=5).sum(-1).min() == 3


@pytest.fixture(scope="module")
def marker_task() -> tasks.Task:
    key = jax.random.key(0)
    return tasks.marker_task(
        TRAINING, VALIDATION, HAND, key, CONFIG.marker_layers, CONFIG.occlusions
    )


def masks_of(key: Any) -> Any:
    seen = np.ones(TRAINING.markers.shape[:-1], bool)
    return np.asarray(tasks.draw_visible(key, OCCLUSIONS, seen))


def test_hidden_inputs_are_zero(marker_task: tasks.Task) -> None:
    key = jax.random.key(5)
    inputs, targets = map(np.asarray, marker_task.prepare(key, TRAINING.markers))
    known = np.repeat(masks_of(key), 3, -1)
    assert (inputs[~known] == 0).all()
    np.testing.assert_array_equal(inputs[known], targets[known])
    assert (targets[~known] != 0).mean() > 0.99


def test_hidden_markers_change_no_input_and_no_other_target(marker_task: tasks.Task) -> None:
    key = jax.random.key(5)
    visible = masks_of(key)
    noise = np.random.default_rng(0).normal(size=TRAINING.markers.shape).astype(np.float32)
    moved = np.where(visible[..., None], TRAINING.markers, noise)
    before = marker_task.prepare(key, TRAINING.markers)
    after = marker_task.prepare(key, moved)
    np.testing.assert_array_equal(before[0], after[0])
    known = np.repeat(visible, 3, -1)
    np.testing.assert_array_equal(np.where(known, before[1], 0), np.where(known, after[1], 0))


def test_training_prepares_as_the_runtime_does(marker_task: tasks.Task) -> None:
    key, network = jax.random.key(5), marker_task.network
    visible, markers = masks_of(key), TRAINING.markers
    eye = np.broadcast_to(np.eye(3, dtype=np.float32), (len(markers), 3, 3))
    measured = np.where(visible[..., None], markers, 0)
    template = HAND.template.astype(np.float32)
    motion = kabsch(template, measured, visible.astype(np.float32), eye)
    registered = untransform(*motion, measured).reshape(len(markers), -1)
    inputs, _ = marker_task.prepare(key, markers)
    known = np.repeat(visible, 3, -1)
    scaled = (registered - network.input_mean) / network.input_scale
    np.testing.assert_allclose(inputs, np.where(known, scaled, 0), atol=2e-4)


def test_validation_is_measured_in_the_units_of_the_data(marker_task: tasks.Task) -> None:
    network, template = marker_task.network, HAND.template.astype(np.float32)
    loss, metres = marker_task.measure(network.arrays)
    key = jax.random.key(0)
    visible, truth = tasks.occlude(key, VALIDATION.markers, template, OCCLUSIONS)
    flat = np.asarray(truth).reshape(len(truth), -1)
    predicted = predict(network, flat, np.repeat(np.asarray(visible), 3, -1))
    off = np.asarray(predicted).reshape(truth.shape) - np.asarray(truth)
    distance = np.linalg.norm(off, axis=-1)[~np.asarray(visible)]
    np.testing.assert_allclose(metres, distance.mean(), rtol=1e-4)
    np.testing.assert_allclose(loss, np.mean((off / network.output_scale[0]) ** 2), rtol=1e-4)


def test_frames_of_more_weight_are_drawn_more_often() -> None:
    drawn = []

    def remember(key: Any, frames: Any) -> Any:
        jax.debug.callback(drawn.append, frames)
        return frames[:, None], frames[:, None]

    spec = (Dense(1, "linear"),)
    weights = {"0.kernel": np.zeros((1, 1), np.float32), "0.bias": np.zeros(1, np.float32)}
    frames = np.arange(4000, dtype=np.float32)
    weight = np.where(frames < 2000, 3, 1).astype(np.float32)
    epoch = training.epoch_function(spec, 32, remember)
    rate, moments = np.float32(0.1), training.ADAM.init(weights)
    for share, given in ((0.75, weight), (0.5, None)):
        epoch(weights, moments, rate, jax.random.key(0), frames, given)[2].block_until_ready()
        jax.effects_barrier()
        assert abs(np.mean(drawn[-1] < 2000) - share) < 0.03
    assert len(np.unique(drawn[-1])) == 4000


# --- what the joint network learns


def joint_task(weight: float = 1.0, mixed: float = 0.0, drawn: float = 0.0) -> tasks.Task:
    augmentation = tasks.Augmentation(mixed, drawn)
    key = jax.random.key(0)
    return tasks.joint_task(
        TRAINING, VALIDATION, HAND, key, CONFIG.joint_layers, weight, augmentation
    )


def test_mixed_frames_are_made_of_whole_fingers_and_keep_their_palm() -> None:
    markers, angles = joint_task().frames
    mix = quickly(tasks.mix_fingers, static_argnums=1)
    mixed, mixed_angles = mix(jax.random.key(4), HAND, markers, angles)
    palm = [i for i, link in enumerate(HAND.links) if link == 0]
    np.testing.assert_array_equal(mixed[:, palm], markers[:, palm])
    sources = []
    for finger in FINGERS:
        own_angles = [i for i, a in enumerate(ANGLES) if a.joint.startswith(finger)]
        own_markers = [i for i, link in enumerate(HAND.links) if JOINTS[link].startswith(finger)]
        same = (np.asarray(mixed_angles)[:, None, own_angles] == angles[None, :, own_angles]).all(
            -1
        )
        source = same.argmax(-1)
        assert same.any(-1).all()
        np.testing.assert_array_equal(mixed[:, own_markers], markers[source][:, own_markers])
        sources.append(source)
    assert (np.ptp(sources, axis=0) > 0).mean() > 0.95


@pytest.mark.parametrize(("mixed", "drawn"), [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.3, 0.3)])
def test_the_joint_network_is_shown_markers_that_its_target_angles_make(
    mixed: float, drawn: float
) -> None:
    """Forward kinematics of the targets gives the inputs, whatever was mixed or drawn."""
    task = joint_task(mixed=mixed, drawn=drawn)
    network = task.network
    inputs, targets = map(np.asarray, task.prepare(jax.random.key(1), task.frames))
    angles = network.output_mean + network.output_scale * targets[:, :26]
    skeleton = HAND.skeleton.astype(np.float32)
    still = np.eye(3, dtype=np.float32), np.zeros(3, np.float32)
    points = forward_kinematics(skeleton, rotations_from_angles(angles), *still)
    markers = np.asarray(marker_positions(HAND, *points)).reshape(len(inputs), -1)
    shown = network.input_mean + network.input_scale * inputs
    np.testing.assert_allclose(shown, markers, atol=2e-4)
    spread = targets[:, 26:].std() / (points[0][:, np.array(tasks.JOINT_POINTS)]).std()
    np.testing.assert_allclose(
        targets[:, 26:].reshape(len(inputs), 15, 3) / spread,
        points[0][:, np.array(tasks.JOINT_POINTS)],
        atol=1e-4,
    )


def test_the_joint_loss_is_angles_and_weighed_positions() -> None:
    task, plain = joint_task(weight=3.0), joint_task(weight=0.0)
    _, targets = task.prepare(jax.random.key(1), task.frames)
    exact = targets[:, :26]
    assert float(task.loss(exact, targets)) < 1e-8
    off = exact + 0.1
    angle_part = float(plain.loss(off, targets))
    assert angle_part == pytest.approx(0.01, rel=1e-3)
    position_part = (float(task.loss(off, targets)) - angle_part) / 3
    again = (float(joint_task(weight=6.0).loss(off, targets)) - angle_part) / 6
    assert position_part == pytest.approx(again, rel=1e-3)
    assert position_part > 1e-4


def test_the_papers_recipe_is_a_preset() -> None:
    own = {"joint_layers": TrainingConfig.joint_layers}
    model, _ = fit(replace(CONFIG, paper_joints=True, epochs=1, **own))
    spec = model.joint_network.spec
    assert spec == (*training.PAPER_JOINTS["joint_layers"], Dense(26, "linear"))


# --- how it is learned


def test_plateau_halves_after_five_and_stops_after_eleven() -> None:
    state = training.Fit(1, {}, None, {}, Plateau(1e-3).after(1.0, CONFIG))
    config = replace(CONFIG, epochs=300)
    rates = []
    while not state.finished(config):
        state = state._replace(plateau=state.plateau.after(1.0, config))
        rates.append(state.plateau.learning_rate)
    assert rates == [1e-3] * 4 + [5e-4] * 5 + [2.5e-4] * 2


def test_progress_starts_the_count_anew_but_not_the_rate() -> None:
    plateau = Plateau(1e-3)
    for loss in (1.0, *[2.0] * 7, 0.5):
        plateau = plateau.after(loss, CONFIG)
    assert plateau == Plateau(5e-4, 0.5, 0)
    assert plateau.after(float("nan"), CONFIG) == Plateau(5e-4, 0.5, 1)


def test_loss_goes_down(fitted: Any) -> None:
    model, metrics = fitted
    for name in ("marker_network", "joint_network"):
        own = [m for m in metrics if m.network == name]
        assert [m.epoch for m in own] == [1, 2, 3, 4]
        assert own[-1].loss < 0.9 * own[0].loss
        assert own[-1].validation_cm < own[0].validation_cm
        best = min(own, key=lambda m: m.validation_loss)
        assert model.training[name]["validation_cm"] == pytest.approx(best.validation_cm)


def test_the_model_can_be_saved(fitted: Any, tmp_path: Path) -> None:
    model_file.save(fitted[0], tmp_path / "model.npz")
    assert_same_networks(model_file.load(tmp_path / "model.npz"), fitted[0])


def test_same_seed_same_numbers(fitted: Any) -> None:
    model, metrics = fit()
    assert_same_networks(model, fitted[0])
    assert [without_clock(m._asdict()) for m in metrics] == [
        without_clock(m._asdict()) for m in fitted[1]
    ]
    other, _ = fit(replace(CONFIG, seed=1, joints=False, epochs=1))
    mean = "0.kernel"
    assert (other.marker_network.arrays[mean] != model.marker_network.arrays[mean]).any()


@pytest.mark.parametrize("interrupted", ["marker_network", "joint_network"])
def test_resuming_equals_not_stopping(fitted: Any, interrupted: str, tmp_path: Path) -> None:
    def report(metrics: training.Metrics) -> None:
        if (metrics.network, metrics.epoch) == (interrupted, 2):
            raise KeyboardInterrupt

    broken, _ = fit(report=report, folder=tmp_path)
    assert broken.training["interrupted"]
    # What a machine leaves that went down after its last checkpoint.
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"network": interrupted, "epoch": 3}) + '\n{"network": "mar')
    model, _ = fit(folder=tmp_path)
    assert_same_networks(model, fitted[0])
    lines = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [without_clock(line) for line in lines] == [
        without_clock(m._asdict()) for m in fitted[1]
    ]


def test_ctrl_c_keeps_the_best_weights(fitted: Any) -> None:
    def report(metrics: training.Metrics) -> None:
        if metrics.epoch == 2:
            raise KeyboardInterrupt

    model, _ = fit(report=report)
    two, _ = fit(replace(CONFIG, epochs=2, joints=False))
    assert model.training["interrupted"]
    assert not two.training["interrupted"]
    assert model.joints == "none"
    assert_same_networks(model, two)


def test_without_joint_truth_there_is_no_joint_network() -> None:
    bare = Frames(TRAINING.markers)
    model = fit_networks(bare, bare, HAND, replace(CONFIG, epochs=1))
    assert model.joint_network is None
    assert model.joints == "none"


# --- from data sets to a file


def test_a_run_leaves_a_model_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    halves = [Frames(TRAINING.markers[i : i + 160], TRAINING.angles[i : i + 160]) for i in (0, 160)]
    datasets = {
        "a": make_dataset("a", halves[0], 2.0, 1.1),
        "b": make_dataset("b", halves[1], 1.0, None),
    }
    monkeypatch.setattr(training_data, "load", lambda spec, split, **_: datasets[spec])
    config = replace(CONFIG, data=("a", "b"), out=tmp_path / "run", epochs=1, joints=False)
    model = training.train(config)
    assert_same_networks(model_file.load(tmp_path / "run" / "model.npz"), model)
    assert model.training["frames"] == 320
    assert model.training["config"]["marker_layers"][0]["units"] == 24
    with pytest.raises(ValueError, match="not empty"):
        training.train(config)
    more = training.train(replace(config, epochs=2, resume=True))
    once = training.train(replace(config, epochs=2, out=tmp_path / "once"))
    assert_same_networks(more, once)
    assert more.training["marker_network"]["epochs"] == 2


def test_what_is_interrupted_while_it_is_finished_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = make_dataset("a", TRAINING, 1.0, 1.1)
    monkeypatch.setattr(training_data, "load", lambda spec, split, **_: given)
    config = replace(CONFIG, data=("a",), out=tmp_path / "run", epochs=1, joints=False)

    def interrupt(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(training, "finish", interrupt)
        training.train(config)
    path = tmp_path / "run" / "model.npz"
    model_file.save(replace(model_file.load(path), fade=0.5), path, overwrite=True)
    before = path.read_bytes()
    with monkeypatch.context() as patched:
        patched.setattr(training, "finish", interrupt)
        assert training.train(replace(config, resume=True)).fade == 0.5
    assert path.read_bytes() == before
    training.train(replace(config, resume=True))
    assert path.read_bytes() != before


# --- what is simulated, and what is only partly seen


def test_what_was_not_measured_teaches_nothing() -> None:
    frames, key = with_gaps(), jax.random.key(5)
    args = VALIDATION, HAND, jax.random.key(0), CONFIG.marker_layers, CONFIG.occlusions
    task = tasks.marker_task(frames, *args)
    inputs, targets = map(np.asarray, task.prepare(key, frames.markers))
    missing = np.isnan(frames.markers).reshape(len(inputs), -1)
    assert np.isfinite(inputs).all()
    np.testing.assert_array_equal(np.isnan(targets), missing)
    assert ((inputs != 0) & ~missing).reshape(-1, 9, 3).any(-1).sum(-1).min() >= 3
    hidden_on_purpose = (inputs == 0) & ~missing
    assert hidden_on_purpose.any(-1).mean() > 0.9
    outputs = np.where(missing, 1e3, np.where(np.isnan(targets), 0, targets))
    assert float(task.loss(outputs, targets)) == 0
    slope = jax.grad(task.loss)(outputs.astype(np.float32), targets)
    assert np.isfinite(slope).all()


def test_simulated_frames_are_others_in_every_epoch_and_as_many_as_asked() -> None:
    frames = TRAINING._replace(simulated=0.4)
    args = VALIDATION, HAND, jax.random.key(0)
    markers = tasks.marker_task(frames, *args, CONFIG.marker_layers, CONFIG.occlusions)
    joints = tasks.joint_task(frames, *args, CONFIG.joint_layers, 1.0, tasks.Augmentation(0, 0))
    plain = tasks.joint_task(TRAINING, *args, CONFIG.joint_layers, 1.0, tasks.Augmentation(0, 0))
    for task, bare in ((markers, None), (joints, plain)):
        one, two = (np.asarray(task.prepare(jax.random.key(i), task.frames)[1]) for i in (1, 2))
        same = np.asarray(task.prepare(jax.random.key(1), task.frames)[1])
        np.testing.assert_array_equal(one, same)
        assert (one != two).any(-1).mean() > 0.5
        if bare is not None:
            kept = np.asarray(bare.prepare(jax.random.key(1), bare.frames)[1])
            share = (np.abs(one - kept).max(-1) > 1e-4).mean()
            assert share == pytest.approx(0.4, abs=0.06)


def test_a_training_goes_on_from_a_model(tmp_path: Path) -> None:
    short = replace(CONFIG, epochs=1)
    first = fit_networks(TRAINING, VALIDATION, HAND, short)
    bare = fit_networks(
        Frames(TRAINING.markers), Frames(VALIDATION.markers), HAND, short, start=first
    )
    assert bare.joint_network is first.joint_network
    assert bare.training["posture"] == first.training["posture"]
    changed = [
        np.abs(bare.marker_network.arrays[k] - first.marker_network.arrays[k]).max()
        for k in first.marker_network.arrays
    ]
    assert 0 < max(changed) < 0.2
    np.testing.assert_array_equal(bare.marker_network.input_mean, first.marker_network.input_mean)


def test_gaps_that_were_counted_are_hidden_in_the_same_proportions(tmp_path: Path) -> None:
    # Two of the first three markers, or the last alone, three times as often.
    seen = np.ones((400, 9), bool)
    seen[:100, :2] = False
    seen[100:, 8] = False
    table = statistics(HAND.markers, 60.0, [seen])
    template = HAND.template.astype(np.float32)
    markers = np.repeat(np.asarray(TRAINING.markers), 20, 0)
    visible, _ = tasks.occlude(jax.random.key(0), markers, template, table)
    hidden = ~np.asarray(visible)
    assert (hidden.sum(-1) == 2).mean() == pytest.approx(0.25, abs=0.02)
    assert hidden.sum(-1).min() == 1
    assert hidden[:, 8].mean() > 2 * hidden[:, 0].mean()
    assert not hidden[:, 3:8].any()
    save({"one hand": table}, tmp_path / "gaps.json")
    config = replace(CONFIG, occlusions=str(tmp_path / "gaps.json"), joints=False, epochs=1)
    assert fit_networks(TRAINING, VALIDATION, HAND, config).marker_network is not None
    with pytest.raises(ValueError, match="gaps"):
        fit_networks(TRAINING, VALIDATION, HAND, replace(config, occlusions="no_gaps.json"))
