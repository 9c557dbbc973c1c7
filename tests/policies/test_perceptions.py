"""What every perception keeps: a rollout remembers what training reads, and a checkpoint acts as its policy did.

The five: pi0.5's image tower, tokens of the visual encoder, privileged object state, that with detection noise, and
detections in images.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.fusion import Reading
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.features import FOLDER
from tests.support.memory import remembered, trained_on
from tests.support.object_dataset import make_object_dataset
from tests.support.picture_rollouts import STARTS, made_detector, pictures_of
from tests.support.small_policy import batch_of, losses_in_training, made_for_training
from tests.support.synthetic_dataset import CAMERAS

WORDS = ("observation.language.tokens", "observation.language.attention_mask")


@dataclass(frozen=True)
class Perception:
    """A way to perceive: the policy's settings, what of the observation it needs, and how far roundings may go."""

    fields: dict[str, Any]
    needs: str
    rounding: float = 0.0
    """Largest difference between training and rollout, as a share of the largest number."""


OBJECTS = {"size": "small", "perception": "objects"}
PERCEPTIONS = {
    "image tower": Perception({"size": "tiny"}, CAMERAS[0], 2**-7),
    "visual encoder": Perception({"size": "small", "visual_encoder": "FILE"}, CAMERAS[1], 2**-7),
    "privileged objects": Perception(OBJECTS, OBS_ENV_STATE),
    "detection noise": Perception(OBJECTS | {"detection_noise": 1.0}, OBS_ENV_STATE),
    "detections": Perception(OBJECTS | {"detector": "FILE"}, CAMERAS[1], 2**-14),
}


@dataclass
class Case:
    """A perception with a dataset for it, whose caches are made once."""

    of: Perception
    root: Path
    fields: dict[str, Any]

    @cached_property
    def shared(self) -> Any:
        """Policy, preprocessor, postprocessor and dataset, for all tests that do not mind its weights."""
        return self.made()

    def made(self, **more: Any) -> Any:
        """The same, new, with other settings."""
        return made_for_training(self.root, **self.fields | more)

    def observed(self, dataset: Any, index: int) -> dict[str, Any]:
        """A rollout's observation at a frame of the dataset."""
        row = dataset.hf_dataset[index]
        numbers = {key: row[key][None] for key in (OBS_STATE, OBS_ENV_STATE) if key in row}
        step = float(index - STARTS[int(np.searchsorted(STARTS, index, "right")) - 1])
        clock = {
            "observation.step": torch.tensor([step]),
            "observation.phase": row["observation.phase"].reshape(1).float(),
        }
        pictures = {} if OBS_ENV_STATE in row else pictures_of(self.root, index)
        return {**pictures, **numbers, **clock, "task": [dataset.meta.tasks.index[int(row["task_index"])]]}


