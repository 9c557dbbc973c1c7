"""Rollouts recorded as LeRobotDatasets (``eval.recording=true``), under the names of columns that policies train on.

LeRobot's own recorder begins each dataset anew with every batch, which ends at the second one, and takes columns by the
environment's names, of which ``pixels/image`` cannot be one. Folders are as LeRobot's: a dataset per task and, where
several environments run at once, per row of the batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.utils.constants import ACTION, OBS_PREFIX
from numpy.typing import NDArray

from lerobot_memobench.datasets.lerobot_format.layout import PRIVILEGED, without_pattern
from lerobot_memobench.envs.observations import BOTH, policy_names
from lerobot_memobench.protocol import CLOCK

REPOSITORY = "eval_recording"


class Recorder:
    """The datasets of one batch of rollouts, which go on with those of the batches before it.

    Args:
        folder: where they are, or will be.
        features: of the environment, by its own names.
        rows: environments of the batch.
        fps: control steps per second.
        repository, private: where they are pushed to; nowhere when None.
    """

    def __init__(
        self,
        folder: Path,
        features: Mapping[str, PolicyFeature],
        rows: int,
        fps: int,
        repository: str | None = None,
        private: bool = False,
    ) -> None:
        names = policy_names(BOTH)
        if any(feature.type is FeatureType.VISUAL for feature in features.values()):
            names |= {"environment_state": PRIVILEGED}  # as in our datasets: true poses are no input beside pictures
        self._names = {key: names.get(key, key) for key in features if key != ACTION}
        self._repository, self._private = repository, private
        columns = _columns({names.get(key, key): feature for key, feature in features.items()})
        self._datasets = [
            _begun_or_gone_on_with(
                folder / f"env_{row}" if rows > 1 else folder,
                f"{repository or REPOSITORY}_env_{row}" if rows > 1 else repository or REPOSITORY,
                columns,
                fps,
            )
            for row in range(rows)
        ]
        self._over = np.zeros(rows, bool)

    def add(
        self,
        observation: Mapping[str, Any],
        action: NDArray[np.float32],
        reward: NDArray[Any],
        success: NDArray[np.bool_],
        done: NDArray[np.bool_],
        tasks: Sequence[str],
        broken: NDArray[np.bool_],
    ) -> None:
        """Append one control step of each row whose episode runs; all arrays have the rows first.

        Args:
            observation: the environment's, before the action.
            done: whether the row's episode ends by this step.
            tasks: instruction of each row.
            broken: whether this step broke the row's episode off: of such an episode nothing is kept.
        """
        for row, dataset in enumerate(self._datasets):
            if self._over[row]:
                continue
            if not dataset.has_pending_frames() and done[row]:
                self._over[row] = True  # an episode that the log held already: it rests, and ends at its first step
                continue
            if broken[row]:
                dataset.clear_episode_buffer()
                self._over[row] = True
                continue
            frame: dict[str, Any] = {name: _value(observation, key, row) for key, name in self._names.items()}
            frame |= {name: observation[name.removeprefix(OBS_PREFIX)][row] for name in CLOCK}
            frame |= {ACTION: action[row], "task": tasks[row]}
            frame["next.reward"] = np.array([reward[row]], np.float32)
            frame |= {"next.success": np.array([success[row]]), "next.done": np.array([done[row]])}
            dataset.add_frame(frame)
            if done[row]:
                dataset.save_episode(parallel_encoding=False)  # this process draws: none may be forked from it
                self._over[row] = True

    def close(self) -> None:
        """Make the datasets whole, without episodes that are not over, and push them where that was asked for."""
        for dataset in self._datasets:
            if dataset.has_pending_frames():
                dataset.clear_episode_buffer()
            dataset.finalize()
            if self._repository is not None and dataset.num_episodes:
                dataset.push_to_hub(private=self._private)


def _begun_or_gone_on_with(root: Path, repository: str, columns: dict[str, Any], fps: int) -> LeRobotDataset:
    if (root / "meta" / "info.json").is_file():
        return LeRobotDataset.resume(repository, without_pattern(root))
    return LeRobotDataset.create(repository, fps, columns, root=root, use_videos=True)


def _columns(features: Mapping[str, PolicyFeature]) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of a recording's columns."""

    def column(dtype: str, shape: Sequence[int] = (1,), names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": tuple(shape), "names": names}

    found = {
        key: column("video", feature.shape, ["height", "width", "channels"])
        if feature.type is FeatureType.VISUAL
        else column("float32", feature.shape)
        for key, feature in features.items()
    }
    return {
        **found,
        **dict.fromkeys(CLOCK, column("float32")),
        "next.reward": column("float32"),
        "next.success": column("bool"),
        "next.done": column("bool"),
    }


def _value(observation: Mapping[str, Any], key: str, row: int) -> NDArray[Any]:
    """Return a row of what an observation holds under a name such as ``pixels/image``."""
    value: Any = observation
    for part in key.split("/"):
        value = value[part]
    picked: NDArray[Any] = value[row]
    return picked if picked.dtype == np.uint8 else picked.astype(np.float32)
