"""Generate reference pages and task cards of the site, and adapt links that leave ``docs``: a hook of MkDocs.

The pages are not committed. Policy configurations are read from their source, without importing torch.
"""

from __future__ import annotations

import ast
import dataclasses
import html
import inspect
import io
import posixpath
import re
import runpy
import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NotRequired, Union, get_args, get_origin, get_type_hints

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "src")]  # MkDocs runs this file without the checkout on its path

from lerobot_memobench.tasks.task import MEMORY_TYPES, SUITES  # noqa: E402

SOURCE = ROOT / "src" / "lerobot_memobench"
DOCS = ROOT / "docs"
ROLLOUTS, ROUTINE = ROOT / "results" / "evaluations" / "rollouts.parquet", "memobench_blind"
"""Table of rollouts, and its evaluation of a policy without a memory."""
SHEET = DOCS / "figures" / "tasks.png"
"""Initial scenes of all published tasks, from `scripts/gallery.py`."""
SHEET_SIDE = 256

BOARD_PAGE = "benchmark/board.md"

COPIES = {
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "develop/contributing.md",
    "research/README.md": "develop/lab.md",
    "src/lerobot_memobench/policies/shipped/memobench_strict/README.md": "results/cards/memobench_strict.md",
    "src/lerobot_memobench/policies/shipped/memobench_strict_memoryless/README.md": (
        "results/cards/memobench_strict_memoryless.md"
    ),
    **{
        f"results/{page.name}": f"results/{page.name.replace('README', 'index')}"
        for page in sorted((ROOT / "results").glob("*.md"))
    },
}
"""Pages that lie elsewhere in the repository -> where the site has them."""

PUBLIC = {
    "Tasks": ("tasks.catalogue", "get_task load_task resolve_tasks task_names find_tasks"),
    "Task": ("tasks.task", "Task Checkpoint Prompt Variant"),
    "Formulas": ("tasks.formula", ""),
    "Environment": ("envs.env", "MemobenchEnv"),
    "Environment configuration": ("envs.lerobot", "MemobenchEnvConfig"),
    "vla-evaluation-harness": ("vla_eval", "MEMOBench"),
    "Observations": ("envs.observations", "observation_space action_space policy_features policy_inputs reads_prompt"),
    "Episode log": ("envs.episode_log", "read_episodes EpisodeRecord CheckpointRecord"),
    "Metrics": ("evaluation.metrics", "Rate Summary summary_of report_values wilson"),
    "Comparison": ("evaluation.comparison", "Comparison compare_evaluations"),
    "Contrast": ("evaluation.statistics", "Contrast"),
    "Datasets": ("datasets.episodes", "episodes_where list_episodes read_episode RecordedEpisode"),
    "Memory mechanisms": ("policies.memobench_mem.memory.mechanism", "MemoryMechanism"),
    "Rendering without OpenGL": ("mujoco_raster", "Renderer RasterError not_drawn"),
    "Errors": ("errors", "MemobenchError"),
    "Constants": ("constants", ""),
}
"""Heading -> public module and its documented names; "" for all names."""


# --- parts of pages ---


