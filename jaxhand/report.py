"""`jaxhand evaluate`: measures a model, prints the tables, writes JSON and a picture."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from jaxhand import joint_evaluation
from jaxhand.datasets import load
from jaxhand.evaluation import COUNTS, DURATIONS, SEEDS, Report, mean_ratio, methods, table3
from jaxhand.joint_evaluation import joint_errors
from jaxhand.options import AlsoModels, DataSets, Takes, Unit
from jaxhand.pictures import check_picture, table_picture
from jaxhand.predictors import PREDICTORS
from jaxhand.sequences import Dataset
from numpy_infer.cli import check_output
from numpy_infer.model import Model, bundled
from numpy_infer.model import load as load_model
from numpy_infer.predictors import BASELINES


@dataclass(frozen=True)
class EvaluationConfig:
    """What to measure, on what, and where to write it; the command line of `jaxhand evaluate`."""

    data: DataSets
    """Data set NAME[:PATH]; its test split is taken. One a table."""
    model: str | None = None
    """A model file of `jaxhand train`, a bundled model's name (default: the one for the data set's
    hand), or the name of a baseline, or of a predictor of your own, for those alone."""
    table: Literal[3, 4] = 3
    """3: hidden markers, and the joints with nothing hidden; 4: the joints while markers are
    hidden, beside inverse kinematics."""
    also: AlsoModels = ()
    """NAME=FILE: a further model's row in Table 4; as often as wanted."""
    test: Takes = ()
    """Takes to test on instead of the data set's default split."""
    truth: Path | None = None
    """Folder that keeps joint truth fitted to dense markers (SIG18, minutes for each user), which
    Table 4 needs: written if it is not there yet, read if it is."""
    unit: Unit = None
    """The unit of `recordings` whose files do not say."""
    left_handed: bool = False
    """The coordinates of `recordings` are left-handed."""
    json: Path | None = None
    """Write all figures here."""
    plot: Path | None = None
    """Draw the table here, like the paper's Fig. 15(a); needs the extra `plot`."""
    seeds: int = SEEDS
    """How many times every start is taken, with other markers hidden."""
    overwrite: bool = False
    """Replace files that exist."""


def evaluate(config: EvaluationConfig, console: Console | None = None) -> dict[str, Any]:
    """Measures, prints, writes.

    Returns:
        What `--json` holds: with `--table 4` what `joint_evaluation` gives as `table4`, `wrist`,
        `steadiness_mm` and `tip_distance_mm`; otherwise
        `{"table3": {METHOD: {"1".."4": {"0.1".."2.0": CELL}}},
        "joints": {METHOD: {"cm", "deg", "wrist_mm", "wrist_deg": CELL}}}`, see `evaluation`.

    Raises:
        ValueError: no model for the hand, a file that is none, that exists already or would stand
            in no folder, no data.
    """
    console = console or Console()
    if config.seeds < 1:
        raise ValueError(f"seeds: expected 1 or more, found {config.seeds}")
    if config.json is not None:
        check_output(config.json, overwrite=config.overwrite)
    if config.plot is not None:
        check_picture(config.plot, overwrite=config.overwrite)
    if len(config.data) != 1:
        raise ValueError(f"expected one --data, found {len(config.data)}: each gets its own table")
    untrained = PREDICTORS.keys() - {"learned", "none"}
    named = config.model is not None and config.model not in untrained
    model = load_model(str(config.model)) if named else None
    if config.table == 4 and config.model is not None:
        _check_joints("Table 4", model)
    others = _others(config, model)
    hand = model.hand if model else None
    truth = config.truth or config.table == 4
    dataset = load(
        config.data[0],
        "test",
        hand=hand,
        takes=config.test or None,
        unit=config.unit,
        left_handed=config.left_handed,
        truth=truth,
    )
    for note in dataset.notes:
        console.print(f"[dim]{note}[/dim]")
    if config.model is None:
        model = _bundled_model(dataset)
        console.print(f"the bundled model {dataset.hand.name}, which has seen simulated hands only")
    model = model or Model(dataset.hand, predictor=str(config.model))
    if config.table == 4:
        result = _joints_report(model, others, dataset, config, console)
    else:
        result = _markers_report(model, dataset, config, console)
    if config.json is not None:
        config.json.write_text(json.dumps(result, indent=1) + "\n", "utf-8")
        console.print(f"wrote {config.json}")
    if config.plot is not None:
        table_picture(result[f"table{config.table}"], config.plot, overwrite=config.overwrite)
        console.print(f"wrote {config.plot}")
    return result


