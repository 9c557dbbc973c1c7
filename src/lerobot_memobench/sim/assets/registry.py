"""Register asset builders by class; registered builders override this package's."""

from __future__ import annotations

import re
from collections.abc import Callable

import mujoco

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.sim.assets import (
    appliances,
    bottles,
    cabinet,
    food,
    kitchen,
    packages,
    tableware,
    trinkets,
)
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import Builder

Build = Callable[[Builder], Asset]

_MODULES = (appliances, bottles, cabinet, food, kitchen, packages, tableware, trinkets)
"""Modules with ``BUILDERS``: class name -> builder."""

_builders: dict[str, Build] = {name: build for module in _MODULES for name, build in module.BUILDERS.items()}


def register(class_name: str, builder: Build) -> None:
    """Register ``builder`` for objects or fixtures of ``class_name``.

    ``class_name`` is exact (``cork__3``) or a family (``cork`` for every ``cork__k``); exact names have priority.
    """
    _builders[class_name] = builder


def known_classes() -> list[str]:
    """Return the registered class names, sorted."""
    return sorted(_builders)


def build_asset(spec: mujoco.MjSpec, name: str, class_name: str) -> Asset:
    """Build an instance ``name`` of ``class_name`` into a scene and return its metadata.

    Raises:
        MemobenchError: no builder is registered for the class.
    """
    family, variant = split_class(class_name)
    build = _builders.get(class_name) or _builders.get(family)
    if build is None:
        raise MemobenchError(
            f"there is no asset of class {class_name!r} for {name!r}: {nearest(family, _builders)} "
            "Register one with lerobot_memobench.sim.assets.registry.register."
        )
    return build(Builder(spec, name, class_name, variant))


def split_class(class_name: str) -> tuple[str, int]:
    """Return family and variant: ``cork__3`` is variant 3 of ``cork``, and ``cork`` is variant 0."""
    match = re.fullmatch(r"(.+?)__(\d+)", class_name)
    return (match.group(1), int(match.group(2))) if match else (class_name, 0)
