"""No product is left to a device's default precision: on a GPU that has three digits, and a model
trained there would not be what numpy runs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np
import pytest
from streams import a_model

from jaxhand import simulation, tasks, tracker, training
from jaxhand.anthropometry import people
from jaxhand.cameras import Rig, film
from jaxhand.ik import ccd
from jaxhand.networks import predict
from jaxhand.sparse_fit import least_squares, prior_of
from jaxhand.two_hands import two_hands
from numpy_infer.arrays import Array
from numpy_infer.hand import load_hand

HAND = load_hand("glove9")
FRAMES = np.broadcast_to(np.float32(HAND.template), (4, *HAND.template.shape))
ANGLES = np.random.default_rng(0).normal(size=(64, 26)).astype(np.float32)
KEY = jax.random.key(0)


def products(jaxpr: Any) -> Iterator[Any]:
    """Every product of matrices in a program, and in those within it."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            yield equation
        for part in jax.tree.leaves(tuple(equation.params.values()), is_leaf=is_program):
            if is_program(part):
                yield from products(getattr(part, "jaxpr", part))


def is_program(part: Any) -> bool:
    return hasattr(part, "eqns") or hasattr(part, "jaxpr")


def network(inputs: Array) -> Any:
    model = a_model("learned", dtype=np.float32, joints=True)
    return [predict(net, inputs) for net in (model.marker_network, model.joint_network)]


def tracked(predictor: str) -> Callable[[Array], Any]:
    model = a_model(predictor, dtype=np.float32, joints=True, gate=True)
    visible, dt = np.ones((4, 9), bool), np.full(4, 1 / 60, np.float32)
    return lambda markers: tracker.run(model, tracker.init(model), markers, visible, dt)


def epoch(key: Array) -> Any:
    config = training.TrainingConfig(data=(), out=training.Path())
    frames = tasks.Frames(FRAMES, ANGLES[: len(FRAMES)])
    task = tasks.marker_task(frames, frames, HAND, KEY, config.marker_layers, config.occlusions)
    weights = task.network.arrays
    run = training.epoch_function(task.network.spec, 2, task.prepare)
    return run(weights, training.ADAM.init(weights), 1e-3, key, task.frames, None)


def filmed(key: Array) -> Any:
    person = people(key, HAND, (2,))
    return film(key, HAND, person, *two_hands(key, 30, 60.0, (2,), person), 60.0, Rig(cameras=4))


@pytest.mark.parametrize(
    ("program", "given", "some"),
    [
        (network, FRAMES.reshape(4, -1), True),
        (tracked("learned"), FRAMES, True),
        (tracked("affine"), FRAMES, True),
        (epoch, KEY, True),
        (filmed, KEY, True),
        (lambda key: simulation.frames(key, HAND, 8), KEY, False),
        (lambda markers: ccd(HAND, markers, tuned=True), FRAMES, False),
        (lambda markers: least_squares(HAND, markers, prior_of(ANGLES)), FRAMES, True),
    ],
    ids=["network", "learned", "affine", "epoch", "cameras", "frames", "ccd", "least_squares"],
)
def test_products_are_of_full_precision(
    program: Callable[[Array], Any], given: Array, some: bool
) -> None:
    found = list(products(jax.make_jaxpr(program)(given).jaxpr))
    assert bool(found) == some
    coarse = [equation for equation in found if "HIGHEST" not in str(equation.params["precision"])]
    assert not coarse, coarse
