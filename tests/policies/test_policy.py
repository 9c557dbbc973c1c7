"""The policy: training batches, rollouts of independent rows, precision, checkpoints."""

from __future__ import annotations

import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from safetensors.torch import load_file, save_file
from torch import Tensor

from lerobot_memobench.constants import ENDED, EXECUTION, NO_CLOCK, PROMPT
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import WordTokenizerProcessorStep
from lerobot_memobench.policies.memobench_mem.rollout import EnvMemory, Rollout
from lerobot_memobench.training.data import Training
from lerobot_memobench.training.loop import begin_average
from tests.support.held_dataset import LENGTHS as HELD_LENGTHS
from tests.support.held_dataset import make_held_dataset
from tests.support.small_policy import (
    Samples,
    batch_of,
    draw_modulation,
    made_for_training,
    open_small_training,
    remembered,
    small_config,
    trained_on,
)
from tests.support.synthetic_dataset import LENGTHS

OBJECTS: dict[str, Any] = {"perception": "objects", "size": "small", "n_action_steps": 3, "memory_stride": 2}
STARTS = np.cumsum([0, *LENGTHS]).tolist()
"""First frames of the episodes, which have prompts of 6, 8 and 0 frames."""


@pytest.fixture(scope="module")
def trained(root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Any, Any, Path, dict[str, Any]]:
    """A policy after two updates, its preprocessor, samples, checkpoint, and the last logged numbers."""
    policy, before, after, dataset = made_for_training(
        root, **OBJECTS, align="contrastive", objective="flow_matching", num_inference_steps=2
    )
    draw_modulation(policy)
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for step in range(2):
        loss, logged = policy.forward(before(batch_of(dataset, [10 + step, 30, 55, 80])))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    folder = tmp_path_factory.mktemp("checkpoint") / "pretrained_model"
    for part in (policy, before, after):
        part.save_pretrained(folder)
    return policy, before, dataset, folder, logged


def observed(dataset: Any, *indices: int, clock: bool = True, **more: Any) -> dict[str, Any]:
    """Return a rollout's observation of rows at these frames of the dataset."""
    rows = [dataset.hf_dataset[index] for index in indices]
    keys = ["observation.state", "observation.environment_state"]
    keys += ["observation.step", "observation.phase"] if clock else []
    found = {key: torch.stack([row[key].float().reshape(-1) for row in rows]) for key in keys}
    return found | {"task": [dataset.meta.tasks.index[int(row["task_index"])] for row in rows]} | more


# -- training ------------------------------------------------------------------------------------------------------


def test_no_memory_is_plain_pi05(root: Path) -> None:
    """Histories have no effect, and no weight belongs to a memory."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS | {"memory": "none"})
    assert not [name for name, _ in policy.named_parameters() if "memory" in name or "modulat" in name]
    assert FRAMES not in before(batch_of(dataset, [30]))
    plans = []
    for history in ([], [0, 1, 2, 3], [41, 42, 43]):
        policy.reset()
        for index in history:
            policy.observe(before(observed(dataset, index)))
        plans.append(policy.predict_action_chunk(before(observed(dataset, 30))))
    assert torch.equal(plans[0], plans[1])
    assert torch.equal(plans[0], plans[2])


def test_bfloat16_trains_in_float32(root: Path) -> None:
    """Updates below the last bit of a bfloat16 weight accumulate; frozen weights stay bfloat16."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS, dtype="bfloat16", optimizer_lr=1e-6)
    assert {parameter.dtype for parameter in policy.get_optim_params()} == {torch.float32}
    frozen = {name: p.dtype for name, p in policy.named_parameters() if not p.requires_grad}
    assert frozen["model.paligemma_with_expert.gemma_expert.lm_head.weight"] == torch.bfloat16
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    weight = policy.model.paligemma_with_expert.gemma_expert.model.layers[0].mlp.up_proj.weight
    start = weight.detach().clone()
    for indices in ([10, 30], [20, 70]):
        with torch.autocast("cpu", dtype=torch.bfloat16):
            policy.train().forward(before(batch_of(dataset, indices)))[0].backward()
        optimizer.step()
        optimizer.zero_grad()
    assert (weight != start).float().mean() > 0.95
    assert policy.select_action(before(observed(dataset, 8))).isfinite().all()


