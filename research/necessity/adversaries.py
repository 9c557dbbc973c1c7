"""Policies without a memory that try to solve strict tasks, and the most that such a policy can reach.

    python -m research.necessity.adversaries --scenes 50 --out outputs/adversaries

Each decision is a function of the instruction and of the input of the present plan: the last W observations before a
plan of K actions, as the strategy declares them to the environment (`DECLARED`). Between decisions the scripted hand
moves. Strategies use the scene as a notebook (drawers ajar, moved objects, knobs between off and on), pass home within
a plan, put the camera into shut drawers, read the clock, or guess at the best odds. In a hold a strategy is not asked:
its actions have no effect, and the observation repeats. Rollouts begin where the prompt has ended and stop once the
strategy cannot change their result. They are appended to ``rollouts.jsonl``; the same command goes on.
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
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.constants import ACTION_DIM, EXECUTION, VALIDATION_SEED
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.evaluation.metrics import wilson
from lerobot_memobench.experts.expert import Expert, plan_of
from lerobot_memobench.experts.hand import OPEN, UP
from lerobot_memobench.experts.travel import opening_direction, release_fixture, rise
from lerobot_memobench.sim.asset import split_class
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import DEAD_CENTRE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.assessment import chance
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.task import STRICT, Task
from research.command import run
from research.necessity.clock import WAIT, best_plan, bin_of
from research.necessity.notes import Motion, leave_ajar, loose_object, opened_to, pull, shift

LEVELS = ("bottom", "middle", "top")
TIMES = ("once", "twice", "three times")
NOTE = 0.03
"""Distance that encodes one event where a drawer or an object is the note, m."""
HOVER = 0.04
"""Height above home at which a hand waits for the clock without being away, m."""
REST = 45
"""Control steps at home that end the count."""
ASIDE, NEAR = 0.09, 0.027
"""Distances from home at which a hand turns to its side, and waits near home for its plan, m."""
SIDES = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.3], [1.0, 0.0, 0.6], [0.0, -1.0, 0.3]])
"""Directions (4, 3) from which a hand comes home after one, two, three and four events."""
HAND_POSE = 0.002
"""Distance from home from which an observation shows the side of the hand, m."""
SHAKES, SHAKEN = 6, 0.0055
"""How often a drawer is shaken, and up to which opening, m."""
CAMERA_IN_HAND = np.array([0.0, 0.05, -0.097])
"""Position of the wrist camera in the frame of the grip site, m."""
LOOKS = {
    "top": ((0.1121, 0.1076, 0.2073), ((-0.1206, -0.0551, 0.9912), (-0.9838, 0.1401, -0.1119))),
    "middle": ((0.1179, 0.0997, 0.1349), ((-0.1567, 0.1625, 0.9742), (-0.9690, 0.1653, -0.1834))),
}
"""Drawer -> position of the camera in the cabinet's frame (m), and first two axes of its hand there."""
SHOWN_PIXELS = 40
"""Pixels of an object from which an image shows it."""
SHOWN = "the clock, if it were shown"
"""The control of the strategy that reads the clock: it gets the elapsed steps, which no observation holds."""
UNBOUND = (SHOWN,)
"""Strategies that the ceiling without a memory does not bind."""
DECLARED: dict[str, dict[str, Any]] = {
    "past home, two frames": {"window_steps": 2},
    "past home, 6 actions": {"replan_steps": 6},
    "past home, 10 actions": {"replan_steps": 10},
    "past home, 10 actions, two frames": {"replan_steps": 10, "window_steps": 2},
    "past home, 50 actions": {"replan_steps": 50},
}
"""Strategy -> settings of its policy, as the environment gets them; others plan each action from one frame."""


def ceiling(task: Task) -> float:
    """Return the highest success rate of a policy without a memory and without a clock.

    Every plan that has an effect after home has observed home alone, and there the scene is as it began, to the bit. So
    the same thing is begun after each release with the same probability: of two things in order at best 1/4, of three
    1/27, and `counted` of events and a rest. In the other families the first choice decides, and the observation is the
    same for all variants.
    """
    if task.family == "counting":
        return float(np.mean([counted(1 + k) for k in task.random_variants]))
    if task.family == "ordering":
        return 1 / 27 if "three" in task.name else 1 / 4
    found = chance(task)
    assert found is not None, task.name
    return found