def cell(text: object) -> str:
    """Return text as a table cell: one line with escaped bars and angle brackets."""
    line = " ".join(str(text).split()).replace("|", "\\|")
    return re.sub(r"(`[^`]*`)|<", lambda match: match[1] or "&lt;", line)


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *([cell(value) for value in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def code(text: object) -> str:
    """Return text as inline code; "" if empty."""
    return f"`{text}`" if str(text) else ""


def plain(docstring: str | None) -> str:
    """Return a docstring as one line of Markdown, with single backquotes."""
    return " ".join((docstring or "").replace("``", "`").split())


# --- commands ---


def short_forms(command: str) -> list[list[str]]:
    """Return the rows of ``lerobot <command> --help``: short form, meaning, default."""
    from lerobot_memobench.cli.lerobot import help_of

    text, rows = help_of(command), []
    for typed, lines in re.findall(r"^  (\S.*)\n((?: {8}.*\n)+)", text, re.MULTILINE):
        meaning, default = re.fullmatch(r"(.*?)(?: \(default: (.*)\))?", " ".join(lines.split())).groups("")
        rows.append([typed, meaning, default])
    return rows


def lerobot_page() -> str:
    """Return the page of `lerobot eval` and `lerobot train`."""
    parts = [
        "# lerobot eval, lerobot train",
        "Short forms of LeRobot's flags. Give any other setting by its full name, as `key=value` or `--key=value`: "
        "`env.render=fast`, `policy.num_inference_steps=5`. An unknown name is an error that suggests the nearest "
        "known name.",
    ]
    for command, example in (
        ("eval", "lerobot eval env=memobench policy=CHECKPOINT tasks=object episodes=10"),
        ("train", "lerobot train policy=memobench_mem align=contrastive dataset=FOLDER"),
    ):
        rows = [
            [" ".join(code(word.strip(",")) for word in typed.split()), html.escape(meaning, quote=False), default]
            for typed, meaning, default in short_forms(command)
        ]
        parts += [f"## lerobot {command}", f"```text\n{example}\n```", table(["short form", "sets", "default"], rows)]
    rows = [
        [code(f"env.{name}"), html.escape(default, quote=False), meaning]
        for name, default, meaning in environment_fields()
    ]
    parts += ["## Environment settings", table(["setting", "default", "meaning"], rows)]
    return "\n\n".join(parts) + "\n"


def environment_fields() -> Iterator[tuple[str, str, str]]:
    """Yield name, default and meaning of the environment's settings."""
    from lerobot_memobench.envs.settings import EnvSettings

    for field in dataclasses.fields(EnvSettings):
        values = ", ".join(code(value) for value in field.metadata["values"] or ())
        default = field.metadata["usual"] or repr(field.default)
        yield field.name, default, f"{field.metadata['meaning']}{f' ({values})' if values else ''}"
    tree = class_of(SOURCE / "envs" / "lerobot.py", "MemobenchEnvConfig")
    meaning = arguments(ast.get_docstring(tree) or "")
    for node in tree.body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name) and node.target.id in meaning:
            yield node.target.id, ast.unparse(node.value) if node.value else "", meaning[node.target.id]


def arguments(docstring: str) -> dict[str, str]:
    """Return name -> meaning from a docstring's ``Args`` or ``Attributes``; ``a, b: text`` describes both names."""
    meanings_by_name: dict[str, str] = {}
    block = re.search(r"^(?:Args|Attributes):\n((?:    .*\n?|\n)+)", docstring, re.MULTILINE)
    for names, meaning in re.findall(
        r"^ {4}([\w, ]+): ((?:.|\n(?! {4}\w[\w, ]*: ))*)", block[1] if block else "", re.MULTILINE
    ):
        meanings_by_name |= dict.fromkeys((name.strip() for name in names.split(",")), plain(meaning))
    return meanings_by_name


def memobench_page() -> str:
    """Return the page of `memobench`, from its help."""
    import typer

    from lerobot_memobench.cli import memobench

    root: Any = typer.main.get_command(memobench.app)
    parts = ["# memobench", "```text\nmemobench COMMAND --help\n```"]
    group = None
    for name, command in root.commands.items():
        if command.hidden:
            continue
        if command.rich_help_panel != group:
            group = command.rich_help_panel
            parts.append(f"## {group}")
        parts += command_parts(f"memobench {name}", command)
    return "\n\n".join(parts) + "\n"


def command_parts(path: str, command: Any) -> Iterator[str]:
    """Yield heading, help and options of a command, then of its subcommands."""
    yield f"### {path}"
    yield plain(command.help)
    rows = []
    for part in command.params:
        if part.name == "help" or getattr(part, "hidden", False):
            continue
        is_option = part.opts[0].startswith("-")
        names = " ".join(map(code, (*part.opts, *part.secondary_opts) if is_option else (part.name,)))
        default = part.default
        shown = "" if default is None or default is False or callable(default) else code(default)
        rows.append([names, plain(getattr(part, "help", "")), "required" if part.required else shown])
    if rows:
        yield table(["argument or option", "meaning", "default"], rows)
    for name, below in getattr(command, "commands", {}).items():
        yield from command_parts(f"{path} {name}", below)


# --- observations, datasets and logs ---


def spaces_page() -> str:
    """Return the page of observation and action spaces."""
    from lerobot_memobench import constants
    from lerobot_memobench.datasets.layout import ACTION_NAMES, PROPRIO_NAMES
    from lerobot_memobench.envs import observations
    from lerobot_memobench.envs.pacing import longest
    from lerobot_memobench.envs.settings import BOTH, EnvSettings
    from lerobot_memobench.sim.object_layout import FIELDS, SIZE, SLOTS, STARTS

    settings = EnvSettings(obs_type=BOTH, robot_state=True, expert_action=True, blind_action=True)
    space = observations.observation_space(settings, longest(settings))
    units = {
        "pixels/image": "third-person camera, RGB, upright",
        "pixels/wrist_image": "wrist camera, RGB, upright",
        "agent_pos": "end-effector position 3 (m), axis-angle 3 (rad), fingers 2 (m)",
        "phase": "0 demonstration prompt and the rest after it, 1 execution",
        "step": "control steps since the start of the phase; in the execution of strict tasks −1, and −2 at its end",
        "environment_state": f"{SLOTS} object slots, with `env.obs_type` of that name or `both`",
        "robot_state/eef/pos": "grip site, m; with `env.robot_state=true`, as all of `robot_state`",
        "robot_state/eef/quat": "orientation of the hand's body, xyzw",
        "robot_state/eef/mat": "rotation matrix of the grip site",
        "robot_state/gripper/qpos": "fingers, m",
        "robot_state/gripper/qvel": "velocities of the fingers, m/s",
        "robot_state/joints/pos": "joints of the arm, rad",
        "robot_state/joints/vel": "velocities of the joints, rad/s",
        "expert_action": "action of the scripted expert; with `env.expert_action=true`",
        "blind_action": "action of the published routine; with `env.blind_action=true`",
    }
    at_policy = observations.policy_names(settings)
    rows = []
    for name, part in sorted(flat(space), key=lambda leaf: [*units].index(leaf[0])):
        policy_name = at_policy.get(name, f"observation.{name}")
        rows.append([code(name), code(policy_name), str(part.shape), str(part.dtype), units[name]])
    slots = {
        "present": "1; 0 in an empty slot, which is all zeros",
        "class": "index of the class; `memobench objects` lists the classes",
        "position": "origin in the world, m; the handle's for LIBERO's drawers and knob",
        "rotation": "first two columns of the rotation matrix",
        "joint": "position: drawer m, door and knob rad, otherwise 0",
        "highlighted": "1 while the prompt highlights the object's place",
    }
    bounds = dict.fromkeys("xyz", "m, ±1 is ±0.05") | {"gripper": "−1 opens, +1 closes"}
    parts = [
        "# Observation and action spaces",
        f"{constants.CONTROL_HZ} control steps per second. Horizon {constants.HORIZON:,} execution steps.",
        "## Observations",
        table(["environment", "policy", "shape", "type", "content"], rows),
        "The instruction is the text `task`.",
        "### State",
        table(["index", "name"], [[str(k), code(name)] for k, name in enumerate(PROPRIO_NAMES)]),
        "### Object slots",
        f"`observation.environment_state` has {SLOTS} slots, {SIZE} numbers in total, sorted by class and place. Slots "
        "contain only information that is visible at this step: no identity, no goal, no history.",
        table(
            ["field", "starts at", "numbers", "content"],
            [[code(name), str(STARTS[name]), str(size), slots[name]] for name, size in FIELDS.items()],
        ),
        "## Actions",
        f"Shape ({constants.ACTION_DIM},), float32, in [−1, 1]: pose delta of the end effector, and gripper.",
        table(
            ["index", "name", "unit"],
            [[str(k), code(name), bounds.get(name, "rad, ±1 is ±0.5")] for k, name in enumerate(ACTION_NAMES)],
        ),
    ]
    return "\n\n".join(parts) + "\n"


def flat(space: Any, above: str = "") -> Iterator[tuple[str, Any]]:
    """Yield name and space of each leaf of a nested dictionary of spaces."""
    for name, part in space.items():
        if hasattr(part, "spaces"):
            yield from flat(part, f"{above}{name}/")
        else:
            yield above + name, part


def dataset_page() -> str:
    """Return the page of a dataset's columns."""
    from lerobot_memobench.constants import IMAGE_SIZE
    from lerobot_memobench.datasets.episodes import DemonstrationRecord
    from lerobot_memobench.datasets.layout import MEANINGS, OBJECTS, dataset_features

    features = {OBJECTS: dataset_features(None)[OBJECTS], **dataset_features((IMAGE_SIZE, IMAGE_SIZE))}
    rows = [
        [code(name), f"{feature['dtype']} {tuple(feature['shape'])}", MEANINGS[name]]
        for name, feature in features.items()
        if name in MEANINGS
    ]
    parts = [
        "# Dataset columns",
        "`memobench generate` writes a LeRobotDataset v3.0.",
        "## Frames",
        table(["column", "type", "meaning"], rows),
        "LeRobot adds `task`, `timestamp`, `frame_index`, `episode_index`, `index` and `task_index`.",
        "## Episodes",
        "In `meta/episodes`, and as JSON in `episode_info` of an episode's first frame.",
        table(
            ["column", "meaning"], [[code(name), meaning] for name, meaning in DemonstrationRecord.meanings().items()]
        ),
    ]
    return "\n\n".join(parts) + "\n"


def schemas_page() -> str:
    """Return the page of log, protocol and card, from the types that validate them."""
    from lerobot_memobench.envs import episode_log, evaluation_file

    wanted = [
        ("episodes.jsonl: one line per rollout", episode_log.EpisodeRecord),
        ("Checkpoints of a line", episode_log.CheckpointRecord),
        ("evaluation.json", evaluation_file.Card),
        ("Its protocol", evaluation_file.Protocol),
        ("Policy of a card", evaluation_file.Policy),
        ("Checkpoint of a card", evaluation_file.ModelFiles),
        ("One start", evaluation_file.Start),
        ("Settings of a card", evaluation_file.CardSettings),
    ]
    parts = [
        "# Log and card schemas",
        "Files are validated against these types when they are read. `null` is allowed if the type includes `None`. "
        "A line holds an outcome; settings, inputs and policy are in `evaluation.json` and apply to each line. Lines "
        "with other fields are skipped, and files of another `format` are refused.",
    ]
    for heading, kind in wanted:
        summary = plain((kind.__doc__ or "").partition("\n\n")[0])
        parts += [f"## {heading}", summary, table(["field", "meaning", "type"], typed_rows(kind))]
    return "\n\n".join(parts) + "\n"


def typed_rows(kind: Any) -> list[list[str]]:
    """Return name, meaning and type of each field of a `TypedDict`; the type includes ``required``."""
    hints, meaning = get_type_hints(kind), meanings(kind)
    marked = get_type_hints(kind, include_extras=True)  # `__required_keys__` does not see NotRequired in strings
    optional = {name for name, hint in marked.items() if get_origin(hint) is NotRequired}
    required = kind.__required_keys__ - optional
    return [
        [code(name), meaning.get(name, "").rstrip("."), code(type_name(hint)) + ", required" * (name in required)]
        for name, hint in hints.items()
    ]


PROTOCOL_ONLY = {
    "hold": "mean of the drawn holds of a strict task, control steps",
    "goals": "revision of the goals of strict tasks",
    "scene_hash_version": "version of `scene_hash`; hashes of different versions are not compared",
    "inputs": "inputs of the policy",
}
"""Keys of a protocol in addition to the environment's settings."""


def meanings(kind: Any) -> dict[str, str]:
    """Return field -> meaning from the comments of a `TypedDict`, above a field or behind it."""
    meaning: dict[str, str] = {}
    if "horizon" in kind.__annotations__:
        from lerobot_memobench.envs.settings import EnvSettings

        meaning |= {field.name: field.metadata["meaning"] for field in dataclasses.fields(EnvSettings)}
        meaning |= PROTOCOL_ONLY
    above: list[str] = []
    for line in inspect.getsource(kind).splitlines():
        if comment := re.fullmatch(r" {4}# (.*)", line):
            above.append(comment[1])
        elif field := re.fullmatch(r" {4}(\w+): [^#]*(?:  # (.*))?", line):
            if text := plain(" ".join([*above, field[2] or ""])):
                meaning[field[1]] = text
            above = []
    return meaning


def type_name(hint: Any) -> str:
    """Return a type without module names."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Literal:
        return " or ".join(map(repr, parts))
    if origin in (Union, UnionType):
        return " or ".join(map(type_name, parts))
    if origin is not None:
        return f"{origin.__name__}[{', '.join(map(type_name, parts))}]"
    return "None" if hint is NoneType else str(hint.__name__)


# --- configurations ---


def class_of(path: Path, name: str) -> ast.ClassDef:
    """Return the syntax tree of a class."""
    tree = ast.parse(path.read_text())
    return next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)


def fields(tree: ast.ClassDef) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, type, default and meaning of a dataclass's fields."""
    meaning = arguments(ast.get_docstring(tree) or "")
    for node, after in zip(tree.body, [*tree.body[1:], None], strict=True):
        if not (isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)) or "ClassVar" in ast.unparse(
            node
        ):
            continue
        text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
        value = node.value
        if isinstance(value, ast.Call) and ast.unparse(value.func) == "setting":
            value = value.args[0]
        default = "" if value is None else ast.unparse(value)
        factory = re.fullmatch(r"field\(default_factory=(.*)\)", default)
        default = {"FROM_SIZE": "by size", "BY_DIALECT": "by dialect", "dict": "{}", "tuple": "()", "list": "[]"}.get(
            factory[1] if factory else default, default
        )
        yield (
            node.target.id,
            ast.unparse(node.annotation),
            default.strip("'\""),
            plain(text) or meaning.get(node.target.id, ""),
        )


