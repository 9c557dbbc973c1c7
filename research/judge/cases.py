"""Right episodes of a task and its near misses, as moves, with the verdict that the instruction asks for.

A near miss of a checkpoint repeats a right episode up to the move that completes the checkpoint, and replaces this
move. A near miss of the goal changes the order or the number of events.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_memobench.experts.expert import counts_events, plan_of, steps_of
from lerobot_memobench.tasks.assessment import handled_atoms
from lerobot_memobench.tasks.formula import Atom, Hold, Not
from lerobot_memobench.tasks.task import STRICT, Task
from research.judge.stage import DWELL, Move, Stage, Verdict, judge

OPEN, JUST_OPEN = 1.1, 1.02
"""Positions of a joint as shares of the way to its bound."""
AWAY = Move("away", steps=1)
HOME = Move("home")
THEN = 22
"""Control steps that a placement of a procedural task lasts; `Then` asks for 10, a nested one for 20."""
Moves = tuple[Move, ...]


@dataclass(frozen=True)
class Case:
    """A sequence of moves and its right verdict.

    Attributes:
        kind: name of the near miss; "right …" for episodes to accept.
        accepted: the verdict that the instruction asks for.
        checkpoint: number of checkpoints that are complete if the case is accepted; None: the goal is reached.
        choice: whether acceptance is a choice that fits the variant (`tasks.assessment`).
    """

    kind: str
    moves: Moves
    accepted: bool = False
    checkpoint: int | None = None
    choice: bool = False

    def is_accepted(self, task: Task, verdict: Verdict) -> bool:
        """Return whether the judge accepts the case."""
        if self.choice:
            return verdict.choice == task.variant_index
        return verdict.success if self.checkpoint is None else verdict.checkpoints >= self.checkpoint


def cases_of(stage: Stage) -> list[Case]:
    """Return every case of a stage's task."""
    return list(_Cases(stage).all())