@pytest.fixture(scope="module")
def cases(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    folder = tmp_path_factory.mktemp("perceptions")
    pictures = shutil.copytree(dataset_root, folder / "pictures", ignore=shutil.ignore_patterns(FOLDER))
    objects, detector = make_object_dataset(folder / "objects"), made_detector(folder / "detector.safetensors", 1)
    shared = {"n_action_steps": 3, "memory_stride": 2}
    return {
        name: Case(
            one,
            objects if one.needs == OBS_ENV_STATE else pictures,
            shared | {key: str(detector) if value == "FILE" else value for key, value in one.fields.items()},
        )
        for name, one in PERCEPTIONS.items()
    }


@pytest.fixture(params=PERCEPTIONS)
def case(request: pytest.FixtureRequest, cases: dict[str, Case]) -> Case:
    return cases[request.param]


def apart(one: torch.Tensor, other: torch.Tensor) -> float:
    """The largest difference, as a share of the largest number."""
    one, other = one.detach().float(), other.detach().float()
    return float((one - other).abs().max() / other.abs().max())


def test_a_rollout_perceives_and_remembers_what_training_reads(case: Case) -> None:
    policy, before, _, dataset = case.shared
    policy.eval().reset()
    index = int(STARTS[1]) + 14
    trained = before(batch_of(dataset, [index]))
    for frame in range(int(STARTS[1]), index + 1):
        acted = before(case.observed(dataset, frame))
        policy.observe(acted)
    ((frames, steps),), ((learned, learned_steps),) = remembered(policy, [0]), trained_on(trained)
    assert steps == learned_steps
    assert apart(frames, learned) <= case.of.rounding
    assert apart(frames[0], frames[7]) > 4 * case.of.rounding, "moments differ"
    prefixes = []
    for batch in (trained, acted):
        prefix = policy.model.embed(policy._seen(batch | {key: trained[key] for key in WORDS}), Reading())
        prefixes.append(prefix.tokens[prefix.real])
    assert apart(*prefixes) <= 2 * case.of.rounding


@pytest.mark.parametrize("case", ["visual encoder", "detection noise"], indirect=True)
@pytest.mark.slow
def test_it_learns(case: Case) -> None:
    policy, before, _, dataset = case.made(chunk_size=4, memory_frames=4)
    losses = losses_in_training(policy, before(batch_of(dataset, [*range(8, 38, 4)])), updates=30)
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])


def needed(case: Case, made: Any) -> list[bool]:
    """Whether a rollout's policy needs each of the observations 1 to 6."""
    policy, before, _, dataset = made
    policy.eval().reset()
    found = []
    for step in range(6):
        policy.select_action(before(case.observed(dataset, int(STARTS[2]) + step)))
        found.append(policy.needs_observation())
    return found


def test_it_needs_what_is_remembered_and_what_is_acted_upon(case: Case) -> None:
    assert needed(case, case.shared) == [False, True, True, True, False, True]


@pytest.mark.parametrize("case", ["privileged objects"], indirect=True)
def test_without_a_memory_it_needs_what_is_acted_upon(case: Case) -> None:
    assert needed(case, case.made(memory_fusion="none")) == [False, False, True, False, False, True]


def test_an_observation_without_its_input_is_refused(case: Case) -> None:
    policy, before, _, dataset = case.shared
    policy.reset()
    observation = case.observed(dataset, int(STARTS[2]))
    del observation[case.of.needs]
    with pytest.raises(MemobenchError, match=rf"no '{case.of.needs}'"):
        policy.select_action(before(observation))


@pytest.mark.parametrize("case", ["visual encoder", "detections"], indirect=True)
def test_pictures_in_a_batch_change_nothing(case: Case) -> None:
    """LeRobot's own samples have them; the features of their frames count."""
    policy, before, _, dataset = case.shared
    decoded = torch.utils.data.default_collate([dataset.reader.get_item(45)])
    assert set(CAMERAS) <= decoded.keys()
    losses = []
    for batch in (decoded, {**decoded, **{name: 1 - decoded[name] for name in CAMERAS}}, batch_of(dataset, [45])):
        torch.manual_seed(0)
        losses.append(policy.train().forward(before(batch))[0].item())
    assert losses == [losses[0]] * 3


def test_a_checkpoint_acts_as_its_policy(case: Case, tmp_path: Path) -> None:
    policy, before, after, dataset = case.shared
    policy.train().forward(before(batch_of(dataset, [10, 30])))
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    again = MemobenchMemPolicy.from_pretrained(tmp_path)
    pre, _ = make_pre_post_processors(again.config, pretrained_path=str(tmp_path))
    assert again.perception.key == policy.perception.key
    policy.eval()
    actions: list[list[torch.Tensor]] = []
    for actor, step in ((policy, before), (again, pre)):
        actor.reset()
        torch.manual_seed(0)
        observations = [case.observed(dataset, int(STARTS[2]) + index) for index in range(5)]
        actions.append([actor.select_action(step(one)) for one in observations])
    assert all(torch.allclose(one, other, atol=1e-6) for one, other in zip(*actions, strict=True))
    assert actions[0][-1].any()
