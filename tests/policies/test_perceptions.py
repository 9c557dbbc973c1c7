"""Perceptions: training, rollouts and checkpoints agree for each of them; slots of objects; samples of tasks.

The five perceptions are pi0.5's image tower, the visual encoder, privileged object state, the same with detection
noise, and detections in images.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import make_pre_post_processors
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from scipy.spatial.transform import Rotation
from torch import Tensor

from lerobot_memobench.datasets.episodes import list_episodes
from lerobot_memobench.datasets.video import frame_reader
from lerobot_memobench.envs.observations import obs_type_of
from lerobot_memobench.envs.settings import PIXELS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, WIDTH, VisualEncoder
from lerobot_memobench.perception.weights import save_detector
from lerobot_memobench.policies.memobench_mem.encoders import encoded_key
from lerobot_memobench.policies.memobench_mem.fusion import MemoryPass
from lerobot_memobench.policies.memobench_mem.memory.mechanism import EXACT, FRAMES, PLACES
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.objects import (
    DETECTED,
    FALSE,
    FEATURES,
    KIND_MISSED,
    MISSED,
    OBS_RAW_STATE,
    VIEWS,
    ObjectEncoder,
    ObjectPool,
    SlotEncoder,
    frame_row,
    slot_features,
    with_detection_noise,
)
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, field
from lerobot_memobench.sim.object_layout import WIDTH as SLOT_WIDTH
from lerobot_memobench.sim.object_slots import classes, fill_slots
from lerobot_memobench.training.sampler import task_weights
from research.detector.labels import kinds
from tests.support.memory import remembered, trained_on
from tests.support.object_dataset import LENGTHS, make_object_dataset, slots_at, state_at
from tests.support.small_policy import batch_of, made_for_training
from tests.support.synthetic_dataset import CAMERAS, make_dataset

FILMED = (12, 23, 9)
"""Lengths of the episodes with images; the second has a prompt of 8 frames, as in the dataset of objects."""
PROMPT_KEYS = ("observation.language.tokens", "observation.language.attention_mask")


@dataclass(frozen=True)
class Perception:
    """Settings of a policy, the observation that it needs, and the rounding between training and rollout."""

    fields: dict[str, Any]
    needs: str
    rounding: float = 0.0
    """Largest difference, as a share of the largest number."""


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
    """A perception with a dataset for it, whose features are computed once."""

    of: Perception
    root: Path
    fields: dict[str, Any]

    @property
    def starts(self) -> list[int]:
        """First frames of the episodes."""
        return np.cumsum([0, *(LENGTHS if self.of.needs == OBS_ENV_STATE else FILMED)]).tolist()

    @cached_property
    def shared(self) -> Any:
        """Policy, preprocessor, postprocessor and samples."""
        return self.made()

    def made(self, **more: Any) -> Any:
        return made_for_training(self.root, **self.fields | more)

    def observed(self, dataset: Any, index: int) -> dict[str, Any]:
        """Return a rollout's observation at a frame of the dataset."""
        row = dataset.hf_dataset[index]
        numbers = {key: row[key][None] for key in (OBS_STATE, OBS_ENV_STATE) if key in row}
        step = float(index - max(start for start in self.starts if start <= index))
        clock = {
            "observation.step": torch.tensor([step]),
            "observation.phase": row["observation.phase"].reshape(1).float(),
        }
        images = {} if OBS_ENV_STATE in row else self.images(index)
        return {**images, **numbers, **clock, "task": [dataset.meta.tasks.index[int(row["task_index"])]]}

    def images(self, index: int) -> dict[str, Tensor]:
        """Return the images of all cameras at a frame, (1, 3, H, W)."""
        episode = int(np.searchsorted(self.starts, index, "right")) - 1
        numbers = [index - self.starts[episode]]
        return {camera: reader_of(self.root, camera)(episode, numbers) for camera in CAMERAS}


reader_of = functools.cache(frame_reader)


def made_detector(path: Path) -> Path:
    """Write a detector with random weights that detects objects everywhere."""
    torch.manual_seed(1)
    detector = Detector(VisualEncoder().eval(), kinds())
    torch.nn.init.zeros_(detector.fine_heads.heatmap.bias)
    save_detector(detector, path)
    return path


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made_detector(tmp_path_factory.mktemp("detector") / "detector.safetensors")


