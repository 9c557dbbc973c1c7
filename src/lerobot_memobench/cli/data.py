"""``memobench generate``, ``convert``, ``cache``, ``view``, ``validate``, ``describe`` and ``push``: datasets."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from lerobot_memobench.cli.console import AnySuite, SuiteOption, Workers, console, counting, say, table
from lerobot_memobench.envs.settings import OBS_TYPES
from lerobot_memobench.errors import MemobenchError, check_choice, count_of
from lerobot_memobench.evaluation.tables import Unbroken
from lerobot_memobench.sim.convention import CONVENTIONS, UPRIGHT
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks
from lerobot_memobench.tasks.task import LIBERO_SUITES, PUBLISHED

if TYPE_CHECKING:
    from lerobot_memobench.datasets.validate import CheckResult
    from lerobot_memobench.jobs.processes import Advance


Convention = Annotated[str, typer.Option(help="Images upright, or libero: mirrored and named as in LIBERO's data.")]
RepoId = Annotated[str | None, typer.Option(help="Name of the dataset, user/name.")]
Finished = Annotated[Path, typer.Argument(help="Folder of a finished dataset.")]
OfSuite = Annotated[
    AnySuite | None, typer.Option(help="Refuse a dataset that holds tasks of another suite; any when left out.")
]


def generate(
    out: Annotated[Path, typer.Option(help="Folder of the dataset that is made.")],
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    suite: SuiteOption = PUBLISHED,
    episodes: Annotated[int, typer.Option(min=1, help="Demonstrations per task.")] = 50,
    prompted_episodes: Annotated[
        int | None, typer.Option(min=1, help="Demonstrations per task that begins with a prompt, if not --episodes.")
    ] = None,
    seed_base: Annotated[int, typer.Option(help="Demonstration i uses the seed seed_base + i.")] = 10_000,
    referent: Annotated[
        Literal["fixed", "random"], typer.Option(help="fixed: the catalogue's goal; random: the seed decides.")
    ] = "fixed",
    images: Annotated[bool, typer.Option(help="Record both cameras.")] = True,
    image_size: Annotated[int, typer.Option(min=16, help="Height and width of the images, pixels.")] = 256,
    demonstration_prompt: Annotated[bool, typer.Option(help="Begin with the prompt where a task has one.")] = True,
    perturb: Annotated[
        bool, typer.Option("--perturb", help="Disturb the arm at random; actions are the expert's corrections.")
    ] = False,
    convention: Convention = UPRIGHT,
    workers: Workers = 1,
    repo_id: RepoId = None,
    finish: Annotated[
        bool, typer.Option("--finish", help="Make the dataset of an unfinished run's episodes, and no other episode.")
    ] = False,
) -> int:
    """Make a LeRobotDataset of expert demonstrations. The same command continues a killed run."""
    if suite in LIBERO_SUITES:
        raise MemobenchError(
            f"--suite {suite}: LIBERO's tasks have no scripted expert, so no demonstrations can be made; its own are "
            "the dataset lerobot/libero"
        )
    chosen = [get_task(name) for name in resolve_tasks(tasks, suite)]
    from lerobot_memobench.datasets.generate import episodes_of
    from lerobot_memobench.datasets.generate import generate as run

    screen = console()
    total = sum(episodes_of(task, episodes, prompted_episodes) for task in chosen)
    with counting(screen, "episodes", total) as count:

        def advance(news: Advance) -> None:
            what = f"{news.task_name}, seed {news.seed}"
            count(news.done, news.total, what, trouble=news.failure, found=news.found)

        summary = run(
            chosen,
            episodes,
            out,
            prompted_episodes=prompted_episodes,
            seed_base=seed_base,
            referent=referent,
            images=images,
            image_size=image_size,
            demonstration_prompt=demonstration_prompt,
            perturb=perturb,
            convention=convention,
            workers=workers,
            finish=finish,
            progress=advance,
            notify=partial(screen.print, soft_wrap=True),
            **({} if repo_id is None else {"repo_id": repo_id}),
        )
    rows = table("task", "solved", "of", "frames", "mean length", right=("solved", "of", "frames", "mean length"))
    for name in summary.tasks:
        of_task = [episode for episode in summary.episodes if episode.task_name == name]
        frames = [episode.frames for episode in of_task if episode.failure is None]
        mean = f"{sum(frames) / len(frames):.0f}" if frames else "–"
        rows.add_row(name, str(len(frames)), str(len(of_task)), str(sum(frames)), mean)
    console().print(Unbroken(rows), crop=False)
    for episode in summary.failures:
        say(f"no demonstration of {episode.task_name}, seed {episode.seed}: {episode.failure}")
    written = f"dataset: {summary.folder}"
    say("no dataset was written: no seed was solved" if summary.folder is None else written)
    return 1 if summary.failures else 0


def convert(
    source: Annotated[
        Path, typer.Argument(help="HDF5 file in the published layout, or a folder or a zip archive of them.")
    ],
    out: Annotated[Path, typer.Option(help="Folder of the dataset that is made.")],
    convention: Convention = UPRIGHT,
    workers: Workers = 1,
    repo_id: RepoId = None,
) -> int:
    """Turn HDF5 demonstrations into a LeRobotDataset.

    Those that cannot be used are named. The same command continues a killed run.
    """
    from lerobot_memobench.datasets.convert import convert as run

    screen = console()
    with counting(screen, "episodes") as count:

        def advance(news: Advance) -> None:
            count(news.done, news.total, f"{news.task_name}, demo_{news.seed}", found=news.found)

        summary = run(
            source,
            out,
            convention=convention,
            workers=workers,
            progress=advance,
            notify=partial(screen.print, soft_wrap=True),
            **({} if repo_id is None else {"repo_id": repo_id}),
        )
    for problem in summary.problems:
        say(f"left out: {problem}")
    for note in summary.notes:
        say(f"note: {note}")
    written = f"dataset of {count_of(summary.episodes, 'episode')}: {summary.folder}"
    say("no dataset was written: no demonstration could be used" if summary.folder is None else written)
    return summary.exit_status


def cache(
    dataset: Annotated[Path, typer.Argument(help="Folder of a LeRobotDataset with the benchmark's columns.")],
    size: Annotated[str, typer.Option(help="Size of the policy that reads it: tiny, small or pi05.")] = "tiny",
    stride: Annotated[
        int | None,
        typer.Option(min=1, help="Keep every how many frames (policy.memory_stride); 8 at size small, else 1."),
    ] = None,
    perception: Annotated[
        str, typer.Option(help="pixels; or objects, detected in the images (policy.perception).")
    ] = "pixels",
    detector: Annotated[
        str | None, typer.Option(help="With objects, the detector (policy.detector): package or a file.")
    ] = None,
    visual_encoder: Annotated[
        str | None, typer.Option(help="At size small, the encoder of images (policy.visual_encoder); the package's.")
    ] = None,
    weights: Annotated[str | None, typer.Option(help="Folder or repository with the image tower (size pi05).")] = None,
    device: Annotated[str | None, typer.Option(help="cuda or cpu; the best there is by default.")] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Frames per pass of the image tower.")] = 64,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Threads that decode videos; as many as there are cores by default.")
    ] = None,
) -> None:
    """Encode a dataset once for policies with a memory. Its frames and its subgoals."""
    from lerobot_memobench.policies.checkpoint import check_device, quiet
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
    from lerobot_memobench.training.features import cache_dataset

    check_device(device)
    with quiet():
        options: dict[str, Any] = {} if stride is None else {"memory_stride": stride}
        config = MemobenchMemConfig(
            size=size, perception=perception, detector=detector, visual_encoder=visual_encoder, device=device, **options
        )
    screen = console()
    with counting(screen, "episodes") as count:
        folder = cache_dataset(
            dataset,
            config,
            weights=weights,
            batch_size=batch_size,
            workers=workers,
            progress=count,
            notify=partial(screen.print, soft_wrap=True),
        )
    say(f"feature cache: {folder}")


def view(
    dataset: Annotated[Path, typer.Argument(help="Folder of a LeRobotDataset.")],
    out: Annotated[Path, typer.Option(help="Folder to write; its videos are links to the dataset's.")],
    obs_type: Annotated[
        str | None, typer.Option(help=f"Inputs: {', '.join(OBS_TYPES)}; images if there are some by default.")
    ] = None,
    prompts: Annotated[bool, typer.Option(help="Keep the frames of demonstration prompts and holds.")] = False,
    convention: Annotated[
        str | None, typer.Option(help="Images upright, or libero: mirrored. Those of the dataset by default.")
    ] = None,
) -> None:
    """Write a dataset for lerobot-train. Without prompt and held frames, and with columns of chosen inputs."""
    from lerobot_memobench.datasets.episodes import read_info
    from lerobot_memobench.training.trainer import view_options, write_view

    if obs_type is not None:
        check_choice("obs_type", obs_type, OBS_TYPES)
    if convention is not None:
        check_choice("convention", convention, [*CONVENTIONS])
    options = view_options(None, read_info(dataset)["features"], prompts, obs_type)
    write_view(dataset, out, replace(options, convention=convention))
    say(f"view: {out}")


def validate(folder: Finished, workers: Workers = 1, suite: OfSuite = None) -> int:
    """Replay every episode and read every file to its end.

    The first disagreement of each is reported, and files that were written again.
    """
    from lerobot_memobench.datasets.episodes import check_suite_of
    from lerobot_memobench.datasets.validate import validate as run

    if suite is not None:
        check_suite_of(folder, suite)
    with counting(console(), "episodes") as count:

        def advance(done: int, total: int, result: CheckResult) -> None:
            count(done, total, result.subject, trouble=result.disagreement)

        results = run(folder, workers=workers, progress=advance)
    for result in results:
        if result.note is not None:
            say(f"note: {result.subject}: {result.note}")
    episodes, files = ([r.disagreement for r in results if r.of_file == of_file] for of_file in (False, True))
    damaged = ", and files of the dataset do not (above)" if any(files) else ""
    say(f"{episodes.count(None)} of {len(episodes)} episodes agree{damaged}")
    return 1 if any(episodes) or any(files) else 0


def push(
    folder: Finished,
    repo_id: Annotated[str, typer.Option(help="Where to, user/name on the Hugging Face hub.")],
    private: Annotated[bool | None, typer.Option(help="Whether a repository that has to be made is private.")] = None,
) -> int:
    """Upload a dataset to the Hugging Face hub. The token is that of `hf auth login` or HF_TOKEN. The same command
    continues a broken upload. Files of an earlier dataset there are deleted.
    """
    from lerobot_memobench.datasets.card import push as run

    say(f"dataset: {run(folder, repo_id, private=private, notify=say)}")
    return 0


def describe(
    folder: Finished,
    out: Annotated[Path | None, typer.Option(help="Where to; DATASET/description when left out.")] = None,
    suite: OfSuite = None,
) -> int:
    """Summarise a dataset. The card's tables and the hash of every episode, small enough to commit."""
    from lerobot_memobench.datasets.card import describe as run
    from lerobot_memobench.datasets.episodes import check_suite_of

    if suite is not None:
        check_suite_of(folder, suite)
    for file in run(folder, out or folder / "description", notify=say):
        say(file)
    return 0