POLICIES = {
    "memobench_mem": ("policies/memobench_mem/configuration_memobench_mem.py", "MemobenchMemConfig"),
    "memobench_remote": ("policies/remote.py", "RemoteConfig"),
}


def policies_page() -> str:
    """Return the page of policy configurations, from their source."""
    parts = [
        "# Policy configuration",
        "Arguments `policy.<field>=` of `lerobot eval` and `lerobot train`, besides those of every policy (`device`, "
        "`push_to_hub` and so on). *by size*: the value depends on `policy.size` and `policy.perception`.",
    ]
    for name, (path, kind) in POLICIES.items():
        tree = class_of(SOURCE / path, kind)
        rows = [
            [code(field), code(default), f"{meaning} *{hint.replace(' | ', ' or ')}*".strip()]
            for field, hint, default, meaning in fields(tree)
        ]
        summary = plain((ast.get_docstring(tree) or "").split("\n\n")[0])
        parts += [f"## {name}", summary, table(["field", "default", "meaning, type"], rows)]
    return "\n\n".join(parts) + "\n"


def python_page() -> str:
    """Return the page of the Python API, which mkdocstrings completes."""
    parts = ["# Python API", "Public modules. All others may change between versions."]
    for heading, (module, names) in PUBLIC.items():
        module = module if module == "mujoco_raster" else f"lerobot_memobench.{module}"
        parts.append(f"## {heading}")
        parts += [f"::: {module}.{name}" for name in names.split()] or [f"::: {module}"]
    return "\n\n".join(parts) + "\n"