# -- rollouts ------------------------------------------------------------------------------------------------------


def test_a_stalled_hand_goes_on_in_its_chunk(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is held for two plans, stalls for three, and moves; all plans have three actions."""
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    chunk = torch.arange(16.0)[None, :, None].expand(1, 16, 7)
    monkeypatch.setattr(policy, "plan", lambda *_: chunk)
    policy.reset()
    done = []
    for step in range(21):
        frame = observed(dataset, 30, **{"observation.step": torch.tensor([[float(step)]])})
        moved = [0, 0, 0.001, 0.002, 0.003, 0.02, 0.02][step // 3]
        frame["observation.state"] = frame["observation.state"] + moved
        done.append(int(policy.select_action(before(frame))[0, 0]))
    assert [done[at : at + 3] for at in range(0, 21, 3)] == [
        [first, first + 1, first + 2] for first in (0, 0, 3, 6, 9, 0, 0)
    ]


def test_plans_are_not_repeated_in_a_hold(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Row 0 acts from frame 4 on, whose observations are equal in 4 ... 9 and 14 ... 17; those of row 1 in 5 ... 12."""
    policy, before, _, dataset = made_for_training(make_held_dataset(tmp_path / "data"), **OBJECTS)
    draw_modulation(policy)
    plan, planned = policy.plan, dict[int, list[int]]()

    def act(corrupted: int | None = None) -> Tensor:
        actions = list[Tensor]()
        policy.reset()
        planned.clear()
        monkeypatch.setattr(policy, "plan", lambda *call: planned.update({len(actions): call[1]}) or plan(*call))
        for step in range(20):
            if step == corrupted:
                policy.corrupt_memory("noise", [1])
            actions.append(policy.select_action(before(observed(dataset, step, HELD_LENGTHS[0] + step))))
        return torch.stack(actions)

    acted, without = (
        act(),
        {0: [1], 3: [1], 4: [0], 6: [1], 10: [0], 13: [0], 15: [1], 16: [0], 18: [1], 19: [0]},
    )
    assert planned == without
    act(corrupted=7)
    assert planned == without | {9: [1]}
    monkeypatch.setattr(EnvMemory, "repeats", lambda *_: False)
    assert torch.equal(act(), acted)
    assert planned == without | {7: [0], 9: [1], 12: [1]}


STATE = torch.tensor([0.1, 0.2, 1.0, 3.13, 0.1, 0.0, 0.04, -0.04])
AXIS = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0])


def moved(index: int, by: float) -> Tensor:
    return STATE + by * torch.eye(8)[index]


@pytest.mark.parametrize(
    ("state", "first"),
    [(state, 6) for state in (moved(2, 0.005), moved(4, 0.05), STATE - 2.007 * STATE * AXIS)]
    + [(state, 0) for state in (STATE, moved(2, 0.01), moved(4, 0.2), None)],
)
def test_stalled_hands_are_recognised(state: Tensor | None, first: int) -> None:
    """One state has nearly the same rotation with the opposite axis; an equal one is of a held hand."""
    row, chunk = EnvMemory(), torch.arange(16.0)[:, None]

    def begins(state: Tensor | None) -> int:
        row.queue.clear()
        row.begin_chunk(chunk, 6, state)
        assert len(row.queue) == 6, "as declared to the environment"
        return int(row.queue[0])

    assert begins(STATE) == 0
    assert begins(state) == first
    row.drop_chunk()
    assert begins(STATE) == 0
    assert [begins(moved(2, 0.001 * step)) for step in range(1, 5)] == [6, 10, 10, 10], "to the chunk's end"


