"""The policy through LeRobot's own doors: factories, training batches, rollouts, checkpoints."""

from __future__ import annotations

import copy
import functools
import operator
import shutil
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies import make_pre_post_processors
from lerobot.processor import TokenizerProcessorStep
from safetensors.torch import load_file, save_file

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem import modeling_memobench_mem, processor_memobench_mem
from lerobot_memobench.policies.memobench_mem.alignment import WordTextEncoder, make_alignment, make_text_encoder
from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import (
    GatherMemoryProcessorStep,
    PromptTokenizerProcessorStep,
    WordTokenizerProcessorStep,
    make_vocabulary,
    make_word_tokenizer,
)
from lerobot_memobench.training.average import TRAINING_FILE, begin_average
from tests.support.memory import remembered, trained_on
from tests.support.small_policy import CHUNK, batch_of, made_for_training, open_small_training, small_config


@pytest.fixture(scope="module")
def trained(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    """A policy after four updates, its processors, dataset, optimiser, and the checkpoint it was saved to."""
    policy, before, after, dataset = made_for_training(dataset_root, align="contrastive")
    with torch.no_grad():
        for name, parameter in policy.named_parameters():
            if ".modulation." in name:
                parameter.normal_(std=0.2)  # it starts at zero, and memory would hardly matter after four updates
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    policy.train()
    for step in range(4):
        loss, logged = policy.forward(before(batch_of(dataset, [step * 7, 45 + step, 70 + step, 90])))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    folder = tmp_path_factory.mktemp("checkpoint") / "pretrained_model"
    policy.save_pretrained(folder)
    before.save_pretrained(folder)
    after.save_pretrained(folder)
    return policy, before, after, dataset, folder, logged


# -- training ------------------------------------------------------------------------------------------------------


def test_batch_gathers_the_history_of_its_frames(dataset_root: Path) -> None:
    policy, before, _, dataset = made_for_training(dataset_root, align="framewise", memory_stride=2)
    batch = before(batch_of(dataset, [0, 39, 40 + 22, 45]))
    steps = [[2 * slot for slot in sample_frames(frame // 2, 8)] for frame in (0, 39, 22, 5)]
    found = trained_on(batch)
    assert [read for _, read in found] == steps
    assert batch["phase"].tolist() == [1, 1, 1, 0]
    expected = policy.perception(torch.stack([dataset[40 + step]["observation.images.image"] for step in steps[2]]))
    torch.testing.assert_close(found[2][0], expected)
    assert batch["memory.text"].shape == (4, 8, 64)
    assert [int(real.sum()) for real in batch["memory.text_mask"]] == [len(read) for read in steps]
    texts = WordTextEncoder(64)(["put the bowl in the drawer"])
    frame_8 = steps[2].index(next(step for step in steps[2] if 8 <= step < 15))
    torch.testing.assert_close(batch["memory.text"][2, frame_8], texts[0])


def test_losses_and_what_is_logged(trained: Any) -> None:
    policy, before, _, dataset, _, logged = trained
    assert {"action_loss", "align_loss", "align_grad_norm", "align_top1", "align_temperature"} <= set(logged)
    assert logged["loss"] == pytest.approx(logged["action_loss"] + 0.1 * logged["align_loss"], rel=1e-5)
    assert logged["align_grad_norm"] > 0
    assert 0 <= logged["align_top1"] <= 1
    per_sample, _ = policy.forward(before(batch_of(dataset, [3, 50, 80])), reduction="none")
    assert per_sample.shape == (3,)


@pytest.mark.parametrize("memory_fusion", ["modulation", "context"])
def test_half_precision_and_both_fusions_train_and_act(dataset_root: Path, memory_fusion: str) -> None:
    """The full size trains in bfloat16 under autocast, as LeRobot runs it."""
    policy, before, _, dataset = made_for_training(
        dataset_root, align="framewise", memory_fusion=memory_fusion, dtype="bfloat16"
    )
    policy.train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        loss, logged = policy.forward(before(batch_of(dataset, [3, 50, 80])))
    loss.backward()
    assert np.isfinite(logged["loss"])
    actions = _rollout(policy, before, [[_observation(dataset, 0, t)] for t in range(2)])
    assert torch.isfinite(actions).all()


def test_prompt_frames_do_not_count(dataset_root: Path) -> None:
    policy, before, _, dataset = made_for_training(dataset_root)
    batch = before(batch_of(dataset, [41, 43, 60, 5]))
    assert batch["phase"].tolist() == [0, 0, 1, 1]
    torch.manual_seed(3)
    loss, _ = policy.forward(batch)
    torch.manual_seed(3)
    per_sample, _ = policy.forward(batch, reduction="none")
    assert per_sample[:2].tolist() == [0, 0]
    assert loss.item() == pytest.approx(per_sample[2:].mean().item(), rel=1e-5)
    prompts, _ = policy.forward(before(batch_of(dataset, [41, 42])))
    assert prompts.item() == 0.0


def test_training_moves_memory_expert_and_vlm_and_not_the_tower(trained: Any, dataset_root: Path) -> None:
    policy = trained[0]
    fresh, *_ = made_for_training(dataset_root, align="contrastive")
    moved = {
        name
        for (name, now), before in zip(policy.named_parameters(), fresh.parameters(), strict=True)
        if not torch.equal(now, before)
    }
    for part in (
        "model.memory.",
        ".modulator.key",
        "model.memory_to_expert",
        ".gemma_expert.",
        "language_model",
        "alignment",
    ):
        assert any(part in name for name in moved), part
    assert not any("vision_tower" in name or "multi_modal_projector" in name or "lm_head" in name for name in moved)


def test_a_batch_without_memory_is_refused(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    batch = {key: value for key, value in before(batch_of(dataset, [3])).items() if not key.startswith("memory.")}
    with pytest.raises(MemobenchError, match=r"has no 'memory\.frames'"):
        policy.forward(batch)


# -- rollout -------------------------------------------------------------------------------------------------------


def _observation(dataset: LeRobotDataset, episode: int, frame: int) -> dict[str, Any]:
    item = dataset[int(dataset.meta.episodes["dataset_from_index"][episode]) + frame]
    keys = ("observation.images.image", "observation.images.wrist_image", "observation.state")
    found = {key: item[key][None] for key in keys}
    found["observation.step"] = torch.tensor([[float(frame)]])
    found["observation.phase"] = item["observation.phase"].reshape(1, 1).float()
    found["task"] = [item["task"]]
    return found


def _join(*observations: dict[str, Any]) -> dict[str, Any]:
    return {
        key: functools.reduce(operator.iadd, (o[key] for o in observations), [])
        if key == "task"
        else torch.cat([o[key] for o in observations])
        for key in observations[0]
    }


def test_rollout_memory_equals_the_gathered_one(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    policy.eval()
    policy.reset()
    for frame in range(23):
        policy.observe(before(_join(_observation(dataset, 1, frame), _observation(dataset, 2, frame))))
    batch = before(batch_of(dataset, [40 + 22, 63 + 22]))
    for (frames, steps), (learned, learned_steps) in zip(remembered(policy, [0, 1]), trained_on(batch), strict=True):
        assert steps == learned_steps
        # The same tower, in batches of other sizes: equal up to the last bit of bfloat16.
        torch.testing.assert_close(frames, learned, rtol=1e-2, atol=1e-2)


def _rollout(policy: Any, before: Any, frames: list[list[dict[str, Any]]]) -> torch.Tensor:
    """Actions (steps, rows, 7) of a rollout whose observations are frames[step][row]."""
    policy.eval()
    policy.reset()
    return torch.stack([policy.select_action(before(_join(*rows))) for rows in frames])


def test_rows_of_a_batch_are_independent(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    episodes = (0, 1, 2)
    frames = [[_observation(dataset, e, t) for e in episodes] for t in range(14)]
    together = _rollout(policy, before, frames)
    close = {"rtol": 1e-4, "atol": 1e-4}
    for row in range(3):
        torch.testing.assert_close(
            together[:, row : row + 1], _rollout(policy, before, [[f[row]] for f in frames]), **close
        )
    permuted = _rollout(policy, before, [[f[2], f[0], f[1]] for f in frames])
    torch.testing.assert_close(permuted, together[:, [2, 0, 1]], **close)
    # Row 0 ends and is frozen, then begins again; row 1 never notices.
    again = [[frames[min(t, 4)][0] if t < 9 else frames[t - 9][0], frames[t][1]] for t in range(14)]
    mixed = _rollout(policy, before, again)
    torch.testing.assert_close(mixed[:, 1], together[:, 1], **close)
    torch.testing.assert_close(mixed[9:, 0], together[:5, 0], **close)
    assert torch.equal(mixed[4:9, 0], mixed[4:5, 0].expand(5, -1))  # frozen: nothing new is planned


def test_actions_depend_on_what_was_seen_long_ago(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    frames = [[_observation(dataset, 1, t)] for t in range(9)]
    other = copy.deepcopy(frames)
    other[0][0]["observation.images.image"] = 1 - other[0][0]["observation.images.image"]
    noise = torch.zeros(1, CHUNK, 32)

    def last_plan(sequence: list[list[dict[str, Any]]]) -> torch.Tensor:
        policy.reset()
        return [policy.predict_action_chunk(before(_join(*rows)), noise=noise) for rows in sequence][-1]

    assert (last_plan(frames) - last_plan(other)).abs().max() > 1e-4
    assert torch.equal(last_plan(frames), last_plan(frames))


def test_plans_begin_with_the_execution_phase(trained: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    policy, before, _, dataset, _, _ = trained
    planned: list[tuple[int, list[int]]] = []
    original = policy.plan
    monkeypatch.setattr(policy, "plan", lambda b, rows, *a: planned.append((t, rows)) or original(b, rows, *a))
    policy.eval()
    policy.reset()
    for t in range(16):
        policy.select_action(before(_join(_observation(dataset, 0, t), _observation(dataset, 1, t))))
    # Row 1 executes from step 8 (its prompt is over); every plan lasts six steps.
    assert planned == [(0, [0]), (6, [0]), (8, [1]), (12, [0]), (14, [1])]


def test_sampling_noise_follows_the_seed_of_the_process(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    frames = [[_observation(dataset, 0, 0)]]
    torch.manual_seed(7)
    first = _rollout(policy, before, frames)
    torch.rand(5)
    assert torch.equal(_rollout(policy, before, frames), first)
    torch.manual_seed(8)
    assert not torch.equal(_rollout(policy, before, frames), first)


def test_a_camera_of_another_name_is_refused(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    policy.reset()
    observation = _observation(dataset, 0, 0)
    observation["observation.images.top"] = observation.pop("observation.images.image")
    with pytest.raises(MemobenchError, match=r"it has observation\.images\.wrist_image, observation\.images\.top"):
        policy.select_action(before(observation))


def test_chunk_of_all_rows(trained: Any) -> None:
    policy, before, _, dataset, _, _ = trained
    policy.reset()
    batch = before(_join(_observation(dataset, 0, 0), _observation(dataset, 2, 0)))
    assert policy.predict_action_chunk(batch).shape == (2, CHUNK, 7)
    assert policy.predict_action_chunk(batch, noise=torch.zeros(2, CHUNK, 32)).shape == (2, CHUNK, 7)


class _Env(gym.Env):
    """Moves a square for a given number of steps; observations as the benchmark's environment gives them."""

    metadata = {"render_fps": 20}
    _max_episode_steps = 12

    def __init__(self, length: int, prompt: int) -> None:
        self.length, self.prompt, self.t = length, prompt, 0
        self.task, self.task_description = "toy", "put the bowl away"
        picture = gym.spaces.Box(0, 255, (48, 48, 3), np.uint8)
        box = lambda n: gym.spaces.Box(-np.inf, np.inf, (n,), np.float32)  # noqa: E731
        self.observation_space = gym.spaces.Dict(
            {
                "pixels": gym.spaces.Dict({"image": picture, "wrist_image": picture}),
                "agent_pos": box(8),
                "step": box(1),
                "phase": box(1),
            }
        )
        self.action_space = gym.spaces.Box(-1, 1, (7,), np.float32)

    def _see(self) -> dict[str, Any]:
        image = np.zeros((48, 48, 3), np.uint8)
        image[self.t : self.t + 10] = 200
        return {
            "pixels": {"image": image, "wrist_image": image},
            "agent_pos": np.zeros(8, np.float32),
            "step": np.array([self.t], np.float32),
            "phase": np.array([self.t >= self.prompt], np.float32),
        }

    def reset(self, *, seed: int | None = None, options: dict | None = None):  # type: ignore[no-untyped-def]
        self.t = 0
        return self._see(), {"is_success": False}

    def step(self, action: np.ndarray):  # type: ignore[no-untyped-def]
        assert np.isfinite(action).all()
        self.t += 1
        done = self.t >= self.length
        return self._see(), 0.0, done, False, {"is_success": done}


def test_lerobots_rollout_loop_runs_on_a_checkpoint(trained: Any) -> None:
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.scripts.lerobot_eval import rollout

    folder = trained[4]
    policy = MemobenchMemPolicy.from_pretrained(folder)
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(folder))
    envs = gym.vector.SyncVectorEnv([lambda: _Env(5, 0), lambda: _Env(12, 4)])
    plain = PolicyProcessorPipeline(steps=[])
    result = rollout(envs, policy, plain, plain, before, after, seeds=[1, 2])
    assert result["action"].shape == (2, 12, 7)
    assert torch.isfinite(result["action"]).all()
    assert result["success"].any(dim=1).tolist() == [True, True]


# -- checkpoints ---------------------------------------------------------------------------------------------------


def test_what_a_checkpoint_holds_is_not_drawn_first(trained: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[torch.Tensor] = []

    def noted(*given: Any) -> Any:
        drawn.append(torch.get_rng_state())
        return make_alignment(*given)

    monkeypatch.setattr(modeling_memobench_mem, "make_alignment", noted)
    before = torch.get_rng_state()
    MemobenchMemPolicy.from_pretrained(trained[4])
    assert all(torch.equal(state, before) for state in drawn)  # of the weights' shapes, and of the policy
    MemobenchMemPolicy(copy.deepcopy(trained[0].config))
    assert not torch.equal(drawn[-1], before)


def test_resuming_rebuilds_the_pipeline_and_finds_the_cache(trained: Any) -> None:
    _, before, _, dataset, folder, _ = trained
    config = begun_with(folder)
    training = open_small_training(dataset.root, config)
    again, acting = training.processors[0], make_pre_post_processors(config, pretrained_path=str(folder))[0]
    for pipeline, lookup in ((again, training.lookup), (acting, None)):
        step = next(step for step in pipeline.steps if isinstance(step, GatherMemoryProcessorStep))
        assert (step.frames, step.align, step.lookup) == (8, "contrastive", lookup)
    raw = batch_of(dataset, [3, 50])
    first, second = before(copy.deepcopy(raw)), again(copy.deepcopy(raw))
    for key in ("memory.frames", "memory.text", "observation.language.tokens", "action"):
        assert torch.equal(first[key], second[key]), key


def test_changing_the_objective_keeps_the_rest(trained: Any, dataset_root: Path) -> None:
    dataset, folder = trained[3], trained[4]
    policy = MemobenchMemPolicy.from_pretrained(
        folder,
        config=small_config(
            align="framewise",
            input_features=trained[0].config.input_features,
            output_features=trained[0].config.output_features,
        ),
        dataset_meta=dataset.meta,
    )
    assert type(policy.alignment).__name__ == "FramewiseAlignment"


def _copy(folder: Path, target: Path) -> Path:
    shutil.copytree(folder, target)
    return target


def test_missing_statistics_are_refused(trained: Any, tmp_path: Path) -> None:
    dataset, folder = trained[3], trained[4]
    broken = _copy(folder, tmp_path / "a")
    state = next(broken.glob("policy_preprocessor_step_*_normalizer_processor.safetensors"))
    save_file({k: v for k, v in load_file(state).items() if not k.startswith("action")}, state)
    with pytest.raises(MemobenchError, match="no dataset statistics for action"):
        MemobenchMemPolicy.from_pretrained(broken)
    MemobenchMemPolicy.from_pretrained(broken, dataset_meta=dataset.meta)  # a dataset brings its own
    state.unlink()
    with pytest.raises(MemobenchError, match=r"no dataset statistics for action and observation.state"):
        MemobenchMemPolicy.from_pretrained(broken)
    (broken / "policy_preprocessor.json").unlink()
    with pytest.raises(MemobenchError, match=r"policy_preprocessor.json"):
        MemobenchMemPolicy.from_pretrained(broken)
    config = small_config(
        input_features=trained[0].config.input_features, output_features=trained[0].config.output_features
    )
    with pytest.raises(MemobenchError, match=r"never|no dataset statistics"):
        make_pre_post_processors(config)


def test_weights_that_do_not_fit_are_refused(trained: Any, tmp_path: Path) -> None:
    folder = trained[4]
    broken = _copy(folder, tmp_path / "a")
    weights = load_file(broken / "model.safetensors")
    weights.pop("model.memory.encoder.project.weight")
    save_file(weights, broken / "model.safetensors")
    with pytest.raises(MemobenchError, match=r"model.memory.encoder.project.weight"):
        MemobenchMemPolicy.from_pretrained(broken)
    (broken / "model.safetensors").unlink()
    with pytest.raises(MemobenchError, match=r"no model.safetensors"):
        MemobenchMemPolicy.from_pretrained(broken)


def begun_with(folder: Path) -> PreTrainedConfig:
    """Return the configuration of a training that begins with a checkpoint."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    return config


def test_weights_that_are_cut_off_are_named(trained: Any, tmp_path: Path) -> None:
    path = cut_off(_copy(trained[4], tmp_path / "a") / "model.safetensors")
    with pytest.raises(MemobenchError, match=rf"{path.name} cannot be read \(SafetensorError: .*; copy or train"):
        MemobenchMemPolicy.from_pretrained(path.parent)
    with pytest.raises(MemobenchError, match=rf"{path.name} cannot be read"):
        made_for_training(trained[3].root, base_weights=str(path.parent))


def test_trained_weights_that_are_cut_off_are_named(trained: Any, tmp_path: Path) -> None:
    folder = _copy(trained[4], tmp_path / "a")
    begin_average(trained[0]).save(folder)
    training = open_small_training(trained[3].root, begun_with(folder))
    assert begin_average(training.policy) is not None
    path = cut_off(folder / TRAINING_FILE)
    with pytest.raises(MemobenchError, match=rf"{path.name} cannot be read \(SafetensorError: .*; copy or train"):
        begin_average(training.policy)


def cut_off(path: Path) -> Path:
    """Keep the first half of a file."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def test_pi05_weights_as_a_start(trained: Any, tmp_path: Path) -> None:
    """A file named as pi0.5's own, at tiny dimensions: everything but the memory comes from it."""
    from lerobot_memobench.policies.memobench_mem.network import MemoryPI05

    torch.manual_seed(11)
    plain = MemoryPI05(small_config(memory_fusion="none"))
    with torch.no_grad():
        for parameter in plain.parameters():
            parameter.add_(0.1)
    save_file({k: v.contiguous() for k, v in plain.state_dict().items()}, tmp_path / "model.safetensors")
    features = {
        "input_features": trained[0].config.input_features,
        "output_features": trained[0].config.output_features,
    }
    policy = MemobenchMemPolicy(small_config(base_weights=str(tmp_path), **features))
    memory = policy.model.memory_parameters()
    own = {
        name.replace("post_attention_layernorm.norm.", "post_attention_layernorm."): tensor
        for name, tensor in policy.model.named_parameters()
        if name not in memory
    }
    for name, tensor in plain.named_parameters():
        assert torch.equal(own[name], tensor), name
    # The tower alone, as `memobench cache --weights` reads it, is the same tower.
    from lerobot_memobench.training.features import load_image_tower

    assert load_image_tower(small_config(), tmp_path).key == policy.perception.key
    assert load_image_tower(small_config()).key == trained[0].perception.key != policy.perception.key


# -- words ---------------------------------------------------------------------------------------------------------


def test_word_tokenizer() -> None:
    vocabulary = make_vocabulary(["Put the bowl away, then wait.", "put the lid on"], 1024)
    tokenizer = make_word_tokenizer(vocabulary)
    ids = tokenizer("Task: put the BOWL, State: -1 255 7;\nAction: zebra").input_ids
    words = tokenizer.convert_ids_to_tokens(ids)
    assert words == [
        *("<bos>", "task", ":", "put", "the", "bowl", ",", "state", ":", "-", "1", "255", "7", ";", "action", ":"),
        "<unk>",
    ]
    assert len(make_vocabulary((f"word{i}" for i in range(5000)), 1024)) == 1024


def step_of(texts: list[str], length: int = 24) -> WordTokenizerProcessorStep:
    return WordTokenizerProcessorStep(vocabulary=make_vocabulary(texts, 1024), max_length=length, padding="max_length")


def test_unknown_words_are_told_once_by_name(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    monkeypatch.setattr(processor_memobench_mem, "_told", set())
    step = step_of(["Switch the stove on."])
    for _ in range(3):
        step._tokenize_text(["Switch the stove on.", "Switch the stove on twice, then once."])
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    told = caplog.text
    assert "does not know 'twice', 'then', 'once' in 'Switch the stove on twice, then once.'" in told
    monkeypatch.setattr(step, "input_tokenizer", None)  # what has been looked at is not tokenized again
    processor_memobench_mem.warn_of_losses(None, "Switch the stove on twice, then once.", 24, full=False)
    step = step_of(["Switch the stove on."])
    step._tokenize_text("Task: Turn the stove on once, State: 1 2;")
    assert "does not know 'turn' in 'Turn the stove on once'" in caplog.messages[1]


def test_what_the_token_limit_cuts_off_is_told_once_per_instruction(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(processor_memobench_mem, "_told", set())
    prompt = "Task: Switch the stove on. Memory: the stove was on, State: {} 12 200;\nAction: "
    step = step_of([prompt], length=14)
    for state in (7, 8, 9):
        step._tokenize_text([prompt.format(state)])
    assert len(caplog.messages) == 1
    assert "prompt of 'Switch the stove on.' has 23 tokens and the policy reads 14" in caplog.text
    assert "cut off: ', State: 7 12 200;\\nAction: '" in caplog.text
    caplog.clear()
    step._tokenize_text("switch the stove on. the stove was on. switch")
    assert not caplog.messages, "what fits is not told"
    exactly = "switch " * 13
    step._tokenize_text(exactly)
    assert not caplog.messages, "nor what fits exactly"
    step._tokenize_text(exactly + "off")
    assert "cut off: 'off'" in caplog.text


def test_the_pretrained_tokenizer_tells_what_it_cuts_off(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(processor_memobench_mem, "_told", set())
    words = make_word_tokenizer(make_vocabulary(["put the bowl"], 1024))
    step = PromptTokenizerProcessorStep(tokenizer=words, max_length=3)
    step._tokenize_text(["put the bowl"])
    assert "cut off: 'bowl'" in caplog.text


def test_texts_that_come_again_are_tokenized_as_by_lerobot() -> None:
    texts = ["put the bowl away", "wait", "put the bowl away", "wait", "put it away"]
    step = WordTokenizerProcessorStep(vocabulary=make_vocabulary(texts, 1024), max_length=8, padding="max_length")
    found, lerobots = step._tokenize_text(texts), TokenizerProcessorStep._tokenize_text(step, texts)
    assert [*found] == [*lerobots]
    for name, expected in lerobots.items():
        assert torch.equal(found[name], expected)
    assert torch.equal(step._tokenize_text("wait")["input_ids"], found["input_ids"][1:2])


def test_word_text_encoder_tells_texts_apart() -> None:
    texts = ["pick up the red cup", "pick up the green cup", "put a on b", "put b on a", "pick up the red cup"]
    vectors = WordTextEncoder(64)(texts)
    similarity = vectors @ vectors.T
    assert similarity[0, 4] > 0.999
    similarity.fill_diagonal_(0)
    similarity[0, 4] = similarity[4, 0] = 0
    assert similarity.max() < 0.99


def test_label_text_encoder_knows_which_texts_are_equal_and_no_words() -> None:
    texts = ["pick up the red cup", "pick up the green cup", "pick up the red cup"]
    labels, hashed = (make_text_encoder(name, 512)(texts) for name in ("labels", "words"))
    assert labels[0] @ labels[2] > 0.999
    assert abs(labels[0] @ labels[1]) < 0.2 < hashed[0] @ hashed[1]
    assert make_text_encoder("labels", 512).key != make_text_encoder("words", 512).key
