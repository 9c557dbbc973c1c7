"""What a BDDL file says, as data, and the check that a formula's names are declared and fit."""

from __future__ import annotations

from dataclasses import dataclass, field

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.formula import Atom, Formula, atoms, rename

_THING = ("object", "fixture")
_JOINTED = ("fixture", "region")
_KINDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "on": (_THING, (*_THING, "region")),
    "in": (_THING, ("region",)),
    "inplace": (("object",),),
}
"""Predicate -> what each of its arguments may be; the others speak of what can be opened or switched."""


@dataclass(frozen=True)
class Region:
    """A named place on ``target``.

    Attributes:
        name: name inside the file; atoms use ``full_name``.
        target: fixture (or object) that carries the region.
        ranges: rectangles (x1, y1, x2, y2) in metres relative to the target's centre; empty for a site of the
            target itself.
        yaw: interval (low, high) in radians from which the yaw of what starts here is drawn.
    """

    name: str
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()
    yaw: tuple[float, float] = (0.0, 0.0)

    @property
    def full_name(self) -> str:
        """The name by which atoms refer to the region: ``<target>_<name>``."""
        return f"{self.target}_{self.name}"


@dataclass(frozen=True)
class Problem:
    """What a BDDL file says; names in ``init`` and ``goal`` are declared. Mappings keep the file's order.

    Attributes:
        unplaced: region whose target is not declared -> the sentence that says so when it is used.
    """

    name: str
    domain: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    objects_of_interest: tuple[str, ...]
    init: tuple[Atom, ...]
    goal: Formula
    unplaced: dict[Region, str] = field(default_factory=dict)

    def entity_kind(self, name: str) -> str | None:
        """Return "object", "fixture", "region" or None."""
        if name in self.objects:
            return "object"
        if name in self.fixtures:
            return "fixture"
        return "region" if name in self.regions else None

    def resolve(self, formula: Formula, where: str) -> Formula:
        """Return ``formula`` with its names spelt as declared; one that is not, or does not fit, raises."""
        declared = {name.lower(): name for name in (*self.objects, *self.fixtures, *self.regions)}
        spelling: dict[str, str] = {}
        for atom in atoms(formula):
            for position, arg in enumerate(atom.args):
                if arg.lower() not in declared:
                    self._check_unplaced(arg)
                    raise MemobenchError(
                        f"{where}: found the name {arg!r}, which none of :objects, :fixtures and :regions "
                        f"(as <target>_<region>) declares, {nearest(arg, declared.values())}"
                    )
                spelling[arg] = declared[arg.lower()]
                self._check_kind(atom, position, spelling[arg], where)
        return rename(formula, spelling)

    def _check_unplaced(self, name: str) -> None:
        """Raise where a name means a region on what is not declared: as it is written, or as it should have been."""
        for region, problem in self.unplaced.items():
            if name.lower().endswith(f"_{region.name}".lower()):
                raise MemobenchError(problem)

    def _check_kind(self, atom: Atom, position: int, name: str, where: str) -> None:
        kind = self.entity_kind(name)
        allowed = _KINDS.get(atom.predicate, (_JOINTED,))[position]
        if kind not in allowed:
            raise MemobenchError(f"{where}: found the {kind} {name!r} in {atom}, expected {' or '.join(allowed)} there")
