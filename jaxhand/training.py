"""Trains the networks (paper, section 3.4); what they learn stands in `tasks`.

Keys are folded in from seed and epoch, so a training that goes on from a checkpoint gives the same
numbers, bit for bit, as one that was never interrupted.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from rich.console import Console

from jaxhand import runs
from jaxhand.anthropometry import SIZE_SPREAD
from jaxhand.export import export, finish
from jaxhand.networks import from_arrays
from jaxhand.occlusions import Occlusions, of_layout
from jaxhand.sparse_fit import prior_of
from jaxhand.tasks import (
    Augmentation,
    Frames,
    Task,
    joint_task,
    marker_task,
    mean_square,
)
from jaxhand.training_config import PAPER_JOINTS, TrainingConfig, as_json
from jaxhand.training_data import check_frames, check_joint_frames, check_measured, collect
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.model import Model
from numpy_infer.model import load as load_model
from numpy_infer.networks import Spec

ADAM = optax.scale_by_adam()

SAVE_SECONDS = 5.0
"""A checkpoint is written when the last one is older: a machine that goes down takes no more."""

Report = Callable[["Metrics"], None]


class Metrics(NamedTuple):
    """What is reported of an epoch."""

    network: str
    epoch: int
    loss: float
    """Mean squared error in scaled units, training frames."""
    validation_loss: float
    """The same, validation frames."""
    validation_cm: float
    """Mean distance: of hidden markers, or of the joints `JOINT_POINTS` to forward kinematics of
    the true angles."""
    learning_rate: float
    frames_per_second: float
    seconds: float
    """Duration of the epoch with its validation."""


class Plateau(NamedTuple):
    """The learning rate, and how long the validation loss has stood still."""

    learning_rate: float
    best: float = math.inf
    """The least validation loss so far."""
    stale: int = 0
    """Epochs since."""

    def after(self, loss: float, config: TrainingConfig) -> Plateau:
        """The state after an epoch with this validation loss."""
        if loss < self.best:
            return Plateau(self.learning_rate, loss)
        stale = self.stale + 1
        rate = self.learning_rate / 2 if stale % config.halve_after == 0 else self.learning_rate
        return Plateau(rate, self.best, stale)


class Fit(NamedTuple):
    """What is carried from epoch to epoch: all that a checkpoint holds."""

    epoch: int
    weights: dict[str, Array]
    moments: Any
    """Adam's."""
    best: dict[str, Array]
    """The weights at the least validation loss."""
    plateau: Plateau

    def finished(self, config: TrainingConfig) -> bool:
        return self.epoch >= config.epochs or self.plateau.stale >= config.stop_after


def epoch_function(
    spec: Spec,
    batch: int,
    prepare: Callable[[Array, Any], tuple[Array, Array]],
    loss: Callable[[Array, Array], Array] = mean_square,
) -> Callable[..., tuple[dict[str, Array], Any, Array]]:
    """One epoch, all of it on the device.

    `epoch(weights, moments, learning_rate, key, frames, weight) -> (weights, moments, loss)`:
    frames are drawn, prepared in one go (see `Task.prepare`; no gradient goes through it), and a
    scan over the batches takes a step of Adam for each. The last, partial batch is left out.
    """

    def epoch(
        weights: dict[str, Array],
        moments: Any,
        learning_rate: float,
        key: Array,
        frames: Any,
        weight: Array | None,
    ) -> tuple[dict[str, Array], Any, Array]:
        draw_key, prepare_key, dropout_key = jax.random.split(key, 3)
        drawn = _draw(draw_key, frames, weight, batch)
        inputs, targets = prepare(prepare_key, drawn)
        rate = jnp.float32(learning_rate)
        return _scan(spec, batch, loss, weights, moments, rate, dropout_key, inputs, targets)

    return epoch


@partial(jax.jit, static_argnames="batch")
def _draw(key: Array, frames: Any, weight: Array | None, batch: int) -> Any:
    """As many frames as there are, in whole batches: each once, or by weight."""
    count = len(jax.tree.leaves(frames)[0])
    order = jax.random.choice(key, count, (count,), replace=weight is not None, p=weight)
    return jax.tree.map(lambda array: array[order[: count - count % batch]], frames)


@partial(jax.jit, static_argnames=("spec", "batch"))
def _scan(
    spec: Spec,
    batch: int,
    loss_of: Callable[[Array, Array], Array],
    weights: dict[str, Array],
    moments: Any,
    learning_rate: Array,
    key: Array,
    inputs: Array,
    targets: Array,
) -> tuple[dict[str, Array], Any, Array]:
    def mean_loss(weights: dict[str, Array], inputs: Array, targets: Array, key: Array) -> Array:
        return loss_of(from_arrays(spec, weights)(inputs, key), targets)

    def step(carry: Any, data: Any) -> tuple[Any, Array]:
        weights, moments = carry
        number, inputs, targets = data
        step_key = jax.random.fold_in(key, number)
        loss, slope = jax.value_and_grad(mean_loss)(weights, inputs, targets, step_key)
        with jax.numpy_dtype_promotion("standard"):  # optax takes a float to the power of an int
            direction, moments = ADAM.update(slope, moments)
        weights = jax.tree.map(lambda w, d: w - learning_rate * d, weights, direction)
        return (weights, moments), loss

    steps = len(inputs) // batch
    split = [array.reshape(steps, batch, -1) for array in (inputs, targets)]
    carry, losses = jax.lax.scan(step, (weights, moments), (jnp.arange(steps), *split))
    return *carry, losses.mean()


