"""The thirty strict tasks: complete, in published scenes, each goal reached by its own routine only."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lerobot_memobench.tasks.assessment import classify_failure
from lerobot_memobench.tasks.bddl import parse_bddl
from lerobot_memobench.tasks.catalogue import get_task, task_index, task_names
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import MEMORY_TYPES, STRICT, Task
from tests.support.scripts import load_script

format_bddl = load_script("strict_suite/bddl_text").format_bddl
SCRIPT = Path(__file__).parents[2] / "scripts" / "strict_suite"
NAMES = task_names(suite=STRICT)
DRAWERS = ("top", "middle", "bottom")
MOVED = {
    "check_all_three_drawers_once_each_in_the_given_order": {"kitchen_table_akita_black_bowl_init_region"},
    "open_and_close_the_microwave_a_given_number_of_times": {"kitchen_table_microwave_init_region"},
}
HOME = Atom("handhome", ())


def variants(name: str) -> list[Task]:
    task = get_task(name)
    return [task.variant(k) for k in range(task.num_variants)]


def of_family(*families: str) -> list[str]:
    return [name for name in NAMES if get_task(name).family in families]


# --- the catalogue ---


def test_a_strict_task_for_each_published_one() -> None:
    assert Counter(get_task(name).memory_type for name in NAMES) == dict(zip(MEMORY_TYPES, (10, 10, 5, 5), strict=True))
    assert sorted(str(get_task(name).derived_from) for name in NAMES) == sorted(task_names())
    assert len(set(task_names(suite=None))) == 60
    assert [task_index(name) for name in NAMES] == list(range(30, 60))
    families = {"counting": 5, "ordering": 5, "hidden_thing": 5, "two_hidden_things": 5}
    assert Counter(get_task(name).family for name in NAMES) == families | {"only_referent": 5, "strict_procedure": 5}
    assert Counter("".join(get_task(name).operations for name in NAMES)) == {"S": 30, "U": 31, "C": 20}


@pytest.mark.parametrize("name", NAMES)
def test_a_strict_task_uses_the_published_scene(name: str) -> None:
    task = get_task(name)
    published = get_task(str(task.derived_from))
    assert (task.suite, task.drawn) == (STRICT, True)
    assert (task.objects, task.fixtures, task.init) == (published.objects, published.fixtures, published.init)
    other = {key for key, region in published.regions.items() if task.regions[key] != region}
    assert other == MOVED.get(name, set())
    assert task.memory_type == published.memory_type == task.folder.parent.name
    assert task.derived_from == published.name
    assert parse_bddl(format_bddl(parse_bddl(task.bddl_text))) == parse_bddl(task.bddl_text)


def test_folders_equal_the_output_of_the_script() -> None:
    done = subprocess.run([sys.executable, str(SCRIPT), "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# --- goals and routines without physics ---


class Table:
    """True atoms of an abstract scene, step by step."""

    def __init__(self, task: Task) -> None:
        self.true = {HOME, *(Atom("inplace", (thing,)) for thing in task.objects)}
        self.true |= {atom for atom in task.init if atom.predicate == "on" and atom.args[0] in task.objects}
        for fixture in ("microwave_1", "flat_stove_1", *(f"wooden_cabinet_1_{drawer}_region" for drawer in DRAWERS)):
            self.true |= {Atom("close", (fixture,)), Atom("turnoff", (fixture,))}
        self.start = {atom for atom in self.true if atom.predicate not in ("on", "in")}
        self.steps: list[set[Atom]] = []
        self.stay(2)

    def stay(self, steps: int = 12) -> None:
        """Append a number of equal steps."""
        ends = {"close": "open", "turnoff": "turnon"}
        joints = {atom.args for atom in self.start if atom.predicate in ends}
        ajar = {args for args in joints if not any(Atom(p, args) in self.true for pair in ends.items() for p in pair)}
        found = {Atom("ajar", args) for args in ajar}
        if self.start <= self.true:
            found.add(Atom("asbegun", ()))
        self.steps += [self.true | found] * steps

    def away(self) -> None:
        """Move the hand to work."""
        self.true.discard(HOME)
        self.stay(3)

    def home(self, steps: int = 3) -> None:
        """Bring the hand home and wait."""
        self.true.add(HOME)
        self.stay(steps)

    def turn(self, name: str, begun: bool, words: tuple[str, str]) -> None:
        """Open, shut or switch something."""
        now, before = (words[0], words[1]) if begun else (words[1], words[0])
        self.true -= {Atom(before, (name,)), Atom(OTHERS[before], (name,))}
        self.stay(2)
        self.true |= {Atom(now, (name,)), *([Atom(OTHERS[now], (name,))] if not begun else [])}
        self.stay(2)

    def use(self, name: str, words: tuple[str, str]) -> None:
        """Open and shut something, or switch it on and off."""
        self.away()
        self.turn(name, True, words)
        self.turn(name, False, words)

    def carry(self, thing: str, place: Atom) -> None:
        """Lift a thing and put it down."""
        self.away()
        self.true = {atom for atom in self.true if not (atom.predicate in ("on", "in") and atom.args[0] == thing)}
        self.true.discard(Atom("inplace", (thing,)))
        self.stay(3)
        self.true.add(place)
        self.stay()


DOOR, SWITCH = ("open", "close"), ("turnon", "turnoff")
OTHERS = {"close": "turnoff", "turnoff": "close", "open": "turnon", "turnon": "open"}
"""Each joint of a `Table` starts both closed and off, regardless of its kind."""


def play(task: Task, steps: list[set[Atom]]) -> Progress:
    """Follow a routine until the episode would end."""
    progress = Progress(task)
    for state in steps:
        if progress.step(state.__contains__) or progress.lost:
            break
    return progress


def fixture_of(task: Task) -> tuple[str, tuple[str, str]]:
    """Return the counted fixture of a counting task and its predicates."""
    atom = next(a for a in atoms(task.goal) if a.predicate in ("open", "turnon"))
    return atom.args[0], DOOR if atom.predicate == "open" else SWITCH


@pytest.mark.parametrize("name", of_family("counting"))
@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("done", [0, 1, 2, 3, 4])
def test_only_the_requested_number_and_then_rest(name: str, number: int, done: int) -> None:
    task = variants(name)[number - 1]
    table = Table(task)
    for _ in range(done):
        table.use(*fixture_of(task))
        table.home()
    end = len(table.steps)
    table.home(60)
    progress = play(task, table.steps)
    assert (progress.success, progress.lost) == (done == number, done != number)
    assert progress.success is False or progress.steps - end > 36, "success came before the rest"
    failure = classify_failure(task, progress.first_step, progress.success, lost=progress.lost)
    assert failure == (None if done == number else "miscount")
    if done == number:
        assert None not in progress.ordered_step


@pytest.mark.parametrize("name", of_family("counting"))
def test_no_count_without_coming_home_and_none_kept_in_the_scene(name: str) -> None:
    task = variants(name)[1]
    other = next(iter({a.args[0] for a in atoms(task.goal) if a.predicate == "ajar"} - {fixture_of(task)[0]}), None)

    def home_with_a_moved_object(table: Table) -> None:
        table.true.add(HOME)
        table.true.discard(Atom("inplace", (next(iter(task.objects)),)))

    def home_with_another_drawer_open(table: Table) -> None:
        if other is not None:
            table.turn(other, True, DOOR)
            table.true.add(HOME)

    spoil = [lambda table: None, home_with_a_moved_object, home_with_another_drawer_open]
    for between in spoil:
        table = Table(task)
        table.use(*fixture_of(task))
        between(table)
        table.stay(3)
        table.use(*fixture_of(task))
        table.home(60)
        assert play(task, table.steps).lost


def orderings() -> Iterator[tuple[Task, list[Callable[[Table], None]]]]:
    """Yield the variants of each ordering task with the requested routine."""

    def drawer(which: str) -> Callable[[Table], None]:
        return lambda table: table.use(f"wooden_cabinet_1_{which}_region", DOOR)

    def stow(table: Table) -> None:
        table.away()
        table.turn("wooden_cabinet_1_top_region", True, DOOR)
        table.carry("akita_black_bowl_1", Atom("in", ("akita_black_bowl_1", "wooden_cabinet_1_top_region")))
        table.turn("wooden_cabinet_1_top_region", False, DOOR)

    def carry(thing: str, place: str) -> Callable[[Table], None]:
        return lambda table: table.carry(thing, Atom("on", (thing, place)))

    for task in variants("check_all_three_drawers_once_each_in_the_given_order"):
        yield task, [drawer(which) for which in sorted(DRAWERS, key=task.language.index)]
    pan = "chefmate_8_frypan_1"
    for name, routine in (
        ("check_the_middle_drawer_once_then_put_the_black_bowl_in_the_top_drawer", [drawer("middle"), stow]),
        (
            "open_and_close_the_microwave_once_then_put_the_white_bowl_on_the_plate",
            [lambda table: table.use("microwave_1", DOOR), carry("white_bowl_1", "plate_1")],
        ),
        (
            "turn_the_stove_on_and_off_once_then_put_the_frying_pan_on_it",
            [lambda table: table.use("flat_stove_1", SWITCH), carry(pan, "flat_stove_1_cook_region")],
        ),
        (
            "turn_the_stove_on_and_off_once_then_put_the_frying_pan_on_the_shelf",
            [lambda table: table.use("flat_stove_1", SWITCH), carry(pan, "wooden_two_layer_shelf_1_top_side")],
        ),
    ):
        yield get_task(name), routine


def routine_of(task: Task, moves: list[Callable[[Table], None]], home: bool = True) -> Progress:
    table = Table(task)
    for move in moves:
        move(table)
        if home:
            table.home()
    return play(task, table.steps)


def test_ordering_takes_each_event_once_and_in_order() -> None:
    seen = set()
    for task, moves in orderings():
        seen.add(task.name)
        right = routine_of(task, moves)
        assert right.success, task.name
        assert None not in right.ordered_step
        assert routine_of(task, moves[::-1]).lost, f"{task.name}: the other way round"
        assert routine_of(task, [moves[0], *moves]).lost, f"{task.name}: the first event twice"
        assert routine_of(task, [moves[0], moves[0], *moves]).lost
        assert routine_of(task, moves, home=False).lost, f"{task.name}: not home in between"
        assert not routine_of(task, moves[:-1]).success
        assert routine_of(task, moves[1:]).lost, f"{task.name}: the first event left out"
    assert seen == set(of_family("ordering"))


@pytest.mark.parametrize("name", of_family("hidden_thing", "two_hidden_things"))
def test_only_the_right_drawer_leads_to_the_hidden_thing(name: str) -> None:
    for task in variants(name):
        (on_table,) = [atom for atom in atoms(task.goal) if atom.predicate == "on"]
        right = dict(task.prompt.places)[on_table.args[0]]
        for opened in (f"wooden_cabinet_1_{drawer}_region" for drawer in DRAWERS):
            table = Table(task)
            table.true = {a for a in table.true if a.predicate != "on"}
            table.true |= {Atom("in", pair) for pair in task.prompt.places}
            table.turn(opened, True, DOOR)
            table.carry(on_table.args[0], on_table)
            progress = play(task, table.steps)
            assert (progress.success, progress.lost) == (opened == right, opened != right)
            failure = classify_failure(task, progress.first_step, progress.success, lost=progress.lost)
            assert failure == (None if opened == right else "wrong_place")


@pytest.mark.parametrize("name", of_family("only_referent", "strict_procedure"))
def test_following_another_video_cannot_be_corrected(name: str) -> None:
    def moves(task: Task) -> list[Atom]:
        return [atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)]

    found = variants(name)
    for task in found:
        for other in found:
            table = Table(task)
            first, then = (other, task) if other is not task else (task, None)
            for one in (first, then):
                for atom in moves(one) if one is not None else ():
                    table.carry(atom.args[0], atom)
            progress = play(task, table.steps)
            assert progress.success == (other is task), f"{task.variant_index} after {other.variant_index}"
            assert progress.lost == (other is not task)
