"""Pre- and post-processing of ``memobench_mem``: pi0.5's steps, memory of training samples, tokenizers of text prompts.

A tokenizer is a pretrained one, or of words from the dataset's tasks. It warns of what it loses: words that it does not
know, and what its length cuts off.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import InitVar, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    ObservationProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    RelativeActionsProcessorStep,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from tokenizers import Regex, Tokenizer
from tokenizers.models import WordLevel
from tokenizers.normalizers import Lowercase
from tokenizers.pre_tokenizers import Split
from tokenizers.processors import TemplateProcessing
from torch import Tensor

from lerobot_memobench.datasets.frames import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.alignment import (
    text_rows,
    texts_of_frames,
    texts_of_histories,
    words,
)
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import SHUFFLE_SEED, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import NONE, find_mechanism
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    AHEAD,
    CHOICES,
    FRAMES,
    PHASE,
    PLACES,
    STEPS,
    SUBGOAL,
    SUBGOALS,
)
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE
from lerobot_memobench.policies.memobench_mem.subgoals import choices, texts_of
from lerobot_memobench.tasks.memory_text import MARK, with_memory

logger = logging.getLogger(__name__)


def make_memobench_mem_pre_post_processors(
    config: MemobenchMemConfig,
    dataset_stats: dict[str, dict[str, Any]] | None = None,
    dataset_meta: Any | None = None,
    lookup: FrameLookup | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Build both processors of a new policy (LeRobot's factory calls this when nothing saved is loaded).

    Args:
        dataset_stats: normalisation statistics of the training dataset.
        dataset_meta: its metadata, whose task texts become the tiny tokenizer's words. LeRobot 0.6.1 leaves it on the
            config instead.
        lookup: the frames of the training dataset; None in LeRobot's own trainer, and for a policy that only acts.

    Raises:
        MemobenchError: no statistics, as when a policy is evaluated that was never trained.
    """
    if not dataset_stats:
        raise MemobenchError(
            "memobench_mem was given no dataset statistics, so states and actions could not be normalised and every "
            "episode would fail: evaluate a trained checkpoint with --policy.path=<folder of pretrained_model>."
        )
    meta = dataset_meta or getattr(config, "_runtime_dataset_meta", None)
    steps = make_default_policy_processor_steps(config, dataset_stats)
    relative = RelativeActionsProcessorStep(
        enabled=config.use_relative_actions,
        exclude_joints=config.relative_exclude_joints,
        action_names=config.action_feature_names,
    )
    input_steps: list[ProcessorStep] = [
        steps.rename_observations,
        steps.add_batch_dim,
        GatherMemoryProcessorStep(**gathering(config), lookup=lookup),
        OracleMemoryProcessorStep(enabled=config.oracle_memory, lookup=lookup),
        relative,
        *([RawStateProcessorStep()] if config.uses_objects else []),
        steps.normalize,  # before the prompt, which may spell the normalised state out
        *([] if config.state_token else [Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim)]),
        _tokenizer(config, prompt_texts(config, meta, lookup)),
        steps.to_device,
    ]
    output_steps: list[ProcessorStep] = [
        steps.unnormalize,
        AbsoluteActionsProcessorStep(enabled=config.use_relative_actions, relative_step=relative),
        steps.to_cpu,
    ]
    return make_policy_processor_pipelines(input_steps=input_steps, output_steps=output_steps)


def follow_training(steps: Iterable[Any], config: MemobenchMemConfig, meta: Any, lookup: FrameLookup) -> None:
    """Give the saved steps of a checkpoint the settings, prompts and frames of the training that they are used in."""
    for step in steps:
        if isinstance(step, GatherMemoryProcessorStep):
            step.follow(config, lookup)
        elif isinstance(step, OracleMemoryProcessorStep):
            step.lookup, step.enabled = lookup, config.oracle_memory
        elif isinstance(step, WordTokenizerProcessorStep):
            step.follow(config, prompt_texts(config, meta, lookup))