def counted(number: int) -> float:
    """Return the highest probability of exactly so many events before the first rest: n^n / (n + 1)^(n + 1).

    From each release a policy goes on with the same probability p, whatever it plans and whatever its input holds. It
    makes n events and then rests in p^n (1 - p) of the episodes.
    """
    return float(number**number / (number + 1) ** (number + 1))


# --- observations and actions of a strategy ---


@dataclass
class Seat:
    """Where a strategy sits: the present observation, the instruction and the scripted hand."""

    episode: Episode
    expert: Expert
    rng: np.random.Generator

    def __post_init__(self) -> None:
        self.frames: list[NDArray[np.float64]] = []
        self._places = {name: self.sim.body_pose(name)[0] for name in self.task.objects}

    @property
    def sim(self) -> Simulation:
        """The scene."""
        return self.episode.sim

    @property
    def task(self) -> Task:
        """The task, as its variant is."""
        return self.episode.task

    def see(self) -> None:
        """Keep the hand's position in the observation of this control step, in a hold too."""
        self.frames.append(self.sim.proprio()[:3].astype(np.float64) - self.sim.home[0])

    @property
    def elapsed(self) -> int:
        """Control steps since the execution began, in holds too: what a clock would show."""
        return len(self.frames) - 1

    @property
    def begins_plan(self) -> bool:
        """Whether this observation is the last of the input of a new plan."""
        return self.elapsed % (self.episode.settings.replan_steps or 1) == 0

    def side(self) -> int | None:
        """Return how many events the hand's side of home stands for in the input of the present plan.

        None if each frame of the input shows the hand at home.
        """
        settings = self.episode.settings
        last = self.elapsed - self.elapsed % (settings.replan_steps or 1)
        for frame in self.frames[max(last - settings.window_steps + 1, 0) : last + 1]:
            if np.linalg.norm(frame) > HAND_POSE:
                return 1 + int(np.argmax(directions() @ frame))
        return None

    def guess(self) -> int:
        """Return which of the things to do is next, by chance: an event, or what ends the episode."""
        others = max(len(self.placed()), self.task.family == "counting")
        return int(self.rng.integers(len(self.events()) + others))

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
        for _ in range(REST):
            yield self.expert.hand.toward(*self.sim.home, OPEN)

    def another_joint(self) -> str:
        """Return a drawer that is not asked for; where there is none, the joint that is."""
        (asked,) = self.events()[0][0].args
        return next((name for name in self.sim.world.joints if name != asked), asked)

    def moved(self) -> float:
        """Return the distance of the note object from its known start, m."""
        name = loose_object(self.task)
        return float(self.sim.body_pose(name)[0][1] - self._places[name][1])


Wanted = tuple[str, str, int]
"""Task, strategy and seed of a rollout."""
Strategy = Callable[[Seat], Motion]
"""Yields actions; each decision is a function of the present observation of the seat."""


# --- counting and order: evidence of past events ---


def by_note(read: Callable[[Seat], int], write: Callable[[Seat, int], Motion]) -> Strategy:
    """Return the strategy that reads the next event from a note in the scene and writes the next note."""

    def act(seat: Seat) -> Motion:
        events = seat.events()
        while (done := read(seat)) < len(events):
            yield from bring(seat, *events[done])
            yield from write(seat, done + 1)
            yield from seat.do()
        yield from finish(seat)

    return act


def bring(seat: Seat, begun: Atom, ended: Atom) -> Motion:
    """Do one event; where something is stowed within it, that too."""
    yield from seat.expert.achieve(begun)
    for atom in atoms(seat.task.goal):
        if atom.predicate == "in" and atom.args[1] == begun.args[0]:
            yield from seat.expert.achieve(atom)
    yield from seat.expert.achieve(ended)


def finish(seat: Seat) -> Motion:
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
    """Choose by the elapsed steps alone, as the best plan that was found (`clock.best_plan`); hover where it waits."""
    events, placed, counts = seat.events(), seat.placed(), seat.task.family == "counting"
    plan = best_plan(len(events) + bool(placed), counts)
    while True:
        while (choice := plan[bin_of(seat.elapsed)]) == WAIT:
            yield seat.expert.hand.toward(seat.sim.home[0] + HOVER * UP, seat.sim.home[1], OPEN)
        if choice == 1 if counts else choice == len(events):
            yield from seat.do()
            yield from finish(seat)
            return
        yield from bring(seat, *events[choice])
        yield from seat.do()


