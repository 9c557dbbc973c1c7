"""Mutants of the code that gives verdicts, and the cases that kill them.

A mutant changes one operator, number or threshold in `tasks.nodes`, `tasks.progress` or `sim.world`, or a joint's
bound. It is killed if a case gets another verdict.
"""

from __future__ import annotations

import ast
import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import count
from types import ModuleType
from unittest.mock import patch

import mujoco
import numpy as np

from lerobot_memobench.sim import world
from lerobot_memobench.tasks import nodes, progress
from lerobot_memobench.tasks.formula import SINCE_START, Atom
from lerobot_memobench.tasks.task import Task
from research.judge.cases import Case, cases_of
from research.judge.stage import Array, Recording, Stage, Trace, Verdict, judge, trace

NEGATED: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.GtE,
    ast.GtE: ast.Lt,
    ast.Gt: ast.LtE,
    ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
SHIFTED: dict[type[ast.cmpop], type[ast.cmpop]] = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
"""Bounds that are one off; for whole numbers only."""
JUDGED = {
    nodes: ("build", "value", "reset"),
    progress: ("step", "settle", "lost"),
    world: (
        *("holds", "touching", "_articulated", "_in", "_on_object", "_on_site"),
        *("_is_or_was_equal", "_is_ajar", "_shift", "_joint_shift"),
    ),
}
"""Module -> functions that give verdicts. ``settled`` ends a lost episode early and does not change its verdict;
``tests/tasks/test_nodes.py`` tests it. The detent of strict scenes moves the arm and is tested with the physics."""
THRESHOLDS = ("ON_DISTANCE", "IN_SLACK", "ON_SITE_BELOW", "ON_SITE_ABOVE", "PLACE_DISTANCE", "LIFTED_HEIGHT")
BOUNDS = ("open_below", "on_at_least")
"""Bounds of joints other than zero."""
NOT_SHOWN = {
    "_ExactlyNode.value: 1 -> 2 in self.count = min(": "the count saturates one later and is compared with the number",
    "nodes: build: 0 -> 1": "the number of an operator without one is not used",
    "_AtomNode.reset": "every evaluation sets the latch",
    "_ThenNode.value: 0 -> 1 in self.done, self.held": "only if the next part holds already; no case of the slow test",
    "Progress.step: self.first_step[k] is None": "verdicts do not hold the first step",
    "Progress.step: now and self.first_step[k] is None": "verdicts do not hold the first step",
    "World.touching: False -> True": "a scene without any contact does not occur",
    "IN_SLACK × 0.5": "no case puts an object 5 to 10 mm below a drawer's floor; tests/sim/test_world.py does",
    "ON_SITE_BELOW ×": "contact with the target decides first",
    "ON_SITE_ABOVE × 2.0": "contact with the target decides first",
}
"""Part of a mutant's name -> why the cases do not kill it."""


@dataclass(frozen=True)
class Mutant:
    """A change of a module.

    ``source``: the whole module, changed; None for a joint's ``bound`` multiplied by ``factor``.
    """

    name: str
    module: ModuleType
    source: str | None = None
    bound: str = ""
    factor: float = 1.0

    def load(self) -> ModuleType:
        """Return the changed module."""
        if self.source is None:
            return self.module
        changed = ModuleType(f"{self.module.__name__}_mutant")
        exec(compile(self.source, str(self.module.__file__), "exec"), changed.__dict__)
        return changed


class _Change(ast.NodeTransformer):
    """Make the change of one number to the functions of a tree; count the possible changes."""

    def __init__(self, wanted: int, functions: Sequence[str], whole_numbers: bool) -> None:
        self.wanted, self.functions, self.whole = wanted, functions, whole_numbers
        self.found, self.owner, self.inside, self.statement, self.made = -1, "", "", "", ""

    def _is_next(self) -> bool:
        self.found += 1
        return self.found == self.wanted

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        self.owner = f"{node.name}."
        return self.generic_visit(node)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        outer, self.inside = self.inside, node.name
        visited = self.generic_visit(node)
        self.inside = outer
        return visited

    def visit(self, node: ast.AST) -> ast.AST:
        if isinstance(node, ast.stmt):
            self.statement = ast.unparse(node).split("\n")[0]
        node = super().visit(node)
        if self.inside not in self.functions or self.made:
            return node
        for changed in self._changes(node):
            if self._is_next():
                change = f"{ast.unparse(node)} -> {ast.unparse(changed)}"
                self.made = f"{self.owner}{self.inside}: {change} in {self.statement}"
                return ast.copy_location(changed, node)
        return node

    def _changes(self, node: ast.AST) -> Iterator[ast.expr]:
        match node:
            case ast.Compare(ops=[operator]):
                for table in (NEGATED, SHIFTED) if self.whole else (NEGATED,):
                    if type(operator) in table:
                        yield ast.Compare(node.left, [table[type(operator)]()], node.comparators)
            case ast.BoolOp(op=operator):
                yield ast.BoolOp(ast.Or() if isinstance(operator, ast.And) else ast.And(), node.values)
            case ast.UnaryOp(op=ast.Not()):
                yield node.operand
            case ast.Call(func=ast.Name(id="all" | "any" as name)):
                yield ast.Call(ast.Name("any" if name == "all" else "all", ast.Load()), node.args, node.keywords)
            case ast.Constant(value=bool(value)):
                yield ast.Constant(not value)
            case ast.Constant(value=int(value)) if self.whole:
                yield ast.Constant(value + 1)


