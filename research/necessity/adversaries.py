"""Policies without a memory that try to solve strict tasks, and the most that such a policy can reach.

    python -m research.necessity.adversaries --scenes 50 --out outputs/adversaries

Each decision is a function of the present observation and the instruction. Between decisions the scripted hand moves.
Strategies use the scene as a notebook (drawers ajar, moved objects, knobs between off and on), look into drawers, read
the clock, or guess at the best odds. Rollouts begin where the prompt has ended and stop once the strategy cannot change
their result. They are appended to ``rollouts.jsonl``, scene by scene; the same command goes on.
"""

from __future__ import annotations

import json
import sys
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.evaluation.metrics import wilson
from lerobot_memobench.experts.expert import Expert, plan_of
from lerobot_memobench.experts.hand import OPEN, UP
from lerobot_memobench.experts.travel import go_home, release_fixture
from lerobot_memobench.protocol import ACTION_DIM, EXECUTION, NO_CLOCK, VALIDATION_SEED
from lerobot_memobench.sim.assets.registry import split_class
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import DEAD_CENTRE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.evidence import chance
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.task import Task
from research.command import run
from research.necessity.demonstrations import rest_steps
from research.necessity.notes import Motion, leave_ajar, loose_object, opened_to, pull, shift

LEVELS = ("bottom", "middle", "top")
TIMES = ("once", "twice", "three times")
NOTE = 0.03
"""Distance that encodes one event where a drawer or an object is the note, m."""
SLOT, PUNCTUAL = 32, 3
"""Control steps of a slot of the clock, and within how many of them the hand comes home that comes in it."""
RETURN = 12
"""Control steps from the place where the hand hovers to its home."""
HOVER = 0.08
"""Height above home at which the hand hovers, m."""
SHOWN = "the clock, if it were shown"
"""The control of the strategy that reads the clock: it gets the step of the episode, which no observation holds."""
CHUNK = "home within a chunk of actions"
"""A policy that carries out several actions without looking is bound by no ceiling: it passes home, where it sees the
scene as it began for a single step, within a chunk, and its hand knows the way all the rest of the time."""
UNBOUND = (SHOWN, CHUNK)
"""Strategies that no ceiling binds: a clock, or a chunk of actions, is a memory."""


def ceiling(task: Task) -> float:
    """Return the highest success rate of a policy that decides at every step, by the present observation alone.

    At home the scene is as it began, to the bit. So the same thing is begun there with the same probability at each
    step: of two things in order at best 1/4, of three 1/27, and `counted` of events and a rest. In the other families
    the first choice decides, and the observation is the same for all variants.
    """
    if task.family == "counting":
        return float(np.mean([counted(1 + k, rest_steps(task.goal)) for k in task.random_variants]))
    if task.family == "ordering":
        return 1 / 27 if "three" in task.name else 1 / 4
    found = chance(task)
    assert found is not None, task.name
    return found


def counted(number: int, rest: int) -> float:
    """Return the highest probability of exactly so many events before the first rest of ``rest`` control steps.

    A policy stays at home in each step with the same probability. The first event begins before a rest, each later one
    too, then the hand rests: nearly n^n / (n + 1)^(n + 1). The step in which a hand leaves home counts as rest, and the
    one in which it comes home, which makes a rest after an event shorter than one at the start by a decision.
    """
    first = np.linspace(0.0, 1.0, 100_001)
    later = first ** ((rest - 2) / (rest - 1))
    return float(((1 - first) * (1 - later) ** (number - 1) * later).max())


# --- observations and actions of a strategy ---