def test_one_thread_runs_a_rollout(trained: Any) -> None:
    policy, before, dataset, _, _ = trained

    def act() -> Any:
        return policy.select_action(before(observed(dataset, 8)))

    policy.reset()
    act()
    with ThreadPoolExecutor(1) as other:
        other.submit(policy.reset).result()
        assert other.submit(act).result().shape == (1, 7)
        with pytest.raises(MemobenchError, match="max_parallel_tasks=1"):
            act()
    policy.reset()
    act()
    (row,) = policy.rollout.envs
    history = row.memory
    policy.drop_queued_actions()
    assert not row.queue
    assert row.memory is history


# -- rows and clocks -----------------------------------------------------------------------------------------------

PUBLISHED = [(PROMPT, 0), (PROMPT, 1), (EXECUTION, 0), (EXECUTION, 1), (EXECUTION, 1), (PROMPT, 0)]
COUNTED_ON = [(PROMPT, 0), (PROMPT, 1), (EXECUTION, 2), (EXECUTION, 3), (EXECUTION, 5), (EXECUTION, 0)]
STRICT = [(PROMPT, 0), (PROMPT, 1), *[(EXECUTION, NO_CLOCK)] * 3, *[(EXECUTION, ENDED)] * 2, (PROMPT, 0)]
WITHOUT_PROMPT = [*[(EXECUTION, NO_CLOCK)] * 3, *[(EXECUTION, ENDED)] * 2, *[(EXECUTION, NO_CLOCK)] * 2]


@pytest.mark.parametrize(
    ("clocks", "positions", "begins", "frozen"),
    [
        (PUBLISHED, [0, 1, 2, 3, 3, 0], [0, 5], [4]),
        (COUNTED_ON, [0, 1, 2, 3, 5, 0], [0, 5], []),
        (STRICT, [0, 1, 2, 3, 4, 4, 4, 0], [0, 7], [5, 6]),
        (WITHOUT_PROMPT, [0, 1, 2, 2, 2, 0, 1], [0, 5], [3, 4]),
    ],
)
def test_rows_follow_their_clock(
    clocks: list[tuple[int, int]], positions: list[int], begins: list[int], frozen: list[int]
) -> None:
    written: list[int] = []
    rollout = Rollout(remembers=True, stride=1)
    found = []
    for k, clock in enumerate(clocks):
        (started,) = rollout.observe([clock], lambda rows, k=k: written.append(k))  # type: ignore[misc]
        (env,) = rollout.envs
        found.append((env.position, started, env.frozen))
    assert [position for position, _, _ in found] == positions
    assert [k for k, (_, started, _) in enumerate(found) if started] == begins
    assert [k for k, (_, _, is_frozen) in enumerate(found) if is_frozen] == frozen
    assert written == [k for k in range(len(clocks)) if k not in frozen]


def test_repeated_frames_are_left_out_as_in_training(tmp_path: Path) -> None:
    """Holds at frames 4, 14 and 22 repeat the frame at which they begin."""
    root = make_held_dataset(tmp_path / "data")
    fields = OBJECTS | {"memory_settings": {"frames": 4}}
    policy, before, _, dataset = made_for_training(root, **fields)
    last = HELD_LENGTHS[0] - 1
    policy.reset()
    for step in range(last + 1):
        policy.observe(before(observed(dataset, step)))
    stored = [frame.step for frame in policy.rollout.envs[0].memory[0]]
    assert stored == [0, 2, 4, 10, 12, 14, 18, 20, 22]
    (rolled,), (trained,) = remembered(policy, [0]), trained_on(before(batch_of(dataset, [last])))
    assert rolled[1] == trained[1] == [0, 4, 14, 22]
    assert torch.equal(rolled[0], trained[0])


# -- chunks for LeRobot --------------------------------------------------------------------------------------------