def by_chance(seat: Seat) -> Motion:
    """Begin at home the same thing with the same probability each time: the best odds of all that has no note."""
    events, placed = seat.events(), seat.placed()
    while True:
        choice = seat.guess()
        if choice < len(events):
            yield from bring(seat, *events[choice])
            yield from seat.do()
        elif placed:
            yield from seat.do(*placed)
        else:
            yield from seat.rest()


def past_home(seat: Seat) -> Motion:
    """Come home from a side that stands for the past events, within a plan, and read it in the plan's input.

    An input that shows home alone leaves the best odds.
    """
    events, placed = seat.events(), seat.placed()
    while True:
        seen = seat.side()
        done = seat.guess() if seen is None else seen
        if done < len(events):
            yield from bring(seat, *events[done])
            yield from come_from(seat, done + 1, lambda: seat.begins_plan)
        elif placed:
            yield from seat.do(*placed)
        else:
            yield from seat.rest()


def come_from(seat: Seat, number: int, plan_begins: Callable[[], bool]) -> Motion:
    """Wait near home, on the side of ``number`` events, until a plan begins; then come home."""
    hand, (home, turn) = seat.expert.hand, seat.sim.home
    side = directions()[number - 1]
    yield from rise(hand, OPEN, 0.2)
    yield from hand.move(home + ASIDE * side, turn, OPEN, tolerance=0.012, turn_tolerance=0.04, timeout=120)
    yield from hand.move(home + NEAR * side, turn, OPEN, tolerance=0.004, turn_tolerance=0.04, timeout=60)
    while not plan_begins():
        yield hand.toward(home + NEAR * side, turn, OPEN)
    for _ in range(30):
        if seat.sim.holds(Atom("asbegun", ())):
            return
        yield hand.toward(home, turn, OPEN, speed=0.6)


def directions() -> NDArray[np.float64]:
    """Return `SIDES` as unit vectors."""
    return SIDES / np.linalg.norm(SIDES, axis=1, keepdims=True)


def without_coming_home(seat: Seat) -> Motion:
    """Do all events without coming home in between: the place of the hand encodes the count."""
    while True:
        for begun, ended in seat.events():
            yield from bring(seat, begun, ended)
        yield from seat.do(*seat.placed())


# --- finding ---


def _asked(seat: Seat) -> tuple[str, str]:
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


def look_inside(seat: Seat) -> Motion:
    """Put the wrist camera into shut drawers, open the one whose image shows the object, or guess."""
    name = _asked(seat)[0]
    for level in LOOKS:
        yield from _look(seat, level)
        shown = seat.sim.visible_bodies("wrist") == seat.sim.model.body(name).id
        if shown.sum() >= SHOWN_PIXELS or seat.rows(_asked(seat)[1]):
            yield from seat.do(Atom("open", (f"wooden_cabinet_1_{level}_region",)))
            yield from _fetch(seat)
            return
    yield from seat.do()
    yield from open_one(seat)


def _look(seat: Seat, level: str) -> Motion:
    """Bring the wrist camera into a drawer of the cabinet from its side, without moving a joint."""
    hand, (place, cabinet) = seat.expert.hand, seat.sim.body_pose("wooden_cabinet_1")
    position, (first, second) = LOOKS[level]
    frame = cabinet @ np.array([first, second, np.cross(first, second)]).T
    target = place + cabinet @ np.array(position) - frame @ CAMERA_IN_HAND
    before = target - 0.10 * frame[:, 1] - 0.05 * frame[:, 2]
    yield from hand.move(hand.position + 0.05 * UP, frame, OPEN, tolerance=0.03, turn_tolerance=0.3, timeout=120)
    yield from hand.move(before, frame, OPEN, tolerance=0.01, turn_tolerance=0.05, timeout=120)
    yield from hand.move(
        target + 0.012 * frame[:, 1], frame, OPEN, tolerance=0.001, turn_tolerance=0.01, timeout=60, speed=0.5
    )
    yield from hand.move(before, frame, OPEN, tolerance=0.03, turn_tolerance=0.3, timeout=60)


