"""Lengths at a file's edge: which unit it is in."""

from __future__ import annotations

from math import isclose
from pathlib import Path

METRES = {
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), 1.0),
    **dict.fromkeys(("cm", "centimeter", "centimeters", "centimetre", "centimetres"), 1e-2),
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), 1e-3),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
}

LARGEST = 1e6
"""Metres: no file counts in larger ones."""


def metres_per(name: str, where: str) -> float:
    """Metres per unit called `name`; ValueError at `where` (FILE:LINE) for an unknown one."""
    metres = METRES.get(name.strip().lower())
    if metres is None:
        raise ValueError(f"{where}: unknown unit {name.strip()!r}; known: {', '.join(METRES)}")
    return metres


def metres(text: str) -> float:
    """What a user says one unit of a file is: a unit's name, or how many metres.

    Raises:
        ValueError: neither, or no number of metres that a unit could have.
    """
    named = METRES.get(text.strip().lower())
    try:
        number = float(text) if named is None else named
    except ValueError:
        number = 0.0
    if not 0 < number < LARGEST:
        raise ValueError(f"unit: expected mm, cm, m, in, ft or a number of metres, got {text!r}")
    return number


def agreed(path: Path, stated: float | None, given: float | None) -> float:
    """Metres per file unit from what the file states and what the user gave.

    Raises ValueError if neither says it, or if they disagree.
    """
    if stated is not None and given is not None and not isclose(stated, given, rel_tol=1e-9):
        raise ValueError(
            f"{path}: the file states {stated:g} m as its unit, and {given:g} m was given: leave "
            "that out or, where the file is wrong, correct it there"
        )
    found = given if stated is None else stated
    if found is None:
        raise ValueError(
            f"{path}: the file does not state its unit; pass --unit mm (cm, m, in), or the metres "
            "in one of its units: --unit 0.001, in Python unit=0.001"
        )
    return found
