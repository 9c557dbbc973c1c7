"""Pre- and post-processing of ``memobench_mem``: pi0.5's steps, memory of training samples, tokenizers of prompts."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import (
    ObservationProcessorStep,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
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
from torch.nn.utils.rnn import pad_sequence

from lerobot_memobench.datasets.frames import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.mechanism import (
    AHEAD,
    CHOICES,
    FRAMES,
    PHASE,
    PLACES,
    STEPS,
    SUBGOAL,
    SUBGOALS,
    TEXT,
    TEXT_MASK,
)
from lerobot_memobench.policies.memobench_mem.objects import OBS_RAW_STATE
from lerobot_memobench.policies.memobench_mem.texts import choices, texts_of, words
from lerobot_memobench.tasks.memory_text import MARK, with_memory

logger = logging.getLogger(__name__)

Features = dict[PipelineFeatureType, dict[str, PolicyFeature]]


def make_memobench_mem_pre_post_processors(
    config: MemobenchMemConfig,
    dataset_stats: dict[str, dict[str, Any]] | None = None,
    dataset_meta: Any | None = None,
    lookup: FrameLookup | None = None,
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Build both processors of a new policy (LeRobot's factory calls this unless it loads saved ones).

    The task texts of ``dataset_meta``, the training dataset, give the words of the word tokenizer. ``lookup`` are its
    frames; None in LeRobot's own trainer, and for a policy that only acts.
    """
    if not dataset_stats:
        raise MemobenchError(
            "memobench_mem has no dataset statistics to normalise states and actions; evaluate a trained checkpoint "
            "with --policy.path=<folder of pretrained_model>."
        )
    meta = dataset_meta or getattr(config, "_runtime_dataset_meta", None)  # LeRobot 0.6.1 sets the attribute
    steps = make_default_policy_processor_steps(config, dataset_stats)
    input_steps: list[ProcessorStep] = [
        steps.rename_observations,
        steps.add_batch_dim,
        GatherMemoryProcessorStep(config=config, lookup=lookup),
        OracleMemoryProcessorStep(enabled=config.oracle_memory, lookup=lookup),
        *([RawStateProcessorStep()] if config.uses_objects else []),
        steps.normalize,  # before the prompt, which may spell the normalised state
        *([] if config.state_token else [Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim)]),
        _tokenizer(config, prompt_texts(config, meta, lookup)),
        steps.to_device,
    ]
    return make_policy_processor_pipelines(input_steps=input_steps, output_steps=[steps.unnormalize, steps.to_cpu])


def follow_training(steps: Iterable[Any], config: MemobenchMemConfig, meta: Any, lookup: FrameLookup) -> None:
    """Set the settings, prompts and frames of a training in the saved steps of the checkpoint that it starts from."""
    for step in steps:
        if isinstance(step, GatherMemoryProcessorStep):
            step.follow(config, lookup)
        elif isinstance(step, OracleMemoryProcessorStep):
            step.lookup, step.enabled = lookup, config.oracle_memory
        elif isinstance(step, WordTokenizerProcessorStep):
            step.follow(config, prompt_texts(config, meta, lookup))


def prompt_texts(config: MemobenchMemConfig, meta: Any | None, lookup: FrameLookup | None) -> list[str]:
    """Return a dataset's tasks, and with oracle memory all its memory texts."""
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


@dataclass
class LookupProcessorStep(ProcessorStep):
    """A step that looks up the frames of training samples in ``lookup``, if there is one."""

    lookup: FrameLookup | None = field(default=None, repr=False, kw_only=True)

    def sample_indices(self, transition: EnvTransition) -> list[int] | None:
        """Return the global indices of training samples; None in a rollout, which has no ``index``."""
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if "index" not in extra or transition.get(TransitionKey.ACTION) is None:
            return None
        return extra["index"].reshape(-1).tolist()

    def transform_features(self, features: Features) -> Features:
        return features