@pytest.fixture(scope="module")
def cases(root: Path, detector: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Case]:
    folder = tmp_path_factory.mktemp("perceptions")
    images = make_dataset(folder / "images", lengths=FILMED)
    shared = {"n_action_steps": 3, "memory_stride": 2}
    return {
        name: Case(
            one,
            root if one.needs == OBS_ENV_STATE else images,
            shared | {key: str(detector) if value == "FILE" else value for key, value in one.fields.items()},
        )
        for name, one in PERCEPTIONS.items()
    }


SLOW = ("detection noise",)


@pytest.fixture(params=[pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in PERCEPTIONS])
def case(request: pytest.FixtureRequest, cases: dict[str, Case]) -> Case:
    return cases[request.param]


def difference(one: Tensor, other: Tensor) -> float:
    """Return the largest difference, as a share of the largest number."""
    one, other = one.detach().float(), other.detach().float()
    return float((one - other).abs().max() / other.abs().max())


# -- the contract --------------------------------------------------------------------------------------------------


def test_rollout_remembers_and_sees_what_training_reads(case: Case) -> None:
    policy, before, _, dataset = case.shared
    policy.eval().reset()
    index = case.starts[1] + 14
    trained = before(batch_of(dataset, [index]))
    for frame in range(case.starts[1], index + 1):
        acted = before(case.observed(dataset, frame))
        policy.observe(acted)
    ((frames, steps),), ((learned, learned_steps),) = remembered(policy, [0]), trained_on(trained)
    assert steps == learned_steps
    assert frames.dtype == (torch.float32 if "perception" in case.fields else torch.bfloat16)
    assert difference(frames, learned) <= case.of.rounding
    assert difference(frames[0], frames[7]) > 4 * case.of.rounding, "frames differ"
    prefixes = []
    for batch in (trained, acted):
        prefix = policy.model.embed(policy._observed(batch | {key: trained[key] for key in PROMPT_KEYS}), MemoryPass())
        prefixes.append(prefix.tokens[prefix.real])
    assert difference(*prefixes) <= 2 * case.of.rounding


def test_memory_is_trained_and_images_encoders_are_not(case: Case) -> None:
    policy, before, _, dataset = case.shared
    policy.train().forward(
        before(batch_of(dataset, [10, case.starts[1] + 10, case.starts[1] + 20, case.starts[2] + 5]))
    )[0].backward()
    assert all(parameter.grad is not None for parameter in policy.model.memory_parameters().values())
    learning = {name for name, parameter in policy.named_parameters() if parameter.requires_grad}
    assert not any("vision_tower" in name or "multi_modal_projector" in name for name in learning)
    policy.zero_grad()


def test_missing_input_is_refused(case: Case) -> None:
    policy, before, _, dataset = case.shared
    policy.reset()
    observation = case.observed(dataset, case.starts[2])
    del observation[case.of.needs]
    with pytest.raises(MemobenchError, match=rf"'{case.of.needs}'"):
        policy.select_action(before(observation))


def test_checkpoint_acts_as_its_policy(case: Case, tmp_path: Path) -> None:
    policy, before, after, dataset = case.shared
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    again = MemobenchMemPolicy.from_pretrained(tmp_path)
    pre, _ = make_pre_post_processors(again.config, pretrained_path=str(tmp_path))
    assert again.perception.key == policy.perception.key
    policy.eval()
    actions: list[list[Tensor]] = []
    for actor, step in ((policy, before), (again, pre)):
        actor.reset()
        torch.manual_seed(0)
        observations = [case.observed(dataset, case.starts[2] + index) for index in range(5)]
        actions.append([actor.select_action(step(one)) for one in observations])
    assert all(torch.allclose(one, other, atol=1e-6) for one, other in zip(*actions, strict=True))
    assert actions[0][-1].any()


