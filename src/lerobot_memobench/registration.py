"""Make the plugin's configurations known to LeRobot at the moment LeRobot's own are.

Configurations register themselves when their module is imported, and their modules need LeRobot, whose import
takes many seconds. LeRobot registers its built-in environments when ``lerobot.envs`` is imported and its
policies when ``lerobot.policies`` is; ours follow right after. Where LeRobot is already there (as when it
discovers plugins), they are imported at once.
"""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from types import ModuleType

#: LeRobot's package -> our configuration modules that register with it.
CONFIGURATIONS: dict[str, tuple[str, ...]] = {
    "lerobot.envs": ("lerobot_memobench.envs.configuration_memobench",),
    "lerobot.policies": (
        "lerobot_memobench.policies.memobench_expert.configuration_memobench_expert",
        "lerobot_memobench.policies.memobench_mem.configuration_memobench_mem",
    ),
}


def register() -> None:
    """Import the configuration modules, now or once LeRobot's package is complete; safe to call again."""
    waiting = set()
    for package in CONFIGURATIONS:
        if _complete(package):
            _import_configurations(package)
        else:
            waiting.add(package)
    if waiting and not any(isinstance(finder, _AfterImport) for finder in sys.meta_path):
        sys.meta_path.insert(0, _AfterImport(waiting))


def _complete(package: str) -> bool:
    module = sys.modules.get(package)
    spec = getattr(module, "__spec__", None)
    # A package that is still being imported has `_initializing` set.
    return module is not None and not getattr(spec, "_initializing", False)


def _import_configurations(package: str) -> None:
    for name in CONFIGURATIONS[package]:
        importlib.import_module(name)


class _AfterImport(importlib.abc.MetaPathFinder):
    """Finds nothing itself; lets each waited-for package be loaded as usual and imports ours after it."""

    def __init__(self, waiting: set[str]) -> None:
        self._waiting = waiting

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname not in self._waiting:
            return None
        self._waiting.discard(fullname)
        spec = importlib.util.find_spec(fullname)  # asks the other finders: this one is not waiting any more
        if spec is not None and spec.loader is not None:
            spec.loader = _ThenRegister(spec.loader, fullname)
        return spec


class _ThenRegister(importlib.abc.Loader):
    """A package's own loader, followed by the import of our configurations."""

    def __init__(self, loader: importlib.abc.Loader, package: str) -> None:
        self._loader = loader
        self._package = package

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        # The package keeps its own loader: resources and tracebacks ask for it.
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        _import_configurations(self._package)