@dataclass
@ProcessorStepRegistry.register(name="memobench_gather_memory")
class GatherMemoryProcessorStep(LookupProcessorStep):
    """Add history, phase and subgoal embeddings to training samples.

    Training samples get the parts of their `Histories`, ``phase`` (B,), and features of the frames
    (``observation.encoded.*``). An alignment adds ``memory.text`` and ``memory.text_mask``: (B, d_t) and (B,) of the
    frame itself, or with ``framewise`` (B, F, d_t) and (B, F) of the remembered frames. In a rollout, where the policy
    itself keeps the history, only ``memory.choices`` (B, S) is added: which texts of ``subgoals`` belong to the task.
    """

    subgoals: dict[str, list[str]] = field(default_factory=dict)
    """Instruction -> texts of its checkpoints, of a privileged memory; saved with the checkpoint."""
    config: MemobenchMemConfig | None = field(default=None, repr=False, kw_only=True)
    """The policy's; None if the step is loaded to act."""

    def __post_init__(self) -> None:
        if self.config is not None:
            self.subgoals = (self.config.subgoals or {}) if self.config.privileged_memory else {}

    def follow(self, config: MemobenchMemConfig, lookup: FrameLookup) -> None:
        self.config, self.lookup = config, lookup
        self.__post_init__()

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if self.subgoals:
            extra = {**extra, CHOICES: choices(self.subgoals, extra.get("task") or [])}
            transition = {**transition, TransitionKey.COMPLEMENTARY_DATA: extra}
        indices, lookup = self.sample_indices(transition), self.lookup
        if indices is None or lookup is None:
            return transition
        observation = transition.get(TransitionKey.OBSERVATION) or {}
        # In a dataset with images the column of objects is no observation of LeRobot's.
        if OBS_ENV_STATE in lookup.columns and OBS_ENV_STATE not in observation:
            observation = {**observation, OBS_ENV_STATE: lookup.columns[OBS_ENV_STATE][indices]}
        return {
            **transition,
            TransitionKey.OBSERVATION: observation,
            TransitionKey.COMPLEMENTARY_DATA: {**extra, **self.gather(lookup, indices)},
        }

    def gather(self, lookup: FrameLookup, indices: Sequence[int]) -> dict[str, Tensor]:
        """Return what the class describes for frames of the dataset, by their global indices."""
        config = self.config
        assert config is not None
        located = [lookup.locate(index) for index in indices]
        features = {PHASE: torch.from_numpy(lookup.phase[np.asarray(indices)].astype(np.int64))}
        features |= {name: encoded(indices) for name, encoded in lookup.encoded.items()}
        if (mechanism := config.mechanism) is None:
            return features
        stride, settings = lookup.stride, mechanism.Settings(**config.memory_settings)

        def slots(episode: int, last: int) -> np.ndarray:
            if not config.skips_repeated_frames:
                return np.asarray(mechanism.slots(last, settings))
            written = lookup.changes(episode)
            return written[mechanism.slots(int(np.searchsorted(written, last, "right")) - 1, settings)]

        recalled = [(episode, slots(episode, frame // stride)) for episode, frame in located]
        ahead = [np.arange(frame // stride + 1, frame // stride + 1 + mechanism.ahead) for _, frame in located]
        memory, numbers = _histories(lookup, recalled, ahead)
        if self.subgoals:
            number = {text: row for row, text in enumerate(texts_of(self.subgoals))}
            known = np.array([*(number.get(text, -1) for text in lookup.texts), -1])
            rows = lookup.text_rows(config.subgoal_level)
            labelled = {SUBGOAL: np.asarray(indices), SUBGOALS: numbers.numpy()}
            memory |= {name: torch.from_numpy(known[rows[frames]]) for name, frames in labelled.items()}
        if config.align == "none":
            return memory | features
        texts = torch.from_numpy(lookup.text_rows(config.subgoal_level)).long()
        if config.align == "framewise":
            histories = [texts[int(lookup.episodes[episode]) + read * stride] for episode, read in recalled]
            asked_texts = pad_sequence(histories, batch_first=True, padding_value=-1)
        else:
            asked_texts = texts[torch.tensor([*indices])]
        embedded = lookup.text_embeddings[asked_texts.clamp(min=0)]
        return memory | features | {TEXT: embedded, TEXT_MASK: asked_texts >= 0}

    def get_config(self) -> dict[str, Any]:
        return {"subgoals": self.subgoals} if self.subgoals else {}


def _histories(
    lookup: FrameLookup, recalled: Sequence[tuple[int, np.ndarray]], ahead: Sequence[np.ndarray]
) -> tuple[dict[str, Tensor], Tensor]:
    """Load frames of episodes by their slots, each once; return them for a batch, and their indices in the dataset.

    The following slots of each sample, ``ahead``, may lie beyond the episode's end.
    """
    stride, needed = lookup.stride, dict[int, list[np.ndarray]]()
    counts = -(-np.diff(lookup.episodes) // stride)
    following = [(episode, slots[slots < counts[episode]]) for (episode, _), slots in zip(recalled, ahead, strict=True)]
    for episode, slots in (*recalled, *following):
        needed.setdefault(episode, []).append(slots)
    unique = {episode: np.unique(np.concatenate(needed[episode])) for episode in sorted(needed)}
    first = dict(zip(unique, np.cumsum([0, *map(len, unique.values())]), strict=False))

    def frame_indices(wanted: Sequence[tuple[int, np.ndarray]], width: int) -> Tensor:
        indices = np.full((len(wanted), width), -1)
        for row, (episode, slots) in enumerate(wanted):
            indices[row, : len(slots)] = first[episode] + np.searchsorted(unique[episode], slots)
        return torch.from_numpy(indices)

    steps = torch.from_numpy(np.concatenate([slots * stride for slots in unique.values()]))
    starts = np.repeat([lookup.episodes[episode] for episode in unique], [len(slots) for slots in unique.values()])
    frames = torch.cat([lookup.tokens(episode, slots.tolist()) for episode, slots in unique.items()])
    longest = max(len(slots) for _, slots in recalled)
    histories = {FRAMES: frames, STEPS: steps, PLACES: frame_indices(recalled, longest)}
    histories |= {AHEAD: frame_indices(following, len(ahead[0]))} if len(ahead[0]) else {}
    return histories, steps + torch.from_numpy(starts)


@dataclass
@ProcessorStepRegistry.register(name="memobench_oracle_memory")
class OracleMemoryProcessorStep(LookupProcessorStep):
    """Append ground-truth memory text to the instruction before tokenization: a control of the paper.

    In training the text comes from the dataset's column ``memory``; in a rollout the environment appends it. An
    environment without this text is refused, because the policy would act without the memory of its training.
    """

    enabled: bool = True

    def __call__(self, transition: EnvTransition) -> EnvTransition:
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
        return {**transition, TransitionKey.COMPLEMENTARY_DATA: {**extra, "task": tasks}}

    def get_config(self) -> dict[str, Any]:
        return {"enabled": self.enabled}


@dataclass
@ProcessorStepRegistry.register(name="memobench_raw_state")
class RawStateProcessorStep(ObservationProcessorStep):
    """Copy the state (B, n), m and rad, to ``observation.raw_state`` before normalisation, for places of objects."""

    def observation(self, observation: dict) -> dict:
        copied = {OBS_RAW_STATE: observation[OBS_STATE].clone()} if OBS_STATE in observation else {}
        return observation | copied

    def transform_features(self, features: Features) -> Features:
        return features


# -- tokenizers of prompts --------------------------------------------------------------------------------------------

_SPECIAL = ("<pad>", "<unk>", "<bos>", "<eos>")


def make_vocabulary(texts: Iterable[str], size: int) -> list[str]:
    """Return words for `WordTokenizerProcessorStep`: special tokens, frame of the prompt, states 0-255, ``texts``."""
    return extend([*_SPECIAL, *"-:;,.", "task", "state", "action", *map(str, range(256))], texts, size)


def extend(vocabulary: Sequence[str], texts: Iterable[str], size: int) -> list[str]:
    """Append to a vocabulary the words of ``texts`` that it lacks, sorted; the most frequent if ``size`` is reached."""
    counts = Counter(word for text in texts for word in words(text))
    for word in vocabulary:
        counts.pop(word, None)
    ranked = sorted(counts, key=lambda word: (-counts[word], word))
    return [*vocabulary, *sorted(ranked[: max(0, size - len(vocabulary))])]


def make_word_tokenizer(vocabulary: Sequence[str]) -> Any:
    """Build a word-level tokenizer from a list of words; unknown words become ``<unk>``."""
    from transformers import PreTrainedTokenizerFast  # slow to import

    number = {word: row for row, word in enumerate(vocabulary)}
    tokenizer = Tokenizer(WordLevel(number, unk_token="<unk>"))
    tokenizer.normalizer = Lowercase()
    tokenizer.pre_tokenizer = Split(Regex(r"\w+|[^\w\s]"), behavior="removed", invert=True)
    tokenizer.post_processor = TemplateProcessing(single="<bos> $A", special_tokens=[("<bos>", number["<bos>"])])
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token="<pad>", unk_token="<unk>", bos_token="<bos>", eos_token="<eos>"
    )


_warned: set[str] = set()
"""Prompts, instructions and words about which this process has logged a warning."""


def warn_of_losses(tokenizer: Any, text: str, max_length: int, full: bool) -> None:
    """Warn of unknown words, each once per process, and of cut (``full``) prompts, once per instruction."""
    prompt = text.partition(", State: ")[0]
    instruction = prompt.partition(MARK)[0].removeprefix("Task: ")
    if f"read {prompt}" in _warned and (not full or f"cut {instruction}" in _warned):
        return
    coded = tokenizer(text, return_offsets_mapping=True)
    spans = list(zip(coded["input_ids"], coded["offset_mapping"], strict=True))
    unknown = {text[a:b].lower(): None for token, (a, b) in spans if token == tokenizer.unk_token_id}
    if new := [repr(word) for word in unknown if f"word {word}" not in _warned]:
        logger.warning(
            "unknown words %s in %r: the policy reads all unknown words alike; train it on instructions with these "
            "words",
            *(", ".join(new), instruction),
        )
    if len(spans) > max_length and f"cut {instruction}" not in _warned:
        logger.warning(
            "the prompt of %r has %d tokens; the policy reads %d (policy.tokenizer_max_length of its training); cut "
            "off: %r",
            *(instruction, len(spans), max_length, text[spans[max_length][1][0] :]),
        )
        _warned.add(f"cut {instruction}")
    _warned.update([f"read {prompt}", *(f"word {word}" for word in unknown)])


@dataclass
@ProcessorStepRegistry.register(name="memobench_tokenizer")
class PromptTokenizerProcessorStep(TokenizerProcessorStep):
    """LeRobot's tokenizer step with warnings about unknown words and cut prompts."""

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        encoded: dict[str, Tensor] = super()._tokenize_text(text)
        # Checked on token numbers first, because this runs at every control step. A full row may have been cut.
        tokenizer, full = self.input_tokenizer, encoded["attention_mask"].bool().all(dim=-1)
        number = -1 if tokenizer.unk_token_id is None else tokenizer.unk_token_id
        unknown = (encoded["input_ids"] == number).any(dim=-1)
        for row in (unknown | full).nonzero().flatten().tolist():
            warn_of_losses(tokenizer, text if isinstance(text, str) else text[row], self.max_length, bool(full[row]))
        return encoded

    def save_artifacts(self, save_directory: Path) -> dict[str, str]:
        return {}  # the settings hold the tokenizer's name or words


@dataclass
@ProcessorStepRegistry.register(name="memobench_word_tokenizer")
class WordTokenizerProcessorStep(PromptTokenizerProcessorStep):
    """LeRobot's tokenizer step with the word tokenizer, whose words are saved in the checkpoint's processor file.

    A training from a checkpoint sets the length of its prompts and appends their new words; known words keep their
    numbers.
    """

    vocabulary: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.vocabulary:
            raise MemobenchError(
                "the checkpoint's preprocessor has no 'vocabulary' for its word tokenizer; save the policy again with "
                "its preprocessor."
            )
        self.tokenizer = make_word_tokenizer(self.vocabulary)
        super().__post_init__()

    def follow(self, config: MemobenchMemConfig, texts: Sequence[str]) -> None:
        assert config.tokenizer_max_length is not None  # set by the configuration
        self.max_length = config.tokenizer_max_length
        self.vocabulary = extend(self.vocabulary, texts, config.dimensions.vocabulary)
        self.__post_init__()

    def _tokenize_text(self, text: str | list[str]) -> dict[str, Tensor]:
        # Each different text is tokenized once, because the samples of a batch share a few instructions.
        texts = [text] if isinstance(text, str) else text
        row = {different: number for number, different in enumerate(dict.fromkeys(texts))}
        rows = torch.tensor([row[text] for text in texts])
        return {name: of_different[rows] for name, of_different in super()._tokenize_text([*row]).items()}

    def get_config(self) -> dict[str, Any]:
        return super().get_config() | {"vocabulary": self.vocabulary}
