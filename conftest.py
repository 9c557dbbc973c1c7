"""Settings of all tests: no network, one thread per process, deterministic hypothesis examples in CI."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

# Set before any test imports torch or LeRobot. The worker processes share the cores.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ["MEMOBENCH_PROMPT_CACHE"] = "off"  # tests neither use nor fill the user's cache

import ctypes.util
import functools
import gc

import pytest
from draccus.wrappers import docstring
from hypothesis import settings

settings.register_profile("memobench", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("memobench")

# draccus parses the source of all configurations for each command line, which takes half a second.
docstring.get_attribute_docstring = functools.cache(docstring.get_attribute_docstring)


def pytest_collection_finish() -> None:
    """Exclude imported objects from garbage collection, which saves a tenth of the time of policy tests."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def remove_log_handlers() -> Iterator[None]:
    """Remove handlers that LeRobot's commands add: they log to the captured stream, which ends with the test."""
    yield
    root = logging.getLogger()
    for handler in list(root.handlers):
        if type(handler) is logging.StreamHandler:
            root.removeHandler(handler)


@pytest.fixture
def short_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each hold of strict tasks the shortest length, one control step without chunks."""
    monkeypatch.setattr("lerobot_memobench.envs.episode.LONGEST_HOLD", 0)


@pytest.fixture
def gl() -> str:
    """Return the backend of MuJoCo's renderer; skip the test without its library."""
    backend = os.environ.get("MUJOCO_GL", "egl")
    if ctypes.util.find_library({"egl": "EGL", "osmesa": "OSMesa"}.get(backend, backend)) is None:
        pytest.skip(f"the library of MUJOCO_GL={backend} is missing")
    return backend
