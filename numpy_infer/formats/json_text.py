"""JSON as every file of ours is read: nothing twice, nothing too deep, nothing too large."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

SIZE_LIMIT = 1 << 20
"""Bytes: more than this is no hand, calibration or label map; as objects it takes thirty times as
much memory."""


def read_json(file: Path | Traversable) -> Any:
    """The file's data.

    Raises:
        ValueError: it is too large or refused as by `parse_json`; a `JSONDecodeError`, which knows
            the line, if it is no JSON. The message does not name the file.
    """
    with file.open("rb") as stream:
        content = stream.read(SIZE_LIMIT + 1)
    if len(content) > SIZE_LIMIT:
        raise ValueError(f"more than {SIZE_LIMIT >> 20} MB of JSON, which no such file has")
    return _data(content)


def parse_json(content: bytes, *, finite: bool = False) -> Any:
    """The data of UTF-8 JSON text, with or without a BOM.

    finite: NaN and numbers too large for a float are refused here, where nobody else looks.

    Raises:
        ValueError: no UTF-8 text, no JSON, an entry twice in an object, or nested too deep.
    """
    try:
        return _data(content, finite=finite)
    except json.JSONDecodeError as error:
        raise ValueError(f"not JSON: {error}") from None


def _data(content: bytes, *, finite: bool = False) -> Any:
    hooks: dict[str, Any] = {"parse_constant": _not_finite, "parse_float": _finite}
    try:
        text = content.decode("utf-8-sig")
        return json.loads(text, object_pairs_hook=_unique, **(hooks if finite else {}))
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 text: byte {error.start} is no part of it") from None
    except RecursionError:
        raise ValueError("not JSON of ours: nested too deep") from None


def _unique(items: list[tuple[str, Any]]) -> dict[str, Any]:
    data: dict[str, Any] = {}
    for key, value in items:
        if key in data:
            raise ValueError(f"duplicate entry {key!r}")
        data[key] = value
    return data


def _finite(text: str) -> float:
    value = float(text)
    return value if abs(value) < float("inf") else _not_finite(text)


def _not_finite(text: str) -> float:
    raise ValueError(f"{text} is no finite number")