# --- tasks ---


@cache
def solved_by_routine() -> dict[str, float]:
    """Return task -> share of rollouts that a scripted routine without a memory solved."""
    import pyarrow.parquet as pq

    found: dict[str, list[bool]] = {}
    for row in pq.read_table(ROLLOUTS, filters=[("evaluation", "==", ROUTINE)]).to_pylist():
        found.setdefault(row["task"], []).append(row["success"])
    return {name: sum(done) / len(done) for name, done in found.items()}


def without_memory(task: Any) -> dict[str, str]:
    """Return referent -> rate without a memory: routine or chance of a published task, ceiling of a strict one."""
    from lerobot_memobench.tasks.assessment import chance
    from research.necessity.adversaries import ceiling

    if task.suite == "strict":
        return {"drawn": f"{100 * ceiling(task):.0f} %"}
    guessed = chance(task)
    fixed = {"fixed": f"{100 * solved_by_routine()[task.name]:.0f} %"}
    return fixed if guessed is None else {**fixed, "random": f"≥ {100 * guessed:.0f} %"}


WITHOUT = {
    "published": "*Without a memory* is the rate of [a scripted routine](results.md#scripted-policies) with fixed "
    "referents, and with random ones that of a constant answer: a policy may do better.",
    "strict": "*Without a memory* is the [ceiling](suites.md#ceilings) of policies without a memory and a clock.",
}
"""Suite -> how the rate without a memory was found."""
NEEDS = {
    "fixed": "no: a routine without a memory solves it",
    "random": "yes, unless the goal accepts another order",
    "drawn": "yes: no current observation determines the answer",
}
"""Referent -> whether a task needs a memory."""
PROMPTS = {
    "routine": "shows the procedure",
    "pick": "picks up the referent",
    "point": "points at the referent",
    "highlight": "highlights the place of the referent",
    "hide": "hides objects in drawers",
}


