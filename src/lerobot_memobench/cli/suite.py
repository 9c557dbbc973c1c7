"""The option ``--suite`` of the commands that look at the catalogue's tasks."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

import typer

from lerobot_memobench.tasks.task import PUBLISHED, STRICT


class Suite(StrEnum):
    """Which thirty tasks are meant."""

    PUBLISHED = PUBLISHED
    STRICT = STRICT


WhichSuite = Annotated[
    Suite,
    typer.Option(
        help="published: the thirty tasks as published; strict: their memory-necessary variants, whose answer pictures do not show."
    ),
]
OfSuite = Annotated[
    Suite | None, typer.Option(help="Refuse a dataset that holds tasks of another suite; any when left out.")
]
