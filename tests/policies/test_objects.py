"""perception=objects through LeRobot's own doors: samples, batches, training, rollouts, checkpoints."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.utils.constants import OBS_ENV_STATE
from scipy.spatial.transform import Rotation

from lerobot_memobench.datasets.lerobot_format.layout import PRIVILEGED
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.fusion import Reading
from lerobot_memobench.policies.memobench_mem.memory.frames import Frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    FRAMES,
    PLACES,
    STEPS,
    Histories,
    MemorySpec,
)
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.objects import (
    FEATURES,
    OBS_RAW_STATE,
    ObjectEncoder,
    ObjectPool,
    SlotEncoder,
    frame_row,
    rotation,
    slot_features,
)
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from lerobot_memobench.sim.object_layout import WIDTH as SLOT_WIDTH
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.training.data import Training, open_datasets, open_training
from lerobot_memobench.training.loop import make_sampler
from lerobot_memobench.training.sampler import (
    FrameSampler,
    task_weights,
)
from tests.support import object_dataset
from tests.support.object_dataset import LENGTHS, PROMPTS, make_object_dataset, slots_at, state_at
from tests.support.small_policy import batch_of, made_for_training, small_config, train_config

OBJECTS: dict[str, Any] = {"perception": "objects", "size": "small", "n_action_steps": 3, "memory_stride": 1}
STARTS = np.cumsum([0, *LENGTHS])


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_object_dataset(tmp_path_factory.mktemp("objects") / "data")


def observed(dataset: Any, index: int, **more: Any) -> dict[str, Any]:
    """An observation of a rollout: frame ``index`` of the dataset, as the environment would give it."""
    row = dataset.hf_dataset[index]
    seen = {key: row[key][None] for key in ("observation.state", "observation.environment_state")}
    episode = int(np.searchsorted(STARTS, index, "right")) - 1
    step = index - STARTS[episode]
    clock = {
        "observation.step": torch.tensor([float(step)]),
        "observation.phase": row["observation.phase"].reshape(1).float(),
    }
    return {**seen, **clock, "task": ["put the butter into the bowl"], **more}


# -- settings ------------------------------------------------------------------------------------------------------


def test_the_rate_falls_as_a_cosine() -> None:
    config = MemobenchMemConfig(device="cpu", size="small", perception="objects")
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    schedule = config.get_scheduler_preset().build(optimizer, num_training_steps=200)
    rates = []
    for _ in range(201):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert rates[0] == pytest.approx(0.1)
    assert rates[100] == pytest.approx(0.51, abs=1e-6)
    assert rates[200] == pytest.approx(0.02)
    assert rates[10:] == sorted(rates[10:], reverse=True)


# -- samples -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("earlier", [False, True])
def test_no_video_is_decoded(earlier: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And objects are read beside pictures, under today's name and that of earlier datasets."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a video was opened")

    folder = make_object_dataset(tmp_path / "filmed", pictures=True, earlier=earlier)
    monkeypatch.setattr("lerobot.datasets.dataset_reader.decode_video_frames", refuse)
    policy, before, _, dataset = made_for_training(folder, **OBJECTS)
    assert set(policy.config.input_features) == {"observation.state", "observation.environment_state"}
    batch = before(batch_of(dataset, [10, 30]))
    column = dataset.hf_dataset.data.column(OBS_ENV_STATE if earlier else PRIVILEGED)
    assert torch.equal(batch[OBS_ENV_STATE], torch.tensor([column[10].as_py(), column[30].as_py()]))
    loss, _ = policy.forward(batch)
    assert loss.isfinite()


def test_a_dataset_without_objects_is_refused(dataset_root: Path) -> None:
    with pytest.raises(MemobenchError, match=r"observation\.environment_state.*memobench generate"):
        made_for_training(dataset_root, **OBJECTS)


@pytest.mark.parametrize(
    ("records", "weights", "expected"),
    [
        (True, {}, {"butter": 1, "drawer": 1}),
        (True, {"prompted": 3}, {"butter": 3, "drawer": 3}),
        (False, {"open the drawer": 0.5}, {"butter": 1, "drawer": 0.5}),
    ],
)
def test_a_task_of_several_instructions_is_one_task(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    records: bool,
    weights: dict[str, float],
    expected: dict[str, float],
) -> None:
    monkeypatch.setattr(object_dataset, "TASKS", ("butter twice", "open the drawer", "butter once"))
    meta = LeRobotDatasetMetadata("here/data", root=make_object_dataset(tmp_path / "data", records=records))
    phase = np.ones(sum(LENGTHS), int)
    phase[[int(start) for start in STARTS[:-1]]] = 0
    tasks, found = task_weights(meta, np.cumsum([0, *LENGTHS]), phase, weights)
    assert tasks.tolist() == ([0, 1, 0] if records else [1, 2, 0])
    assert found[tasks[[0, 1]]].tolist() == [expected["butter"], expected["drawer"]]
    with pytest.raises(MemobenchError, match="names 'open the drawr'"):
        task_weights(meta, np.cumsum([0, *LENGTHS]), phase, {"open the drawr": 2.0})
    with pytest.raises(MemobenchError, match="leaves no task"):
        task_weights(meta, np.cumsum([0, *LENGTHS]), phase, {"prompted": 0.0})


def test_a_weight_is_of_the_task_then_of_its_memory_type(tmp_path: Path) -> None:
    root = make_object_dataset(tmp_path / "data", records=True)
    meta = LeRobotDatasetMetadata("here/data", root=root)
    records = [place.record for place in list_episodes(root)]
    kinds = {record.task_name: record.memory_type for record in records if record is not None}
    name, kind = next(iter(kinds.items()))
    phase = np.ones(sum(LENGTHS), int)
    tasks, found = task_weights(meta, np.cumsum([0, *LENGTHS]), phase, {kind: 2.0, name: 5.0})
    for record, task in zip(records, tasks, strict=True):
        assert record is not None
        assert found[task] == (5.0 if record.task_name == name else 2.0 if record.memory_type == kind else 1.0)


def sampled(root: Path, config: Any, episodes: list[int] | None = None) -> tuple[FrameSampler, Training]:
    whole = train_config(root, config)
    whole.dataset.episodes = episodes
    training = open_training(whole, open_datasets(whole))
    return make_sampler(whole, training), training


def test_batches_hold_frames_of_few_episodes_and_no_prompt(root: Path) -> None:
    sampler, training = sampled(root, small_config(**OBJECTS))
    before = training.processors[0]
    loader = torch.utils.data.DataLoader(training.samples(), batch_size=12, sampler=sampler)
    drawn = torch.cat([part["index"] for part in loader]).tolist()
    execution = {
        int(STARTS[episode]) + frame
        for episode, (length, prompt) in enumerate(zip(LENGTHS, PROMPTS, strict=True))
        for frame in range(prompt, length)
    }
    assert len(drawn) == len(execution)
    assert set(drawn) <= execution
    batch = before(next(iter(loader)))
    assert len(batch["episode_index"].unique()) <= 3
    assert len(batch[FRAMES]) < (batch[PLACES] >= 0).sum(), "frames of an episode share their memory"


def test_of_some_episodes_no_other_frame_is_drawn(root: Path) -> None:
    sampler, training = sampled(root, small_config(**OBJECTS), [1, 2])
    drawn = [frame for _ in range(20) for frame in sampler]
    assert set(drawn) == {int(STARTS[k]) + frame for k in (1, 2) for frame in range(PROMPTS[k], LENGTHS[k])}
    assert np.mean([frame < STARTS[2] for frame in drawn]) == pytest.approx(1 / 2, abs=0.06)
    assert training.processors[0](batch_of(training.samples(), [int(STARTS[1]) + 9]))[FRAMES].any()


def test_the_sampler_draws_prompted_tasks_more_often(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_dataset, "PROMPTS", (0, 8, 0))
    root = make_object_dataset(tmp_path / "data")
    sampler, _ = sampled(root, small_config(**OBJECTS, task_weights={"prompted": 3.0}))
    drawn = np.array([frame for _ in range(20) for frame in sampler])
    assert np.mean((drawn >= STARTS[1]) & (drawn < STARTS[2])) == pytest.approx(3 / 4, abs=0.06)


def _normalised_by(processor: Any) -> dict[str, Any]:
    found = next(step for step in processor.steps if type(step).__name__.endswith("ormalizerProcessorStep"))
    held: dict[str, Any] = found._tensor_stats["action"]
    return held


def test_statistics_are_those_of_execution_frames(root: Path) -> None:
    _, before, after, dataset = made_for_training(root, **OBJECTS)
    hf = dataset.hf_dataset.with_format("numpy")
    actions = np.asarray(hf["action"])[np.asarray(hf["observation.phase"]).reshape(-1) != 0]
    for processor in (before, after):
        held = _normalised_by(processor)
        assert np.allclose(held["mean"], actions.mean(axis=0), atol=1e-5)
        assert np.allclose(held["std"], actions.std(axis=0) + 0.01, atol=1e-4)


def test_relative_actions_need_relative_statistics(root: Path) -> None:
    with pytest.raises(MemobenchError, match="relative_action=true"):
        made_for_training(root, **OBJECTS, use_relative_actions=True)


# -- training ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "fields",
    [
        {"align": "semantic"},
        {"align": "contrastive"},
        {"align": "framewise"},
        {"align": "framewise", "memory_fusion": "context", "tokens_per_frame": 3},
        {"memory_fusion": "none", "oracle_memory": True},
        {"size": "tiny", "memory_stride": 2},
    ],
    ids=lambda fields: "-".join(map(str, fields.values())),
)
def test_every_kind_trains(root: Path, fields: dict[str, Any]) -> None:
    policy, before, _, dataset = made_for_training(root, **OBJECTS | fields)
    batch = before(batch_of(dataset, [10, 30, 50, 80]))
    loss, logged = policy.train().forward(batch)
    loss.backward()
    gradients = {name: parameter.grad for name, parameter in policy.named_parameters() if parameter.requires_grad}
    assert loss.isfinite()
    assert all(gradients[f"model.{name}"] is not None for name in policy.model.memory_parameters())
    if "align" in fields:
        assert {"align_loss", "align_grad_norm", "align_top1"} <= set(logged)
    if "oracle_memory" in fields:
        words = next(step for step in before.steps if type(step).__name__ == "WordTokenizerProcessorStep")
        assert words.vocabulary.index("lit") in batch["observation.language.tokens"]


# -- memory, in training and in a rollout --------------------------------------------------------------------------


def test_the_present_is_the_same_in_training_and_in_a_rollout(root: Path) -> None:
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    index = 20
    trained, acted = before(batch_of(dataset, [index])), before(observed(dataset, index, task=dataset[index]["task"]))
    words = ("observation.language.tokens", "observation.language.attention_mask")
    prefixes = [
        policy.train(learning).model.embed(policy._seen(batch), Reading())
        for batch, learning in ((trained, True), (acted, False))
    ]
    seen = [prefix.tokens[prefix.real] for prefix in prefixes]
    assert torch.equal(*seen)
    count = trained[words[1]].sum()
    assert len(seen[0]) == 3 + 1 + count, "three things, the state and the words"
    assert [prefix.tokens.shape[1] for prefix in prefixes] == [3 + 1 + count, 16 + 1 + count]


def test_a_batch_to_learn_from_has_the_slots_of_its_fullest_sample(root: Path) -> None:
    """The same is learned as with all slots, and of a batch in which nothing is seen, too."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    batch = before(batch_of(dataset, [20, 44]))
    fewer = batch | {OBS_ENV_STATE: batch[OBS_ENV_STATE].clone()}
    fewer[OBS_ENV_STATE][0, SLOT_WIDTH:] = 0.0
    nothing = batch | {OBS_ENV_STATE: torch.zeros_like(batch[OBS_ENV_STATE])}
    assert [policy.train().perception.present(seen)[1][0].shape for seen in (batch, fewer, nothing)] == [
        (2, 3),
        (2, 3),
        (2, 1),
    ]
    losses = [policy.train(learning).forward(fewer, reduction="none")[0] for learning in (True, False)]
    torch.testing.assert_close(*losses, rtol=1e-4, atol=1e-5)
    assert torch.isfinite(policy.train().forward(nothing)[0])


