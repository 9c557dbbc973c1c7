"""The configuration and the processor of a small SmolVLM, which LeRobot would fetch for SmolVLA."""

from __future__ import annotations

from pathlib import Path

from tests.support.tiny_paligemma import word_tokenizer


def tiny_smolvlm(out: Path, text: str) -> Path:
    """Write them into a new folder in ``out``, with a tokenizer of a text's words; return it."""
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
        "hidden_size": 48,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 4,
        "num_key_value_heads": 2,
        "head_dim": 12,
        "vocab_size": len(tokenizer),
        "pad_token_id": tokenizer.pad_token_id,
        "max_position_embeddings": 512,
    }
    vision = {
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
        "image_size": 512,
        "patch_size": 16,
    }
    image = tokenizer.convert_tokens_to_ids("<image>")
    SmolVLMConfig(text_config=words, vision_config=vision, scale_factor=4, image_token_id=image).save_pretrained(folder)
    SmolVLMProcessor(SmolVLMImageProcessor(), tokenizer, SmolVLMVideoProcessor()).save_pretrained(folder)
    return folder