def shake(seat: Seat) -> Motion:
    """Shake each drawer below its spring and come home; open the one after which home is another one, or guess.

    The strategy remembers which drawer it has shaken, and how home was.
    """
    begun = _bits(seat)
    for drawer in sorted(seat.sim.world.joints):
        joint = seat.sim.world.articulation(drawer)[0]
        yield from pull(seat.expert, drawer, opened_to(seat.expert, drawer, 0.0) - 0.004)
        out = np.append(opening_direction(seat.expert.hand, joint), [0.0, 0.0, 0.0, 1.0])
        for _ in range(SHAKES):
            for _ in range(12):
                if joint.closed_q - seat.sim.world.articulation(drawer)[1] > SHAKEN:
                    break
                yield (out * [0.1, 0.1, 0.1, 1, 1, 1, 1]).astype(np.float32)
            for _ in range(3):
                yield (out * [-1, -1, -1, 1, 1, 1, 1]).astype(np.float32)
        yield from release_fixture(seat.expert.hand)
        yield from seat.do()
        if not np.array_equal(_bits(seat), begun):
            yield from seat.expert.achieve(Atom("open", (drawer,)))
            yield from _fetch(seat)
            return
    yield from open_one(seat)


def _bits(seat: Seat) -> NDArray[np.float64]:
    """Return all that an observation at home could show: the whole state, the hand's pose and the object slots."""
    return np.concatenate([seat.sim.state()[1:], seat.sim.proprio(), seat.episode.objects()])


def open_one(seat: Seat) -> Motion:
    """Open a drawer drawn by chance, and fetch the requested object."""
    yield from seat.expert.achieve(Atom("open", (str(seat.rng.choice(sorted(seat.sim.world.joints))),)))
    yield from _fetch(seat)


def _fetch(seat: Seat) -> Motion:
    name, kind = _asked(seat)
    while seat.rows(kind):
        yield from seat.do(Atom("on", (name, "kitchen_table_table_region")))


# --- referents and procedures ---


def routine(choose: Callable[[Seat, int], int], seat: Seat) -> Motion:
    """Reach the goal of one of the variants."""
    task = seat.episode.published
    yield from _do_variants(seat, [task.random_variants[choose(seat, len(task.random_variants))]])


