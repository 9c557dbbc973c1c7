"""Synthetic and simulated demonstrations and datasets; tests do not change them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.datasets.demonstration import Demonstration, labels, persistent_rows
from lerobot_memobench.datasets.episodes import DemonstrationRecord, RecordedEpisode
from lerobot_memobench.datasets.layout import EXECUTED_ACTION, LANGUAGE, OBJECTS
from lerobot_memobench.datasets.write import write_dataset
from lerobot_memobench.sim.object_layout import SIZE
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Checkpoint, Task
from tests.support.short_demonstrations import drawn_steps, record_demonstration, with_images

STOVE = "turn_on_the_stove_and_turn_it_off"
BUTTER = "put_the_butter_into_the_bowl_from_the_prompt_video"
FRAMES = 6
"""Length of the demonstrations of `simulated`, whose prompts take 2."""

MakeTask = Callable[..., Task]
MakeDemo = Callable[..., Demonstration]


@pytest.fixture(autouse=True, scope="session")
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
        return replace(
            get_task(STOVE),
            name=name,
            memory_type=memory_type,  # type: ignore[arg-type]
            family="synthetic",
            language=f"do the {name.replace('_', ' ')}",
            checkpoints=checkpoints,
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
        length = len(rows[0])
        rng = np.random.default_rng(seed)
        images = None if size is None else {name: moving_images(length, size, rng) for name in ("image", "wrist_image")}
        return Demonstration(
            task=task or make_task("SUC"[: len(rows)]),
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


def as_recorded(demo: Demonstration) -> RecordedEpisode:
    """Return a demonstration as `read_episode` would read it."""
    columns, record = labels(demo), DemonstrationRecord.of(demo)
    frames = {"states": demo.states, "observation.state": demo.proprio, OBJECTS: demo.objects}
    frames |= {"action": demo.actions, EXECUTED_ACTION: demo.applied, **columns}
    frames[LANGUAGE] = [persistent_rows(columns)] * len(demo)
    return RecordedEpisode(record, frames, 0)


def moving_images(length: int, size: int, rng: np.random.Generator) -> np.ndarray:
    """Return (T, size, size, 3) uint8 images: a smooth background and a bar whose column encodes the frame number."""
    x, y = np.meshgrid(np.linspace(0, 1, size), np.linspace(0, 1, size))
    base = np.stack([0.5 + 0.3 * np.sin(4 * x + 3 * y + p) for p in rng.uniform(0, 6, size=3)], axis=-1)
    frames = np.repeat((base * 255).astype(np.uint8)[None], length, axis=0)
    for t in range(length):
        left = (t * 4) % (size - 4)
        frames[t, :, left : left + 4] = 255
    return frames


@pytest.fixture(scope="session")
def demos(make_demo: MakeDemo, make_task: MakeTask) -> list[Demonstration]:
    """Three synthetic episodes of two tasks; the last two begin with a demonstration prompt of 5 frames."""
    second = make_task("SU", name="other_task", memory_type="object")
    a = ["0" * 8 + "1" * 17, "0" * 20 + "1" * 5]
    b = ["0" * 9 + "1" * 21, "0" * 29 + "1"]
    return [
        make_demo(a, seed=10_000, size=64),
        make_demo(b, task=second, seed=10_000, exec_start=5, size=64, state_dim=8),
        make_demo(b, task=second, seed=10_001, exec_start=5, size=64, state_dim=8),
    ]


@pytest.fixture(scope="session")
def synthetic(demos: list[Demonstration], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(demos, tmp_path_factory.mktemp("synthetic") / "ds", repo_id="local/test")


@pytest.fixture(scope="session")
def shown() -> list[Demonstration]:
    """Two short episodes of the simulator with images; the second one is perturbed."""
    first, second = (with_images(drawn_steps(BUTTER, seed, FRAMES, 2), 32) for seed in (10_000, 10_001))
    return [first, replace(second, executed=second.actions, actions=second.actions * np.float32(0.5))]


@pytest.fixture(scope="session")
def simulated(shown: list[Demonstration], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(shown, tmp_path_factory.mktemp("simulated") / "ds")


@pytest.fixture(scope="session")
def stove() -> Demonstration:
    """Demonstration of the expert, with small images."""
    return record_demonstration(get_task(STOVE), 10_000, image_size=32)


@pytest.fixture
def copy(tmp_path: Path) -> Callable[[Path], Path]:
    return lambda folder: Path(shutil.copytree(folder, tmp_path / "copies" / f"{len(list(tmp_path.glob('*/*')))}"))
