"""The folder of a training run: its config, metrics, checkpoints and, at the end, its model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import orbax.checkpoint as orbax

from numpy_infer.formats.json_text import read_json

OWN = ("config.json", "metrics.jsonl", "checkpoints", "model.npz")
"""What a run's folder holds."""

DIGEST = "digest"
"""Beside the config: of what its paths held, see `training_data`."""

FREE = ("out", "epochs", "resume", "overwrite")
"""What may differ when a run is gone on with: it leaves the numbers of every epoch alone."""


def check(folder: Path, config: Mapping[str, Any]) -> None:
    """Refuses a folder that is in use, unless the config says to resume or overwrite its run.

    Raises:
        ValueError: with what to pass instead.
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out: expected a folder, found the file {folder}")
    if not folder.exists() or not any(folder.iterdir()):
        if config["resume"]:
            what = "is empty" if folder.exists() else "does not exist"
            raise ValueError(f"{folder} {what}, so there is no run to resume: leave out --resume")
        return
    if config["overwrite"]:
        return
    if not config["resume"]:
        raise ValueError(
            f"{folder} is not empty: pass --resume to go on with its run, --overwrite to throw "
            "that away, or another --out"
        )
    if not (folder / "config.json").exists():
        raise ValueError(f"{folder} holds no run to resume: pass another --out")
    try:
        before = read_json(folder / "config.json")
    except ValueError as error:
        raise ValueError(f"{folder / 'config.json'}: {error}; pass another --out") from None
    if not isinstance(before, dict):
        raise ValueError(f"{folder / 'config.json'} is no run's: pass another --out")
    for name, now in config.items():
        if name == DIGEST and before.get(name) != now:
            raise ValueError(
                f"{folder} was trained on other files than lie under the same paths now "
                "(recordings, --hand, --start or --occlusions): pass another --out"
            )
        if name not in FREE and before.get(name) != now:
            raise ValueError(f"{folder} was trained with {name} {before.get(name)}, not {now}")


def create(folder: Path, config: Mapping[str, Any]) -> None:
    """Makes the folder ready and writes the config; only a run's own files are ever removed."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in OWN if config["overwrite"] else ():
        part = folder / name
        if part.is_dir():
            shutil.rmtree(part)
        else:
            part.unlink(missing_ok=True)
    part = folder / "config.json.part"
    part.write_text(json.dumps(config, indent=1) + "\n", "utf-8")
    part.replace(folder / "config.json")


def checkpoints(folder: Path | None, network: str) -> Any:
    """Context manager around the network's checkpoints; of None if nothing is to be kept."""
    if folder is None:
        return nullcontext()
    options = orbax.CheckpointManagerOptions(max_to_keep=1)
    return orbax.CheckpointManager((folder / "checkpoints" / network).absolute(), options=options)


def save(manager: Any, epoch: int, state: Mapping[str, Any]) -> None:
    """Writes a checkpoint in the background, if it is newer than the last."""
    if manager is not None and epoch > (manager.latest_step() or 0):
        manager.save(epoch, args=orbax.args.StandardSave(state))


def restore(manager: Any, state: Mapping[str, Any]) -> Mapping[str, Any]:
    """The newest checkpoint, in the shape of `state`; `state` itself if there is none."""
    if manager is None or manager.latest_step() is None:
        return state
    return manager.restore(manager.latest_step(), args=orbax.args.StandardRestore(state))


def record(folder: Path | None, metrics: Mapping[str, Any]) -> None:
    """Appends a line to the metrics."""
    if folder is not None:
        with (folder / "metrics.jsonl").open("a", encoding="utf-8") as file:
            file.write(json.dumps(metrics) + "\n")


def forget(folder: Path | None, network: str, epoch: int) -> None:
    """Drops the metrics recorded after the epoch of the checkpoint: those are done again."""
    if folder is None or not (folder / "metrics.jsonl").exists():
        return
    kept = []
    for line in (folder / "metrics.jsonl").read_text("utf-8").splitlines(keepends=True):
        if not line.endswith("\n"):
            break  # a machine that went down leaves half a line
        entry = json.loads(line)
        if entry["network"] != network or entry["epoch"] <= epoch:
            kept.append(line)
    (folder / "metrics.jsonl").write_text("".join(kept), "utf-8")