def test_no_memory_is_nothing_in_training_and_in_a_rollout(root: Path) -> None:
    """Whatever was seen before, and whatever a batch brings along, the same comes out, and no weight makes it."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS | {"memory_fusion": "none"})
    assert not [name for name, _ in policy.named_parameters() if "memory" in name or "modulat" in name]
    batch = before(batch_of(dataset, [30]))
    assert FRAMES not in batch
    noise = torch.randn(1, policy.config.chunk_size, 32, generator=torch.Generator().manual_seed(0))
    plans = []
    for history in ([], [0, 1, 2, 3], [41, 42, 43]):
        policy.reset()
        for step, index in enumerate(history):
            policy.observe(before(observed(dataset, index, **{"observation.step": torch.tensor([float(step)])})))
        last = before(observed(dataset, 30, **{"observation.step": torch.tensor([30.0])}))
        plans.append(policy.predict_action_chunk(last, noise=noise))
    assert torch.equal(plans[0], plans[1])
    assert torch.equal(plans[0], plans[2])


def test_memory_that_is_masked_is_nothing(root: Path) -> None:
    """A frame that a sample does not remember changes no loss; a real one does."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if ".modulation." in name:
                parameter.normal_(std=0.2)
    batch = before(batch_of(dataset, [int(STARTS[2]) + 3]))
    assert batch[PLACES].tolist() == [[0, 1, 2, 3]]

    def loss(frames: torch.Tensor) -> float:
        torch.manual_seed(3)
        steps = torch.arange(len(frames))
        return float(policy.forward(batch | {FRAMES: frames, STEPS: steps})[0])

    frames = batch[FRAMES]
    assert loss(torch.cat([frames, frames * 0.1])) == pytest.approx(loss(frames), abs=1e-6)
    changed = frames.clone()
    changed[1] = changed[1] * 0.9
    assert loss(changed) != pytest.approx(loss(frames), abs=1e-6)


