"""Referent and procedure: shown in the video, drawn by seed; a wrong object or a wrong order cannot be corrected."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from folders import Setting, StrictTask

from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import And, Atom, Formula, Hold, Never, Or, Then, When, atoms
from lerobot_memobench.tasks.progress import HOLD_STEPS
from lerobot_memobench.tasks.task import Task

REFERENTS = (
    (
        "put_only_the_milk_pointed_out_in_the_prompt_video_on_the_plate",
        "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate",
        "find the specific milk pointed out in the prompt video and put it, and no other, on the plate",
    ),
    (
        "put_the_butter_only_into_the_bowl_from_the_prompt_video",
        "put_the_butter_into_the_bowl_from_the_prompt_video",
        "put the butter into the bowl from the prompt video and into no other",
    ),
    (
        "put_only_the_butter_picked_up_in_the_prompt_video_on_the_plate",
        "put_the_butter_picked_up_in_the_prompt_video_on_the_plate",
        "put only the butter picked up in the prompt video on the plate",
    ),
    (
        "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate",
        "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate",
        "put only the milk from the highlighted location in the prompt video on the plate",
    ),
    (
        "put_only_the_milk_picked_up_in_the_prompt_video_on_the_plate",
        "put_the_milk_picked_up_in_the_prompt_video_on_the_plate",
        "put only the milk picked up in the prompt video on the plate",
    ),
)
PROCEDURES = (
    (
        "assemble_strictly_in_the_order_demonstrated_in_the_prompt_video",
        "execute_the_assembly_procedure_demonstrated_in_the_prompt_video",
        "execute the assembly procedure strictly in the order demonstrated in the prompt video",
    ),
    (
        "clear_and_serve_strictly_as_demonstrated_in_the_prompt_video",
        "execute_the_clear-and-serve_procedure_demonstrated_in_the_prompt_video",
        "execute the clear-and-serve procedure strictly as demonstrated in the prompt video",
    ),
    (
        "discard_and_plate_strictly_as_demonstrated_in_the_prompt_video",
        "follow_the_prompt_to_determine_the_items,_discard_the_waste_first,_then_plate_the_remaining_item",
        "follow the prompt strictly: discard the item shown to be the waste first, then plate the remaining one",
    ),
    (
        "stack_the_bowls_strictly_in_the_sequence_shown_in_the_prompt_video",
        "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video",
        "stack the bowls one by one strictly in the sequence shown in the prompt video",
    ),
    (
        "swap_the_objects_strictly_in_the_sequence_shown_in_the_prompt_video",
        "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt",
        "swap the objects strictly in the 3-step sequence shown in the prompt video, allowing no other move",
    ),
)


def strict_tasks() -> list[StrictTask]:
    """Return the five tasks of a referent and the five of a procedure."""
    return [
        *(_strict_task(*names, "only_referent") for names in REFERENTS),
        *(_strict_task(*names, "strict_procedure") for names in PROCEDURES),
    ]


def _strict_task(name: str, published: str, language: str, family: str) -> StrictTask:
    task = get_task(published)
    shown = [task.variant(k) for k in task.random_variants]
    settings = tuple(_setting(one, shown, language) for one in shown)
    return StrictTask(name, published, family, task.operations, settings)


def _setting(one: Task, shown: Sequence[Task], language: str) -> Setting:
    steps, others = _steps(one), [atom for other in shown for atom in _steps(other)]
    foreign = tuple(dict.fromkeys(atom for atom in others if atom not in steps))
    order = [When((later, Then((earlier,)))) for earlier, later in pairwise(steps)]
    parts: list[Formula] = [Never(Or(foreign) if len(foreign) > 1 else foreign[0])] if foreign else []
    return Setting(
        language,
        And((*parts, *order, _reached(steps))),
        tuple(checkpoint.goal for checkpoint in one.checkpoints),
        tuple(checkpoint.language for checkpoint in one.checkpoints),
        one.demo_summary,
        one.prompt,
    )


def _steps(task: Task) -> list[Atom]:
    return [atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)]


def _reached(steps: Sequence[Atom]) -> Formula:
    """Return the goal that the final place of each object holds, for as long as a child of ``Then``."""
    last = tuple({step.args[0]: step for step in steps}.values())
    return Hold(HOLD_STEPS, And(last)) if len(steps) > 1 else last[0]
