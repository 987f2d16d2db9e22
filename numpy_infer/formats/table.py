"""Text tables: lines that know their number, rows that must be whole, gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from numpy_infer.formats.refusal import shortened
from numpy_infer.recordings import Recording

LARGEST = 1e15
"""A number beyond this, in any unit, is no measurement: made of it, others would overflow."""

AWAY = 0.1
"""Metres: no marker goes so far in a frame."""

RATES = (1e-6, 1e9)
"""Hz: outside these a number is no frame rate."""


@dataclass(frozen=True)
class TextFile:
    """A text file's lines, without line ends and without empty lines at the end."""

    path: Path
    lines: list[str]
    notes: tuple[str, ...]

    def error(self, index: int, message: str) -> ValueError:
        """ValueError at line `index`, counted from 0."""
        return ValueError(f"{self.where(index)}: {shortened(message)}")

    def where(self, index: int) -> str:
        """FILE:LINE of line `index`, counted from 0; past the end, the last line."""
        return f"{self.path}:{min(index + 1, len(self.lines))}"

    def cells(self, index: int, delimiter: str | None) -> list[str]:
        """The stripped cells of one line; a missing line is a truncated file."""
        if index >= len(self.lines):
            raise self.error(index, "the file ends inside its header")
        return [cell.strip() for cell in self.lines[index].split(delimiter)]

    def numbers(self, first: int, columns: int, delimiter: str | None) -> np.ndarray:
        """[rows, columns] numbers from line `first` to the end; NaN where a cell is blank, or its
        number beyond measure (`LARGEST`).

        Empty cells beyond the last column are forgiven, every other misfit is a ValueError.
        """
        lines = self.lines[first:]
        if not lines:
            raise self.error(first, "the file has a header and no frames")
        # A header may promise more than memory holds; a row that has its cells has as many bytes.
        if sum(map(len, lines)) < len(lines) * (columns - 1):
            short = next(i for i, line in enumerate(lines) if len(line) < columns - 1)
            raise self.error(first + short, _misfit(columns, lines[short].split(delimiter)))
        table = np.empty((len(lines), columns))
        for row, line in enumerate(lines):
            cells = line.split(delimiter)
            if len(cells) < columns or any(map(str.strip, cells[columns:])):
                raise self.error(first + row, _misfit(columns, cells))
            try:
                table[row] = _row_of_numbers(line, cells[:columns])
            except ValueError:
                raise self.error(first + row, _not_a_number(cells)) from None
        table[np.abs(table) > LARGEST] = np.nan
        return table

    def check_count(self, what: str, stated: int, found: int) -> None:
        """ValueError if the header's count is not what the body has."""
        if stated != found:
            raise self.error(
                len(self.lines), f"the header states {stated} {what}, found {found}: cut off?"
            )

    def check_time(self, time: np.ndarray, first: int) -> None:
        """ValueError at the first line whose time is missing."""
        finite = np.isfinite(time)
        if not finite.all():
            raise self.error(
                first + int(np.argmin(finite)), "the time is missing or beyond measure"
            )

    def unique(self, index: int, names: Sequence[str], what: str) -> tuple[str, ...]:
        """The names as a tuple; ValueError at line `index` for an empty or a repeated one."""
        seen = set()
        for position, name in enumerate(names):
            if not name:
                raise self.error(index, f"{what} {position + 1} has no name")
            if name in seen:
                raise self.error(index, f"duplicate {what} {name!r}")
            seen.add(name)
        return tuple(names)


def read_text(path: Path) -> TextFile:
    """Read UTF-8 text, with or without a BOM, with any line ends."""
    data = path.read_bytes()
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ValueError(f"{path}:{line}: not UTF-8 text") from None
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    # A last number cut in half still is a number: only the missing line end can tell.
    unended = ("the last line has no line end; is the file cut off?",)
    notes = unended if lines[-1].strip() else ()
    while lines and not lines[-1].strip():
        lines.pop()
    if not lines:
        raise ValueError(f"{path}: the file is empty")
    return TextFile(path, lines, notes)


