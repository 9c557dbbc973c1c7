"""All that LeRobot and transformers are made to do beside their own: one list, one way in, one way out.

A hook stands in the place of a function of theirs for as long as a training needs it, and calls that function with
layers of ours around it. It goes with the last of those. A decorator that somebody else puts
around it, before or after, stays and is called too: whether a hook stands is told by the function itself, which is kept
here, and by no attribute that a decorator could copy. What a layer does is beside the code that needs it.

LeRobot 0.6.1 and its main branch were read. A version between that nobody has read is taken by what it is: the function
must take what is handed to it, and LeRobot must still call it with what a layer reads; else one sentence refuses it.
"""

from __future__ import annotations

import ast
import functools
import importlib
import importlib.util
import inspect
import logging
import sys
import threading
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.specifiers import SpecifierSet
from packaging.version import Version

from lerobot_memobench.errors import MemobenchError

LEROBOT = "0.6.1"
"""The version of LeRobot that requirements.lock pins."""
READ = (LEROBOT, "0.6.2")
"""The versions whose functions were read: that one, and what the main branch calls itself."""
SUPPORTED = SpecifierSet(">=0.6.1,<0.8", prereleases=True)
"""The versions that pyproject.toml allows."""

logger = logging.getLogger(__name__)

Function = Callable[..., Any]
Layer = Callable[[Function], Function]
"""Makes of a function the one that is called in its place."""


@dataclass(frozen=True)
class Hook:
    """A function of theirs that something of ours is laid around.

    Attributes:
        module: that holds it. name: its name there; of a method, behind that of its class.
        parameters: what it must take, in this order where they are handed over by place.
        does: what it is made to do. why: what it would do otherwise.
        caller: a module of theirs that must call it. by_name: the keywords that a layer reads of such a call.
        everywhere: whether it is replaced in each module that imported it by its name too.
        ends: the first version of LeRobot that does without the function.
        package: that it is part of. read: the versions of it that were read.
    """

    module: str
    name: str
    parameters: tuple[str, ...]
    does: str
    why: str
    caller: str | None = None
    by_name: tuple[str, ...] = ()
    everywhere: bool = False
    ends: str | None = None
    package: str = "lerobot"
    read: tuple[str, ...] = READ

    @property
    def version(self) -> str:
        """The package and the versions of it that were read."""
        return f"{self.package} {', '.join(self.read)}"


OPEN_DATASETS = Hook(
    "lerobot.datasets.factory",
    "make_train_eval_datasets",
    ("cfg",),
    "leave frames of demonstration prompts out, choose a policy's inputs, tell a held-out part its training",
    "LeRobot trains on prompts, whose actions have no effect, and takes pictures and object state alike for inputs",
    caller="lerobot.scripts.lerobot_train",
    everywhere=True,
)
MAKE_PROCESSORS = Hook(
    "lerobot.policies.factory",
    "make_pre_post_processors",
    ("policy_cfg", "pretrained_path", "pretrained_revision"),
    "hand a training to the steps of its policy that are rebuilt from a checkpoint",
    "LeRobot rebuilds saved steps without telling them the policy or the dataset",
    caller="lerobot.scripts.lerobot_train",
    everywhere=True,
)
DRAW_FRAMES = Hook(
    "lerobot.datasets.sampler",
    "EpisodeAwareSampler.__init__",
    (
        *("self", "dataset_from_indices", "dataset_to_indices", "episode_indices_to_use", "drop_n_first_frames"),
        *("drop_n_last_frames", "shuffle", "seed", "absolute_to_relative_idx"),
    ),
    "begin episodes at their execution, and draw frames in groups and tasks in turns, where a policy asks for it",
    "LeRobot draws all frames of all episodes, each once",
    caller="lerobot.scripts.lerobot_train",
    by_name=("drop_n_last_frames", "episode_indices_to_use", "shuffle", "seed", "absolute_to_relative_idx"),
)
READ_SAMPLE = Hook(
    "lerobot.datasets.dataset_reader",
    "DatasetReader.get_item",
    ("self", "idx"),
    "give samples without pictures out of main memory, of the dataset object that such a policy is trained on",
    "LeRobot decodes the videos of every sample, wanted or not",
    caller="lerobot.datasets.lerobot_dataset",
)
PREPARE = Hook(
    "accelerate.accelerator",
    "Accelerator.prepare",
    ("self",),
    "shard a policy's average of weights where it shards the policy",
    "accelerate knows of a policy and its optimizer, and LeRobot would save weights that are no average",
    package="accelerate",
    read=("1.15.0",),
)
GATHER_SHARDS = Hook(
    "lerobot.scripts.lerobot_train",
    "gather_fsdp_state_dicts",
    ("model", "optimizer"),
    "gather the average of a sharded policy's weights beside the weights",
    "LeRobot saves in one process, in which nothing can be gathered any more",
    ends="0.6.2",
    read=(LEROBOT,),
)
HOOKS = (OPEN_DATASETS, MAKE_PROCESSORS, DRAW_FRAMES, READ_SAMPLE, PREPARE, GATHER_SHARDS)


