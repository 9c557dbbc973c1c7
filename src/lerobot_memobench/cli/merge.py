"""``memobench merge`` and ``memobench rerun``: parts become one evaluation, a card is put to the test."""

from __future__ import annotations

import datetime as dt
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from lerobot_memobench.cli.console import console
from lerobot_memobench.cli.orders import parse_shard
from lerobot_memobench.engine.card import checkpoint_files, disagreement, key_of, tree_hash, versions
from lerobot_memobench.engine.merging import merge as merge_parts
from lerobot_memobench.engine.merging import part_folders
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.report import REPORT_MARKDOWN
from lerobot_memobench.evaluation.records.protocol import CARD_FILE, read_card


def merge(
    out: Annotated[Path, typer.Argument(help="Folder of the whole evaluation.")],
    folders: Annotated[
        list[Path] | None, typer.Argument(help="Folders of its parts; OUT/shard-*-of-* when left out.")
    ] = None,
) -> int:
    """Join the parts of an evaluation that were run with shard=i/n and report the whole. Status 1: some are missing."""
    return merge_and_report(out, folders or part_folders(out))


def merge_and_report(out: Path, folders: Sequence[Path]) -> int:
    """Merge, write and print the report; return 1 when episodes that were asked for are missing."""
    from lerobot_memobench.cli.running import print_report

    absent = merge_parts(out, folders)
    print_report(out, None)
    screen = console()
    screen.print(f"report: {out / REPORT_MARKDOWN}", soft_wrap=True)
    if absent:
        task, episode = absent[0]
        screen.print(
            f"note: {len(absent)} episodes that were asked for are missing, the first is {task}, episode {episode}; "
            "run their parts with resume=true and merge again",
            soft_wrap=True,
        )
    return 1 if absent else 0


def rerun(
    card: Annotated[Path, typer.Argument(help="A card.json, or the folder of an evaluation that holds one.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the repetition; a dated one when left out.")] = None,
) -> int:
    """Repeat the evaluation that a card describes and compare every episode. Status 1: one ended differently."""
    path = card / CARD_FILE if card.is_dir() else card
    told = read_card(path)
    if not told["episodes"]:
        raise MemobenchError(f"{path} holds no episodes to compare with; expected that of an evaluation that has ended")
    screen = console()
    for note in differences_here(told):
        screen.print(f"note: {note}", soft_wrap=True)
    folder = out or Path("outputs/eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}_rerun"

    from lerobot_memobench.cli.lerobot import run

    words = ["eval", *told["flags"], f"output_dir={folder}"]
    if told["shard"] is not None:
        words.append(f"shard={told['shard']}")
        folder = folder / parse_shard(told["shard"]).folder
    status = run(words)
    if status:
        return status
    problem = first_disagreement(told["episodes"], read_episodes(folder))
    if problem is not None:
        screen.print(f"not repeated: {problem}", soft_wrap=True)
        return 1
    screen.print(f"repeated: all {len(told['episodes'])} episodes agree with the card", soft_wrap=True)
    return 0


def differences_here(card: Mapping[str, Any]) -> list[str]:
    """Return in what this machine differs from the one that wrote a card.

    Raises:
        MemobenchError: the policy is not here, or is another one.
    """
    from lerobot_memobench.cli.evaluation import gl_facts, policy_folder

    if card["checkpoint"]:
        path = card["checkpoint"]["path"]
        given = next((flag.partition("=")[2] for flag in card["flags"] if flag.startswith("--policy.path=")), path)
        folder = policy_folder(given)
        if folder is None:
            raise MemobenchError(f"the checkpoint {given} is not here; put it there to repeat the evaluation")
        found = tree_hash(checkpoint_files(folder))
        if found != card["policy"].get("sha256"):
            raise MemobenchError(
                f"the checkpoint {given} is not the one that was evaluated (sha256 {found[:12]}, on the card "
                f"{str(card['policy'].get('sha256'))[:12]}); its results would be another policy's"
            )
    here = {**versions(), **gl_facts()}
    notes = []
    for run in card["runs"]:
        told = {**run["versions"], **run["gl"]}
        changed = [
            f"{name} {version} (here {here[name]})"
            for name, version in told.items()
            if here.get(name, version) != version
        ]
        if changed:
            notes.append(f"the card's run used {', '.join(changed)}; results may depend on it")
    return list(dict.fromkeys(notes))


def first_disagreement(card: Sequence[Mapping[str, Any]], records: Sequence[Mapping[str, Any]]) -> str | None:
    """Return where a log departs from a card's episodes, None when nowhere."""
    found = {key_of(record): record for record in records}
    for episode in card:
        other = found.get(key_of(episode))
        if other is None:
            return f"{episode['task']}, episode {episode['episode']} is on the card and was not run here"
        problem = disagreement(episode, other, "on the card", "here")
        if problem is not None:
            return problem
    return None
