"""``memobench merge`` and ``memobench rerun``: parts become one evaluation, a card is put to the test."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console


def merge(
    out: Annotated[Path, typer.Argument(help="Folder of the whole evaluation.")],
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of its parts; OUT/shard-*-of-* when left out.")
    ] = None,
) -> int:
    """Join the parts of an evaluation and report the whole. They ran with shard=i/n. Status 1: some are missing."""
    from lerobot_memobench.cli.evaluate import merge_and_print
    from lerobot_memobench.run.merging import part_folders

    return merge_and_print(out, folders or part_folders(out))


def rerun(
    card: Annotated[Path, typer.Argument(help="A card.json, or the folder of an evaluation that holds one.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the repetition; a dated one when left out.")] = None,
    server: Annotated[
        str | None, typer.Option(help="Where the card's policy server is here, host:port; 127.0.0.1 needs no saying.")
    ] = None,
) -> int:
    """Repeat the evaluation of a card and compare every episode. Status 1: one ended differently."""
    from lerobot_memobench.cli.evaluate import evaluate_here
    from lerobot_memobench.envs.episode_log import read_episodes
    from lerobot_memobench.run import rerun as again
    from lerobot_memobench.run.card import first_disagreement

    told = again.repeatable_card(card, server)
    again.check_policy(told)
    screen = console()
    for note in again.differences_here(told):
        screen.print(f"note: {note}", soft_wrap=True)
    plan = again.plan_of_card(told, out)
    status = evaluate_here(plan)
    if status:
        return status
    problem = first_disagreement(told["episodes"], read_episodes(plan.log))
    if problem is not None:
        screen.print(f"not repeated: {problem}", soft_wrap=True)
        return 1
    screen.print(f"repeated: all {len(told['episodes'])} episodes agree with the card", soft_wrap=True)
    return 0
