"""``memobench submit`` and ``export``: results for the board of this benchmark and for the Hugging Face hub."""

from __future__ import annotations

import datetime as dt
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import say
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file


def submit(
    card: Annotated[Path, typer.Argument(help="The folder of a finished evaluation.")],
    name: Annotated[str, typer.Option(help="Name of the row's folder: lower-case letters, digits, _ and -.")] = "",
    model: Annotated[str, typer.Option(help="Name of the policy, as the board shows it.")] = "",
    submitter: Annotated[str, typer.Option(help="You or your team; @name for a GitHub account.")] = "",
    training_data: Annotated[str, typer.Option(help="Origin and number of the demonstrations, in a few words.")] = "",
    check: Annotated[
        bool, typer.Option(help="Check only: any tasks and episodes, no name or model; write nothing.")
    ] = False,
    parameters: Annotated[int | None, typer.Option(min=0, help="Number of parameters; 0 for a script.")] = None,
    code: Annotated[str | None, typer.Option(help="Address of the code, https://…")] = None,
    weights: Annotated[str | None, typer.Option(help="Address of the weights, https://…")] = None,
    paper: Annotated[str | None, typer.Option(help="Address of the paper, https://…")] = None,
    pauses: Annotated[
        Path | None, typer.Option(help="Folder of an evaluation of the same policy with pause_steps=100.")
    ] = None,
    without_memory: Annotated[
        str | None, typer.Option(help="Row of the board with a partner that has no memory.", metavar="NAME")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the submission and the text of the pull request.")] = Path(
        "outputs/board"
    ),
) -> None:
    """Check a result by the rules of the board, and write its submission.

    It consists of a folder for results/board and the text of a pull request.
    """
    from lerobot_memobench.board.rules import check_control, check_evaluation
    from lerobot_memobench.board.submission import (
        BOARD,
        LINKS,
        PAUSES,
        About,
        RowName,
        own_evaluation,
        pull_request,
        write_submission,
    )
    from lerobot_memobench.io import checked, count_of

    given = {"--name": name, "--model": model, "--submitter": submitter, "--training-data": training_data}
    if missing := [option for option, text in given.items() if not (text or check)]:
        raise MemobenchError(f"a submission needs {', '.join(missing)}; to check a result alone, give --check")
    if check:
        name, model, submitter, training_data = (text or "unnamed" for text in (name, model, submitter, training_data))
    checked(name, RowName)
    links = dict(zip(LINKS, (code, weights, paper), strict=True))
    about = checked(
        {
            **{"model": model, "submitter": submitter, "date": f"{dt.date.today()}", "training_data": training_data},
            **{"parameters": parameters, "without_memory": without_memory},
            "links": {key: link for key, link in links.items() if link is not None},
        },
        About,
    )
    evaluation = own_evaluation(card)
    check_evaluation(evaluation, part=check)
    if pauses:
        check_control(evaluation, own_evaluation(pauses), PAUSES, part=check)
    if check:
        return say(f"accepted: {count_of(len(evaluation.records), 'rollout')} of {card}; nothing is written")
    write_submission(out / name, about, {"": card, **({PAUSES: pauses} if pauses else {})})
    say(f"accepted: {out / name}")
    say(f"text of the pull request: {write_file(out / f'{name}.md', pull_request(name, about, evaluation))}")
    say(f"next: copy {out / name} to {BOARD / name} in a copy of the repository, check it there by")
    say(f"`python -m tools.board {BOARD}`, and open the pull request")


def export(
    card: Annotated[Path, typer.Argument(help="The folder of an evaluation, or of a row of the board.")],
    dataset: Annotated[str, typer.Option(help="Repository of the benchmark's dataset on the hub, user/name.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder of the model's repository; the text is printed when left out.")
    ] = None,
) -> None:
    """Export a result for the page of a model on the Hugging Face hub, .eval_results/memobench.yaml."""
    from lerobot_memobench.evaluation.records import read_runs
    from lerobot_memobench.evaluation.report import HUB_FILE, huggingface_yaml

    (run,) = read_runs([card])
    text = huggingface_yaml(run, dataset)
    if out is None:
        print(text, end="")
        return
    (out / HUB_FILE).parent.mkdir(parents=True, exist_ok=True)
    say(write_file(out / HUB_FILE, text))