def prompt_texts(config: MemobenchMemConfig, meta: Any | None, lookup: FrameLookup | None) -> list[str]:
    """Return a dataset's tasks, and with oracle memory every memory text that follows them in a prompt."""
    tasks = [] if meta is None or meta.tasks is None else [str(task) for task in meta.tasks.index]
    if config.oracle_memory and lookup is not None:
        tasks += [with_memory("", memory) for memory in lookup.memories]
    return tasks


def _tokenizer(config: MemobenchMemConfig, texts: Sequence[str]) -> TokenizerProcessorStep:
    options = {"max_length": config.tokenizer_max_length, "padding_side": "right", "padding": "max_length"}
    if config.tokenizer_name != "words":
        try:
            return PromptTokenizerProcessorStep(tokenizer_name=config.tokenizer_name, **options)
        except OSError as error:
            raise MemobenchError(
                f"The tokenizer '{config.tokenizer_name}' could not be loaded: give a folder that holds PaliGemma's "
                "tokenizer by --policy.tokenizer_name, or log in to the hub, where it is gated."
            ) from error
    return WordTokenizerProcessorStep(vocabulary=make_vocabulary(texts, config.dimensions.vocabulary), **options)


def gathering(config: MemobenchMemConfig) -> dict[str, Any]:
    """Return the fields of a policy's `GatherMemoryProcessorStep`."""
    same = ("align", "subgoal_level", "shuffle_subgoals", "memory")
    frames = 0 if config.memory == NONE else config.memory_frames
    subgoals = (config.subgoals or {}) if config.privileged_memory else {}
    return {"frames": frames, "subgoals": subgoals} | {name: getattr(config, name) for name in same}


@dataclass
class LookupProcessorStep(ProcessorStep):
    """A step that looks up the frames of training samples; without a ``lookup`` it sees none."""

    lookup: FrameLookup | None = field(default=None, repr=False, kw_only=True)

    def sample_indices(self, transition: EnvTransition) -> list[int] | None:
        """Return the global indices of training samples; None in a rollout.

        LeRobot keeps of a training batch only the keys of its transition, the frame's ``index`` among them; rollouts
        carry none.
        """
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if "index" not in extra or transition.get(TransitionKey.ACTION) is None:
            return None
        found: list[int] = extra["index"].reshape(-1).tolist()
        return found

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features


