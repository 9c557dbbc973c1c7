"""What the tests of memory necessity share."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.rendering import close_renderers, gl_backend


@pytest.fixture
def gl() -> Iterator[None]:
    """Skip without a GL library; free what was opened afterwards."""
    try:
        gl_backend()
    except MemobenchError as error:
        pytest.skip(str(error))
    before = os.environ.get("MUJOCO_GL")
    yield
    close_renderers()
    if before is None:
        os.environ.pop("MUJOCO_GL", None)
