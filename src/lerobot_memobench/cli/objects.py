"""``memobench objects``: how to read what an object observation says."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console


def objects(
    as_json: Annotated[bool, typer.Option("--json", help="Print slots, fields and classes as JSON.")] = False,
) -> None:
    """Print the layout of object observations. Slots, the fields of each, the classes by index."""
    from lerobot_memobench.sim.object_layout import SLOTS
    from lerobot_memobench.sim.object_slots import layout

    told = layout()
    if as_json:
        print(json.dumps(told, indent=1))
        return
    screen = console()
    screen.print(f"{SLOTS} slots, one after another; of each:")
    for field in told["fields"]:
        screen.print(f"  {field['start']:>2}  {field['name']} ({field['size']})")
    screen.print("classes: " + ", ".join(f"{k} {name}" for k, name in enumerate(told["classes"])), soft_wrap=True)