def _by_first_slot(seat: Seat, count: int) -> int:
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
    SHOWN: by_clock,
    **dict.fromkeys(DECLARED, past_home),
    "without coming home": without_coming_home,
    "chance": by_chance,
}
FINDING: dict[str, Strategy] = {
    "peek 6 cm": partial(peek, 0.058),
    "peek 3 cm": partial(peek, 0.025),
    "peek below the spring": partial(peek, 0.006),
    "look into shut drawers": look_inside,
    "shake below the spring": shake,
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
NOTHING = np.zeros(ACTION_DIM, np.float32)
"""An action without effect: in a prompt or a hold."""


@cache
def _episode(name: str, strategy: str) -> Episode:
    """Return the episodes of a task, with a scene that is compiled once; of prompts only the final scene is visible."""
    return Episode(get_task(name), EnvSettings(suite=STRICT, demonstration_prompt=False, **DECLARED.get(strategy, {})))


def rollout(name: str, strategy: str, seed: int) -> dict[str, object]:
    """Return one rollout of a strategy: success, whether the goal was lost, control steps, and those in holds."""
    episode = _episode(name, strategy if strategy in DECLARED else "")
    return play(episode, STRATEGIES[str(episode.published.family)][strategy], strategy, seed)


def play(episode: Episode, act: Strategy, strategy: str, seed: int) -> dict[str, object]:
    """Return the rollout of a strategy with this name in the scene of a seed."""
    episode.reset(seed, keep_prompt=True)
    while episode.phase != EXECUTION:
        episode.step(NOTHING)
    name = episode.published.name
    rng = np.random.default_rng([seed, zlib.crc32(f"{name}, {strategy}".encode())])
    expert = Expert(episode.task, episode.sim, rng)
    expert.hand.speed = 0.8
    seat = Seat(episode, expert, rng)
    motion = act(seat)
    while not episode.done:
        seat.see()
        action = next(motion, None) if episode.action_has_effect else NOTHING
        if action is None:
            break
        episode.step(action)
    found = {"success": episode.success, "lost": episode.lost, "steps": episode.exec_steps}
    found["held"] = episode.pacing.held_steps
    return {"task": name, "strategy": strategy, "seed": seed, **found}


def gather(
    play_one: Callable[[str, str, int], dict[str, object]], wanted: Sequence[Wanted], out: Path, workers: int
) -> list[dict[str, object]]:
    """Return the rollouts of task, strategy and seed, old ones in the folder included; new ones are appended there."""
    out.mkdir(parents=True, exist_ok=True)
    log = out / "rollouts.jsonl"
    found = [json.loads(line) for line in log.read_text().splitlines()] if log.is_file() else []
    done = {(r["task"], r["strategy"], r["seed"]) for r in found}
    with ProcessPoolExecutor(workers) as pool, log.open("a") as file:
        for future in as_completed([pool.submit(play_one, *one) for one in wanted if one not in done]):
            found.append(future.result())
            file.write(json.dumps(found[-1]) + "\n")
            file.flush()
    return [r for r in found if (r["task"], r["strategy"], r["seed"]) in set(wanted)]


def table(rollouts: list[dict[str, object]]) -> str:
    """Return the rates by task and strategy with Wilson intervals, and the ceiling."""
    lines = ["| task | ceiling | strategy | solved | rollouts | interval |", "|---|---:|---|---:|---:|---|"]
    results: dict[tuple[object, object], list[bool]] = {}
    for one in rollouts:
        results.setdefault((one["task"], one["strategy"]), []).append(bool(one["success"]))
    for name in task_names(suite="strict"):
        for strategy in STRATEGIES[str(get_task(name).family)]:
            if found := results.get((name, strategy)):
                lines.append(line(f"`{name}` | {100 * ceiling(get_task(name)):.1f} | {strategy}", found))
    return "\n".join(lines)


def summary(rollouts: list[dict[str, object]]) -> str:
    """Return the rates by family and strategy with Wilson intervals, and the mean of the ceilings of the tasks."""
    lines = ["| family | ceiling | strategy | solved | rollouts | interval |", "|---|---:|---|---:|---:|---|"]
    for family, strategies in STRATEGIES.items():
        for strategy in strategies:
            mine = [r for r in rollouts if get_task(str(r["task"])).family == family and r["strategy"] == strategy]
            if mine:
                most = np.mean([ceiling(get_task(str(r["task"]))) for r in mine])
                lines.append(line(f"{family} | {100 * most:.1f} | {strategy}", [bool(r["success"]) for r in mine]))
    return "\n".join(lines)


def line(what: str, found: list[bool]) -> str:
    """Return a row of a table: rate in per cent, number of rollouts, and interval."""
    rate = float(np.mean(found))
    low, high = wilson(rate, len(found))
    return f"| {what} | {100 * rate:.0f} | {len(found)} | {100 * low:.0f} to {100 * high:.0f} |"


def adversaries(
    out: Annotated[Path, typer.Option(help="Folder of the rollouts; the same command goes on.")],
    scenes: Annotated[int, typer.Option(min=1, help="Scenes of each task and strategy.")] = 50,
    seed: Annotated[int, typer.Option(help="Seed of the first scene.")] = VALIDATION_SEED,
    tasks: Annotated[list[str] | None, typer.Option(help="Names or memory types; all strict tasks if omitted.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    strategies: Annotated[list[str] | None, typer.Option(help="Names of strategies; all if omitted.")] = None,
) -> None:
    """Roll out every strategy on every strict task; print the table."""
    chosen = [
        name for name in task_names(suite="strict") if not tasks or name in tasks or get_task(name).memory_type in tasks
    ]
    wanted = [
        (name, strategy, seed + scene)
        for scene in range(scenes)
        for name in chosen
        for strategy in STRATEGIES[str(get_task(name).family)]
        if strategy in (strategies or [strategy])
    ]
    asked = gather(rollout, wanted, out, workers)
    print(f"{table(asked)}\n\n{summary(asked)}")
    print(f"\nceiling of these tasks, their mean: {100 * np.mean([ceiling(get_task(name)) for name in chosen]):.1f} %")


if __name__ == "__main__":
    sys.exit(run("necessity.adversaries", adversaries))