class _Standing:
    """A hook in one place: the function that was there, the one that is, and the layers that are needed now."""

    def __init__(self, hook: Hook, holder: Any, theirs: Function) -> None:
        _check_parameters(hook, theirs)
        _check_caller(hook)
        self.hook, self.holder, self.name, self.theirs = hook, holder, hook.name.rpartition(".")[2], theirs
        self.layers: list[Layer] = []
        self.called = theirs

        @functools.wraps(theirs)
        def ours(*args: Any, **named: Any) -> Any:
            return self.called(*args, **named)

        self.ours: Function = ours

    def set(self, layers: list[Layer]) -> None:
        """Lay these around the function, each once; with none of them, put it back."""
        self.layers, self.called = layers, self.theirs
        for layer in dict.fromkeys(layers):
            self.called = layer(self.called)
        if layers:
            if getattr(self.holder, self.name) is self.theirs:
                setattr(self.holder, self.name, self.ours)
            return
        others = [holder for holder, found in _importers(self.hook) if found is self.ours]  # while it stood
        for holder in [self.holder, *others]:
            if getattr(holder, self.name) is self.ours:
                setattr(holder, self.name, self.theirs)


_LOCK = threading.RLock()
_made: dict[Function, _Standing] = {}
"""Each function of ours that was ever put in a place: its own marker."""


def _importers(hook: Hook) -> list[tuple[Any, Function]]:
    """Return the modules that hold a function by its name because they imported it, with what they hold."""
    name, known = hook.name.rpartition(".")[2], (hook.module, hook.name)
    modules = list(sys.modules.values()) if hook.everywhere else []
    held: list[tuple[Any, Any]] = [(module, getattr(module, "__dict__", {}).get(name)) for module in modules]
    return [
        (module, found)
        for module, found in held
        if (getattr(found, "__module__", None), getattr(found, "__qualname__", None)) == known
    ]


def _places(hook: Hook) -> list[_Standing]:
    """Return the hook in its places; made where no call comes to it, directly or through decorators that say so."""
    module = importlib.import_module(hook.module)
    owner, _, name = hook.name.rpartition(".")
    first = getattr(module, owner) if owner else module
    places: dict[_Standing, None] = {}
    for holder, found in [(first, getattr(first, name)), *_importers(hook)]:
        before = (there for there in _made.values() if there.holder is holder and there.theirs is found)
        place, inner = next(before, None), found
        while place is None and inner is not None:
            place, inner = _made.get(inner), getattr(inner, "__wrapped__", None)
        if place is None:
            place = _Standing(hook, holder, found)
            _made[place.ours] = place
        places[place] = None
    return [*places]


def install(hook: Hook, layer: Layer) -> Callable[[], None]:
    """Lay something around a function of theirs, outside of what lies there; return what takes it away again.

    Raises:
        MemobenchError: the function does not take what the one that was read takes, or nothing calls it any more.
    """
    with _LOCK:
        places = _places(hook)
        for place in places:
            place.set([*place.layers, layer])

    def undo() -> None:
        with _LOCK:
            while places:
                place = places.pop()
                layers = [*place.layers]
                layers.remove(layer)
                place.set(layers)

    return undo