def tasks_page(suite: str) -> str:
    """Return the list of a suite's tasks, with links to their cards."""
    from lerobot_memobench.tasks.catalogue import get_task, longest_cue_to_use, task_names

    rows = []
    for number, name in enumerate(task_names(suite=suite), 1):
        task = get_task(name)
        rates = " · ".join(without_memory(task).values())
        link = f"[{title_of(task)}]({card_page(task)}#{slug(name)})"
        rows.append([str(number), link, task.memory_type, task.operations, str(longest_cue_to_use(task) or "–"), rates])
    return f"""# {suite.capitalize()} tasks

`tasks=` accepts the numbers and names. *Operations* are those of the checkpoints: Storage, Update, Compression. The
*gap* is the [longest of the task](gap.md). {WITHOUT[suite]}

{table(["", "task", "memory type", "operations", "gap, control steps", "without a memory"], rows)}
"""


def cards_page(suite: str, memory_type: str) -> str:
    """Return the cards of a suite's tasks of one memory type."""
    from lerobot_memobench.tasks.catalogue import get_task, task_names, task_number

    parts = [
        f"# {suite.capitalize()} {memory_type} tasks",
        f"A card per task, made from its files. {WITHOUT[suite]}",
    ]
    if suite == "strict":
        parts.append(
            "The scene is [held](protocol.md#holds) at the start of each execution and after each event. "
            "[Limitations of this suite](suites.md#limits-of-the-strict-suite)."
        )
    for name in task_names(memory_type, suite):
        parts += task_parts(task_number(name), get_task(name))
    return "\n\n".join(parts) + "\n"


