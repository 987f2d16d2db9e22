"""The whole line on simulated hands: train, measure, export, track with numpy alone.

Needs no data and no network. What it prints is meant for somebody who sees all this for the first
time.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from jaxhand import evaluation, pictures, simulation
from jaxhand.export import export, finish
from jaxhand.report import print_table3
from jaxhand.sequences import RATE
from jaxhand.tasks import Frames
from jaxhand.training import Metrics, TrainingConfig, fit_networks
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.pose import HandPose
from numpy_infer.recordings import Recording, write
from numpy_infer.tracker import HandTracker

FILES = ("model.npz", "table3.json", "stream.csv", "table3.png", "stream.png")
"""What the folder holds afterwards; the pictures only with matplotlib."""


@dataclass(frozen=True)
class DemoConfig:
    """The command line of `jaxhand demo`."""

    out: Path = Path("demo")
    """Folder for the model, the table, a stream with holes and the pictures."""
    seed: int = 0
    """Other seeds simulate other hands."""
    short: bool = False
    """Hardly any training: only to see that everything runs."""
    overwrite: bool = False
    """Replace the files of an earlier demo."""


class Size(NamedTuple):
    """How much is simulated and trained."""

    frames: int
    """To train on, each of another person."""
    people: int
    """To test on; as many again to validate on."""
    seconds: float
    """Of each of them."""
    epochs: int
    """For each network."""
    seeds: int
    """Of Table 3."""
    methods: tuple[str, ...]
    """Its rows. XLA takes some ten seconds to compile each."""


FULL = Size(
    frames=40_000,
    people=10,
    seconds=10,
    epochs=20,
    seeds=2,
    methods=("last_known", "moving_average", "affine", "learned"),
)
SHORT = Size(frames=2_000, people=2, seconds=4, epochs=1, seeds=1, methods=("affine", "learned"))


class People(NamedTuple):
    """Simulated hands: other people to train, to validate and to test on."""

    training: Frames
    validation: simulation.Streams
    test: simulation.Streams


def demo(config: DemoConfig) -> None:
    """Runs the demo.

    Raises:
        ValueError: the folder holds files of an earlier demo, and `overwrite` is False.
    """
    _check(config)
    console = Console(highlight=False, soft_wrap=True)
    hand, size = load_hand("glove9"), SHORT if config.short else FULL
    console.print(
        f"Hands in a glove of {len(hand)} markers, simulated. Cameras lose markers; two networks "
        "learn to fill them in and to read the joint angles off them."
    )
    with _progress(console, "simulating hands"):
        people = simulate(hand, size, jax.random.key(config.seed))
    model = _train(hand, people, size, config.seed, console)
    if not config.short:
        with _progress(console, "choosing the blend on validation"):
            model = finish(model, people.validation.sequences())
    config.out.mkdir(parents=True, exist_ok=True)
    path = config.out / "model.npz"
    export(model, path, overwrite=config.overwrite)
    console.print(f"wrote {path}: {path.stat().st_size / 1e3:.0f} kB; running it needs numpy alone")
    available = evaluation.methods(model)
    rows = {name: available[name] for name in size.methods}
    with _progress(console, "measuring on people never seen") as bar:

        def report(name: str, share: float) -> None:
            bar((list(rows).index(name) + share) / len(rows))

        test = people.test.sequences()
        table = evaluation.table3(rows, test, seeds=size.seeds, report=report)
    print_table3(table, console)
    text = json.dumps({"table3": table}, indent=1)
    (config.out / "table3.json").write_text(text + "\n", "utf-8")
    poses = _track(path, people.test, console)
    write(_recording(hand, people.test), config.out / "stream.csv", overwrite=True)
    _draw(config, hand, table, people.test, poses, console)
    _next_steps(config, console)


def simulate(hand: Hand, size: Size, key: Array) -> People:
    """All the hands of a demo."""
    frame_key, stream_key = jax.random.split(key)
    count, length = 2 * size.people, round(size.seconds * RATE)
    # Runs once: optimising it would take much longer than it runs.
    compiled = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    frames = compiled(lambda key: simulation.frames(key, hand, size.frames))(frame_key)
    streams = compiled(lambda key: simulation.streams(key, hand, count, length, RATE))(stream_key)
    streams = jax.tree.map(np.asarray, streams)
    validation, test = slice(size.people), slice(size.people, None)
    return People(Frames(*frames), _part(streams, validation), _part(streams, test))


def _part(streams: simulation.Streams, which: slice) -> simulation.Streams:
    """Some of the people."""
    parts = {name: array[which] for name, array in streams._asdict().items() if name != "time"}
    return simulation.Streams(**parts, time=streams.time)


def stream_errors(output: Array, truth: Array, visible: Array) -> dict[int, float]:
    """Mean error in cm of the hidden markers, by how many are hidden at once (4: or more)."""
    distance = 100 * np.linalg.norm(output - truth, axis=-1)
    hidden = ~visible
    number = np.minimum(hidden.sum(-1), 4)[..., None] * hidden
    return {int(n): float(distance[number == n].mean()) for n in np.unique(number[number > 0])}


def _check(config: DemoConfig) -> None:
    there = [name for name in FILES if (config.out / name).exists()]
    if there and not config.overwrite:
        raise ValueError(
            f"{config.out} holds {', '.join(there)}: pass --overwrite to replace them, or another "
            "--out"
        )


@contextmanager
def _progress(console: Console, text: str) -> Iterator[Any]:
    """A line with a bar; gives the function that is told the share done."""
    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(text, total=1.0)
        yield lambda share: progress.update(task, completed=share)
        progress.update(task, completed=1.0)


def _train(hand: Hand, people: People, size: Size, seed: int, console: Console) -> Model:
    config = TrainingConfig(
        data=(), out=Path(), seed=seed, batch=64, epochs=size.epochs, halve_after=2
    )
    markers, angles = people.validation.markers, people.validation.angles
    validation = Frames(*(a.reshape(-1, *a.shape[2:]) for a in (markers, angles)))
    errors = {}
    with _progress(console, "training two networks") as bar:

        def report(metrics: Metrics) -> None:
            errors[metrics.network] = metrics.validation_cm
            before = 0 if metrics.network == "marker_network" else size.epochs
            bar((before + metrics.epoch) / (2 * size.epochs))

        model = fit_networks(people.training, validation, hand, config, report)
    console.print(
        f"trained on {size.frames} frames; on other people, hidden markers are off by "
        f"{errors['marker_network']:.1f} cm from a single frame, finger joints by "
        f"{errors['joint_network']:.1f} cm with all markers seen"
    )
    return model


def _track(path: Path, streams: simulation.Streams, console: Console) -> HandPose:
    """Runs the exported file, and the affine baseline, over all streams with their gaps, and says
    how well they did. Gives the outputs for the first stream."""
    learned = HandTracker.load(path, alignment=True)
    affine = HandTracker(replace(learned.model, predictor="affine", joints="none"))
    outputs: dict[str, list[HandPose]] = {"learned": [], "affine": []}
    seconds: list[float] = []
    with _progress(console, "tracking with numpy alone") as bar:
        for i, (markers, visible) in enumerate(zip(streams.markers, streams.visible, strict=True)):
            seen = np.where(visible[..., None], markers, np.nan)
            outputs["learned"].append(_run(learned, seen, seconds))
            outputs["affine"].append(_run(affine, seen, []))
            bar((i + 1) / len(streams.markers))
    errors = {
        name: stream_errors(np.stack([p.markers for p in poses]), streams.markers, streams.visible)
        for name, poses in outputs.items()
    }
    console.print(
        f"{len(streams.markers)} streams with holes, {1e3 * np.median(seconds):.2f} ms per frame; "
        "where markers are hidden, they are off by"
    )
    for number, error in errors["learned"].items():
        many = "1 marker" if number == 1 else f"{number}{'+' * (number == 4)} markers"
        rival = errors["affine"][number]
        console.print(f"  {many} hidden: {error:.1f} cm (affine combination: {rival:.1f} cm)")
    return outputs["learned"][0]


def _run(tracker: HandTracker, seen: Array, seconds: list[float]) -> HandPose:
    """The outputs for a stream `[T, M, 3]`, NaN where hidden, each field with a leading T; appends
    what each frame took to `seconds`."""
    tracker.reset()
    poses = []
    for markers in seen:
        began = time.perf_counter()
        poses.append(tracker.step(markers, 1 / RATE))
        seconds.append(time.perf_counter() - began)
    return HandPose(*(None if f[0] is None else np.stack(f) for f in zip(*poses, strict=True)))


def _recording(hand: Hand, streams: simulation.Streams) -> Recording:
    """The first stream with its holes, as a marker file holds it."""
    seen = np.where(streams.visible[0][..., None], streams.markers[0], np.nan)
    return Recording(hand.markers, seen, streams.time, RATE, source="jaxhand demo")


def _draw(
    config: DemoConfig,
    hand: Hand,
    table: Mapping[str, Any],
    streams: simulation.Streams,
    poses: HandPose,
    console: Console,
) -> None:
    if find_spec("matplotlib") is None:
        console.print("no pictures without matplotlib: pip install 'jaxhand[plot]'")
        return
    pictures.table_picture(table, config.out / "table3.png", overwrite=config.overwrite)
    pictures.stream_picture(
        hand,
        streams.markers[0],
        np.where(streams.visible[0][..., None], streams.markers[0], np.nan),
        poses,
        streams.time,
        config.out / "stream.png",
        overwrite=config.overwrite,
    )
    console.print(f"wrote {config.out / 'table3.png'} and {config.out / 'stream.png'}")


def _next_steps(config: DemoConfig, console: Console) -> None:
    model, stream = config.out / "model.npz", config.out / "stream.csv"
    console.print(
        "\nWhat next:\n"
        f"  jaxhand track {stream} --model {model} -o filled.csv\n"
        "      fills the holes of a recording\n"
        "  jaxhand inspect TAKE.trc\n"
        "      tells what is in a recording of yours\n"
        "  jaxhand train --data recordings:FOLDER --out runs/mine\n"
        "      trains on your own recordings",
        markup=False,
    )
