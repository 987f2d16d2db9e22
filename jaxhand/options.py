"""Kinds of command line options that several verbs share."""

from __future__ import annotations

from typing import Annotated

import tyro

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

AlsoModels = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
"""`--also NAME=FILE`, likewise."""