def _bundled_model(dataset: Dataset) -> Model:
    name = dataset.hand.name
    if name not in bundled():
        raise ValueError(
            f"no model is bundled for {name}: name one with --model FILE (jaxhand train makes "
            f"one), or a baseline: {', '.join(BASELINES)}"
        )
    return load_model(name)


def _markers_report(
    model: Model, dataset: Dataset, config: EvaluationConfig, console: Console
) -> dict[str, Any]:
    result: dict[str, Any] = {
        "table3": _table3(model, dataset, config.seeds, console),
        "joints": {},
    }
    print_table3(result["table3"], console)
    if model.joint_network is not None and dataset.sequences[0].angles is not None:
        result["joints"] = joint_errors(model, dataset)
        print_joints(result["joints"], console)
    return result


def _check_joints(what: str, model: Model | None) -> None:
    if model is None or model.marker_network is None or model.joint_network is None:
        raise ValueError(f"{what} needs a model with both networks")


def _others(config: EvaluationConfig, model: Model | None) -> dict[str, Model]:
    """The models of `--also`; looked at before the data, which may take minutes.

    Raises:
        ValueError: what would be no row of its own.
    """
    if config.also and config.table != 4:
        raise ValueError("also: further rows are for --table 4")
    others: dict[str, Model] = {}
    for name, path in map(_named, config.also):
        if name in others or name in joint_evaluation.ROWS:
            raise ValueError(f"also: a row {name!r} is there already")
        others[name] = load_model(path)
        _check_joints(f"also {name}: Table 4", others[name])
        if model is not None and others[name].hand.markers != model.hand.markers:
            raise ValueError(f"also {name}: a model for other markers than {config.model}")
    return others


def _joints_report(
    model: Model,
    others: Mapping[str, Model],
    dataset: Dataset,
    config: EvaluationConfig,
    console: Console,
) -> dict[str, Any]:
    rows = joint_evaluation.rows(model, dataset, others)
    with _bars(list(rows), console) as report:
        table = joint_evaluation.table4(rows, dataset, seeds=config.seeds, report=report)
    if dataset.noise_floor is not None:
        table["noise_floor"] = joint_evaluation.noise_floor_row(dataset)
    own = rows["learned"].model
    result: dict[str, Any] = {
        "table4": table,
        "wrist": joint_evaluation.wrist_errors(own, dataset, config.seeds),
        "steadiness_mm": joint_evaluation.steadiness(own, dataset),
        "tip_distance_mm": joint_evaluation.tip_distance_errors(own, dataset),
    }
    print_table4(table, console)
    for count, cells in result["wrist"].items():
        console.print(
            f"wrist, {count} alignment markers hidden for 0.5 s: {_cell(cells['mm'])} mm, "
            f"{_cell(cells['deg'])}°"
        )
    steadiness = result["steadiness_mm"]
    jitter, of_truth = (
        "–" if steadiness[name] is None else f"{steadiness[name]:.3f}"
        for name in ("jitter", "jitter_of_truth")
    )
    console.print(
        f"third difference of the joints: {jitter} mm, of the truth {of_truth} mm; steps of a "
        f"still hand with markers that are {1e3 * joint_evaluation.STILL_NOISE:g} mm noisy: "
        f"{steadiness['still']:.2f} mm"
    )
    console.print(
        f"distance of thumb tip and finger tips under 3 cm: off by "
        f"{_cell(result['tip_distance_mm'])} mm"
    )
    return result