@dataclass
@ProcessorStepRegistry.register(name="memobench_gather_memory")
class GatherMemoryProcessorStep(LookupProcessorStep):
    """Add history, phase and subgoal embeddings to training samples.

    In a rollout, where the policy itself keeps the history, observations are left alone, but for ``memory.choices``
    (B, S), which training samples have too: which of the texts of ``subgoals`` (instruction -> texts of its
    checkpoints) are the task's, for a memory that chooses among them.

    Adds ``memory.frames``, ``memory.steps`` and ``memory.places`` (`Histories`), ``phase`` (B,), features of the frames
    (``observation.encoded.*``), and with an alignment ``memory.text`` and ``memory.text_mask``: (B, d_t) and (B,) for
    the frame itself, or with ``framewise`` (B, F, d_t) and (B, F) for the frames of the history. With ``subgoals``
    there are the numbers of the active ones: ``memory.subgoal`` (B,) and ``memory.subgoals`` (U,), of the samples and
    of the frames. A memory that learns to foresee has ``memory.ahead`` (B, n). With ``frames`` 0 (``memory=none``)
    there is no history.

    A step without a ``lookup`` (a rollout, LeRobot's own trainer) adds nothing but ``memory.choices``.
    """

    frames: int = 32
    align: str = "none"
    subgoal_level: str = "intermediate"
    shuffle_subgoals: bool = False
    shuffle_seed: InitVar[int] = SHUFFLE_SEED  # written by earlier versions, always this
    memory: str = "frames"
    subgoals: dict[str, list[str]] = field(default_factory=dict)
    _texts: np.ndarray | None = field(default=None, init=False, repr=False)

    def follow(self, config: MemobenchMemConfig, lookup: FrameLookup) -> None:
        """Look up frames for a training by its settings."""
        self.lookup, self._texts = lookup, None
        for name, value in gathering(config).items():
            setattr(self, name, value)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with the frames' history, phase and texts."""
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if self.subgoals:
            extra = {**extra, CHOICES: choices(self.subgoals, extra.get("task") or [])}
            transition = {**transition, TransitionKey.COMPLEMENTARY_DATA: extra}
        indices, lookup = self.sample_indices(transition), self.lookup
        if indices is None or lookup is None:
            return transition
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {**extra, **self.gather(lookup, indices)}
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        # LeRobot passes on observations only, and in a dataset with pictures the objects' column has another name.
        if OBS_ENV_STATE in lookup.columns and OBS_ENV_STATE not in observation:
            transition[TransitionKey.OBSERVATION] = {
                **observation,
                OBS_ENV_STATE: lookup.columns[OBS_ENV_STATE][indices],
            }
        return transition

    def gather(self, lookup: FrameLookup, indices: Sequence[int]) -> dict[str, Tensor]:
        """Look up frames of the dataset by their global indices."""
        places = [lookup.locate(index) for index in indices]
        found = {PHASE: torch.from_numpy(lookup.phase[np.asarray(indices)].astype(np.int64))}
        found |= {name: encoded(indices) for name, encoded in lookup.encoded.items()}
        if not self.frames:
            return found
        mechanism, stride = find_mechanism(self.memory), lookup.stride
        recalled = [(episode, np.asarray(mechanism.slots(frame // stride, self.frames))) for episode, frame in places]
        ahead = [np.arange(frame // stride + 1, frame // stride + 1 + mechanism.ahead) for _, frame in places]
        memory, numbers = _histories(lookup, recalled, ahead)
        if self.subgoals:
            number = {text: row for row, text in enumerate(texts_of(self.subgoals))}
            known = np.array([*(number.get(text, -1) for text in lookup.texts), -1])
            rows = lookup.text_rows(self.subgoal_level)
            asked = {SUBGOAL: np.asarray(indices), SUBGOALS: numbers.numpy()}
            memory |= {name: torch.from_numpy(known[rows[frames]]) for name, frames in asked.items()}
        if self.align == "none":
            return memory | found
        rows = self._text_rows(lookup)
        if self.align != "framewise":
            return memory | found | texts_of_frames(lookup, rows, indices)
        histories = [int(lookup.episodes[episode]) + read * stride for episode, read in recalled]
        return memory | found | texts_of_histories(lookup, rows, histories, self.frames)

    def _text_rows(self, lookup: FrameLookup) -> np.ndarray:
        if self._texts is None:
            self._texts = text_rows(lookup, self.subgoal_level, self.align, self.shuffle_subgoals)
        return self._texts

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds; ``frames`` alone tells the oldest two mechanisms apart there."""
        found = {
            "frames": self.frames,
            "align": self.align,
            "subgoal_level": self.subgoal_level,
            "shuffle_subgoals": self.shuffle_subgoals,
        }
        if self.subgoals:
            found["subgoals"] = self.subgoals
        return found if self.memory in ("frames", NONE) else found | {"memory": self.memory}


def _histories(
    lookup: FrameLookup, recalled: Sequence[tuple[int, np.ndarray]], ahead: Sequence[np.ndarray]
) -> tuple[dict[str, Tensor], Tensor]:
    """Load frames of episodes by their slots, each once; return them for a batch, and their numbers in the dataset.

    Args:
        ahead: slots that follow each of those, beyond the episode's end perhaps.
    """
    stride, needed = lookup.stride, dict[int, list[np.ndarray]]()
    counts = -(-np.diff(lookup.episodes) // stride)
    following = [(episode, slots[slots < counts[episode]]) for (episode, _), slots in zip(recalled, ahead, strict=True)]
    for episode, slots in (*recalled, *following):
        needed.setdefault(episode, []).append(slots)
    unique = {episode: np.unique(np.concatenate(needed[episode])) for episode in sorted(needed)}
    first = dict(zip(unique, np.cumsum([0, *map(len, unique.values())]), strict=False))

    def places(wanted: Sequence[tuple[int, np.ndarray]], width: int) -> Tensor:
        found = np.full((len(wanted), width), -1)
        for row, (episode, slots) in enumerate(wanted):
            found[row, : len(slots)] = first[episode] + np.searchsorted(unique[episode], slots)
        return torch.from_numpy(found)

    steps = torch.from_numpy(np.concatenate([slots * stride for slots in unique.values()]))
    starts = np.repeat([lookup.episodes[episode] for episode in unique], [len(slots) for slots in unique.values()])
    frames = torch.cat([lookup.tokens(episode, slots.tolist()) for episode, slots in unique.items()])
    found = {FRAMES: frames, STEPS: steps, PLACES: places(recalled, max(len(slots) for _, slots in recalled))}
    found |= {AHEAD: places(following, len(ahead[0]))} if len(ahead[0]) else {}
    return found, steps + torch.from_numpy(starts)


@dataclass
@ProcessorStepRegistry.register(name="memobench_oracle_memory")
class OracleMemoryProcessorStep(LookupProcessorStep):
    """The paper's control: ground-truth memory text behind the instruction, before the prompt is tokenized.

    Training samples take it from the dataset's column ``memory``. In a rollout the environment, which alone knows what
    has been done, writes the same words into its instruction; one that does not is refused, because the policy would
    be scored without the memory it was trained on. A step that is not ``enabled`` does nothing.
    """

    enabled: bool = True

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with memory text in its tasks.

        Raises:
            MemobenchError: a rollout's instruction has none, or LeRobot's own trainer runs the step.
        """
        if not self.enabled:
            return transition
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        tasks = extra.get("task") or []
        indices = self.sample_indices(transition)
        if indices is not None:
            if self.lookup is None:
                raise MemobenchError(
                    "policy.oracle_memory=true reads the memory text of each sample, which LeRobot's own trainer does "
                    "not look up; train with `lerobot train policy=memobench_mem`"
                )
            memories = self.lookup.memory_texts(indices)
            tasks = [with_memory(task, memory) for task, memory in zip(tasks, memories, strict=True)]
        elif not tasks or not all(MARK in task for task in tasks):
            raise MemobenchError(
                "This policy was trained with oracle_memory=true and the environment gives no memory text; evaluate it "
                "with --env.oracle_memory=true."
            )
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {**extra, "task": tasks}
        return transition

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds."""
        return {"enabled": self.enabled}


@dataclass
@ProcessorStepRegistry.register(name="memobench_raw_state")
class RawStateProcessorStep(ObservationProcessorStep):
    """Copy the state (B, n), m and rad, to ``observation.raw_state`` before it is normalised.

    Objects' places are given from the hand.
    """

    def observation(self, observation: dict) -> dict:
        """Return the observation with its state twice."""
        if OBS_STATE not in observation:
            return observation
        return observation | {OBS_RAW_STATE: observation[OBS_STATE].clone()}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features


# -- tokenizers of text prompts ---------------------------------------------------------------------------------------

_SPECIAL = ("<pad>", "<unk>", "<bos>", "<eos>")


def make_vocabulary(texts: Iterable[str], size: int) -> list[str]:
    """Words for :class:`WordTokenizerProcessorStep`: special tokens, the prompt's frame, states 0-255, then ``texts``.

    The commonest words stay when there are more than ``size`` in all.
    """
    return extend([*_SPECIAL, *"-:;,.", "task", "state", "action", *map(str, range(256))], texts, size)


def extend(vocabulary: Sequence[str], texts: Iterable[str], size: int) -> list[str]:
    """Return a vocabulary and behind it, sorted, the words of ``texts`` that it lacks: the commonest up to ``size``."""
    counts = Counter(word for text in texts for word in words(text))
    for word in vocabulary:
        counts.pop(word, None)
    ranked = sorted(counts, key=lambda word: (-counts[word], word))
    return [*vocabulary, *sorted(ranked[: max(0, size - len(vocabulary))])]


def make_word_tokenizer(vocabulary: Sequence[str]) -> Any:
    """A word-level tokenizer from its list of words; unknown words become ``<unk>``. No file and no hub."""
    from transformers import PreTrainedTokenizerFast  # slow to import, and the other size needs none of it

    number = {word: row for row, word in enumerate(vocabulary)}
    tokenizer = Tokenizer(WordLevel(number, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Split(Regex(r"\w+|[^\w\s]"), behavior="removed", invert=True)
    tokenizer.post_processor = TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", number["<bos>"])])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>", eos_token="<eos>"
    )


_told: set[str] = set()
"""Texts, instructions and words about which this process has been warned."""


def warn_of_losses(tokenizer: Any, text: str, max_length: int, full: bool) -> None:
    """Warn of what a policy does not read of a prompt: unknown words, each once per process; and what is cut off, once
    per instruction: numbers of the state and memory texts differ from step to step.

    Args:
        full: the prompt takes all of ``max_length`` tokens, and may have had more.
    """
    prompt = text.partition(", State: ")[0]
    instruction = prompt.partition(MARK)[0].removeprefix("Task: ")
    if f"read {prompt}" in _told and (not full or f"cut {instruction}" in _told):
        return
    coded = tokenizer(text, return_offsets_mapping=True)
    spans = list(zip(coded["input_ids"], coded["offset_mapping"], strict=True))
    unknown = dict.fromkeys(text[a:b].lower() for token, (a, b) in spans if token == tokenizer.unk_token_id)
    new = [repr(word) for word in unknown if f"word {word}" not in _told]
    if new:
        logger.warning(
            "the policy does not know %s in %r, and reads unknown words all alike; it can act on these only after "
            "training on instructions that hold them",
            ", ".join(new),
            instruction,
        )
    if len(spans) > max_length and f"cut {instruction}" not in _told:
        logger.warning(
            "the prompt of %r has %d tokens and the policy reads %d (policy.tokenizer_max_length when it is trained); "
            "cut off: %r",
            instruction,
            len(spans),
            max_length,
            text[spans[max_length][1][0] :],
        )
        _told.add(f"cut {instruction}")
    _told.update(f"word {word}" for word in unknown)
    _told.add(f"read {prompt}")


@dataclass
@ProcessorStepRegistry.register(name="memobench_tokenizer")
class PromptTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step, which warns of what it loses of a prompt."""

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        found: dict[str, Tensor] = super()._tokenize_text(text)
        # A full row may have been cut off. Both are checked in numbers first: this runs at every step.
        tokenizer, full = self.input_tokenizer, found["attention_mask"].bool().all(dim=-1)
        unknown = (found["input_ids"] == (-1 if tokenizer.unk_token_id is None else tokenizer.unk_token_id)).any(dim=-1)
        for row in (unknown | full).nonzero().flatten().tolist():
            warn_of_losses(tokenizer, text if isinstance(text, str) else text[row], self.max_length, bool(full[row]))
        return found

    def save_artifacts(self, save_directory: Path) -> dict[str, str]:
        """Save no tokenizer, as LeRobot's main does: its name or words stand in the file, which 0.6.1 reads too."""
        return {}


@dataclass
@ProcessorStepRegistry.register(name="memobench_word_tokenizer")
class WordTokenizerProcessorStep(PromptTokenizerProcessorStep):
    """LeRobot's tokenizer step with the word tokenizer; its words are saved in the checkpoint's processor file.

    In a training from a checkpoint it takes the length of the training's prompts, and adds their new words behind its
    own, which keep their numbers.
    """

    vocabulary: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.vocabulary:
            raise MemobenchError(
                "The checkpoint's preprocessor has no 'vocabulary' for its word tokenizer; save the policy again with "
                "its preprocessor."
            )
        self.tokenizer = make_word_tokenizer(self.vocabulary)
        super().__post_init__()

    def follow(self, config: MemobenchMemConfig, texts: Sequence[str]) -> None:
        """Learn the words of a training's prompts, and take their length."""
        assert config.tokenizer_max_length is not None  # set by the configuration
        self.max_length = config.tokenizer_max_length
        self.vocabulary = extend(self.vocabulary, texts, config.dimensions.vocabulary)
        self.__post_init__()

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        """Do as LeRobot does, with each of the texts once: the samples of a batch share a few instructions."""
        texts = [text] if isinstance(text, str) else text
        row = {different: number for number, different in enumerate(dict.fromkeys(texts))}
        rows = torch.tensor([row[text] for text in texts])
        return {name: of_different[rows] for name, of_different in super()._tokenize_text([*row]).items()}

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds, the words included."""
        return super().get_config() | {"vocabulary": self.vocabulary}
