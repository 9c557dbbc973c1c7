"""``memobench submit`` and ``export``: results for the board of this benchmark and for other boards."""

from __future__ import annotations

import datetime as dt
import tempfile
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import say
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file


class ExportFormat(StrEnum):
    """Formats of other boards."""

    LEROBOT = "lerobot"
    HUGGINGFACE = "huggingface"
    VLA_EVAL = "vla-eval"


FILES = {
    ExportFormat.LEROBOT: "eval_info.json",
    ExportFormat.HUGGINGFACE: ".eval_results/memobench.yaml",
    ExportFormat.VLA_EVAL: "leaderboard.json",
}


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
    """Check a result as the board's continuous integration does, and write its submission.

    It consists of a folder for results/board and the text of a pull request.
    """
    from lerobot_memobench.board.check import check_partners, check_submission, read_board
    from lerobot_memobench.board.rows import board_row
    from lerobot_memobench.board.submission import BOARD, LINKS, About, RowName, read_submission, write_submission
    from lerobot_memobench.board.text import pull_request
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
    sources = {key: folder for key, folder in (("", card), ("pauses", pauses)) if folder}
    others = [row for row in read_board(BOARD) if row.name != name] if BOARD.is_dir() else []
    with tempfile.TemporaryDirectory() as draft:
        written = write_submission(Path(draft) / "board" / name, about, sources)
        try:
            found = read_submission(written)
            check_submission(found, others, part=check)
        except MemobenchError as error:
            raise MemobenchError(str(error).replace(f"{written.parent}/", "")) from None
        check_partners([*others, found] if BOARD.is_dir() else [])
        if check:
            return say(f"accepted: {count_of(len(found.evaluation.records), 'rollout')} of {card}; nothing is written")
        text = pull_request(board_row(found, others))
        write_submission(out / name, about, sources)
    say(f"accepted: {out / name}")
    say(f"text of the pull request: {write_file(out / f'{name}.md', text)}")
    say(f"next: copy {out / name} to {BOARD / name} in a copy of the repository, and open the pull request")


def export(
    card: Annotated[Path, typer.Argument(help="The folder of an evaluation, or of a row of the board.")],
    as_: Annotated[ExportFormat, typer.Option("--as", help="lerobot, huggingface or vla-eval.")],
    dataset: Annotated[
        str | None, typer.Option(help="huggingface: repository of the benchmark's dataset, user/name.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the file; it is printed when left out.")] = None,
) -> None:
    """Export a result for LeRobot's comparison, Hugging Face or vla-evaluation-harness.

    These are eval_info.json, .eval_results/memobench.yaml of a model repository, and an entry of leaderboard.json.
    """
    from lerobot_memobench.board.exports import huggingface_yaml, lerobot_json, vla_eval_json
    from lerobot_memobench.evaluation.records import read_runs

    (run,) = read_runs([card])
    if as_ is ExportFormat.HUGGINGFACE:
        if dataset is None:
            raise MemobenchError("--as huggingface needs --dataset user/name, the benchmark's dataset on the Hub")
        text = huggingface_yaml(run, dataset)
    else:
        text = lerobot_json(run) if as_ is ExportFormat.LEROBOT else vla_eval_json(run)
    if out is None:
        print(text, end="")
        return
    file = out / FILES[as_]
    file.parent.mkdir(parents=True, exist_ok=True)
    say(write_file(file, text))