@contextmanager
def hooked(hook: Hook, layer: Layer) -> Iterator[None]:
    """While this lasts, something lies around a function of theirs; errors as of `install`."""
    undo = install(hook, layer)
    try:
        yield
    finally:
        undo()


def hooked_for(owner: object, hook: Hook, layer: Layer) -> None:
    """Do as `hooked` for as long as ``owner`` lives."""
    weakref.finalize(owner, install(hook, layer)).atexit = False


def there() -> list[Hook]:
    """Return the hooks whose functions the installed LeRobot has."""
    found = Version(metadata.version("lerobot"))
    return [hook for hook in HOOKS if hook.ends is None or found < Version(hook.ends)]


def installed() -> list[Hook]:
    """Return the hooks that stand now."""
    return [hook for hook in HOOKS if any(there.layers for there in _made.values() if there.hook is hook)]


def table() -> str:
    """Return all hooks as Markdown, as docs/develop.md lists them."""
    rows = [f"| `{hook.module}.{hook.name}` | {hook.does} | {hook.why} | {hook.version} |" for hook in HOOKS]
    return "\n".join(["| function | is made to | because | read in |", "|---|---|---|---|", *rows])


def check_version() -> None:
    """Refuse a LeRobot beside those that are supported: it may train on other frames.

    Raises:
        MemobenchError: it is installed.
    """
    found = metadata.version("lerobot")
    if found not in SUPPORTED:
        raise MemobenchError(
            f"lerobot {found} is installed, and the benchmark steers the training of lerobot{SUPPORTED}; install "
            f"lerobot=={LEROBOT} (make setup)"
        )
    if found not in READ:
        _say_unread(found)


@functools.cache
def _say_unread(found: str) -> None:
    logger.warning("lerobot %s was not tried with this version; tried: %s", found, ", ".join(READ))


def _advice(hook: Hook) -> str:
    """Return what to do where a function of theirs is another one."""
    return (
        f"{hook.package} {metadata.version(hook.package)} is installed, or something has replaced it; install "
        f"{hook.package}=={hook.read[0]} (make setup), or leave out what replaces it"
    )


def _check_caller(hook: Hook) -> None:
    """Refuse to lay anything around a function of a version that nobody has read, if nothing there calls it.

    Raises:
        MemobenchError: no call in the module that should do so, or none that names what a layer reads of it.
    """
    if hook.caller is None or metadata.version(hook.package) in hook.read:
        return
    spec = importlib.util.find_spec(hook.caller)
    source = "" if spec is None or spec.origin is None else Path(spec.origin).read_text(encoding="utf-8")
    owner, _, name = hook.name.rpartition(".")
    wanted = owner if name == "__init__" else name
    for call in (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)):
        # A call of it, or one that hands it on, as to functools.partial.
        called = {ast.unparse(part).rpartition(".")[2] for part in (call.func, *call.args[:1])}
        if wanted in called and set(hook.by_name) <= {keyword.arg for keyword in call.keywords}:
            return
    raise MemobenchError(
        f"{hook.caller} does not call {wanted}({', '.join(f'{name}=' for name in hook.by_name)}) any more, as in "
        f"{hook.version}, where it is made to {hook.does}: {_advice(hook)}"
    )


def _check_parameters(hook: Hook, function: Function) -> None:
    """Refuse to lay anything around a function that does not take what is handed to it."""
    found = inspect.signature(function).parameters
    open_ended = any(parameter.kind is parameter.VAR_KEYWORD for parameter in found.values())
    if open_ended or set(hook.parameters) <= set(found):
        return
    raise MemobenchError(
        f"{hook.module}.{hook.name} takes ({', '.join(found)}) and not ({', '.join(hook.parameters)}), as in "
        f"{hook.version}, where it is made to {hook.does}: {_advice(hook)}"
    )


if __name__ == "__main__":
    print(table())