@dataclass
class Seat:
    """Where a strategy sits: the present observation, the instruction and the scripted hand."""

    episode: Episode
    expert: Expert
    rng: np.random.Generator
    shows_step: bool

    def __post_init__(self) -> None:
        self._places = {name: self.sim.body_pose(name)[0] for name in self.task.objects}

    @property
    def sim(self) -> Simulation:
        """The scene."""
        return self.episode.sim

    @property
    def task(self) -> Task:
        """The task, as its variant is."""
        return self.episode.task

    @property
    def step(self) -> int:
        """The clock of the observation."""
        return self.episode.step_index if self.shows_step else self.episode.clock

    def rows(self, kind: str) -> list[NDArray[np.float32]]:
        """Return the visible slots of a class, lowest first."""
        slots = self.episode.objects().reshape(SLOTS, WIDTH)
        found = [row for row in slots if row[STARTS["present"]] and classes()[int(row[STARTS["class"]])] == kind]
        return sorted(found, key=lambda row: float(row[STARTS["position"] + 2]))

    def joint(self, name: str) -> float:
        """Return the visible position of a drawer, door or knob, m or rad."""
        rows = self.rows(self.sim.world.articulation(name)[0].kind)
        number = next((k for k, level in enumerate(LEVELS) if f"_{level}_" in name), 0)
        return float(rows[number][STARTS["joint"]]) if number < len(rows) else 0.0

    def events(self) -> list[tuple[Atom, Atom]]:
        """Return beginning and end of every event that the instruction asks for, in order."""
        begun = [a for a in plan_of(self.task.goal) if isinstance(a, Atom) and a.predicate in ("open", "turnon")]
        ends = {"open": "close", "turnon": "turnoff"}
        found = [(a, Atom(ends[a.predicate], a.args)) for a in dict.fromkeys(begun)]
        times = next((k for k, word in enumerate(TIMES, 1) if word in self.task.language), 1)
        return found * times if self.task.family == "counting" else found

    def placed(self) -> list[Atom]:
        """Return the object and its place, to be carried once all events are done."""
        return [atom for atom in atoms(self.task.goal) if atom.predicate == "on"]

    def do(self, *achieved: Atom) -> Motion:
        """Bring atoms about, then come home."""
        for atom in (*achieved, Atom("handhome", ())):
            yield from self.expert.achieve(atom)

    def rest(self) -> Motion:
        """Stay at home longer than the rest that ends the count."""
        for _ in range(45):
            yield self.expert.hand.toward(*self.sim.home, OPEN)

    def another_joint(self) -> str:
        """Return a drawer that is not asked for; where there is none, the joint that is."""
        (asked,) = self.events()[0][0].args
        return next((name for name in self.sim.world.joints if name != asked), asked)

    def moved(self) -> float:
        """Return the distance of the note object from its known start, m."""
        name = loose_object(self.task)
        return float(self.sim.body_pose(name)[0][1] - self._places[name][1])


Strategy = Callable[[Seat], Motion]
"""Yields actions; each decision is a function of the present observation of the seat."""


# --- counting and order: evidence of past events ---


def by_note(read: Callable[[Seat], int], write: Callable[[Seat, int], Motion]) -> Strategy:
    """Return the strategy that reads the next event from a note in the scene and writes the next note."""

    def act(seat: Seat) -> Motion:
        events = seat.events()
        while (done := read(seat)) < len(events):
            yield from _bring(seat, *events[done])
            yield from write(seat, done + 1)
            yield from seat.do()
        yield from _finish(seat)

    return act


def _bring(seat: Seat, begun: Atom, ended: Atom) -> Motion:
    """Do one event; where something is stowed within it, that too."""
    yield from seat.expert.achieve(begun)
    for atom in atoms(seat.task.goal):
        if atom.predicate == "in" and atom.args[1] == begun.args[0]:
            yield from seat.expert.achieve(atom)
    yield from seat.expert.achieve(ended)


def _finish(seat: Seat) -> Motion:
    """Finish after the events: carry an object to its place, or rest."""
    for atom in seat.placed():
        yield from seat.expert.achieve(atom)
    yield from seat.rest()


def _notes_in_joint(seat: Seat) -> int:
    name = seat.another_joint()
    joint = seat.sim.world.articulation(name)[0]
    size = NOTE if joint.kind == "drawer" else 0.12
    return max(round(abs(seat.joint(name) - joint.closed_q) / size), 0)


