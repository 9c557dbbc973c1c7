"""Draw a demonstration of each memory type: the middle of its prompt and of each subgoal.

python scripts/storyboard.py            # docs/figures/storyboard.jpg
"""

from __future__ import annotations

import argparse
from collections.abc import Collection
from pathlib import Path

import gallery
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.sim.simulation import RenderSettings
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.memory_text import subtask_texts

TASKS = (
    "check_all_three_drawers_of_the_cabinet",
    "put_the_artichoke_into_the_top_drawer_and_the_chestnut_into_the_middle_drawer",
    "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate",
    "execute_the_assembly_procedure_demonstrated_in_the_prompt_video",
)
SEED, SIZE, COLUMNS = 7, 192, 6
FIGURE = Path(__file__).parents[1] / "docs" / "figures" / "storyboard.jpg"


def play(name: str, drawn: Collection[int] = ()) -> tuple[Episode, dict[int, NDArray]]:
    """Play the expert's demonstration; return the episode, and pictures (SIZE, SIZE, 3) of some control steps."""
    episode, pictures = Episode(get_task(name), render=RenderSettings(SIZE, SIZE, "high")), {}
    episode.reset(SEED)
    while not (episode.done or episode.expert_done):
        if episode.step_index in drawn:
            pictures[episode.step_index] = episode.images()["image"]
        episode.step(episode.expert_action())
    return episode, pictures


def middles(episode: Episode) -> dict[int, str]:
    """Return the control step in the middle of the prompt and of each subgoal -> its text."""
    begin = episode.exec_start or 0
    found = {begin // 2: "demonstration prompt"} if begin else {}
    last = begin
    for text, step in zip(subtask_texts(episode.task), episode.progress.ordered_step, strict=True):
        end = begin + (step or episode.exec_steps)
        found[(last + end) // 2] = text
        last = end
    return found


def draw(name: str) -> Image.Image:
    """Return the row of a task; the episode runs twice, as the middles are known at its end."""
    episode, _ = play(name)
    texts = middles(episode)
    pictures = play(name, texts)[1]
    cells = [(f"{step}: {text}", pictures[step]) for step, text in texts.items()]
    return gallery.grid(cells, COLUMNS, heading=f"{episode.task.memory_type}: {episode.task.title}")


def main() -> None:
    """Draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", nargs="?", type=Path, default=FIGURE)
    out = parser.parse_args().out
    gallery.stack([draw(name) for name in TASKS]).save(out, quality=88)
    print(out)


if __name__ == "__main__":
    main()