@pytest.mark.parametrize("case", ["visual encoder", "detections"], indirect=True)
def test_samples_hold_features_and_decode_no_video(case: Case, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, before, _, dataset = case.shared
    first = case.starts[1] + 5
    decoded = torch.utils.data.default_collate([dataset.reader.get_item(first)])

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a video was opened")

    monkeypatch.setattr("lerobot.datasets.dataset_reader.decode_video_frames", refuse)
    sample = dataset[first]
    assert not set(CAMERAS) & sample.keys()
    assert set(policy.config.image_features) == set(CAMERAS)
    batch = before(batch_of(dataset, [first, first + 5]))
    assert len(batch[FRAMES]) < (batch[PLACES] >= 0).sum(), "samples of an episode share frames"
    if "detector" in case.fields:
        truth = policy.perception.detect(case.images(first), batch[OBS_RAW_STATE][:1])
        assert truth.any()
        assert torch.allclose(batch[DETECTED][:1], truth, rtol=2**-15, atol=1e-7)
    else:
        assert all(batch[encoded_key(camera)].shape == (2, GRID**2, WIDTH) for camera in CAMERAS)
        assert batch[FRAMES].shape[1:] == (POOLED**2, WIDTH)
    losses = []  # images in a batch of LeRobot's have no effect
    for one in (decoded, {**decoded, **{name: 1 - decoded[name] for name in CAMERAS}}, batch_of(dataset, [first])):
        torch.manual_seed(0)
        losses.append(policy.train().forward(before(one))[0].item())
    assert losses == [losses[0]] * 3


# -- detectors and visual encoders ---------------------------------------------------------------------------------


def test_policies_of_objects_act_from_detections(cases: dict[str, Case], detector: Path, tmp_path: Path) -> None:
    """A policy that never saw images acts by a detector as by its detections; the state has no effect then."""
    policy, before, after, _ = cases["privileged objects"].shared
    for part in (policy, before, after):
        part.save_pretrained(tmp_path)
    found = []
    for overrides in ([], [f"--detector={detector}"]):
        config: Any = PreTrainedConfig.from_pretrained(tmp_path, cli_overrides=overrides)
        acting = MemobenchMemPolicy.from_pretrained(tmp_path, config=config)
        found.append((acting, make_pre_post_processors(acting.config, str(tmp_path))[0]))
    (given, of_objects), (seeing, of_images) = found
    assert set(seeing.config.image_features) == {*VIEWS}
    assert obs_type_of(seeing.config) == PIXELS != obs_type_of(given.config)
    case = cases["detections"]
    dataset = case.shared[3]
    for frame in range(6):
        batch = case.observed(dataset, frame)
        slots = seeing.perception.detect(batch, batch[OBS_STATE])
        objects = {key: value for key, value in batch.items() if key not in VIEWS} | {OBS_ENV_STATE: slots}
        noise = {OBS_ENV_STATE: torch.ones(1, SIZE)}
        assert torch.equal(given.select_action(of_objects(objects)), seeing.select_action(of_images(batch | noise)))


def test_unusable_encoder_files_are_named(cases: dict[str, Case], tmp_path: Path) -> None:
    file = tmp_path / "narrow.safetensors"
    save_detector(Detector(VisualEncoder((4, 4, 8, 8, 16), (0, 0, 0, 1, 0)), ("cork",)), file)
    with pytest.raises(MemobenchError, match=file.name):
        made_for_training(cases["visual encoder"].root, size="small", visual_encoder=str(file))


def test_detectors_need_images_and_a_file(root: Path, detector: Path) -> None:
    for file, named in ((detector, "images"), ("absent", "absent")):
        with pytest.raises(MemobenchError, match=named):
            made_for_training(root, **OBJECTS, detector=str(file))


def test_objects_next_to_images_decode_no_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = make_object_dataset(tmp_path / "filmed", images=True)
    monkeypatch.setattr("lerobot.datasets.dataset_reader.decode_video_frames", None)
    policy, before, _, dataset = made_for_training(folder, **OBJECTS)
    assert set(policy.config.input_features) == {OBS_STATE, OBS_ENV_STATE}
    assert before(batch_of(dataset, [10, 30]))[OBS_ENV_STATE].any()


# -- samples of tasks ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("weights", "expected"),
    [({}, [1, 1]), ({"prompted": 3.0}, [3, 3]), ({"KIND": 2.0, "NAME": 5.0}, [5, 2])],
)
def test_weights_of_tasks(weights: dict[str, float], expected: list[float], cases: dict[str, Case]) -> None:
    """A task's name counts before its memory type, and this before ``prompted``."""
    root = cases["privileged objects"].root
    records: list[Any] = [place.record for place in list_episodes(root)]
    names = {"KIND": records[0].memory_type, "NAME": records[0].task_name}
    phase = np.ones(sum(LENGTHS), int)
    phase[np.cumsum([0, *LENGTHS])[:-1]] = 0
    meta = LeRobotDatasetMetadata("here/data", root=root)
    given = {names.get(key, key): weight for key, weight in weights.items()}
    tasks, found = task_weights(meta, np.cumsum([0, *LENGTHS]), phase, given)
    assert tasks.tolist() == [0, 1, 0], "episodes of one task"
    assert found[tasks[[0, 1]]].tolist() == expected
    for bad, named in (({"open it": 2.0}, "open it"), ({"prompted": 0.0}, "task_weights")):
        with pytest.raises(MemobenchError, match=named):
            task_weights(meta, np.cumsum([0, *LENGTHS]), phase, bad)


