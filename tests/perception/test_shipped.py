"""The eyes that come with the package, on scenes that nothing was trained on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from lerobot_memobench.perception.kinds import kinds
from lerobot_memobench.perception.labels import images_of
from lerobot_memobench.perception.pictures import make_pictures
from lerobot_memobench.perception.testing import outcomes, seeing
from lerobot_memobench.perception.weights import SHIPPED, load_eyes

from .conftest import BOWLS, DRAWERS


def test_they_see_and_their_tokens_are_white(gl: str, tmp_path: Path) -> None:
    eyes = load_eyes(SHIPPED)
    assert SHIPPED.stat().st_size <= 6_000_000
    assert eyes.kinds == kinds()
    pictures = make_pictures(tmp_path, [BOWLS, DRAWERS], [50_000], 2)
    told, _ = outcomes(seeing(eyes), pictures)
    errors = told["error"][told["camera"] == 0]
    assert len(errors) > 40
    assert np.isfinite(errors).mean() > 0.8
    assert np.median(errors) < 0.6
    with torch.inference_mode():
        tokens = eyes.tower(images_of(pictures.rows(np.arange(len(pictures))))).flatten(0, 1)
    assert tokens.mean(dim=0).abs().mean() < 0.3
    assert 0.5 < tokens.var(dim=0).mean() < 2
