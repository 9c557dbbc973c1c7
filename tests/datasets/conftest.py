"""Synthetic tasks and demonstrations: no simulator, small images, hand-made truth tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Checkpoint, Task

MakeTask = Callable[..., Task]
MakeDemo = Callable[..., Demonstration]


@pytest.fixture(autouse=True, scope="module")
def _own_datasets_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep Arrow copies of test datasets out of the user's cache."""
    import datasets

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path_factory.mktemp("hf_datasets_cache"))
        yield


@pytest.fixture(scope="session")
def make_task() -> MakeTask:
    def make(operations: str = "SUC", name: str = "synthetic_task", memory_type: str = "temporal") -> Task:
        checkpoints = tuple(
            Checkpoint(
                Atom("open", (f"drawer_{k}",)),
                (operation, operation, operation),  # type: ignore[arg-type]
                (f"coarse {k}", f"did thing {k}", f"did thing {k} with the left hand"),
            )
            for k, operation in enumerate(operations)
        )
        return Task(
            name=name,
            memory_type=memory_type,  # type: ignore[arg-type]
            family="synthetic",
            language=f"do the {name.replace('_', ' ')}",
            objects={},
            fixtures={},
            regions={},
            init=(),
            objects_of_interest=(),
            goal=Atom("open", ("drawer_0",)),
            checkpoints=checkpoints,
            prompt=None,
            variants=(),
            demo_summary="",
            folder=Path(name),
            bddl_text=name,
            metadata={},
        )

    return make


@pytest.fixture(scope="session")
def make_demo(make_task: MakeTask) -> MakeDemo:
    """Return a function of a truth table: ``rows[k]`` is a string of 0 and 1, one character per frame."""

    def make(
        rows: list[str],
        *,
        task: Task | None = None,
        seed: int = 10_000,
        exec_start: int = 0,
        size: int | None = None,
        state_dim: int = 5,
        success: bool = True,
    ) -> Demonstration:
        task = task or make_task("SUC"[: len(rows)])
        length = len(rows[0])
        rng = np.random.default_rng(seed)
        images = None
        if size is not None:
            images = {name: moving_images(length, size, rng) for name in ("image", "wrist_image")}
        return Demonstration(
            task=task,
            seed=seed,
            referent="fixed",
            variant=0,
            states=rng.normal(size=(length, state_dim)),
            actions=rng.uniform(-1, 1, size=(length, 7)).astype(np.float32),
            proprio=rng.normal(size=(length, 8)).astype(np.float32),
            images=images,
            exec_start=exec_start,
            satisfied=np.array([[c == "1" for c in row] for row in rows], dtype=np.bool_).T,
            success=success,
            fixture_poses={"cabinet": np.arange(7.0)},
            scene_hash="abc",
            objects=rng.normal(size=(length, SIZE)).astype(np.float32),
        )

    return make


def moving_images(length: int, size: int, rng: np.random.Generator) -> np.ndarray:
    """(T, size, size, 3) uint8: a smooth picture and a bar whose column tells the frame number."""
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    phase = rng.uniform(0, 6, size=3)
    base = np.stack([0.5 + 0.3 * np.sin(4 * x + 3 * y + p) for p in phase], axis=-1)
    frames = np.repeat((base * 255).astype(np.uint8)[None], length, axis=0)
    for t in range(length):
        left = (t * 4) % (size - 4)
        frames[t, :, left : left + 4] = 255
    return frames
