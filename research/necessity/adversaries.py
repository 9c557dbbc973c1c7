"""Policies without a memory that try to solve strict tasks, and the most that such a policy can reach.

    python -m research.necessity.adversaries --scenes 50 --workers 2 --out outputs/adversaries

Each decision is a function of the present observation and the instruction. Between decisions the scripted hand moves.
The prompt plays within the reset. Strategies use the scene as a notebook (drawers ajar, moved objects, knobs between
off and on), look into drawers, read the clock, or guess at the best odds. Results are appended to ``rollouts.jsonl``;
the same command goes on.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.observations import OBJECTS, RESET
from lerobot_memobench.evaluation.metrics import wilson
from lerobot_memobench.experts.expert import Expert, plan_of
from lerobot_memobench.experts.grasping import pick, put_on_region
from lerobot_memobench.experts.hand import OPEN
from lerobot_memobench.experts.travel import let_go
from lerobot_memobench.protocol import VALIDATION_SEED
from lerobot_memobench.sim.assets.registry import split_class
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import classes
from lerobot_memobench.sim.scene import DEAD_CENTRE
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.evidence import chance
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.task import Task
from research.command import run

Motion = Iterator[NDArray[np.float32]]
LEVELS = ("bottom", "middle", "top")
TIMES = ("once", "twice", "three times")
NOTE = 0.03
"""Distance that stands for one event where a drawer or an object is the note, m."""
ROUND = 160
"""Control steps within which an event is done and the hand is home again."""


def ceiling(task: Task) -> float:
    """Return the highest success rate without a memory, a clock or a look into drawers.

    At home the scene is as it began, to the bit. So the same thing is begun there with the same probability each time:
    of n events and a rest, at best n^n / (n + 1)^(n + 1); of two things in order 1/4, of three 1/27. In the other
    families the first choice decides, and the observation is the same for all variants.
    """
    if task.family == "counting":
        return float(np.mean([n**n / (n + 1) ** (n + 1) for n in (1, 2, 3)]))
    if task.family == "ordering":
        return 1 / 27 if "three" in task.name else 1 / 4
    found = chance(task)
    assert found is not None, task.name
    return found


# --- what a strategy sees and can do ---


@dataclass
class Seat:
    """Where a strategy sits: the present observation, the instruction and the scripted hand."""

    env: MemobenchEnv
    expert: Expert
    rng: np.random.Generator
    observation: dict[str, NDArray[np.float32]]

    @property
    def words(self) -> str:
        """The instruction."""
        return self.env.task_description

    @property
    def family(self) -> str:
        """Family of the task, which its instruction names."""
        return str(self.env.episode.task.family)

    def rows(self, kind: str) -> list[NDArray[np.float32]]:
        """Return the visible slots of a class, lowest first."""
        slots = self.observation["environment_state"].reshape(SLOTS, WIDTH)
        found = [row for row in slots if row[STARTS["present"]] and classes()[int(row[STARTS["class"]])] == kind]
        return sorted(found, key=lambda row: float(row[STARTS["position"] + 2]))

    def joint(self, name: str) -> float:
        """Return the visible position of a drawer, door or knob, m or rad."""
        kind = self.env.episode.sim.world.articulation(name)[0].kind
        rows = self.rows(kind)
        number = next((k for k, level in enumerate(LEVELS) if f"_{level}_" in name), 0)
        return float(rows[number][STARTS["joint"]]) if number < len(rows) else 0.0

    @property
    def n(self) -> int:
        """How often the instruction asks for the event."""
        return next((k for k, word in enumerate(TIMES, 1) if word in self.words), 1)

    @property
    def step(self) -> int:
        """The clock of the observation."""
        return int(self.observation["step"][0])

    def event(self) -> tuple[Atom, Atom]:
        """Return the beginning and the end of the event that is asked for first."""
        done = [atom for atom in plan_of(self.env.episode.task.goal) if isinstance(atom, Atom)]
        begun = next(atom for atom in done if atom.predicate in ("open", "turnon"))
        return begun, Atom({"open": "close", "turnon": "turnoff"}[begun.predicate], begun.args)

    def events(self) -> list[tuple[Atom, Atom]]:
        """Return beginning and end of every event of the routine, in order."""
        goal = self.env.episode.task.goal
        begun = [a for a in plan_of(goal) if isinstance(a, Atom) and a.predicate in ("open", "turnon")]
        ends = {"open": "close", "turnon": "turnoff"}
        return [(a, Atom(ends[a.predicate], a.args)) for a in dict.fromkeys(begun)]

    def do(self, *achieved: Atom) -> Motion:
        """Bring atoms about, then come home."""
        for atom in (*achieved, Atom("handhome", ())):
            yield from self.expert.achieve(atom)

    def rest(self, steps: int = 45) -> Motion:
        """Stay at home."""
        for _ in range(steps):
            yield self.expert.hand.toward(*self.env.episode.sim.home, OPEN)

    def leave_ajar(self, name: str, to: float) -> Motion:
        """Move a drawer, door or knob to a position and let go of it."""
        world = self.env.episode.sim.world
        joint = world.articulation(name)[0]
        way = np.sign(to - joint.closed_q)
        begin = Atom("turnon" if joint.kind == "knob" else "open", (name,))
        for action in self.expert.achieve(begin):
            yield action
            if way * (world.articulation(name)[1] - to) >= 0.0:
                break
        yield from let_go(self.expert.hand)

    def shift(self, name: str, by: float) -> Motion:
        """Carry an object sideways."""
        hand = self.expert.hand
        where = self.env.episode.sim.body_pose(name)[0] + np.array([0.0, by, 0.0])
        held = yield from pick(hand, name, place=where)
        if held is not None:
            yield from put_on_region(hand, held, where)

    def another_joint(self) -> str:
        """Return a drawer that is not asked for; where there is none, the joint that is."""
        (asked,) = self.event()[0].args
        drawers = [name for name in self.env.episode.sim.world.joints if name != asked]
        return drawers[0] if drawers else asked

    def loose_object(self) -> str:
        """Return an object that no goal asks for; where there is none, any."""
        task = self.env.episode.task
        asked = {name for atom in atoms(task.goal) if atom.predicate in ("on", "in") for name in atom.args}
        return next((name for name in task.objects if name not in asked), next(iter(task.objects)))

    def moved(self, name: str) -> float:
        """Return how far an object stands aside of its start, as it is seen; the start is the same every time."""
        sim = self.env.episode.sim
        return float(sim.body_pose(name)[0][1] - sim._start._places[name][1])


Strategy = Callable[[Seat], Motion]
"""Yields actions; each decision is a function of what the seat shows at that moment."""


# --- counting and order: what tells that it has been done ---


def by_note(read: Callable[[Seat], int], write: Callable[[Seat, int], Motion]) -> Strategy:
    """Return the strategy that does what a note in the scene says is next, and writes the next note."""

    def act(seat: Seat) -> Motion:
        while True:
            done = read(seat)
            events = seat.events() * seat.n if seat.family == "counting" else seat.events()
            if done < len(events):
                begun, ended = events[done]
                yield from _bring(seat, begun, ended)
                yield from write(seat, done + 1)
                yield from seat.do()
            else:
                yield from _finish(seat)

    return act


def _bring(seat: Seat, begun: Atom, ended: Atom) -> Motion:
    """Do one event; where something is stowed within it, that too."""
    yield from seat.expert.achieve(begun)
    for atom in atoms(seat.env.episode.task.goal):
        if atom.predicate == "in" and atom.args[1] == begun.args[0]:
            yield from seat.expert.achieve(atom)
    yield from seat.expert.achieve(ended)


def _finish(seat: Seat) -> Motion:
    """Do what comes after the events: rest, or carry a thing to its place."""
    for atom in atoms(seat.env.episode.task.goal):
        if atom.predicate == "on" and not seat.env.episode.sim.holds(atom):
            yield from seat.expert.achieve(atom)
            return
    yield from seat.rest()


def _notes_in_joint(seat: Seat) -> int:
    name = seat.another_joint()
    joint = seat.env.episode.sim.world.articulation(name)[0]
    size = NOTE if joint.kind == "drawer" else 0.12
    return max(round(abs(seat.joint(name) - joint.closed_q) / size), 0)


def _write_in_joint(seat: Seat, number: int) -> Motion:
    name = seat.another_joint()
    joint = seat.env.episode.sim.world.articulation(name)[0]
    size = NOTE if joint.kind == "drawer" else 0.12
    yield from seat.leave_ajar(name, joint.closed_q + np.sign(joint.open_q - joint.closed_q) * size * number)


def _notes_below_the_spring(seat: Seat) -> int:
    name = seat.another_joint()
    joint = seat.env.episode.sim.world.articulation(name)[0]
    return max(round(4 * abs(seat.joint(name) - joint.closed_q) / DEAD_CENTRE[joint.kind]), 0)


def _write_below_the_spring(seat: Seat, number: int) -> Motion:
    name = seat.another_joint()
    joint = seat.env.episode.sim.world.articulation(name)[0]
    way = np.sign(joint.open_q - joint.closed_q)
    yield from seat.leave_ajar(name, joint.closed_q + way * DEAD_CENTRE[joint.kind] * number / 4)


def _notes_in_object(size: float, seat: Seat) -> int:
    return max(round(abs(seat.moved(seat.loose_object())) / size), 0)


def _write_in_object(size: float, seat: Seat, number: int) -> Motion:
    yield from seat.shift(seat.loose_object(), size)


def _no_notes(seat: Seat, number: int) -> Motion:
    yield from ()


def _events_by_clock(seat: Seat) -> int:
    return seat.step // ROUND % (len(seat.events()) * (seat.n if seat.family == "counting" else 1) + 1)


def _open_means_done(seat: Seat) -> int:
    """Count the drawers that stand open, which are shut once all are."""
    return sum(seat.joint(begun.args[0]) < -NOTE for begun, _ in seat.events())


def by_chance(seat: Seat) -> Motion:
    """Begin at home the same thing with the same probability each time: the best odds of all that has no note."""
    events = seat.events()
    while True:
        if seat.family == "counting":
            if seat.rng.random() < seat.n / (seat.n + 1):
                yield from seat.do(*events[0])
            else:
                yield from seat.rest()
            continue
        places = [atom for atom in atoms(seat.env.episode.task.goal) if atom.predicate == "on"]
        choice = int(seat.rng.integers(len(events) + len(places)))
        if choice < len(events):
            yield from _bring(seat, *events[choice])
            yield from seat.do()
        else:
            yield from seat.do(places[0])


def without_coming_home(seat: Seat) -> Motion:
    """Do all events in one go: where the hand is tells how often."""
    for begun, ended in seat.events() * (seat.n if seat.family == "counting" else 1):
        yield from _bring(seat, begun, ended)
    yield from seat.do()
    yield from _finish(seat)
    yield from seat.rest(1200)


# --- finding ---


def _asked(seat: Seat) -> tuple[str, str]:
    """Return the object that the instruction names, and its class."""
    sim = seat.env.episode.sim
    prompt = seat.env.episode.task.prompt
    assert prompt is not None
    named = {name: split_class(sim.assets[name].class_name)[0] for name, _ in prompt.places}
    for name, kind in named.items():
        if kind.split("_")[-1] in seat.words or kind.split("_")[0] in seat.words:
            return name, kind
    return next(iter(named.items()))


def _drawers(seat: Seat) -> list[str]:
    return sorted(seat.env.episode.sim.world.joints)


def peek(by: float, seat: Seat) -> Motion:
    """Pull each drawer a little, look, and fetch what is seen."""
    name, kind = _asked(seat)
    while True:
        if seat.rows(kind):
            yield from seat.do(Atom("on", (name, "kitchen_table_table_region")))
            continue
        shut = [drawer for drawer in _drawers(seat) if seat.joint(drawer) > -by / 2]
        if not shut:
            yield from seat.rest(1)
            continue
        yield from seat.leave_ajar(shut[0], 0.005 - by)


def open_one(seat: Seat) -> Motion:
    """Open a drawer drawn by chance, and fetch what is asked for."""
    name, kind = _asked(seat)
    yield from seat.expert.achieve(Atom("open", (str(seat.rng.choice(_drawers(seat))),)))
    while True:
        if seat.rows(kind):
            yield from seat.do(Atom("on", (name, "kitchen_table_table_region")))
        else:
            yield from seat.rest(1)


# --- referents and procedures ---


def routine(choose: Callable[[Seat, int], int], seat: Seat) -> Motion:
    """Do what one of the variants asks for."""
    task = get_task(seat.env.episode.published.name)
    shown = task.variant(task.random_variants[choose(seat, len(task.random_variants))])
    for atom in plan_of(shown.goal):
        if isinstance(atom, Atom):
            yield from seat.expert.achieve(atom)
    yield from seat.rest(1200)


def _by_first_slot(seat: Seat, count: int) -> int:
    """Read the order of equal objects in their slots."""
    slots = seat.observation["environment_state"].reshape(SLOTS, WIDTH)
    return round(1e4 * float(np.abs(slots).sum())) % count


def every_variant(seat: Seat) -> Motion:
    """Do what all variants ask for, one after the other."""
    task = get_task(seat.env.episode.published.name)
    for variant in task.random_variants:
        for atom in plan_of(task.variant(variant).goal):
            if isinstance(atom, Atom):
                yield from seat.expert.achieve(atom)
    yield from seat.rest(1200)


EVENTS: dict[str, Strategy] = {
    "another joint is the note": by_note(_notes_in_joint, _write_in_joint),
    "a note below the spring": by_note(_notes_below_the_spring, _write_below_the_spring),
    "an object is the note": by_note(partial(_notes_in_object, NOTE), partial(_write_in_object, NOTE)),
    "a millimetre is the note": by_note(partial(_notes_in_object, 0.0003), partial(_write_in_object, 0.0003)),
    "open means done": by_note(_open_means_done, _no_notes),
    "the clock": by_note(_events_by_clock, _no_notes),
    "without coming home": without_coming_home,
    "chance": by_chance,
}
FINDING: dict[str, Strategy] = {
    "peek 60 mm": partial(peek, 0.060),
    "peek 20 mm": partial(peek, 0.020),
    "peek 8 mm": partial(peek, 0.008),
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


def rollout(name: str, strategy: str, seed: int) -> dict[str, object]:
    """Return one rollout of a strategy: success, whether the goal was lost, control steps."""
    env = MemobenchEnv(name, obs_type=OBJECTS, prompt_in=RESET, seed_base=seed)
    observation, _ = env.reset(seed=seed)
    rng = np.random.default_rng([seed, len(strategy)])
    expert = Expert(env.episode.task, env.episode.sim, rng)
    expert.hand.speed = 0.8
    seat = Seat(env, expert, rng, observation)
    for action in STRATEGIES[str(env.episode.task.family)][strategy](seat):
        seat.observation, _, ended, cut, _ = env.step(np.clip(action, -1, 1).astype(np.float32))
        if ended or cut:
            break
    episode = env.episode
    found = {"success": bool(episode.success), "lost": bool(episode.lost), "steps": episode.exec_steps}
    env.close()
    return {"task": name, "strategy": strategy, "seed": seed, **found}


def table(rollouts: list[dict[str, object]]) -> str:
    """Return the rates by task and strategy with Wilson intervals, and the ceiling."""
    lines = ["| task | ceiling | strategy | solved | rollouts | interval |", "|---|---:|---|---:|---:|---|"]
    for name in task_names(suite="strict"):
        task = get_task(name)
        for strategy in STRATEGIES[str(task.family)]:
            found = [bool(r["success"]) for r in rollouts if (r["task"], r["strategy"]) == (name, strategy)]
            if found:
                rate = float(np.mean(found))
                low, high = wilson(rate, len(found))
                lines.append(
                    f"| `{name}` | {100 * ceiling(task):.1f} | {strategy} | {100 * rate:.0f} | {len(found)} | "
                    f"{100 * low:.0f} to {100 * high:.0f} |"
                )
    return "\n".join(lines)


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
    print(table(found))
    print(
        f"\nceiling of the suite, the mean of its tasks: {100 * np.mean([ceiling(get_task(n)) for n in chosen]):.1f} %"
    )


if __name__ == "__main__":
    sys.exit(run("necessity.adversaries", adversaries))