def test_statistics_are_those_of_the_execution(cases: dict[str, Case]) -> None:
    _, before, after, dataset = cases["privileged objects"].shared
    hf = dataset.hf_dataset.with_format("numpy")
    actions = np.asarray(hf["action"])[np.asarray(hf["observation.phase"]).reshape(-1) != 0]
    for processor in (before, after):
        step = next(step for step in processor.steps if type(step).__name__.endswith("ormalizerProcessorStep"))
        held = step._tensor_stats["action"]
        assert np.allclose(held["mean"], actions.mean(axis=0), atol=1e-5)
        assert np.allclose(held["std"], actions.std(axis=0) + 0.01, atol=1e-4)


# -- slots ---------------------------------------------------------------------------------------------------------

KINDS = len(classes())
WHERE = np.array([[0.0, 0.1, 0.9], [0.1, -0.1, 0.95], [-0.1, 0.0, 1.0]])


def slots(places: np.ndarray = WHERE, lit: int | None = None, seed: int = 0) -> Tensor:
    return torch.from_numpy(slots_at(np.random.default_rng(seed), places, lit))


def hand(place: tuple[float, float, float] = (0.0, 0.0, 1.1)) -> Tensor:
    return torch.from_numpy(state_at(np.array(place)))


def test_features_relative_to_the_hand_move_with_it() -> None:
    """Features in the hand's frame do not change if hand and thing move together; features in the world do."""
    turn, pose = Rotation.from_rotvec([0.2, -0.3, 1.0]), Rotation.from_rotvec([3.0, 0.3, 0.1])
    thing = slots().reshape(SLOTS, SLOT_WIDTH)[1:2].double()
    start = torch.tensor([[0.02, -0.08, 0.97, *pose.as_rotvec()]])
    moved, gone = thing.clone(), np.array([0.1, 0.2, -0.1])
    for first in (2, 5, 8):
        shift = gone if first == 2 else 0.0
        moved[0, first : first + 3] = torch.from_numpy(turn.apply(thing[0, first : first + 3].numpy()) + shift)
    end = torch.tensor([[*(turn.apply(start[0, :3].numpy()) + gone), *(turn * pose).as_rotvec()]])
    before, after = slot_features(thing.float(), start.float()), slot_features(moved.float(), end.float())
    assert before.shape == (1, FEATURES)
    own = [*range(12, 18), *range(24, 30)]  # fine offsets and axes in the hand's frame
    assert torch.allclose(before[:, own], after[:, own], atol=1e-4)
    assert (before[:, :12] - after[:, :12]).abs().max() > 0.1