def _write_in_joint(seat: Seat, number: int) -> Motion:
    name = seat.another_joint()
    joint = seat.sim.world.articulation(name)[0]
    size = NOTE if joint.kind == "drawer" else 0.12
    way = np.sign(joint.open_q - joint.closed_q)
    yield from leave_ajar(seat.expert, name, joint.closed_q + way * size * number)


def _notes_below_the_spring(seat: Seat) -> int:
    name = seat.another_joint()
    joint = seat.sim.world.articulation(name)[0]
    return max(round(4 * abs(seat.joint(name) - joint.closed_q) / DEAD_CENTRE[joint.kind]), 0)


def _write_below_the_spring(seat: Seat, number: int) -> Motion:
    name = seat.another_joint()
    joint = seat.sim.world.articulation(name)[0]
    way = np.sign(joint.open_q - joint.closed_q)
    yield from leave_ajar(seat.expert, name, joint.closed_q + way * DEAD_CENTRE[joint.kind] * number / 4)


def _notes_in_object(size: float, seat: Seat) -> int:
    return max(round(abs(seat.moved()) / size), 0)


def _write_in_object(size: float, seat: Seat, number: int) -> Motion:
    yield from shift(seat.expert, loose_object(seat.task), size)


def open_means_done(seat: Seat) -> Motion:
    """Leave finished fixtures open or on; close or switch off everything at the end."""
    while True:
        waiting = [begun for begun, _ in seat.events() if not seat.sim.holds(begun)]
        if waiting:
            yield from seat.do(waiting[0])
        else:
            yield from seat.do(*(ended for _, ended in seat.events()), *seat.placed())


def by_clock(seat: Seat) -> Motion:
    """Come home in a slot of the clock that encodes the number of past events, and hover until then.

    Who is home at another time has not begun: it hovers until the slot of its number. Without a clock: `by_chance`.
    """
    if seat.step == NO_CLOCK:
        yield from by_chance(seat)
    events = seat.events()
    while True:
        slot, late = divmod(seat.step, SLOT)
        done = slot % (len(events) + 1)
        if late > PUNCTUAL:
            yield from _come_in_slot(seat, 0)
        elif done < len(events):
            yield from _bring(seat, *events[done])
            yield from _come_in_slot(seat, done + 1)
        else:
            yield from _finish(seat)
            return


def _come_in_slot(seat: Seat, number: int) -> Motion:
    """Hover above home, and come home at the beginning of the next slot of ``number`` events."""
    hand, (position, rotation) = seat.expert.hand, seat.sim.home
    yield from go_home(hand, position + HOVER * UP, rotation)
    cycle = SLOT * (len(seat.events()) + 1)
    while (seat.step + RETURN) % cycle != number * SLOT:
        yield hand.toward(position + HOVER * UP, rotation, OPEN)
    yield from seat.do()


def by_chance(seat: Seat) -> Motion:
    """Begin at home the same thing with the same probability each time: the best odds of all that has no note."""
    events, placed = seat.events(), seat.placed()
    while True:
        choice = int(seat.rng.integers(len(events) + max(len(placed), seat.task.family == "counting")))
        if choice < len(events):
            yield from _bring(seat, *events[choice])
            yield from seat.do()
        elif placed:
            yield from seat.do(*placed)
        else:
            yield from seat.rest()


def by_chunk(seat: Seat) -> Motion:
    """Do all events with the hand home in between, and look there only once they are done: then rest or not."""
    while seat.task.family == "ordering" or seat.rng.random() < 0.5:
        for begun, ended in seat.events():
            yield from _bring(seat, begun, ended)
            yield from seat.do()
        yield from seat.do(*seat.placed())
    yield from seat.rest()


def without_coming_home(seat: Seat) -> Motion:
    """Do all events without coming home in between: the place of the hand encodes the count."""
    while True:
        for begun, ended in seat.events():
            yield from _bring(seat, begun, ended)
        yield from seat.do(*seat.placed())


# --- finding ---


