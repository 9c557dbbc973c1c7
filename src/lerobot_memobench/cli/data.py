"""``memobench convert``, ``validate``, ``describe`` and ``push``: datasets that are there."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, counting
from lerobot_memobench.cli.suite import OfSuite
from lerobot_memobench.io import count_of

if TYPE_CHECKING:
    from lerobot_memobench.datasets.validate import Verdict
    from lerobot_memobench.jobs.processes import Advance


def convert(
    source: Annotated[Path, typer.Argument(help="HDF5 file in the published layout, or a folder of them.")],
    out: Annotated[Path, typer.Option(help="Folder of the dataset that is made.")],
    upside_down: Annotated[
        bool, typer.Option("--upside-down", help="The images are stored bottom row first: turn them up.")
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    repo_id: Annotated[str | None, typer.Option(help="Name of the dataset, user/name.")] = None,
) -> int:
    """Turn HDF5 demonstrations into a LeRobotDataset. What cannot be used is named. The same command continues a killed
    run.
    """
    from lerobot_memobench.datasets.convert import convert as run

    screen = console()
    with counting(screen, "episodes") as count:

        def advance(news: Advance) -> None:
            count(news.done, news.total, f"{news.task_name}, demo_{news.seed}", found=news.found)

        summary = run(
            source,
            out,
            upside_down=upside_down,
            workers=workers,
            progress=advance,
            tell=lambda said: screen.print(said, soft_wrap=True, markup=False),
            **({} if repo_id is None else {"repo_id": repo_id}),
        )
    for problem in summary.problems:
        screen.print(f"left out: {problem}", soft_wrap=True)
    for note in summary.notes:
        screen.print(f"note: {note}", soft_wrap=True, markup=False)
    if summary.folder is None:
        screen.print("no dataset was written: nothing could be used")
    else:
        screen.print(f"dataset of {count_of(summary.episodes, 'episode')}: {summary.folder}", soft_wrap=True)
    return summary.exit_status


def validate(
    folder: Annotated[Path, typer.Argument(help="Folder of a dataset, of HDF5 files of this package, or of both.")],
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    suite: OfSuite = None,
) -> int:
    """Replay every episode in the simulator. The first disagreement of each is reported."""
    from lerobot_memobench.datasets.lerobot_format.reading import check_suite_of
    from lerobot_memobench.datasets.validate import exit_status
    from lerobot_memobench.datasets.validate import validate as run

    if suite is not None:
        check_suite_of(folder, suite)
    screen = console()
    with counting(screen, "episodes") as count:

        def advance(done: int, total: int, verdict: Verdict) -> None:
            count(done, total, verdict.episode, trouble=verdict.disagreement)

        verdicts = run(folder, workers=workers, progress=advance)
    wrong = sum(verdict.disagreement is not None for verdict in verdicts)
    screen.print(f"{len(verdicts) - wrong} of {len(verdicts)} episodes agree")
    return exit_status(verdicts)


def push(
    folder: Annotated[Path, typer.Argument(help="Folder of a finished dataset.")],
    repo_id: Annotated[str, typer.Option(help="Where to, user/name on the Hugging Face hub.")],
    private: Annotated[bool | None, typer.Option(help="Whether a repository that has to be made is private.")] = None,
    hdf5: Annotated[bool, typer.Option("--hdf5", help="Upload the HDF5 files as well.")] = False,
) -> int:
    """Upload a dataset to the Hugging Face hub. The token is that of `hf auth login` or HF_TOKEN. The same command
    continues a broken upload. Files of an earlier dataset there are deleted.
    """
    from lerobot_memobench.datasets.push import push as run

    screen = console()
    address = run(
        folder, repo_id, private=private, hdf5=hdf5, tell=lambda said: screen.print(said, soft_wrap=True, markup=False)
    )
    screen.print(f"dataset: {address}", soft_wrap=True)
    return 0


def describe(
    folder: Annotated[Path, typer.Argument(help="Folder of a finished dataset.")],
    out: Annotated[Path | None, typer.Option(help="Where to; DATASET/description when left out.")] = None,
    suite: OfSuite = None,
) -> int:
    """Keep of a dataset what fits into a repository. Figures, the card's tables, the hash of every episode."""
    from lerobot_memobench.datasets.describe import describe as run
    from lerobot_memobench.datasets.lerobot_format.reading import check_suite_of

    if suite is not None:
        check_suite_of(folder, suite)
    screen = console()
    for file in run(folder, out or folder / "description", say=screen.print):
        screen.print(str(file), soft_wrap=True)
    return 0