def fit_networks(
    training: Frames,
    validation: Frames,
    hand: Hand,
    config: TrainingConfig,
    report: Report = lambda _: None,
    folder: Path | None = None,
    joint_frames: tuple[Frames, Frames] | None = None,
    start: Model | None = None,
) -> Model:
    """Trains on arrays, without any data set on disk.

    Ctrl-C ends the training and keeps the best weights; `Model.training["interrupted"]` says so.

    Args:
        training, validation: frames; both with angles where a joint network is wanted.
        hand: markers are registered to its template, and angles move its skeleton.
        config: what it says of which data to read, and how, is not looked at.
        report: called after every epoch.
        folder: where metrics and checkpoints are kept and, if there are any, gone on from; None
            keeps nothing.
        joint_frames: frames to train and validate the joint network on instead; with angles.
            Of either kind, those with all markers and all angles count.
        start: a model of the same hand, whose networks are trained further.

    Raises:
        ValueError: misshapen or too few frames, or no loss was finite.
        KeyboardInterrupt: before the end of the first epoch, when there is nothing to keep.
    """
    if config.paper_joints:
        config = replace(config, paper_joints=False, **PAPER_JOINTS)
    if not config.joints:
        training, validation = (x._replace(angles=None) for x in (training, validation))
    occlusions, joint_frames = _checked(training, validation, hand, config, joint_frames, start)
    tasks = [
        partial(
            marker_task,
            training,
            validation,
            hand,
            hidden=config.marker_layers,
            occlusions=occlusions,
            start=start.marker_network if start else None,
            sizes=_sizes(config, start),
        )
    ]
    if joint_frames is not None:
        tasks.append(
            partial(
                joint_task,
                *joint_frames,
                hand,
                hidden=config.joint_layers,
                position_weight=config.position_weight,
                augmentation=Augmentation(config.mixed, config.drawn),
                start=start.joint_network if start else None,
            )
        )
    networks: dict[str, Any] = {}
    if start is not None:
        before = {name: getattr(start, name) for name in ("marker_network", "joint_network")}
        networks = {name: network for name, network in before.items() if network is not None}
    summary: dict[str, Any] = {"frames": len(training.markers), "interrupted": False}
    for number, make in enumerate(tasks):
        key = jax.random.fold_in(jax.random.key(config.seed), number)
        task = make(key=key)
        fit, summary["interrupted"] = _fit(task, config, key, report, folder)
        if math.isfinite(fit.plateau.best):
            networks[task.name] = jax.tree.map(np.asarray, replace(task.network, arrays=fit.best))
            error = float(task.measure(fit.best)[1]) * 100
            # It may be of nothing: where what would be hidden was never measured.
            known = error if math.isfinite(error) else None
            summary[task.name] = {"epochs": fit.epoch, "validation_cm": known}
        elif not summary["interrupted"]:
            raise ValueError(f"{task.name}: the loss is not finite; lower the learning rate")
        if summary["interrupted"]:
            break
    if not networks:
        raise KeyboardInterrupt
    joints = "learned" if "joint_network" in networks else "none"
    if joint_frames is None:
        if start is not None and "posture" in start.training:
            summary["posture"] = start.training["posture"]
    elif joints == "learned":
        angles = np.asarray(joint_frames[0].angles)
        # What the rival that fits postures knows of them, see `sparse_fit`.
        posture = prior_of(angles[np.isfinite(angles).all(-1)])._asdict()
        summary["posture"] = {name: array.tolist() for name, array in posture.items()}
    return Model(hand, predictor="learned", joints=joints, training=summary, **networks)


def _sizes(config: TrainingConfig, start: Model | None) -> float:
    if config.sizes is not None:
        return config.sizes
    return 0.0 if start is None or start.marker_network is None else SIZE_SPREAD


def _checked(
    training: Frames,
    validation: Frames,
    hand: Hand,
    config: TrainingConfig,
    joint_frames: tuple[Frames, Frames] | None,
    start: Model | None,
) -> tuple[tuple[float, ...] | Occlusions, tuple[Frames, Frames] | None]:
    """How markers are hidden, and what the joint network is trained and validated on, if it is.

    Raises:
        ValueError: what `fit_networks` refuses before it trains.
    """
    check_frames("training", training, hand, config.batch)
    check_frames("validation", validation, hand, 1)
    if not training.simulated and (start is None or start.marker_network is None):
        check_measured("training", training, hand)
    known = config.joints and training.angles is not None and validation.angles is not None
    if joint_frames is None and known:
        joint_frames = training, validation
    if joint_frames is not None:
        check_joint_frames("training", joint_frames[0], hand, config.batch)
        check_joint_frames("validation", joint_frames[1], hand, 1)
    if isinstance(config.occlusions, str):
        return of_layout(config.occlusions, hand.markers), joint_frames
    return config.occlusions, joint_frames


