"""A model that knows postures, without the time to train one."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax
import numpy as np
from simulated import quickly, worn
from streams import a_model

from jaxhand import simulation
from jaxhand.motion import Motion
from jaxhand.tasks import register
from numpy_infer import load_hand
from numpy_infer.model import Model
from numpy_infer.networks import Dense, Network

GLOVE = load_hand("glove9")
FEATURES = 400


@functools.cache
def fitted_model() -> Model:
    """A joint network whose last layer is fitted to simulated postures, on random features."""
    angles = np.asarray(quickly(simulation.poses, static_argnums=1)(jax.random.key(5), (6000,)))
    still = np.eye(3, dtype=np.float32), np.zeros(3, np.float32)
    markers = worn(GLOVE, Motion(angles, *still))[0]
    weight = np.broadcast_to(GLOVE.alignment_weight, markers.shape[:-1])
    inputs = np.asarray(register(np.float32(GLOVE.template), markers, weight))
    inputs = inputs.reshape(len(inputs), -1)
    mean, scale = inputs.mean(0), inputs.std()
    rng = np.random.default_rng(0)
    kernel = (rng.standard_normal((inputs.shape[1], FEATURES)) / 2).astype(np.float32)
    bias = rng.standard_normal(FEATURES).astype(np.float32)
    hidden = np.maximum((inputs - mean) / scale @ kernel + bias, 0)
    hidden = np.concatenate([hidden, np.ones((len(hidden), 1))], -1)
    last = np.linalg.solve(hidden.T @ hidden + np.eye(FEATURES + 1), hidden.T @ angles)
    network = Network(
        (Dense(FEATURES), Dense(angles.shape[-1], "linear")),
        {
            "0.kernel": kernel,
            "0.bias": bias,
            "1.kernel": last[:-1].astype(np.float32),
            "1.bias": last[-1].astype(np.float32),
        },
        mean,
        np.full_like(mean, scale),
        np.zeros(angles.shape[-1], np.float32),
        np.ones(angles.shape[-1], np.float32),
    )
    plain = a_model("affine", dtype=np.float32)
    return replace(plain, joints="learned", joint_network=network)