class _Cases:
    def __init__(self, stage: Stage) -> None:
        self.task, self.stage = stage.task, stage
        self.strict = self.task.suite == STRICT
        self.hides = self.task.prompt is not None and self.task.prompt.kind == "hide"
        self.right = self._right_moves()
        self.puts = tuple(move for move in self.right if move.kind == "put")
        self.events = self._events()

    def all(self) -> Iterator[Case]:
        yield from self._accepted()
        yield from self._of_checkpoints()
        yield from self._of_numbers()
        yield from self._of_order()
        yield from self._of_rest()
        yield from self._of_places()
        yield from self._of_choices()
        yield Case("moved without the hand", tuple(move for move in self.right if move.kind != "away"))

    # --- a right episode ---

    def _right_moves(self) -> Moves:
        goal = self.task.goal
        formulas = (*(checkpoint.goal for checkpoint in self.task.checkpoints), goal)
        steps: Sequence[Atom | Hold] = [step for formula in formulas for step in steps_of(formula)]
        if counts_events(goal):
            steps = plan_of(goal)
        self.stage.restart()
        opened: set[str] = set()
        moves: list[Move] = []
        for step in steps:
            for move in self._moves_of(step, opened):
                self.stage.do(move)
                moves.append(move)
        # A plan may go on after the goal is reached.
        steps_to_goal = judge(self.stage, self.stage.record(tuple(moves))).steps
        return tuple(move for i, move in enumerate(moves) if sum(one.steps for one in moves[:i]) < steps_to_goal)

    def _moves_of(self, step: Atom | Hold, opened: set[str]) -> Moves:
        """Return the moves of a step of the plan; none if its atom holds. ``opened``: joints opened so far."""
        if isinstance(step, Hold):
            return (Move("rest", steps=step.number),)
        latched = step.predicate in ("wasopen", "wasturnedon")
        if step.args[0] in opened if latched else self.stage.sim.holds(step):
            return ()
        if latched or step.predicate in ("open", "turnon"):
            opened.add(step.args[0])
            return AWAY, Move("joint", step.args[0], share=OPEN)
        if step.predicate in ("close", "turnoff"):
            return (Move("joint", step.args[0]),)
        lasts = THEN if self.task.memory_type == "procedural" else DWELL
        if step.predicate not in ("on", "in"):
            return (HOME,)
        name, place = step.args
        return AWAY, Move("put", name, place, steps=lasts)

    def _events(self) -> list[slice]:
        found, begun = [], 0
        for i, move in enumerate(self.right):
            if move.opens:
                begun = i - 1
            elif move.kind == "joint":
                found.append(slice(begun, i + 1))
        return found

    def _accepted(self) -> Iterator[Case]:
        yield Case("right", self.right, True)
        slow = tuple(replace(move, steps=3 * move.steps) if move.kind != "home" else move for move in self.right)
        yield Case("right, slowly", slow, True)
        just = tuple(replace(move, share=JUST_OPEN) if move.opens else move for move in self.right)
        yield Case("right, just open or on", just, True)
        if any(not self._is_narrow(move) for move in self.puts):
            aside = tuple(
                move if self._is_narrow(move) else replace(move, offset=(0.0, 0.024, 0.0)) for move in self.right
            )
            yield Case("right, 2.4 cm off centre", aside, True)

    def _is_narrow(self, move: Move) -> bool:
        """Return whether an object 2.4 cm off its target's centre would fall."""
        return move.kind != "put" or "bowl" in str(move.place)

    # --- checkpoints ---

    def _of_checkpoints(self) -> Iterator[Case]:
        whole = self.stage.record(self.right)
        counts = [0, *(judge(self.stage, whole[: i + 1]).checkpoints for i in range(len(whole)))]
        for i, (move, before, done) in enumerate(zip(self.right, counts, counts[1:], strict=False)):
            for k in range(before, done):
                goal = self.task.checkpoints[k].goal
                inside = any(isinstance(part, Not) for part in (goal, *getattr(goal, "children", ())))
                for kind, moves in self._out_of_place(move) if inside else self._nearly(move, self.right[i - 1]):
                    yield Case(kind, (*self.right[:i], *moves), checkpoint=k + 1)

    def _nearly(self, move: Move, previous: Move) -> Iterator[tuple[str, Moves]]:
        if move.opens:
            yield "opened or turned on by 80 %", (replace(move, share=0.8),)
            yield "touched, not moved", (replace(move, share=0.0),)
            yield from (
                ("another joint", (replace(move, name=name),))
                for name in self.stage.sim.world.joints
                if name != move.name
            )
        elif move.kind == "joint":
            yield "closed or turned off by 80 %", (replace(move, share=0.2),)
            yield "left open or on", ()
        elif move.kind == "put":
            yield from self._nearly_put(move)
        elif move.kind == "home":
            yield "hand 1 cm from home", (replace(move, share=0.02),)
        elif move.kind == "rest":
            yield "rest one step too short", (replace(move, steps=move.steps - previous.steps - 1),)

    def _nearly_put(self, move: Move) -> Iterator[tuple[str, Moves]]:
        assert move.place is not None
        drawer = self.stage.is_drawer(move.place)
        yield "next to the target", (replace(move, offset=(0.0, self._outside(move.place), 0.0)),)
        if drawer:
            depth = float(self.stage.half(move.place)[2])
            yield "above the drawer", (replace(move, offset=(0.0, 0.0, depth + 0.01)),)
            yield "below the drawer", (replace(move, offset=(0.0, 0.0, -depth - 0.015)),)
        else:
            yield "held 2 cm above the target", (replace(move, offset=(0.0, 0.0, 0.02)),)
        yield "touched, not moved", (replace(move, place=None),)
        carriers = [atom.args[1] for atom in self.task.init if atom.args[0] == move.name]
        others = [name for name in self.task.objects if name not in (move.name, move.place, *carriers)]
        yield from (("right place, wrong object", (replace(move, name=name),)) for name in others[:2])
        yield from (("right object, wrong place", (replace(move, place=place),)) for place in self._other_places(move))

    def _outside(self, place: str) -> float:
        """Return a displacement along y that takes an object 1 cm out of its target, m."""
        region = self.task.regions.get(place)
        if region is None and not self.stage.is_drawer(place):
            return 0.04
        if region is not None and region.ranges:
            return float(max(box[3] for box in region.ranges) - (region.ranges[0][1] + region.ranges[0][3]) / 2) + 0.01
        return float(np.max(self.stage.half(place)[:2])) + 0.01

    def _other_places(self, move: Move) -> list[str]:
        assert move.place is not None
        if self.stage.is_drawer(move.place):
            return [name for name in self.stage.sim.world.joints if name != move.place]
        kind, taken = self.task.objects.get(move.place), {move.name, *(put.place for put in self.puts)}
        return [name for name, other in self.task.objects.items() if other == kind and name not in taken]

    def _out_of_place(self, move: Move) -> Iterator[tuple[str, Moves]]:
        yield "touched, not moved", ()
        drawer = next(one.name for one in self.right if one.opens)
        yield "moved within the drawer", (replace(move, place=drawer, offset=(0.0, 0.02, 0.0)),)

    # --- the goal ---

    def _of_numbers(self) -> Iterator[Case]:
        if not self.events or self.events[-1].stop == len(self.right):  # such an episode ends after the first event
            return
        last = self.events[-1]
        if self.task.family == "counting":
            once = self.right[last]
            yield Case("one repetition more", (*self.right[: last.stop], HOME, *once, *self.right[last.stop :]))
            yield Case("one repetition less", (*self.right[: last.start], *self.right[last.stop :]))
        elif self.puts:
            first = self.events[0]
            again = self.right[first]
            yield Case("one repetition more", (*self.right[: first.stop], HOME, *again, *self.right[first.stop :]))

    def _of_order(self) -> Iterator[Case]:
        asked = self.strict or self.task.memory_type == "procedural" or " then " in self.task.language
        kind = "order exchanged" if asked else "right, in another order"
        if self.task.memory_type == "procedural":
            yield Case(kind, (AWAY, *self.puts[1:], self.puts[0], Move("rest", steps=2 * THEN)))
        elif (
            self.events and self.task.family != "counting" and self.events[0].stop < len(self.right) and not self.hides
        ):
            first = self.events[0]
            rest = self.right[first.stop :]
            yield Case(kind, (*rest, HOME, *self.right[first], HOME), not asked)
        if self.strict and HOME in self.right[1:]:
            hasty = tuple(move for move in self.right[:-1] if move != HOME)
            yield Case("hand not home in between", (*hasty, *(() if self.puts else (HOME,)), self.right[-1]))

    def _of_rest(self) -> Iterator[Case]:
        last = self.right[-1]
        if self.task.memory_type == "procedural":
            out = Move("put", last.name, offset=(0.0, 0.0, 0.1), steps=2 * THEN)
            yield Case("held one step too short", (*self.right[:-1], replace(last, steps=9), out))
        if not self.strict or HOME not in self.right[1:]:
            return
        event = self.events[-1]
        if last.kind == "rest":  # leaving home takes one more step of rest
            short = replace(last, steps=last.steps - DWELL - 2)
            yield Case("rest too short, one repetition more", (*self.right[:-1], short, *self.right[event], HOME, last))
            yield Case("rest before the first event", (last, *self.right))
        begun = self.events[0].start
        ajar = (AWAY, Move("joint", self.right[begun + 1].name, share=0.3))
        shut = (AWAY, Move("joint", self.right[begun + 1].name))
        yield Case("left ajar at home", (*self.right[:begun], *ajar, HOME, *shut, HOME, *self.right[begun:]))
        yield Case(
            "right, ajar while the hand is away", (*self.right[:begun], *ajar, *shut, HOME, *self.right[begun:]), True
        )

    def _of_places(self) -> Iterator[Case]:
        if not self.strict or HOME not in self.right[1:]:
            return
        name = self.puts[0].name if self.puts else next(iter(self.task.objects))
        if self.task.family == "counting":
            yield Case(
                "an object moved by 2 mm", (AWAY, Move("put", name, offset=(0.0, 0.002, 0.0)), HOME, *self.right)
            )
        elif self.puts:
            for kind, shift, accepted in (
                ("right, object moved by 8 mm and back", 0.008, True),
                ("object moved by 12 mm and back", 0.012, False),
            ):
                moved = (AWAY, Move("put", name, offset=(0.0, shift, 0.0)), Move("put", name), HOME)
                yield Case(kind, (*moved, *self.right), accepted)

    def _of_choices(self) -> Iterator[Case]:
        """Yield strict episodes with a wrong choice that is corrected, and choices short of an answer."""
        if self.hides:
            asked = next(move.name for move in self.right if move.opens)
            for name in self.stage.sim.world.joints:
                for kind, way, accepted in (
                    ("wrong drawer moved by 10 mm", 0.0105, False),
                    ("right, wrong drawer moved by 8 mm", 0.0078, True),
                ):
                    if name != asked:
                        pulled = Move("joint", name, share=way / abs(self.stage.way(name)))
                        yield Case(kind, (AWAY, pulled, Move("joint", name), *self.right), accepted)
        if self.task.memory_type != "object":
            return
        wrong = [self.task.variant(k) for k in self.task.random_variants if k != self.task.variant_index]
        for other in wrong[:1] if self.strict else ():
            name, place = steps_of(other.goal)[0].args
            yield Case("wrong choice, then corrected", (AWAY, Move("put", name, place), Move("put", name), *self.right))
        if all(handled_atoms(other) != handled_atoms(self.task) for other in wrong):
            for kind, height, accepted in (
                ("touched, raised by 1 cm", 0.01, False),
                ("right, lifted by 3 cm", 0.03, True),
            ):
                lift = Move("put", self.puts[0].name, offset=(0.0, 0.0, height))
                yield Case(kind, (AWAY, lift), accepted, choice=True)
