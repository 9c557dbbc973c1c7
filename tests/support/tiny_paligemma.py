"""pi0 and pi0.5 in small: LeRobot fixes their sizes and fetches their tokenizer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.policies.memobench_mem.processor_memobench_mem import make_vocabulary, make_word_tokenizer


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