def test_plans_need_every_observation(root: Path) -> None:
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    policy.reset()
    policy.predict_action_chunk(before(observed(dataset, 63, clock=False)))
    with pytest.raises(MemobenchError, match=r"inference\.type=sync.*observe"):
        policy.predict_action_chunk(before(observed(dataset, 69, clock=False)))
    policy.reset()
    policy.predict_action_chunk(before(observed(dataset, STARTS[2])))
    with pytest.raises(MemobenchError, match="step 2"):
        policy.predict_action_chunk(before(observed(dataset, STARTS[2] + 6)))


@pytest.mark.parametrize("clock", [True, False])
def test_observe_and_plan_equal_select_action(root: Path, clock: bool) -> None:
    policy, before, _, dataset = made_for_training(root, **OBJECTS)
    batches = [before(observed(dataset, STARTS[2] + step, clock=clock)) for step in range(13)]
    policy.reset()
    plans, actions = [], []
    for batch in batches:
        policy.observe(batch)
        plans.append(policy.predict_action_chunk(batch) if len(plans) % 6 == 0 else None)
    trained = before(batch_of(dataset, [STARTS[2] + 12]))
    assert remembered(policy, [0])[0][1] == trained_on(trained)[0][1]
    policy.reset()
    for batch in batches:
        policy.drop_queued_actions()
        actions.append(policy.select_action(batch))
    for plan, action in zip(plans, actions, strict=True):
        assert plan is None or torch.allclose(plan[:, 0], action, atol=1e-5)


# -- checkpoints ---------------------------------------------------------------------------------------------------


def copied(folder: Path, target: Path) -> Path:
    shutil.copytree(folder, target)
    return target


def test_incomplete_statistics_are_refused(trained: Any, tmp_path: Path) -> None:
    policy, _, dataset, folder, _ = trained
    broken = copied(folder, tmp_path / "it")
    state = next(broken.glob("policy_preprocessor_step_*_normalizer_processor.safetensors"))
    save_file({k: v for k, v in load_file(state).items() if not k.startswith("action")}, state)
    with pytest.raises(MemobenchError, match="statistics for action"):
        MemobenchMemPolicy.from_pretrained(broken)
    MemobenchMemPolicy.from_pretrained(broken, dataset_meta=dataset.meta)  # a dataset has its own
    (broken / "policy_preprocessor.json").unlink()
    with pytest.raises(MemobenchError, match=r"policy_preprocessor\.json"):
        MemobenchMemPolicy.from_pretrained(broken)
    with pytest.raises(MemobenchError, match="statistics"):
        make_pre_post_processors(policy.config)


def test_broken_weights_are_refused(trained: Any, root: Path, tmp_path: Path) -> None:
    file = copied(trained[3], tmp_path / "it") / "model.safetensors"
    weights = load_file(file)
    save_file({key: one for key, one in weights.items() if key != "model.memory.encoder.project.weight"}, file)
    with pytest.raises(MemobenchError, match=r"model\.memory\.encoder\.project\.weight"):
        MemobenchMemPolicy.from_pretrained(file.parent)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(MemobenchError, match=rf"{file.name} cannot be read"):
        MemobenchMemPolicy.from_pretrained(file.parent)
    with pytest.raises(MemobenchError, match=rf"{file.name} cannot be read"):
        made_for_training(root, **OBJECTS, base_weights=str(file.parent))


def test_base_weights_are_loaded_except_for_the_memory(trained: Any, tmp_path: Path) -> None:
    """Names are those of openpi's checkpoints, whose embedding is the language head."""
    fields = {"perception": "objects", "size": "small"}
    plain = MemoryPI05(small_config(**fields, memory="none"))
    with torch.no_grad():
        for parameter in plain.parameters():
            parameter.add_(0.1)
    paligemma = plain.paligemma_with_expert.paligemma
    paligemma.model.language_model.embed_tokens.weight = paligemma.lm_head.weight
    weights = {name.replace("time_mlp", "action_time_mlp"): one for name, one in plain.state_dict().items()}
    del weights["paligemma_with_expert.paligemma.model.language_model.embed_tokens.weight"]
    save_file({name: one.contiguous() for name, one in weights.items()}, tmp_path / "model.safetensors")
    features = {name: getattr(trained[0].config, name) for name in ("input_features", "output_features")}
    policy = MemobenchMemPolicy(small_config(base_weights=str(tmp_path), **fields, **features))
    memory = policy.model.memory_names()
    own = {name: one for name, one in policy.model.named_parameters() if name not in memory}
    expected = dict(plain.named_parameters(remove_duplicate=False))
    assert own.keys() == expected.keys()
    assert all(torch.equal(own[name], one) for name, one in expected.items())