def test_empty_slots_are_no_tokens() -> None:
    perception = ObjectEncoder(classes(), 32).eval()
    noisy = slots().clone().reshape(SLOTS, SLOT_WIDTH)
    noisy[3:, 1:] = 7.0
    both = torch.stack([slots(), noisy.reshape(-1)])
    batch = {OBS_ENV_STATE: both, OBS_RAW_STATE: hand().expand(2, -1)}
    (part,), (mask,) = perception.present(batch)
    tokens = perception.prefix(part)
    assert mask.tolist() == [[True] * 3 + [False] * (SLOTS - 3)] * 2
    assert torch.equal(tokens[0], tokens[1])
    assert not tokens[0, 3:].any()
    assert tokens[0, :3].abs().sum(dim=1).min() > 0
    trained = [perception.train().present({**batch, OBS_ENV_STATE: one})[1][0].shape[1] for one in (both, 0 * both)]
    assert trained == [3, 1], "training drops slots that are empty in the whole batch"
    pool = ObjectPool(perception.order, perception.kinds, 32)
    pooled = pool(perception.remember(batch, [0, 1])[:, 0])
    assert torch.allclose(pooled[0], pooled[1], rtol=0, atol=1e-6)
    assert pool(frame_row(torch.zeros(1, SIZE), hand()[None], torch.ones(1))[:, 0]).isfinite().all()


@pytest.mark.parametrize("phase", [False, True])
def test_pools_hold_highlight_and_phase_in_any_order(phase: bool) -> None:
    pool = ObjectPool(range(KINDS), KINDS + 1, 32, phase=phase)

    def pooled(one: Tensor, at: float) -> Tensor:
        made: Tensor = pool(frame_row(one[None], hand()[None], torch.tensor([at])))
        return made

    lit = slots(lit=1)
    shuffled = lit.reshape(SLOTS, SLOT_WIDTH)[torch.randperm(SLOTS)].reshape(-1)
    assert torch.allclose(pooled(lit, 1.0), pooled(shuffled, 1.0), atol=1e-6)
    assert (pooled(lit, 1.0) - pooled(slots(), 1.0)).abs().max() > 1e-4
    assert torch.equal(pooled(lit, 1.0), pooled(lit, 0.0)) != phase


def test_classes_keep_their_embedding_by_name() -> None:
    trained = [name for name in classes() if name != classes()[2]]
    perception = ObjectEncoder(trained, 16)
    assert [perception.order[classes().index(name)] for name in trained] == list(range(len(trained)))
    assert perception.order[2] == len(trained), "a new class"
    encoder = SlotEncoder(perception.order, perception.kinds, 8, 16)
    assert encoder.kind.num_embeddings == len(trained) + 1


KIND = {name: classes().index(name) for name in ("butter", "akita_black_bowl", "drawer", "plate", "milk")}
LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def thing(name: str, place: tuple[float, float, float], axes: tuple[float, ...] = LEVEL) -> list[float]:
    return [1.0, KIND[name], *place, *axes, 0.0, 0.0]


def scene(*things: list[float]) -> torch.Tensor:
    return torch.from_numpy(fill_slots(np.array(things))).reshape(1, SLOTS, SLOT_WIDTH)


TABLE = scene(
    thing("butter", (0.0, 0.1, 0.9)),
    thing("akita_black_bowl", (0.1, -0.1, 0.9)),
    thing("milk", (-0.1, 0.2, 0.95)),
    thing("plate", (0.05, 0.25, 0.9)),
)
FAR = torch.tensor([[0.0, -0.5, 1.3, 0.0, 0.0, 0.0]])


def many(slots: torch.Tensor, hand: torch.Tensor, size: float = 1.0) -> torch.Tensor:
    """Return the noisy slots of a scene in 150 batches of 24."""
    torch.manual_seed(3)
    return torch.cat([with_detection_noise(slots.expand(24, -1, -1), hand.expand(24, -1), size) for _ in range(150)])


def errors(seen: torch.Tensor, slots: torch.Tensor) -> torch.Tensor:
    """Return the errors of places of things, m, up to 5 cm."""
    there = field(seen, "present").squeeze(-1) > 0
    kinds, places = field(seen, "class").squeeze(-1)[there], field(seen, "position")[there]
    real = slots[field(slots, "present").squeeze(-1) > 0]
    found = torch.cat([(places[kinds == one[1]] - one[2:5]).norm(dim=1) for one in real])
    return found[found < 0.05]


