"""Texts that invite the authors of memory policies to the board, with the commands that they would run.

No command was run with their weights. `tests/test_publish.py` parses each.
"""

from __future__ import annotations

from typing import NamedTuple


class Guest(NamedTuple):
    """A memory policy of the field, and how its server is asked here."""

    name: str
    paper: str  # arXiv
    replan: int
    on_libero: bool
    """Whether its authors have a LIBERO checkpoint, so that names, images and actions can be checked with it."""
    note: str
    dialect: str = "robomme"

    @property
    def slug(self) -> str:
        """Its name in files and commands."""
        return self.name.lower().replace("-", "_")

    @property
    def door(self) -> str:
        """The words of a command that name its server."""
        port = {"robomme": 8011, "openpi": 8000}[self.dialect]
        return (
            f"policy=memobench_remote dialect={self.dialect} host=127.0.0.1 port={port} replan={self.replan} "
            f"policy.label={self.slug}" + " convention=libero" * self.on_libero
        )


EACH_FRAME = "A server of RoboMME's protocol receives every frame"
GUESTS = (
    Guest("FrameSamp", "2603.04639", 16, False, f"{EACH_FRAME}: your `mme_vla_suite` is asked as it is. Its released "
          "weights know another simulator and its actions, so it has to be trained first."),
    Guest("SimpleMemVLA", "2609.05533", 16, True, f"{EACH_FRAME}, as your `observe()` does."),
    Guest("MemoryVLA", "2508.19236", 8, True, "Your REST server needs the websocket of 20 lines in the guide. The bank "
          "is written at each question, every `replan` steps of prompt and execution.", "openpi"),
    Guest("HiF-VLA", "2512.09928", 8, True, f"{EACH_FRAME}: collect them at `add_buffer` for the motion of the last "
          "8, clear them at `reset`, and answer with a chunk of 8."),
    Guest("MemER", "2510.20328", 8, False, f"{EACH_FRAME}: both levels stand behind it, and the high level chooses "
          "its keyframes from them."),
    Guest("PrediMem", "2605.10921", 5, False, f"{EACH_FRAME}: keyframes and recent frames are chosen from them. "
          "RoboMemArena's robot and actions are LIBERO's, as ours; its images were not compared with ours."),
    Guest("ECoMEM", "2610.00801", 16, False, f"{EACH_FRAME}. We found no released code; of your simulators we know "
          "RoboMME, whose protocol we therefore propose."),
    Guest("Mem-0", "2603.01229", 5, False, f"{EACH_FRAME}. This client does not speak XPolicyLab's protocol, and your "
          "released weights move two arms: a server of RoboMME's protocol and training on one arm are needed."),
)  # fmt: skip
INVITATION = """# {name} in MEMOBench

To the authors of {name} ([arXiv:{paper}](https://arxiv.org/abs/{paper})).

MEMOBench measures memory in LIBERO's scenes, by 30 strict tasks that need one. We invite {name} to
[its board]({site}benchmark/board/). **We have not run {name}**: our client was tested with small servers of each
protocol, not with your weights.

{note} [The protocol, and a server of your own]({site}guides/remote/).

```bash
pip install {package} mujoco==3.9.0
memobench doctor
```
{control}
Train on demonstrations with images, which take hours of all cores, and serve the policy. The
[published ones](https://huggingface.co/datasets/{user}/memobench-strict) hold states without images.

```bash
memobench generate --suite strict --workers 16{convention} --out outputs/strict
```

A short run, the row of the board, and its control with pauses. `replan=` is the number of executed actions of each
answer; set yours.

```bash
lerobot eval env=memobench suite=strict tasks=object episodes=2 {door} output_dir=outputs/eval/{slug}_short
lerobot eval env=memobench suite=strict evidence=true {door} output_dir=outputs/eval/{slug}
lerobot eval env=memobench suite=strict evidence=true pause_steps=100 {door} output_dir=outputs/eval/{slug}_pauses
```

With your own numbers and address; `--supervised-with-answer` if texts that name the hidden answer were learned from:

```bash
memobench submit outputs/eval/{slug} --name {slug} --model {name} --submitter @you --parameters 4000000000 \\
    --training-data "1,500 strict demonstrations" --no-supervised-with-answer --pauses outputs/eval/{slug}_pauses
```
"""
CONTROL = """
First repeat the rate of your LIBERO checkpoint in LIBERO's own suite: names, images and actions are then right.

```bash
lerobot eval env=memobench suite=libero_object episodes=10 {door} output_dir=outputs/eval/{slug}_libero
```
"""


def invitation(guest: Guest, user: str, package: str) -> str:
    """Return the text to a policy's authors; ``user``: whose repositories; ``package``: name and version to install."""
    words = {**guest._asdict(), "slug": guest.slug, "door": guest.door, "user": user}
    return INVITATION.format(
        **words,
        package=package,
        site=f"https://{user}-memobench-docs.static.hf.space/",
        control=CONTROL.format(**words) if guest.on_libero else "",
        convention=" --convention libero" * guest.on_libero,
    )
