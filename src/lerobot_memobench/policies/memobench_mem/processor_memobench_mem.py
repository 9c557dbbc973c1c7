"""Pre- and post-processing of ``memobench_mem``: pi0.5's steps, plus the memory of training samples."""

from __future__ import annotations

from typing import Any

from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    RelativeActionsProcessorStep,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.language.tokenizer import (
    PromptTokenizerProcessorStep,
    WordTokenizerProcessorStep,
    make_vocabulary,
)
from lerobot_memobench.policies.memobench_mem.processing.gather_memory import GatherMemoryProcessorStep, gathering
from lerobot_memobench.policies.memobench_mem.processing.oracle_memory import OracleMemoryProcessorStep
from lerobot_memobench.policies.memobench_mem.processing.raw_state import RawStateProcessorStep
from lerobot_memobench.policies.memobench_mem.processing.training_run import prompt_texts, training_run


def make_memobench_mem_pre_post_processors(
    config: MemobenchMemConfig,
    dataset_stats: dict[str, dict[str, Any]] | None = None,
    dataset_meta: Any | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Build both processors of a new policy (LeRobot's factory calls this when nothing saved is loaded).

    Args:
        dataset_stats: normalisation statistics of the training dataset.
        dataset_meta: its metadata, whose task texts become the tiny tokenizer's words. LeRobot 0.6.1 leaves it on the
            config instead.

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
        GatherMemoryProcessorStep(**gathering(config)),
        OracleMemoryProcessorStep(enabled=config.oracle_memory),
        relative,
        *([RawStateProcessorStep()] if config.sees_objects else []),
        steps.normalize,  # before the prompt, which may spell the normalised state out
        *([] if config.state_token else [Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim)]),
        _tokenizer(config, meta),
        steps.to_device,
    ]
    output_steps: list[ProcessorStep] = [
        steps.unnormalize,
        AbsoluteActionsProcessorStep(enabled=config.use_relative_actions, relative_step=relative),
        steps.to_cpu,
    ]
    run = training_run(config)
    if run is not None:
        run.follow(input_steps)
    return make_policy_processor_pipelines(input_steps=input_steps, output_steps=output_steps)


def _tokenizer(config: MemobenchMemConfig, meta: Any | None) -> TokenizerProcessorStep:
    options = {"max_length": config.tokenizer_max_length, "padding_side": "right", "padding": "max_length"}
    if config.tokenizer_name != "words":
        try:
            return PromptTokenizerProcessorStep(tokenizer_name=config.tokenizer_name, **options)
        except OSError as error:
            raise MemobenchError(
                f"The tokenizer '{config.tokenizer_name}' could not be loaded: give a folder that holds PaliGemma's "
                "tokenizer by --policy.tokenizer_name, or log in to the hub, where it is gated."
            ) from error
    run = training_run(config)
    texts = prompt_texts(config, meta, None if run is None else run.cache)
    return WordTokenizerProcessorStep(vocabulary=make_vocabulary(texts, config.dimensions.vocabulary), **options)