def test_errors_have_the_measured_sizes() -> None:
    """Median and 90th percentile of 1.6 and 8 mm; 99 of 100 things are found."""
    seen = many(TABLE, FAR)
    median, ninetieth = np.percentile(errors(seen, TABLE), [50, 90])
    assert 0.0013 < median < 0.0025
    assert 0.005 < ninetieth < 0.01
    there = field(seen, "present") > 0
    found = there.sum() / len(seen) - FALSE
    assert found / 4 == pytest.approx(1 - MISSED - KIND_MISSED, abs=0.02)


def test_rotations_are_those_that_a_detector_can_see() -> None:
    tilted = (0.0, 0.6, 0.8, 1.0, 0.0, 0.0)  # x axis to the side and up
    behind = (-0.8, 0.6, 0.0, -0.6, -0.8, 0.0)
    slots = scene(
        thing("akita_black_bowl", (0.1, -0.1, 0.9), behind),
        thing("butter", (0.0, 0.1, 0.9), behind),
        thing("drawer", (0.2, 0.0, 1.0), (0.8, -0.6, 0.0, 0.6, 0.8, 0.0)),
        thing("milk", (-0.1, 0.2, 0.95), tilted),
    )
    axes = field(with_detection_noise(slots, FAR, 0.0), "rotation")[0]
    seen = {name: axes[slots[0, :, 1] == KIND[name]][0].tolist() for name in ("akita_black_bowl", "butter", "drawer")}
    assert seen["akita_black_bowl"] == pytest.approx([0.0, 1.0, 0.0, -1.0, 0.0, 0.0], abs=1e-6), "round"
    assert seen["butter"] == pytest.approx([-0.8, 0.6, 0.0, -0.6, -0.8, 0.0])
    assert seen["drawer"] == pytest.approx([-0.8, 0.6, 0.0, -0.6, -0.8, 0.0])
    milk = axes[slots[0, :, 1] == KIND["milk"]][0]
    assert milk.tolist() == pytest.approx([0.0, 1.0, 0.0, 0.0, 0.0, 1.0]), "its y axis points up"


def test_slots_are_sorted_and_empty_slots_stay_empty() -> None:
    seen = many(TABLE, FAR, 3.0)
    there = field(seen, "present").squeeze(-1) > 0
    assert not seen[~there].any()
    assert (there.int().diff(dim=1) <= 0).all()
    kind, place = field(seen, "class").squeeze(-1), field(seen, "position")
    first = torch.where(kind == KIND["drawer"], -place[..., 2], place[..., 0])
    order = (kind + first.clamp(-4, 4) / 10).masked_fill(~there, torch.inf)
    assert (order.diff(dim=1).nan_to_num() >= 0).all()
    assert with_detection_noise(torch.zeros(2, SLOTS, SLOT_WIDTH), FAR.expand(2, -1), 1.0).eq(0).all()


def _batch() -> dict[str, torch.Tensor]:
    """Return two samples of one frame, which is stored too, and one of another."""
    other = scene(thing("butter", (0.2, 0.1, 0.9)))
    slots = torch.cat([TABLE, TABLE, other]).reshape(3, SIZE)
    found = {OBS_ENV_STATE: slots, OBS_RAW_STATE: FAR.expand(3, -1)}
    return {**found, FRAMES: ObjectEncoder(classes(), 32).remember(found, [1])}


def test_errors_are_drawn_once_per_frame() -> None:
    batch = _batch()
    perception = ObjectEncoder(classes(), 32, 1.0).train()
    first, second = perception.observed(batch), perception.observed(batch)
    for seen in (first, second):
        present = seen[OBS_ENV_STATE]
        assert torch.equal(present[0], present[1])
        assert torch.equal(present[0], seen[FRAMES][0, 0, :SIZE])
        assert torch.equal(seen[FRAMES][0, 0, SIZE:], batch[FRAMES][0, 0, SIZE:])
        assert torch.equal(seen[EXACT], batch[FRAMES])
        assert not (present == batch[OBS_ENV_STATE]).all(dim=1).any()
    assert not torch.equal(first[FRAMES], second[FRAMES])
    without = {name: one for name, one in batch.items() if name != FRAMES}
    assert perception.observed(without).keys() == without.keys()
