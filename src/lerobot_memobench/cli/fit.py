"""``memobench fit``: whether a training fits the GPUs and the disk that are there."""

from __future__ import annotations

from typing import Annotated

import typer
from rich.table import Table
from rich.text import Text

from lerobot_memobench.cli.console import console, say
from lerobot_memobench.errors import MemobenchError

VERDICTS = {True: ("fits", "green"), None: ("try it", "yellow"), False: ("no", "red")}


def fit(
    settings: Annotated[
        list[str],
        typer.Argument(
            help="what `lerobot train` would be given: config=train_paper batch_size=16 …", metavar="key=value"
        ),
    ],
    gpus: Annotated[int, typer.Option(min=1, help="GPUs that train together, one process on each.")] = 1,
    gpu_memory: Annotated[
        float | None, typer.Option(min=1, help="GiB of one, as nvidia-smi shows it.", metavar="GiB")
    ] = None,
) -> int:
    """Count what a training needs of a GPU and the disk. Nothing is loaded. Status 1 where no way to train
    memobench_mem fits.
    """
    from lerobot_memobench.run.arguments import read_arguments, resolve_recipe, split_arguments
    from lerobot_memobench.run.gpu_memory import GIB, OVERHEAD, disk, training_of
    from lerobot_memobench.run.training import check_numbers, with_own_memory

    arguments = with_own_memory(read_arguments("train", resolve_recipe(split_arguments(settings))))
    check_numbers(arguments)
    training = training_of(arguments, gpus)
    if training is None:
        raise MemobenchError("only trainings of policy=memobench_mem are counted; name one, as config=train_paper")
    parts = ("weights", "frozen", "optimizer", "average", "gradients", "buckets", "copies", "activations")
    table = Table(title=f"batch_size={training.batch} on {gpus} × GPU, GiB of each", title_justify="left")
    table.add_column("", no_wrap=True)
    for name in (*parts, "peak"):
        table.add_column(name, justify="right", no_wrap=True)
    found = training.ways()
    card = None if gpu_memory is None else round(gpu_memory * GIB)
    if card is not None:
        table.add_column(f"of {gpu_memory:g}")
    for one in found:
        numbers = [*(getattr(one, part) for part in parts), one.peak + OVERHEAD]
        verdict = [] if card is None else [Text(*VERDICTS[one.fits(card)])]
        table.add_row(one.way, *(f"{number / GIB:.1f}" for number in numbers), *verdict)
    console().print(table)
    written = disk(training)
    say(
        f"disk: {written.checkpoints} × checkpoint of {written.checkpoint / GIB:.0f} GiB, feature cache of "
        f"{training.frames:,} frames {written.cache / GIB:.0f} GiB; together {written.total / GIB:.0f} GiB"
    )
    return 1 if card is not None and all(one.fits(card) is False for one in found) else 0
