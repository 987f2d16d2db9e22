"""The one sentence with which a file is refused."""

from __future__ import annotations

from json import JSONDecodeError
from pathlib import Path

LONGEST = 600
"""Characters: what is wrong in a file may be a word of megabytes."""


def shortened(message: str) -> str:
    """The message, or its beginning."""
    return message if len(message) <= LONGEST else message[:LONGEST] + " …"


def refusal(path: str | Path, error: Exception) -> ValueError:
    """What is wrong, with the file's name before it, once; of text that is no JSON the line."""
    if isinstance(error, JSONDecodeError):
        return ValueError(f"{path}:{error.lineno}: not JSON: {error.msg}")
    message = str(error)
    named = message.startswith(str(path))
    return ValueError(shortened(message) if named else f"{path}: {shortened(message)}")