def hide_gaps(markers: np.ndarray, *, zeros: bool) -> tuple[np.ndarray, tuple[str, ...]]:
    """[T, M, 3] with whole markers NaN where any coordinate is not finite, and notes about it.

    zeros: three exact zeros are a gap too, and are counted in a note.
    """
    hidden = ~np.isfinite(markers).all(axis=-1)
    at_zero = (markers == 0).all(axis=-1) if zeros else np.zeros_like(hidden)
    count = int(at_zero.sum())
    notes = (f"{count} positions of exactly 0 0 0 are taken as gaps",) if count else ()
    return np.where((hidden | at_zero)[..., None], np.nan, markers), notes


def zeros_are_gaps(markers: np.ndarray) -> bool:
    """Whether a file writes gaps as three zeros, by its markers [T, M, 3] in metres: somewhere one
    is at zero, and in the frame before or after it more than `AWAY` from there."""
    zero = (markers == 0).all(-1)
    away = (np.abs(markers) > AWAY).any(-1)
    return bool((zero[1:] & away[:-1]).any() or (zero[:-1] & away[1:]).any())


def check_writable(names: Sequence[str]) -> None:
    """ValueError for a name that would not come back from a text file."""
    for name in names:
        if name != name.strip() or not name or set(name) & set('\t\r\n,:"#'):
            raise ValueError(
                f"marker name {name!r} cannot be written: it is empty, or has outer spaces, a "
                'tab, a line end or one of , : " #'
            )


def write_rows(path: Path, header: Sequence[Sequence[str]], recording: Recording, gap: str) -> None:
    """Writes a table between tabs: a header's rows, then for each frame its number, its time and
    3·M cells in millimetres with 6 decimals (1 nm)."""
    millimetres = np.round(recording.markers * 1e3, 6)
    visible = recording.visible
    # These formats read 0 0 0 as a gap: a marker measured there is moved by one nanometre.
    millimetres[..., 0][visible & (millimetres == 0).all(axis=-1)] = 1e-6
    millimetres[~visible] = np.nan
    rows = millimetres.reshape(len(millimetres), -1)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines("\t".join(row) + "\n" for row in header)
        for index, (time, row) in enumerate(zip(recording.time, rows, strict=True)):
            cells = [gap if value != value else f"{value:.6f}" for value in row.tolist()]
            file.write("\t".join([str(index + 1), number(time), *cells]) + "\n")


def positive(text: str, where: str, what: str) -> float:
    """The number in `text`; ValueError at `where` (FILE:LINE) unless it is finite and above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise ValueError(f"{where}: {what}: expected a positive number, found {text!r}")
    return value


def hertz(rate: float, where: str, what: str) -> float:
    """The frame rate; ValueError at `where` (FILE:LINE) for one that no recording has."""
    if not RATES[0] <= rate <= RATES[1]:
        raise ValueError(f"{where}: {what}: {rate:.3g} Hz is no frame rate")
    return rate


def number(value: float) -> str:
    """The shortest text that reads back as the same number."""
    return repr(float(value)).removesuffix(".0")


def _misfit(columns: int, cells: Sequence[str]) -> str:
    return f"expected {columns} columns, found {len(cells)}"


def _row_of_numbers(line: str, cells: Sequence[str]) -> list[float]:
    if "_" in line:  # Python reads 1_0 as ten; no file means that
        raise ValueError
    try:
        return list(map(float, cells))  # most rows have no blank cell
    except ValueError:
        return [float(cell.strip() or "nan") for cell in cells]


def _not_a_number(cells: Sequence[str]) -> str:
    for column, cell in enumerate(cells):
        try:
            float(cell.strip() or "nan")
            is_number = "_" not in cell
        except ValueError:
            is_number = False
        if not is_number:
            return f"column {column + 1}: expected a number, found {cell.strip()!r}"
    raise AssertionError("called for a row of numbers")
