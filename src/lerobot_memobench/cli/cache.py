"""``memobench cache``: a dataset's frames, encoded once for policies with a memory."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lerobot_memobench.cli.console import console, counting


def cache(
    dataset: Annotated[Path, typer.Argument(help="Folder of a LeRobotDataset with the benchmark's columns.")],
    size: Annotated[str, typer.Option(help="Size of the policy that reads it: tiny, small or pi05.")] = "tiny",
    stride: Annotated[
        int | None, typer.Option(min=1, help="Keep every how many frames (policy.memory_stride); 8 with eyes, else 1.")
    ] = None,
    perception: Annotated[
        str, typer.Option(help="pixels; or objects, which eyes find in the pictures (policy.perception).")
    ] = "pixels",
    eyes: Annotated[
        str | None, typer.Option(help="Eyes (policy.eyes): package or a file; at size small the package's by default.")
    ] = None,
    weights: Annotated[
        str | None, typer.Option(help="Folder or repository whose image tower is used (size pi05).")
    ] = None,
    device: Annotated[str | None, typer.Option(help="cuda or cpu; the best there is by default.")] = None,
    batch_size: Annotated[int, typer.Option(min=1, help="Frames per pass of the image tower.")] = 64,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for memory caches (policy.memory_cache_dir); memory_cache in the dataset's by default."
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Threads that decode videos; as many as there are cores by default.")
    ] = None,
) -> None:
    """Encode a dataset once for policies with a memory. Its frames and its subgoals."""
    from lerobot_memobench.envs.prompting import quiet
    from lerobot_memobench.policies.memobench_mem.caching import cache_dataset
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

    with quiet():
        place = None if out is None else str(out)
        given: dict[str, Any] = {} if stride is None else {"memory_stride": stride}
        config = MemobenchMemConfig(
            size=size, perception=perception, eyes=eyes, memory_cache_dir=place, device=device, **given
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
            tell=lambda said: screen.print(said, soft_wrap=True),
        )
    screen.print(f"memory cache: {folder}", soft_wrap=True)
