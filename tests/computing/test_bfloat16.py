"""When products in bfloat16 are taken: where a CPU has instructions for them and is clearly quicker by them."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from lerobot_memobench.computing import bfloat16


@pytest.fixture(autouse=True)
def asked_anew() -> Iterator[None]:
    bfloat16.quicker_in_bfloat16.cache_clear()
    yield
    bfloat16.quicker_in_bfloat16.cache_clear()


@pytest.mark.parametrize("instructions", ["avx512_bf16", "amx_bf16"])
@pytest.mark.parametrize("slower", [0.5, 0.7, 0.9, 1.0, 2.0])
def test_they_are_taken_where_they_are_clearly_quicker(
    slower: float, instructions: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    products = torch.backends.mkldnn.matmul
    usual = products.fp32_precision
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {instructions: True})
    monkeypatch.setattr(bfloat16, "_seconds", lambda: slower if products.fp32_precision == "bf16" else 1.0)
    assert bfloat16.quicker_in_bfloat16() == (slower < 0.8)
    assert products.fp32_precision == usual


@pytest.mark.parametrize("known", [{}, {"avx512_bf16": False, "avx512_f": True}])
def test_a_cpu_without_instructions_for_them_is_not_tried(
    known: dict[str, bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: known)
    monkeypatch.setattr(bfloat16, "_seconds", lambda: pytest.fail("it was tried"))
    assert not bfloat16.quicker_in_bfloat16()


def test_the_trial_multiplies_in_both_and_puts_everything_back(monkeypatch: pytest.MonkeyPatch) -> None:
    products, multiply = torch.backends.mkldnn.matmul, bfloat16._seconds
    usual, tried = products.fp32_precision, set()

    def seconds() -> float:
        tried.add(products.fp32_precision)
        return multiply()

    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    monkeypatch.setattr(bfloat16, "_seconds", seconds)
    bfloat16.quicker_in_bfloat16()
    assert tried == {"ieee", "bf16"}
    assert products.fp32_precision == usual
