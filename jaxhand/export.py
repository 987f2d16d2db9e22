"""Finishes a trained model and writes it to a file that the numpy runtime is seen to run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import jax
import numpy as np

from jaxhand import evaluation, expected_error
from jaxhand.networks import predict
from jaxhand.sequences import Sequence as MarkerSequence
from numpy_infer import model as model_file
from numpy_infer import networks
from numpy_infer.model import Model
from numpy_infer.networks import Network

FADES = (0.01, 0.02, 0.03, 0.04, 0.06, 0.1)
"""Metres: values of δ that are tried on validation."""

SHARES = (0.0, 0.25, 0.5, 0.75, 0.85, 0.9, 0.95, 1.0)
"""Parts of the way from the network that was refined to what it became, that are tried on
validation (Wortsman et al. 2022, Robust fine-tuning of zero-shot models): weights somewhat short of
the end may be better for people that were not in the data."""

PARITY = 1e-4
"""Largest difference between JAX and numpy outputs, relative to the spread of the outputs: what
float32 leaves after four layers, with room."""


def finish(
    model: Model,
    sequences: Sequence[MarkerSequence],
    report: Callable[[str], None] = lambda text: None,
    start: Model | None = None,
) -> Model:
    """Chooses δ of the continuity blend and measures what error to expect, both on validation
    sequences. A model without a marker network, or sequences too short, stay as is.

    Args:
        model: as trained.
        sequences: of validation.
        report: is told what was chosen.
        start: the model that the training went on from, whose scaling it has; how much of what it
            learned is kept is then chosen first.
    """
    if model.marker_network is None:
        return model
    try:
        evaluation.find_starts(sequences)
    except ValueError as error:
        report(f"fade and expected error keep their defaults: {error}")
        return model
    if start is not None and start.marker_network is not None:
        between = {share: _between(start.marker_network, model, share) for share in SHARES}
        share = _best("{:.0%} of what was learned", between, sequences, report)
        model = replace(between[share], training={**model.training, "kept": share})
    faded = {fade: replace(model, fade=fade) for fade in FADES}
    fade = _best("fade δ = {:.3f} m", faded, sequences, report)
    return with_expected_error(faded[fade], sequences, report)


def _best(
    words: str,
    models: Mapping[float, Model],
    sequences: Sequence[MarkerSequence],
    report: Callable[[str], None],
) -> float:
    """The key of the model whose mean over Table 3 is least; `words` say what a key is."""
    errors = {}
    for key, model in models.items():
        errors[key] = _error(model, sequences)
        report(f"{words.format(key)}: {errors[key]:.3f} cm on validation")
    best = min(errors, key=errors.__getitem__)
    report(f"{words.format(best)} is taken")
    return best


def _between(start: Network, model: Model, share: float) -> Model:
    """The model with the marker network so far on its way from `start`; both scale alike."""
    network: Network = model.marker_network  # type: ignore[assignment]
    arrays = {
        name: (1 - share) * before + share * network.arrays[name]
        for name, before in start.arrays.items()
    }
    return replace(model, marker_network=replace(network, arrays=arrays))


def _error(model: Model, sequences: Sequence[MarkerSequence]) -> float:
    """cm, over all cells of Table 3 with a trial."""
    learned = replace(model, predictor="learned", joints="none")
    table = evaluation.table3({"": learned}, sequences, seeds=1)[""]
    cells = [cell["mean"] for row in table.values() for cell in row.values()]
    return float(np.mean([mean for mean in cells if mean is not None]))


def with_expected_error(
    model: Model,
    sequences: Sequence[MarkerSequence],
    report: Callable[[str], None] = lambda text: None,
) -> Model:
    """The model with the errors to expect as they are measured on sequences of validation."""
    samples = expected_error.measure(replace(model, predictor="learned", joints="none"), sequences)
    if len(samples.measured) < expected_error.FEWEST:
        report(f"expected error keeps its defaults: only {len(samples.measured)} hidden markers")
        return model
    return replace(model, **expected_error.fit(samples, len(model.hand))._asdict())


def export(model: Model, path: str | Path, *, overwrite: bool = False) -> Model:
    """Writes a model file, reads it back with numpy and holds its outputs against JAX's.

    Returns:
        The model as read back.

    Raises:
        ValueError: the file exists and `overwrite` is False; or the outputs differ, which leaves
            what was there.
    """
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists: choose another name, or ask to overwrite it")
    with TemporaryDirectory(dir=path.parent, prefix=".jaxhand-") as folder:
        written = Path(folder) / path.name
        model_file.save(model, written)
        back = model_file.load(written)
        for name in ("marker_network", "joint_network"):
            trained, read = getattr(model, name), getattr(back, name)
            if trained is not None and (difference := _difference(trained, read)) > PARITY:
                raise ValueError(
                    f"{name}: numpy and JAX differ by {difference:.1e} of the outputs' spread, "
                    f"expected at most {PARITY:.0e}"
                )
        written.replace(path)
    return back


def _difference(trained: Network, read: Network) -> float:
    """Largest difference between the two, on random inputs with a third of them hidden, relative
    to the spread of the outputs."""
    rng = np.random.default_rng(0)
    size = (256, len(read.input_mean))
    inputs = read.input_mean + read.input_scale * rng.standard_normal(size).astype(np.float32)
    known = rng.random(size) > 1 / 3
    jax_side = np.asarray(jax.jit(predict)(trained, inputs, known))
    numpy_side = networks.predict(read, inputs, known)
    return float(np.abs(jax_side - numpy_side).max() / max(numpy_side.std(), 1e-9))
