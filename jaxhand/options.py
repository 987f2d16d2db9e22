"""Kinds of command line options: takes, data sets, layers of a network."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import tyro

from numpy_infer.formats.json_text import read_json
from numpy_infer.formats.units import metres
from numpy_infer.networks import Dense, Spec, read_spec

Takes = Annotated[
    tuple[str, ...],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="NAME,NAME",
        instance_from_str=lambda arguments: tuple(filter(None, arguments[0].split(","))),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=lambda value: [",".join(value)],
    ),
]
"""Names of takes or users, with commas between."""

DataSets = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
"""`--data NAME[:PATH][@WEIGHT]`, as often as wanted."""

Unit = Annotated[
    float | None,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="mm|cm|m|in|METRES",
        instance_from_str=lambda arguments: metres(arguments[0]),
        is_instance=lambda value: value is None or isinstance(value, float),
        str_from_instance=lambda value: [f"{value:g}" if value else "what the file says"],
    ),
]
"""Metres in one unit of a file, or the unit's name."""

AlsoModels = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
"""`--also NAME=FILE`, likewise."""


def read_layers(text: str) -> Spec:
    """Hidden layers from `200,0.1,150`: a whole number is that many ReLU units, a part of 1 a
    dropout; or from a JSON file with a list of layers as `numpy_infer.networks.read_spec` has it.

    Raises:
        ValueError: neither; the message names the layer, or the file.
    """
    if text.endswith(".json"):
        try:
            layers = read_json(Path(text))
        except (OSError, ValueError) as error:
            raise ValueError(f"layers {text}: {error}") from None
        if not isinstance(layers, list):
            raise ValueError(f"layers {text}: expected a list, found {type(layers).__name__}")
    else:
        layers = [_read_layer(part) for part in text.split(",")]
    return read_spec([*layers, {"type": "dense", "units": 1, "activation": "linear"}])[:-1]


def _read_layer(text: str) -> dict[str, Any]:
    try:
        number = float(text)
    except ValueError:
        raise ValueError(
            f"layer {text!r}: expected units such as 200, a dropout such as 0.1, or a .json file"
        ) from None
    if 0 < number < 1:
        return {"type": "dropout", "rate": number}
    return {"type": "dense", "units": int(number) if number.is_integer() else number}


def _write_layers(spec: Spec) -> list[str]:
    return [",".join(str(x.units if isinstance(x, Dense) else x.rate) for x in spec)]


Layers = Annotated[
    Spec,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="LAYERS",
        instance_from_str=lambda arguments: read_layers(arguments[0]),
        is_instance=lambda value: isinstance(value, tuple),
        str_from_instance=_write_layers,
    ),
]