def card_page(task: Any) -> str:
    """Return the name of the page that holds a task's card."""
    return f"tasks_{task.suite}_{task.memory_type}.md"


def title_of(task: Any) -> str:
    """Return a task's title: its instruction, or its name if the seed draws the instruction."""
    title: str = task.name.replace("_", " ") if task.suite == "strict" else task.language
    return title.capitalize()


def task_parts(number: int, task: Any) -> Iterator[str]:
    """Yield one task's card."""
    from lerobot_memobench.evaluation.tables import OPERATION_NAMES
    from lerobot_memobench.tasks.catalogue import cue_to_use, get_task, task_number

    drawn = task.suite == "strict"  # the seed draws the instruction
    yield f"## {number}. {title_of(task)} {{ #{slug(task.name)} }}"
    yield f"`{task.name}`"
    scene_of = task_number(task.derived_from or task.name)
    yield f"![Initial scene](../figures/tasks/{scene_of:02}.png){{ width=256 loading=lazy }}"
    rows = [
        ["memory type, family", f"{task.memory_type}, {task.family.replace('_', ' ')}"],
        ["instruction", f"{task.language}{' (one of several)' if drawn else ''}"],
        ["demonstration prompt", PROMPTS[task.prompt.kind] if task.prompt else "none"],
        ["objects", ", ".join(sorted(set(task.objects.values())))],
        ["fixtures", ", ".join(sorted(set(task.fixtures.values()) - {"kitchen_table"})) or "table only"],
        ["admissible goals", str(len(task.random_variants))],
    ]
    measured = " · ".join("–" if distance is None else str(distance) for distance in cue_to_use(task))
    rows.append(["[gap](gap.md) of each checkpoint, control steps", measured])
    if task.derived_from:
        page = card_page(get_task(task.derived_from))
        rows.append(["scene of", f"[`{task.derived_from}`]({page}#{slug(task.derived_from)})"])
    for referent, rate in without_memory(task).items():
        where = "" if referent == "drawn" else f", referent {referent}"
        rows += [[f"needs a memory{where}", NEEDS[referent]], [f"without a memory{where}", rate]]
    yield table(["", ""], rows)
    yield table(
        ["checkpoint", "operation", "text (intermediate)"],
        [[str(k), OPERATION_NAMES[c.operation], c.language[1]] for k, c in enumerate(task.checkpoints, 1)],
    )