def _asked(seat: Seat) -> tuple[str, str]:
    """Return the object that the instruction names, and its class."""
    assert seat.task.prompt is not None
    named = {name: split_class(seat.sim.assets[name].class_name)[0] for name, _ in seat.task.prompt.places}
    for name, kind in named.items():
        if kind.split("_")[-1] in seat.task.language or kind.split("_")[0] in seat.task.language:
            return name, kind
    return next(iter(named.items()))


def peek(by: float, seat: Seat) -> Motion:
    """Pull each drawer a little, look while it is held, and fetch the visible object; without any, guess."""
    for drawer in sorted(seat.sim.world.joints):
        yield from pull(seat.expert, drawer, opened_to(seat.expert, drawer, 0.0) - by)
        seen = bool(seat.rows(_asked(seat)[1]))
        yield from release_fixture(seat.expert.hand)
        if seen:
            yield from _fetch(seat)
            return
    yield from open_one(seat)


def open_one(seat: Seat) -> Motion:
    """Open a drawer drawn by chance, and fetch the requested object."""
    yield from seat.expert.achieve(Atom("open", (str(seat.rng.choice(sorted(seat.sim.world.joints))),)))
    yield from _fetch(seat)


def _fetch(seat: Seat) -> Motion:
    """Put the requested object on the table while it is visible."""
    name, kind = _asked(seat)
    while seat.rows(kind):
        yield from seat.do(Atom("on", (name, "kitchen_table_table_region")))


# --- referents and procedures ---


def routine(choose: Callable[[Seat, int], int], seat: Seat) -> Motion:
    """Reach the goal of one of the variants."""
    task = seat.episode.published
    yield from _do_variants(seat, [task.random_variants[choose(seat, len(task.random_variants))]])


def _by_first_slot(seat: Seat, count: int) -> int:
    """Read the order of equal objects in their slots."""
    return round(1e4 * float(np.abs(seat.episode.objects()).sum())) % count


def _do_variants(seat: Seat, variants: Sequence[int]) -> Motion:
    for variant in variants:
        for atom in plan_of(seat.episode.published.variant(variant).goal):
            if isinstance(atom, Atom):
                yield from seat.expert.achieve(atom)
    yield from seat.rest()


def every_variant(seat: Seat) -> Motion:
    """Do what all variants ask for, one after the other."""
    yield from _do_variants(seat, seat.episode.published.random_variants)


EVENTS: dict[str, Strategy] = {
    "another joint is the note": by_note(_notes_in_joint, _write_in_joint),
    "a note below the spring": by_note(_notes_below_the_spring, _write_below_the_spring),
    "an object is the note": by_note(partial(_notes_in_object, NOTE), partial(_write_in_object, NOTE)),
    "a millimetre is the note": by_note(partial(_notes_in_object, 0.0003), partial(_write_in_object, 0.0003)),
    "open means done": open_means_done,
    "the clock": by_clock,
    SHOWN: by_clock,
    CHUNK: by_chunk,
    "without coming home": without_coming_home,
    "chance": by_chance,
}
FINDING: dict[str, Strategy] = {
    "peek 6 cm": partial(peek, 0.058),
    "peek 3 cm": partial(peek, 0.025),
    "peek below the spring": partial(peek, 0.006),
    "open one": open_one,
}
PROMPTED: dict[str, Strategy] = {
    "first variant": partial(routine, lambda seat, count: 0),
    "order of slots": partial(routine, _by_first_slot),
    "every variant": every_variant,
}
STRATEGIES: dict[str, dict[str, Strategy]] = {
    "counting": EVENTS,
    "ordering": EVENTS,
    "hidden_thing": FINDING,
    "two_hidden_things": FINDING,
    "only_referent": PROMPTED,
    "strict_procedure": PROMPTED,
}
"""Family -> name -> strategy."""


@cache
def _episode(name: str) -> Episode:
    """Return the episodes of a task, with a scene that is compiled once; of prompts only the final scene is visible."""
    return Episode(get_task(name), demonstration_prompt=False)