def test_a_hand_that_stands_still_carries_out_a_whole_plan(root: Path) -> None:
    """Of the first plan three actions of six, then all of one where nothing moves, and three where the hand does."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS, full_chunk_when_stalled=True)
    policy.reset()
    left = []
    for step, index in enumerate([30] * 9 + [50] * 3):
        seen = observed(dataset, index, **{"observation.step": torch.tensor([float(step)])})
        seen["observation.state"] = seen["observation.state"] + 0.02 * (index > 30)
        policy.select_action(before(seen))
        left.append(len(policy.rollout.rows[0].queue))
    assert left == [2, 1, 0, *reversed(range(6)), 2, 1, 0]


# -- rollouts and checkpoints --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, Any, Path]:
    policy, before, after, dataset = made_for_training(root, **OBJECTS | {"align": "contrastive"})
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for step in range(3):
        policy.forward(before(batch_of(dataset, [10 + step, 30, 55, 80])))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    folder = tmp_path_factory.mktemp("checkpoint") / "pretrained_model"
    for part in (policy, before, after):
        part.save_pretrained(folder)
    return policy, before, dataset, folder


def test_rows_are_independent(saved: tuple[Any, Any, Any, Path]) -> None:
    policy, before, dataset, _ = saved

    def act(batches: list[list[dict[str, Any]]]) -> list[torch.Tensor]:
        policy.reset()
        found = []
        for rows in batches:
            joined = {key: torch.cat([row[key] for row in rows]) for key in rows[0] if key != "task"}
            found.append(policy.select_action(before(joined | {"task": [row["task"][0] for row in rows]})))
        return found

    one = [observed(dataset, index) for index in range(12)]
    other = [observed(dataset, int(STARTS[2]) + index) for index in range(12)]
    together, alone = act([list(rows) for rows in zip(one, other, strict=True)]), act([[row] for row in one])
    assert all(torch.allclose(both[0], single[0], atol=1e-5) for both, single in zip(together, alone, strict=True))


def test_another_perceptions_weights_are_refused(saved: tuple[Any, Any, Any, Path]) -> None:
    folder = saved[3]
    config = small_config(size="small", perception="pixels")
    config.input_features = {
        **saved[0].config.input_features,
        "observation.images.image": PolicyFeature(FeatureType.VISUAL, (3, 48, 48)),
    }
    config.output_features = saved[0].config.output_features
    with pytest.raises(MemobenchError, match=r"--policy\.perception"):
        MemobenchMemPolicy.from_pretrained(folder, config=config)


# -- slots ------------------------------------------------------------------------------------------------------------

KINDS = len(classes())
WHERE = np.array([[0.0, 0.1, 0.9], [0.1, -0.1, 0.95], [-0.1, 0.0, 1.0]])


def seen(places: np.ndarray = WHERE, lit: int | None = None, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(slots_at(np.random.default_rng(seed), places, lit))


def hand(place: tuple[float, float, float] = (0.0, 0.0, 1.1)) -> torch.Tensor:
    return torch.from_numpy(state_at(np.array(place)))


def test_rotations_are_scipys() -> None:
    turns = np.random.default_rng(1).normal(size=(20, 3)) * 2
    expected = torch.from_numpy(Rotation.from_rotvec(turns).as_matrix()).float()
    assert torch.allclose(rotation(torch.from_numpy(turns).float()), expected, atol=1e-5)
    assert torch.equal(rotation(torch.zeros(1, 3))[0], torch.eye(3))


def test_what_is_told_from_the_hand_moves_and_turns_with_it() -> None:
    """Turned and moved together, hand and thing stay the same to each other; what is told of the world changes."""
    turn = Rotation.from_rotvec([0.2, -0.3, 1.0])
    pose = Rotation.from_rotvec([3.0, 0.3, 0.1])
    thing = seen().reshape(SLOTS, WIDTH)[1:2].double()
    start = torch.tensor([[0.02, -0.08, 0.97, *pose.as_rotvec()]])
    moved, gone = thing.clone(), np.array([0.1, 0.2, -0.1])
    for first in (2, 5, 8):
        shift = gone if first == 2 else 0.0
        moved[0, first : first + 3] = torch.from_numpy(turn.apply(thing[0, first : first + 3].numpy()) + shift)
    end = torch.tensor([[*(turn.apply(start[0, :3].numpy()) + gone), *(turn * pose).as_rotvec()]])
    before, after = slot_features(thing.float(), start.float()), slot_features(moved.float(), end.float())
    assert before.shape == (1, FEATURES)
    own = [*range(12, 18), *range(24, 30)]  # near, in the hand's frame; axes in the hand's frame
    assert torch.allclose(before[:, own], after[:, own], atol=1e-4)
    assert (before[:, :12] - after[:, :12]).abs().max() > 0.1


def test_a_millimetre_beside_the_hand_is_seen() -> None:
    """Through the whole of memory, where bfloat16 would hold places to 4 mm."""
    perception = ObjectEncoder(classes(), 2, 32)
    pool = perception.pool()
    moved = WHERE + np.array([0.001, 0, 0])
    rows = [
        perception.remember({"observation.environment_state": one[None], OBS_RAW_STATE: hand()[None]}, [0])
        for one in (seen(), seen(moved))
    ]
    assert rows[0].dtype == torch.float32
    assert (rows[0] - rows[1]).abs().max() > 0.0009
    assert not torch.equal(pool(rows[0]), pool(rows[1]))


def test_an_empty_slot_is_no_token_whatever_it_holds() -> None:
    perception = ObjectEncoder(classes(), 2, 32).eval()  # in training empty slots are left out
    noisy = seen().clone().reshape(SLOTS, WIDTH)
    noisy[3:, 1:] = 7.0
    both = torch.stack([seen(), noisy.reshape(-1)])
    batch = {"observation.environment_state": both, OBS_RAW_STATE: hand().expand(2, -1)}
    (part,), (mask,) = perception.present(batch)
    tokens = perception.prefix(part)
    assert mask.tolist() == [[True] * 3 + [False] * (SLOTS - 3)] * 2
    assert torch.equal(tokens[0], tokens[1])
    assert not tokens[0, 3:].any()
    assert tokens[0, :3].abs().sum(dim=1).min() > 0
    pool = ObjectPool(perception.order, perception.kinds, 2, 32)
    pooled = pool(perception.remember(batch, [0, 1])[:, 0])
    assert torch.allclose(pooled[0], pooled[1], rtol=0, atol=1e-6), "the size of a token is rounded"
    nothing = pool(frame_row(torch.zeros(1, SIZE), hand()[None], torch.ones(1))[:, 0])
    assert nothing.isfinite().all()


def test_frames_are_pooled_whatever_the_order_of_their_things() -> None:
    pool = ObjectPool(range(KINDS), KINDS + 1, 2, 32, phase=True)
    slots = seen(lit=1).reshape(SLOTS, WIDTH)
    rows = torch.stack([slots, slots[torch.randperm(SLOTS)]]).reshape(2, SIZE)
    pooled = pool(frame_row(rows, hand().expand(2, -1), torch.ones(2))[:, 0])
    assert torch.allclose(pooled[0], pooled[1], atol=1e-6)
    unlit = pool(frame_row(seen()[None], hand()[None], torch.ones(1))[:, 0])
    prompt = pool(frame_row(seen(lit=1)[None], hand()[None], torch.zeros(1))[:, 0])
    assert (pooled[0] - unlit[0]).abs().max() > 1e-4, "the highlight is seen"
    assert (pooled[0] - prompt[0]).abs().max() > 1e-4, "so is the phase"


def frames_memory(pool: ObjectPool, width: int, frames: int, content: bool = True) -> Frames:
    return Frames(MemorySpec(width, 2, width, width, frames, 0, 8), pool, Frames.Settings(content=content))


@pytest.mark.parametrize("phase", [False, True])
def test_a_clock_remembers_no_thing_and_the_phase_where_it_is_told(phase: bool) -> None:
    memory = frames_memory(ObjectPool(range(KINDS), KINDS + 1, 2, 32, phase=phase), 32, 4, content=False)

    def read(slots: torch.Tensor, begin: int) -> torch.Tensor:
        frames = frame_row(slots, hand().expand(4, -1), (torch.arange(4) >= begin).float())
        state = memory.init(1)
        for number, frame in enumerate(frames):
            state = memory.write(state, frame[None], torch.tensor([8 * number]))
        return memory.read(state).rows()

    first = read(seen().expand(4, -1), 2)
    assert torch.equal(first, read(seen(lit=1).expand(4, -1), 2)), "what was seen"
    assert torch.equal(first, read(seen().expand(4, -1), 1)) == (not phase), "when the execution began"


def test_a_frame_that_many_read_is_encoded_once() -> None:
    class Counting(ObjectPool):
        count = 0

        def forward(self, frames: torch.Tensor) -> torch.Tensor:
            Counting.count += len(frames)
            return super().forward(frames)

    memory = frames_memory(Counting(range(KINDS), KINDS + 1, 2, 16), 16, 4)
    stored = torch.cat([frame_row(seen(seed=n)[None], hand()[None], torch.ones(1)) for n in range(5)])
    places, steps = torch.tensor([[0, 1, 2, 3], [0, 2, 4, -1]]), torch.arange(5) * 8
    shared = memory.replay(Histories(stored, steps, places))
    assert Counting.count == 5
    for row, read in enumerate(([0, 1, 2, 3], [0, 2, 4])):
        state = memory.init(1)
        for frame in read:
            state = memory.observe(state, stored[[frame]], steps[[frame]])
        alone = memory.read(state)
        assert torch.equal(alone.mask[0], shared.mask[row])
        real = alone.mask[0]
        assert torch.allclose(alone.rows()[0][real], shared.rows()[row][real], atol=1e-6)


def test_classes_keep_their_meaning_when_others_come() -> None:
    """A policy knows the classes it was trained with by name; one it does not know is another, not its neighbour."""
    trained = [name for name in classes() if name != classes()[2]]
    perception = ObjectEncoder(trained, 2, 16)
    assert [perception.order[classes().index(name)] for name in trained] == list(range(len(trained)))
    assert perception.order[2] == len(trained)
    encoder = SlotEncoder(perception.order, perception.kinds, 8, 16)
    assert encoder.kind.num_embeddings == len(trained) + 1


def test_which_thing_was_lit_can_be_learned() -> None:
    """A scene in which nothing is lit now, remembered after frames in which one thing was: where is that one?"""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    memory = frames_memory(ObjectPool(range(KINDS), KINDS + 1, 2, 32), 32, 2)
    head = torch.nn.Linear(32, 2)
    optimizer = torch.optim.Adam([*memory.parameters(), *head.parameters()], lr=3e-3)
    steps, places_of, losses = torch.arange(2).repeat(32), torch.arange(64).reshape(32, 2), []
    for _ in range(150):
        places, lit = rng.uniform(-0.3, 0.3, (32, 3, 3)) + np.array([0, 0, 0.9]), rng.integers(3, size=32)
        shown = [slots_at(rng, here, which) for here, thing in zip(places, lit, strict=True) for which in (thing, None)]
        rows = frame_row(torch.from_numpy(np.stack(shown)), hand().expand(64, -1), torch.tensor([0.0, 1.0] * 32))
        tokens = memory.replay(Histories(rows, steps, places_of)).rows()
        wanted = torch.from_numpy(places[np.arange(32), lit, :2]).float() / 0.17
        loss = (head(tokens.mean(dim=1)) - wanted).square().mean()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(float(loss.detach()))
    assert np.mean(losses[-20:]) < 0.3 * np.mean(losses[:10]), "guessing keeps the whole variance"


def test_a_memory_does_not_tell_the_phase_unless_it_is_told_to() -> None:
    """Frames that differ in the phase alone: where it is not told, no clock of the execution can be read."""
    rows = [frame_row(seen()[None], hand()[None], torch.tensor([phase])) for phase in (0.0, 1.0)]
    for told in (False, True):
        pool = ObjectEncoder(classes(), 2, 32, phase=told).pool()
        assert torch.equal(pool(rows[0]), pool(rows[1])) != told


def test_small_brings_its_recipe_and_leaves_it_to_the_user(tmp_path: Path) -> None:
    config = MemobenchMemConfig(device="cpu", size="small", perception="objects")
    assert (config.chunk_size, config.n_action_steps, config.num_inference_steps) == (16, 6, 1)
    assert (config.objective, config.memory_stride) == ("regression", 8)
    assert (config.optimizer_lr, config.optimizer_weight_decay, config.ema_decay) == (1e-3, 1e-4, 0.995)
    assert (config.tokens_per_frame, config.frames_per_episode, config.memory_frames) == (2, 6, 32)
    assert config.normalization_mapping["ACTION"] is NormalizationMode.MEAN_STD
    own = {"chunk_size": 8, "ema_decay": 0.0, "tokens_per_frame": 4}
    other = MemobenchMemConfig(device="cpu", size="small", perception="objects", **own)
    assert {name: getattr(other, name) for name in own} == own
    assert other.n_action_steps == 6
    other.save_pretrained(tmp_path)
    assert dataclasses.asdict(PreTrainedConfig.from_pretrained(tmp_path)) == dataclasses.asdict(other)
    before = MemobenchMemConfig(device="cpu", size="tiny")
    assert (before.objective, before.num_inference_steps, before.memory_stride) == ("flow_matching", 10, 1)
    assert (before.chunk_size, before.ema_decay, before.frames_per_episode) == (50, 0.999, 1)
    assert before.normalization_mapping["STATE"] is NormalizationMode.QUANTILES


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"perception": "object"}, "objects"),
        ({"perception": "objects", "tokens_per_frame": 0}, "tokens_per_frame"),
        ({"frames_per_episode": 0}, "frames_per_episode"),
        ({"warmup_fraction": 2.0}, "warmup_fraction"),
        ({"task_weights": {"prompted": -1.0}}, "must not hold negative weights"),
        ({"size": "small", "perception": "objects", "detection_noise": -1.0}, "detection_noise=-1.0"),
    ],
)
def test_bad_values_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(MemobenchError, match=message):
        MemobenchMemConfig(device="cpu", **fields)