def slug(name: str) -> str:
    """Return a task's name as an anchor."""
    return name.replace(",", "")


@cache
def task_places() -> dict[str, tuple[int, int]]:
    """Return the position of each task's image in the sheet, name -> (left, top), pixels."""
    places: dict[str, tuple[int, int]] = runpy.run_path(str(ROOT / "scripts" / "gallery.py"))["task_places"]()
    return places


def scene(number: int) -> bytes:
    """Return the image of a published task's initial scene, cropped from the sheet."""
    from PIL import Image

    from lerobot_memobench.tasks.catalogue import task_names

    left, top = task_places()[task_names()[number - 1]]
    content = io.BytesIO()
    with Image.open(SHEET) as sheet:
        sheet.crop((left, top, left + SHEET_SIDE, top + SHEET_SIDE)).save(content, "PNG")
    return content.getvalue()


# --- the site ---

PAGES: dict[str, Callable[[], str]] = {
    "reference/lerobot.md": lerobot_page,
    "reference/memobench.md": memobench_page,
    "reference/spaces.md": spaces_page,
    "reference/dataset.md": dataset_page,
    "reference/schemas.md": schemas_page,
    "reference/policies.md": policies_page,
    "reference/python.md": python_page,
    **{f"benchmark/tasks_{suite}.md": partial(tasks_page, suite) for suite in SUITES},
    **{
        f"benchmark/tasks_{suite}_{memory_type}.md": partial(cards_page, suite, memory_type)
        for suite in SUITES
        for memory_type in MEMORY_TYPES
    },
}
"""Generated page of the site -> function that returns its text."""


LINK = re.compile(r"\[([^\[\]]*(?:\[[^\[\]]*\][^\[\]]*)*)\]\(([^()\s]+)\)")


def relink(markdown: str, source: str, page: str) -> str:
    """Return Markdown of the file ``source`` as the site's page ``page``; links that leave the site become paths."""
    folder = posixpath.dirname(page) or "."

    def adapt(match: re.Match[str]) -> str:
        text, link = match[1], match[2]
        path, mark, anchor = link.partition("#")
        if not path or ":" in path:
            return match[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        if target.startswith("docs/") or target in COPIES:
            place = COPIES.get(target) or target.removeprefix("docs/")
            return f"[{text}]({posixpath.relpath(place, folder)}{mark}{anchor})"
        return text if text.strip("`") == target else f"{text} (`{target}`)"

    return LINK.sub(adapt, markdown)


def copy_of(source: str) -> str:
    """Return a page from outside ``docs``, without front matter and with adapted links."""
    text = re.sub(r"\A---\n.*?\n---\n", "", (ROOT / source).read_text(), flags=re.DOTALL)
    return relink(text, source, COPIES[source])


def on_files(files: Any, config: Any) -> Any:
    """Add the generated pages (called by MkDocs)."""
    from mkdocs.structure.files import File

    for path, make in PAGES.items():
        files.append(File.generated(config, path, content=make()))
    for source, path in COPIES.items():
        files.append(File.generated(config, path, content=copy_of(source)))
    for number in range(1, 31):
        files.append(File.generated(config, f"figures/tasks/{number:02}.png", content=scene(number)))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Adapt the links of a page that leave ``docs``, and fill in the board (called by MkDocs)."""
    found = relink(markdown, f"docs/{page.file.src_uri}", page.file.src_uri)
    if page.file.src_uri == BOARD_PAGE:
        from tools.board.page import PLACE
        from tools.board.page import table as board_table

        found = found.replace(PLACE, board_table())
    return found


def on_page_content(content: str, **_: Any) -> str:
    """Allow line breaks in table cells after ``_``, ``.``, ``/`` and ``=`` of names, and prevent them in intervals."""

    def break_cell(match: re.Match[str]) -> str:
        parts = re.split(r"(<[^>]*>)", match[2])
        parts[::2] = [re.sub(r"(?<=[A-Za-z])([_./=])(?=[A-Za-z])", r"\1<wbr>", part) for part in parts[::2]]
        cell = re.sub(r"\[[\d.]+–[\d.]+\]", r'<span class="interval">\g<0></span>', "".join(parts))
        return match[1] + cell + match[3]

    return re.sub(r"(<td[^>]*>)(.*?)(</td>)", break_cell, content, flags=re.DOTALL)
