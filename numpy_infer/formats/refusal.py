"""The one sentence with which a file is refused."""

from __future__ import annotations

from pathlib import Path

LONGEST = 600
"""Characters: what is wrong in a file may be a word of megabytes."""


def shortened(message: str) -> str:
    """The message, or its beginning."""
    return message if len(message) <= LONGEST else message[:LONGEST] + " …"


def refusal(path: str | Path, error: Exception) -> ValueError:
    """What is wrong, with the file's name before it, once."""
    message = str(error)
    named = message.startswith(str(path))
    return ValueError(shortened(message) if named else f"{path}: {shortened(message)}")