@pytest.fixture(scope="module")
def start(root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("start") / "pretrained_model"
    policy, *processors, _ = made_for_training(root, **OBJECTS)
    for part in (policy, *processors):
        part.save_pretrained(folder)
    return folder


def training_from(root: Path, checkpoint: Path, **settings: Any) -> Training:
    config: Any = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    for name, value in settings.items():
        setattr(config, name, value)
    return open_small_training(root, config)


def test_oracle_memory_extends_the_vocabulary(root: Path, start: Path, tmp_path: Path) -> None:
    before = _tokenizer(start)
    training = training_from(root, start, oracle_memory=True)
    for part in (training.policy, *training.processors):
        part.save_pretrained(tmp_path)
    batch, after = training.processors[0](batch_of(Samples(training), [3, 50])), _tokenizer(tmp_path)
    assert after.vocabulary[: len(before.vocabulary)] == before.vocabulary
    texts = after.input_tokenizer.batch_decode(batch["observation.language.tokens"])
    assert all("memory" in text and "was lit" in text and "<unk>" not in text for text in texts), texts


def _tokenizer(checkpoint: Path) -> WordTokenizerProcessorStep:
    config = PreTrainedConfig.from_pretrained(checkpoint)
    MemobenchMemPolicy.from_pretrained(checkpoint, config=config)
    pipeline, _ = make_pre_post_processors(config, pretrained_path=str(checkpoint))
    return next(step for step in pipeline.steps if isinstance(step, WordTokenizerProcessorStep))


def test_settings_that_saved_processors_lack_are_refused(root: Path, start: Path) -> None:
    with pytest.raises(MemobenchError, match="tokenizer_name"):
        training_from(root, start, tokenizer_name="google/some")
    config: Any = PreTrainedConfig.from_pretrained(start)
    config.oracle_memory = True
    with pytest.raises(MemobenchError, match="oracle_memory"):
        MemobenchMemPolicy.from_pretrained(start, config=config)


@pytest.mark.parametrize("memory", ["frames", "none"])
def test_adapters_leave_memory_and_heads_whole(dataset_root: Path, memory: str, tmp_path: Path) -> None:
    align = "none" if memory == "none" else "contrastive"
    policy, before, _, dataset = made_for_training(dataset_root, memory=memory, align=align)
    names = policy._get_default_peft_targets()["modules_to_save"]  # peft compares the ends of names
    modules = [name for name, _ in policy.named_modules() if any(name.endswith(end) for end in names)]
    whole = {name for name, _ in policy.named_parameters() if any(name.startswith(f"{one}.") for one in modules)}
    own = {f"model.{name}" for name in policy.model.memory_parameters()}
    assert whole == own | {name for name, _ in policy.named_parameters() if name.startswith("alignment.")}
    assert bool(whole) == (memory != "none")
    if memory == "none":
        return
    policy.save_pretrained(tmp_path)
    policy.config.pretrained_path = str(tmp_path)
    wrapped = policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "r": 2})
    wrapped.train()
    loss, _ = wrapped.forward(before(batch_of(dataset, [3, 50, 80])))
    loss.backward()
    learning = {name for name, p in wrapped.named_parameters() if p.requires_grad and p.grad is not None}
    for part in ("lora_A", "model.memory.", "modulators", "memory_to_expert", "alignment"):
        assert any(part in name for name in learning), part
    assert begin_average(policy) is None