def mutants() -> list[Mutant]:
    """Return all mutants."""
    found = [mutant for module in JUDGED for mutant in _of_source(module)]
    text = _source(world)
    for name in THRESHOLDS:
        for factor in (0.5, 2.0):
            changed = f"{text}\n{name} = {factor} * {name}\n"
            found.append(Mutant(f"world: {name} × {factor}", world, changed))
    found += [Mutant(f"progress: HOLD_STEPS {shift:+}", progress, _shifted(shift)) for shift in (-1, 1)]
    found += [Mutant(f"joints: {bound} × {factor}", world, None, bound, factor) for bound, factor in _bounds()]
    return found


def _bounds() -> Iterator[tuple[str, float]]:
    yield from ((bound, factor) for bound in BOUNDS for factor in (0.75, 1.25))


def _shifted(shift: int) -> str:
    return _source(progress).replace("HOLD_STEPS = 10", f"HOLD_STEPS = {10 + shift}")


def _source(module: ModuleType) -> str:
    assert module.__file__ is not None
    with open(module.__file__, encoding="utf-8") as file:
        return file.read()


def _of_source(module: ModuleType) -> Iterator[Mutant]:
    tree = ast.parse(_source(module))
    for number in count():
        change = _Change(number, JUDGED[module], module is not world)
        changed = change.visit(copy.deepcopy(tree))
        if not change.made:
            return
        yield Mutant(f"{module.__name__.rpartition('.')[2]}: {change.made}", module, ast.unparse(changed))


class Predicates:
    """The predicates of a mutant, on the model of a simulation at the start of the execution."""

    def __init__(self, mutant: Mutant, stage: Stage) -> None:
        stage.restart()
        module = mutant.load()
        self._model, self._data, task = stage.sim.model, stage.sim.data, stage.task
        self._world = module.World(task, self._model, self._data, stage.sim.assets)
        joints = self._world.joints
        for name, (joint, address) in list(joints.items()) if mutant.bound else ():
            moved = getattr(joint, mutant.bound) * mutant.factor
            joints[name] = (replace(joint, **{mutant.bound: moved}), address)
        self._start = module.StartState(self._model, self._data, tuple(task.objects), joints)

    def set_state(self, state: Array) -> None:
        """Set a state, as `Simulation.set_state`."""
        self._start.mark_step()
        self._data.qpos[:], self._data.qvel[:] = np.split(state[1:], [self._model.nq])
        mujoco.mj_step1(self._model, self._data)

    def begin_execution(self) -> None:
        """Store the state as the start of the execution."""
        self._start.mark_scene()

    def holds(self, atom: Atom) -> bool:
        """Return whether an atom is true."""
        return bool((self._start if atom.predicate in SINCE_START else self._world).holds(atom))


# --- cases with their verdicts ---


@dataclass(frozen=True)
class Judgement:
    """A case with its states, its true atoms and the judge's verdict."""

    case: Case
    recording: Recording
    trace: Trace
    verdict: Verdict


class Battery:
    """All cases of one variant of a task, with the judge's verdicts."""

    def __init__(self, task: Task) -> None:
        self.task, self.stage = task, Stage(task)
        self.judgements = [self._judgement(case) for case in cases_of(self.stage)]

    def _judgement(self, case: Case) -> Judgement:
        recording = self.stage.record(case.moves)
        found = trace(self.stage.sim, self.task, self.stage.start, recording)
        return Judgement(case, recording, found, judge(self.task, found, choices=case.choice))

    def kills(self, mutant: Mutant) -> str | None:
        """Return the kind of the first case with another verdict or an error; None for a survivor."""
        module = mutant.load()
        sim = Predicates(mutant, self.stage) if mutant.module is world else None
        make = module.Progress if mutant.module is progress else progress.Progress
        with patch.object(progress, "build", module.build if mutant.module is nodes else nodes.build):
            for one in self.judgements:
                try:
                    found = trace(sim, self.task, self.stage.start, one.recording) if sim else one.trace
                    if judge(self.task, found, make, one.case.choice) != one.verdict:
                        return one.case.kind
                except Exception:
                    return one.case.kind
        return None


def is_not_shown(mutant: Mutant) -> bool:
    """Return whether a mutant is a known survivor."""
    return any(part in mutant.name for part in NOT_SHOWN)


def killer(mutant: Mutant, batteries: Sequence[Battery]) -> str | None:
    """Return the task and the case that kill a mutant, None for a survivor."""
    found = ((one, one.kills(mutant)) for one in batteries)
    return next((f"{one.task.name}: {kind}" for one, kind in found if kind is not None), None)
