"""LeRobot's policies in small: settings, checkpoints, language models without a hub."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class, make_policy_config

from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import make_vocabulary, make_word_tokenizer

SMALL: dict[str, dict[str, Any]] = {
    "act": {
        **{"pretrained_backbone_weights": None, "dim_model": 32, "n_heads": 2, "dim_feedforward": 64},
        **{"n_encoder_layers": 1, "n_vae_encoder_layers": 1, "latent_dim": 8, "chunk_size": 4, "n_action_steps": 4},
    },
    "diffusion": {"pretrained_backbone_weights": None, "down_dims": (16, 32), "n_groups": 4},
}


def words_of(kind: str) -> list[str]:
    return [f"policy={kind}", *(f"policy.{name}={json.dumps(value)}" for name, value in SMALL[kind].items())]


def make_config(
    kind: str, images: Mapping[str, int], state: int = 8, action: int = 7, objects: int = 0, **settings: Any
) -> PreTrainedConfig:
    """Return the configuration of a small policy with images (name -> side, pixels) and vectors of these lengths."""
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, (state,))}
    for name, side in images.items():
        inputs[f"observation.images.{name}"] = PolicyFeature(FeatureType.VISUAL, (3, side, side))
    if objects:
        inputs["observation.environment_state"] = PolicyFeature(FeatureType.ENV, (objects,))
    return make_policy_config(
        kind,
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (action,))},
        **{"device": "cpu", "push_to_hub": False, **SMALL.get(kind, {}), **settings},
    )


def save_checkpoint(folder: Path, config: PreTrainedConfig, lengths: Mapping[str, int] | None = None) -> Path:
    """Save a checkpoint as LeRobot does; ``lengths``: of vectors that alone have statistics, None for all features."""
    get_policy_class(config.type)(config).save_pretrained(folder)
    shapes = {name: (length,) for name, length in (lengths or {}).items()}
    for name, feature in {**config.input_features, **config.output_features}.items() if lengths is None else ():
        shapes[name] = (3, 1, 1) if feature.type is FeatureType.VISUAL else feature.shape
    stats = {}
    for name, shape in shapes.items():
        stats[name] = {"mean": torch.zeros(shape), "std": torch.ones(shape)}
        stats[name] |= {"min": -torch.ones(shape), "max": torch.ones(shape)}
    for pipeline in make_pre_post_processors(config, dataset_stats=stats):
        pipeline.save_pretrained(folder)
    return folder


def word_tokenizer(text: str, **special: str) -> Any:
    """Return a tokenizer of a text's words; ``special`` names tokens as SmolVLM's tokenizer does."""
    from transformers import PreTrainedTokenizerFast

    plain = make_word_tokenizer(make_vocabulary([text], 400))
    return PreTrainedTokenizerFast(
        tokenizer_object=plain.backend_tokenizer,
        extra_special_tokens=special,
        pad_token="<pad>",
        unk_token="<unk>",
        bos_token="<bos>",
        eos_token="<eos>",
    )


def shrink_paligemma(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    """Give pi0 and pi0.5 small dimensions and a tokenizer of a text's words, which needs no hub."""
    from lerobot.policies.pi0 import modeling_pi0
    from lerobot.policies.pi05 import modeling_pi05
    from lerobot.processor import tokenizer_processor

    class Tokenizers:
        @staticmethod
        def from_pretrained(name: str, **options: Any) -> Any:
            # LeRobot's main puts the tokenizer into the checkpoint.
            assert name == "google/paligemma-3b-pt-224" or (Path(name) / "tokenizer.json").is_file()
            return word_tokenizer(text)

    monkeypatch.setattr(tokenizer_processor, "AutoTokenizer", Tokenizers)

    def shrink(module: Any) -> None:
        whole = module.PaliGemmaForConditionalGenerationWithPiGemma
        gemma = module.get_gemma_config("gemma_300m")

        def small(config: Any) -> Any:
            vision = config.vision_config
            vision.hidden_size, vision.intermediate_size = 32, 64
            vision.num_hidden_layers, vision.num_attention_heads = 1, 2
            vision.projection_dim = config.projection_dim = config.text_config.hidden_size
            return whole(config=config)

        sizes = {"width": 32, "depth": 2, "mlp_dim": 64, "num_heads": 8, "num_kv_heads": 1, "head_dim": 8}
        monkeypatch.setattr(module, "PaliGemmaForConditionalGenerationWithPiGemma", small)
        monkeypatch.setattr(module, "get_gemma_config", lambda variant: type(gemma)(**sizes))

    shrink(modeling_pi0)
    shrink(modeling_pi05)


def tiny_smolvlm(out: Path, text: str) -> Path:
    """Write configuration and processor of a small SmolVLM into a new folder in ``out``; return it."""
    from transformers import SmolVLMConfig, SmolVLMImageProcessor, SmolVLMProcessor, SmolVLMVideoProcessor

    folder = out / "smolvlm"
    tokenizer = word_tokenizer(
        text,
        fake_image_token="<fake_token_around_image>",
        image_token="<image>",
        end_of_utterance_token="<end_of_utterance>",
        global_image_token="<global-img>",
        video_token="<video>",
    )
    words = {
        **{"hidden_size": 48, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4},
        **{"num_key_value_heads": 2, "head_dim": 12, "max_position_embeddings": 512},
        **{"vocab_size": len(tokenizer), "pad_token_id": tokenizer.pad_token_id},
    }
    vision = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision |= {"image_size": 512, "patch_size": 16}
    image = tokenizer.convert_tokens_to_ids("<image>")
    SmolVLMConfig(text_config=words, vision_config=vision, scale_factor=4, image_token_id=image).save_pretrained(folder)
    SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor()).save_pretrained(folder)
    return folder