def rollout(name: str, strategy: str, seed: int) -> dict[str, object]:
    """Return one rollout of a strategy: success, whether the goal was lost, control steps."""
    episode = _episode(name)
    episode.reset(seed, keep_prompt=True)
    while episode.phase != EXECUTION:
        episode.step(np.zeros(ACTION_DIM, np.float32))
    rng = np.random.default_rng([seed, zlib.crc32(f"{name}, {strategy}".encode())])
    expert = Expert(episode.task, episode.sim, rng)
    expert.hand.speed = 0.8
    for action in STRATEGIES[str(episode.task.family)][strategy](Seat(episode, expert, rng, strategy == SHOWN)):
        episode.step(action)
        if episode.done:
            break
    found = {"success": episode.success, "lost": episode.lost, "steps": episode.exec_steps}
    return {"task": name, "strategy": strategy, "seed": seed, **found}


def table(rollouts: list[dict[str, object]]) -> str:
    """Return the rates by task and strategy with Wilson intervals, and the ceiling."""
    lines = ["| task | ceiling | strategy | solved | rollouts | interval |", "|---|---:|---|---:|---:|---|"]
    results: dict[tuple[object, object], list[bool]] = {}
    for one in rollouts:
        results.setdefault((one["task"], one["strategy"]), []).append(bool(one["success"]))
    for name in task_names(suite="strict"):
        for strategy in STRATEGIES[str(get_task(name).family)]:
            if found := results.get((name, strategy)):
                lines.append(_line(f"`{name}` | {100 * ceiling(get_task(name)):.1f} | {strategy}", found))
    return "\n".join(lines)


def summary(rollouts: list[dict[str, object]]) -> str:
    """Return the rates by family and strategy with Wilson intervals, and the mean of the ceilings of the tasks."""
    lines = ["| family | ceiling | strategy | solved | rollouts | interval |", "|---|---:|---|---:|---:|---|"]
    for family, strategies in STRATEGIES.items():
        for strategy in strategies:
            mine = [r for r in rollouts if get_task(str(r["task"])).family == family and r["strategy"] == strategy]
            if mine:
                most = np.mean([ceiling(get_task(str(r["task"]))) for r in mine])
                lines.append(_line(f"{family} | {100 * most:.1f} | {strategy}", [bool(r["success"]) for r in mine]))
    return "\n".join(lines)


def _line(what: str, found: list[bool]) -> str:
    rate = float(np.mean(found))
    low, high = wilson(rate, len(found))
    return f"| {what} | {100 * rate:.0f} | {len(found)} | {100 * low:.0f} to {100 * high:.0f} |"


def adversaries(
    out: Annotated[Path, typer.Option(help="Folder of the rollouts; the same command goes on.")],
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each task and strategy.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed of the first scene.")] = VALIDATION_SEED,
    tasks: Annotated[list[str] | None, typer.Option(help="Names or memory types; all strict tasks if omitted.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
) -> None:
    """Roll out every strategy on every strict task; print the table."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "rollouts.jsonl"
    found = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    done = {(r["task"], r["strategy"], r["seed"]) for r in found}
    chosen = [
        name for name in task_names(suite="strict") if not tasks or name in tasks or get_task(name).memory_type in tasks
    ]
    wanted = [
        (name, strategy, seed + scene)
        for scene in range(scenes)
        for name in chosen
        for strategy in STRATEGIES[str(get_task(name).family)]
        if (name, strategy, seed + scene) not in done
    ]
    with ProcessPoolExecutor(workers) as pool, log.open("a") as file:
        for future in as_completed([pool.submit(rollout, *one) for one in wanted]):
            found.append(future.result())
            file.write(json.dumps(found[-1]) + "\n")
            file.flush()
    asked = [one for one in found if one["task"] in chosen and seed <= one["seed"] < seed + scenes]
    print(f"{table(asked)}\n\n{summary(asked)}")
    print(f"\nceiling of these tasks, their mean: {100 * np.mean([ceiling(get_task(name)) for name in chosen]):.1f} %")


if __name__ == "__main__":
    sys.exit(run("necessity.adversaries", adversaries))