def _fit(
    task: Task, config: TrainingConfig, key: Array, report: Report, folder: Path | None
) -> tuple[Fit, bool]:
    """Trains one network; True if it was interrupted."""
    run = epoch_function(task.network.spec, config.batch, task.prepare, task.loss)
    weights = dict(task.network.arrays)
    fit = Fit(0, weights, ADAM.init(weights), weights, Plateau(config.learning_rate))
    with runs.checkpoints(folder, task.name) as checkpoints:
        fit = Fit(**runs.restore(checkpoints, fit._asdict()))
        runs.forget(folder, task.name, fit.epoch)
        saved = time.monotonic()
        try:
            while not fit.finished(config):
                advanced, metrics = _advance(run, task, fit, config, key)
                runs.record(folder, metrics._asdict())
                fit = advanced
                report(metrics)
                if time.monotonic() - saved > SAVE_SECONDS:
                    runs.save(checkpoints, fit.epoch, fit._asdict())
                    saved = time.monotonic()
        except KeyboardInterrupt:
            interrupted = True
        else:
            interrupted = False
        runs.save(checkpoints, fit.epoch, fit._asdict())
    return fit, interrupted


def _advance(
    run: Callable[..., Any], task: Task, fit: Fit, config: TrainingConfig, key: Array
) -> tuple[Fit, Metrics]:
    """One epoch and its validation."""
    number, rate = fit.epoch + 1, fit.plateau.learning_rate
    began = time.perf_counter()
    epoch_key = jax.random.fold_in(key, number)
    weights, moments, loss = run(
        fit.weights, fit.moments, rate, epoch_key, task.frames, task.weight
    )
    loss = float(loss)  # waits for the epoch
    trained = time.perf_counter()
    validation_loss, error = map(float, task.measure(weights))
    plateau = fit.plateau.after(validation_loss, config)
    best = weights if plateau.best < fit.plateau.best else fit.best
    metrics = Metrics(
        network=task.name,
        epoch=number,
        loss=loss,
        validation_loss=validation_loss,
        validation_cm=error * 100,
        learning_rate=rate,
        frames_per_second=len(jax.tree.leaves(task.frames)[0]) / (trained - began),
        seconds=time.perf_counter() - began,
    )
    return Fit(number, weights, moments, best, plateau), metrics


def train(config: TrainingConfig) -> Model:
    """Trains on data sets, chooses what is chosen on validation, and writes `model.npz`.

    Raises:
        ValueError: data that are missing or do not fit together, or a folder that is in use.
    """
    if not config.data:
        raise ValueError("name a data set to train on: --data NAME:PATH")
    console = Console(soft_wrap=True, highlight=False)
    plain = as_json(config)
    runs.check(config.out, plain)
    given = collect(config)
    # Once more, now that it is known what lies under the paths.
    plain[runs.DIGEST] = given.digest
    runs.check(config.out, plain)
    # What is refused leaves no folder behind, and throws no older run away.
    frames = given.training, given.validation
    _checked(*frames, given.hand, config, given.joint_frames, given.start)
    runs.create(config.out, plain)

    def report(m: Metrics) -> None:
        left = timedelta(seconds=round((config.epochs - m.epoch) * m.seconds))
        console.print(
            f"{m.network} {m.epoch}/{config.epochs}  loss {m.loss:.4f}  "
            f"validation {m.validation_loss:.4f}, {m.validation_cm:.3f} cm  "
            f"rate {m.learning_rate:.1e}  {m.frames_per_second:,.0f} frames/s  at most {left} left"
        )

    for note in given.notes:
        console.print(note)
    model = fit_networks(
        given.training,
        given.validation,
        given.hand,
        config,
        report,
        config.out,
        given.joint_frames,
        given.start,
    )
    if model.training["interrupted"]:
        begun = model.joints == "learned" or not config.joints
        kept = "the best weights so far are kept" + ("" if begun else ", the joints have none yet")
        console.print(f"interrupted: {kept}; --resume goes on")
    model = replace(model, training={**model.training, "config": as_json(config)})
    path, told = config.out / "model.npz", console.print
    try:
        model = finish(model, given.sequences, told, given.start)
    except KeyboardInterrupt:
        if path.exists():
            told(f"interrupted: {path} stays as it was; --resume makes the choices again")
            return load_model(path)
        told("interrupted: all that was learned is kept, fade and expected error are the defaults")
    model = export(model, path, overwrite=True)
    console.print(f"wrote {path}")
    return model