def _named(text: str) -> tuple[str, str]:
    name, _, path = text.partition("=")
    if not name or not path:
        raise ValueError(f"also: expected NAME=FILE, found {text!r}")
    return name, path


def print_table4(table: Mapping[str, Any], console: Console) -> None:
    """Table 4: error in cm, with half of its 95 % interval. What a method was not measured with
    takes no lines."""
    printed = Table(
        title="Error of the joints with k markers hidden, cm (paper, Table 4)",
        box=SIMPLE_HEAD,
        padding=0,
        show_edge=False,
    )
    for heading in ("method", "k", *(f"{duration:g} s" for duration in DURATIONS)):
        justify: Any = "left" if heading == "method" else "right"
        printed.add_column(heading, justify=justify, no_wrap=True)
    for name, rows in table.items():
        counts = [k for k in COUNTS if any(cell["n"] for cell in rows[str(k)].values())]
        printed.add_row(name, "0", _cell(rows["0"]), end_section=not counts)
        for count in counts:
            cells = [_cell(rows[str(count)][f"{duration:.1f}"]) for duration in DURATIONS]
            printed.add_row("", str(count), *cells, end_section=count == counts[-1])
    console.print(printed)


def print_table3(table: Mapping[str, Any], console: Console) -> None:
    """Table 3 as the paper prints it: error in cm, with half of its 95 % interval."""
    title = "Error of k hidden markers, cm (paper, Table 3)"
    # Narrow enough for a terminal of 80 columns.
    printed = Table(title=title, box=SIMPLE_HEAD, padding=0, show_edge=False)
    for heading in ("method", "k", *(f"{duration:g} s" for duration in DURATIONS)):
        justify: Any = "left" if heading == "method" else "right"
        printed.add_column(heading, justify=justify, no_wrap=True)
    for name, rows in table.items():
        for count in COUNTS:
            cells = [_cell(rows[str(count)][f"{duration:.1f}"]) for duration in DURATIONS]
            last = count == COUNTS[-1]
            printed.add_row(name if count == 1 else "", str(count), *cells, end_section=last)
    console.print(printed)
    if "learned" in table:
        ratio = mean_ratio(table, "learned", "affine")
        console.print(f"learned / affine, mean of the cells: {ratio:.3f}")


def print_joints(joints: Mapping[str, Any], console: Console) -> None:
    """The joint stage with nothing hidden."""
    printed = Table(title="Joints with nothing hidden: PIP, DIP and tip; thumb MCP, IP and tip")
    columns = {
        "cm": "position (cm)",
        "deg": "angles (°)",
        "wrist_mm": "wrist (mm)",
        "wrist_deg": "wrist (°)",
    }
    printed.add_column("method")
    for heading in columns.values():
        printed.add_column(heading, justify="right")
    for name, cells in joints.items():
        printed.add_row(name, *(_cell(cells[key]) for key in columns))
    console.print(printed)


def _table3(
    model: Model, dataset: Dataset, seeds: int, console: Console
) -> dict[str, dict[str, dict[str, Any]]]:
    rows = methods(replace(model, joints="none"))
    with _bars(list(rows), console) as report:
        return table3(rows, dataset.sequences, seeds=seeds, report=report)


@contextmanager
def _bars(names: list[str], console: Console) -> Iterator[Report]:
    """A line with a bar for each method."""
    columns = (TextColumn("{task.description:20}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        bars = {name: progress.add_task(name, total=1.0, start=False) for name in names}

        def report(name: str, share: float) -> None:
            progress.start_task(bars[name])
            progress.update(bars[name], completed=share)

        yield report


def _cell(cell: Mapping[str, Any]) -> str:
    if cell["mean"] is None:
        return "–"
    digits = 2 if cell["mean"] < 9.995 else 1
    mean = f"{cell['mean']:.{digits}f}"
    if cell["low"] is None:
        return mean
    return f"{mean} [dim]±{(cell['high'] - cell['low']) / 2:.{digits}f}[/dim]"
