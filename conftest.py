"""What every test starts from: no network, one thread, and the same examples on every run in CI."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator

# Before torch or LeRobot is imported by any test. Two cores are shared by the tests' own worker processes.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")
os.environ["MEMOBENCH_PROMPT_CACHE"] = "off"  # tests simulate what they check, and leave nothing in the user's cache

import ctypes.util
import functools
import gc

import pytest
from draccus.wrappers import docstring
from hypothesis import settings

settings.register_profile("memobench", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("memobench")

# draccus reads the source of every policy's configuration anew for each command line: half a second, hundreds of times.
docstring.get_attribute_docstring = functools.cache(docstring.get_attribute_docstring)


def pytest_collection_finish() -> None:
    """Keep what the imports made out of Python's garbage collections: a tenth of the time of tests of policies."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True)
def log_handlers_end_with_the_test() -> Iterator[None]:
    """LeRobot's commands log to the stream of the test that ran them; a server's thread may outlive that stream."""
    yield
    root = logging.getLogger()
    for handler in list(root.handlers):
        if type(handler) is logging.StreamHandler:
            root.removeHandler(handler)


@pytest.fixture
def gl() -> str:
    """Return with what MuJoCo's own renderer draws here; skip without its library."""
    backend = os.environ.get("MUJOCO_GL", "egl")
    if ctypes.util.find_library({"egl": "EGL", "osmesa": "OSMesa"}.get(backend, backend)) is None:
        pytest.skip(f"MuJoCo's own renderer has no {backend} here")
    return backend
