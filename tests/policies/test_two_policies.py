"""Two policies in one process: what a training reads is its own, whatever else is trained or rolled out there."""

from __future__ import annotations

import ast
import functools
import gc
import inspect
import pkgutil
import shutil
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.datasets.dataset_reader import DatasetReader
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_memobench import lerobot_hooks
from lerobot_memobench.datasets.feature_cache.layout import FOLDER
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import DRAW_FRAMES, MAKE_PROCESSORS, READ_SAMPLE
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.sampler import SamplerSpec
from tests.support.picture_rollouts import made_detector, observed
from tests.support.small_policy import batch_of, made_for_training, small_config

INDICES = [10, 30, 50, 80]
SEEING: dict[str, Any] = {"size": "small", "n_action_steps": 3, "memory_stride": 2}
SEEING |= {"align": "semantic"}


@pytest.fixture(scope="module")
def root(dataset_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The dataset; its caches are made once."""
    to = tmp_path_factory.mktemp("seen") / "data"
    return shutil.copytree(dataset_root, to, ignore=shutil.ignore_patterns(FOLDER))


@pytest.fixture(scope="module")
def encoders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("detectors")
    return made_detector(folder / "one.safetensors", 1), made_detector(folder / "other.safetensors", 2)


def training(root: Path, **fields: Any) -> Iterator[float]:
    """Train a new policy, as `learning`."""
    yield from learning(*made_for_training(root, **fields))


def learning(policy: Any, before: Any, _: Any, dataset: Any) -> Iterator[float]:
    """Train a policy on a batch, which is read anew for each update; yield its losses."""
    optimizer = torch.optim.AdamW(policy.get_optim_params(), lr=1e-3)
    update = 0
    while True:
        torch.manual_seed(update)  # torch's generator is the process's
        loss, _ = policy.train().forward(before(batch_of(dataset, INDICES)))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        policy.update()
        update += 1
        yield loss.item()


def alone(root: Path, updates: int = 3, **fields: Any) -> list[float]:
    """Return the losses of a training beside which there is no other; made once."""
    return _alone(root, updates, tuple(sorted(fields.items())))


@functools.cache
def _alone(root: Path, updates: int, fields: tuple[tuple[str, Any], ...]) -> list[float]:
    run = training(root, **dict(fields))
    return [next(run) for _ in range(updates)]


KINDS = {
    "other encoders on the same dataset": ({}, {}),
    "tokens and pictures": ({}, {"visual_encoder": "random", "image_resolution": (48, 48)}),
    "shuffled texts, fewer frames": ({}, {"shuffle_subgoals": True, "memory_frames": 4, "align": "framewise"}),
    "memory text in the prompt": ({"oracle_memory": True}, {}),
}


@pytest.mark.slow  # other encoders on one dataset are a default test, below
@pytest.mark.parametrize("kind", KINDS)
def test_two_trainings_in_turns_learn_what_each_learns_alone(
    root: Path, encoders: tuple[Path, Path], kind: str
) -> None:
    settings = [
        SEEING | {"visual_encoder": str(path)} | fields for path, fields in zip(encoders, KINDS[kind], strict=True)
    ]
    expected = [alone(root, **fields) for fields in settings]
    assert expected[0] != expected[1]
    runs = [training(root, **fields) for fields in settings]
    found = [[next(run) for run in runs] for _ in expected[0]]
    assert [list(losses) for losses in zip(*found, strict=True)] == expected


def test_two_policies_may_be_trained_on_one_dataset_object(root: Path, encoders: tuple[Path, Path]) -> None:
    settings = [SEEING | {"visual_encoder": str(path)} for path in encoders]
    expected = [alone(root, **fields) for fields in settings]
    first = made_for_training(root, **settings[0])
    dataset = first[3]
    config = small_config(**settings[1])
    torch.manual_seed(0)
    policy = make_policy(config, ds_meta=dataset.meta)
    second = (policy, *make_pre_post_processors(config, dataset_stats=dataset.meta.stats), dataset)
    runs = [learning(*made) for made in (first, second)]
    found = [[next(run) for run in runs] for _ in expected[0]]
    assert [list(losses) for losses in zip(*found, strict=True)] == expected


def test_who_looks_at_pictures_gets_them_from_a_dataset_that_is_shared(root: Path, encoders: tuple[Path, Path]) -> None:
    policy, before, _, dataset = made_for_training(root, **SEEING | {"visual_encoder": str(encoders[0])})
    assert "observation.images.image" not in dataset[45]
    looking = make_policy(small_config(size="tiny"), ds_meta=dataset.meta)
    batch = batch_of(dataset, INDICES)
    assert "observation.images.image" in batch
    with pytest.raises(MemobenchError, match="open the dataset once for each policy"):
        policy.train().forward(before(batch))
    del looking
    gc.collect()
    assert "observation.images.image" not in dataset[45], "it has gone"
    other = LeRobotDataset("memobench/synthetic", root=root)
    assert "observation.images.image" in other[45], "another dataset object is nobody's"


@pytest.mark.slow
def test_a_policy_that_is_loaded_to_act_changes_no_training(
    root: Path, encoders: tuple[Path, Path], tmp_path: Path
) -> None:
    settings = SEEING | {"visual_encoder": str(encoders[0])}
    saved, saved_before, saved_after, dataset = made_for_training(root, **SEEING | {"visual_encoder": str(encoders[1])})
    for part in (saved, saved_before, saved_after):
        part.save_pretrained(tmp_path)
    expected = alone(root, 4, **settings)
    saved.reset()
    seen = [observed(root, dataset, index) for index in range(3)]
    actions = [saved.select_action(saved_before(one)) for one in seen]
    run = training(root, **settings)
    found = [next(run)]
    for _ in range(3):
        acting = MemobenchMemPolicy.from_pretrained(tmp_path)
        before, _ = make_pre_post_processors(acting.config, pretrained_path=str(tmp_path))
        acting.reset()
        assert all(
            torch.equal(acting.select_action(before(one)), action) for one, action in zip(seen, actions, strict=True)
        )
        found.append(next(run))
    assert found == expected


def test_a_checkpoint_goes_on_by_its_own_run(root: Path, encoders: tuple[Path, Path], tmp_path: Path) -> None:
    """Its steps are rebuilt after another policy has begun a training of its own."""
    made = made_for_training(root, **SEEING | {"visual_encoder": str(encoders[0]), "oracle_memory": True})
    for part in made[:3]:
        part.save_pretrained(tmp_path)
    config = PreTrainedConfig.from_pretrained(tmp_path)
    config.pretrained_path, config.subgoal_level = tmp_path, "coarse"
    policy = make_policy(config, ds_meta=made[3].meta)
    made_for_training(root, **SEEING | {"visual_encoder": str(encoders[1])})
    before, _ = make_pre_post_processors(config, pretrained_path=str(tmp_path))
    gather, oracle = before.steps[2:4]
    assert (gather.subgoal_level, oracle.enabled) == ("coarse", True)
    assert gather._run is oracle._run is policy.run


# -- what of LeRobot's is changed, and for how long ----------------------------------------------------------------


def test_nothing_of_lerobots_is_changed_once_a_training_is_over(root: Path, encoders: tuple[Path, Path]) -> None:
    gc.collect()
    before = lerobot_hooks.installed()
    places = {hook: pkgutil.resolve_name(f"{hook.module}:{hook.name}") for hook in lerobot_hooks.there()}
    made = made_for_training(root, **SEEING | {"visual_encoder": str(encoders[0])})
    assert set(lerobot_hooks.installed()) >= {MAKE_PROCESSORS, DRAW_FRAMES, READ_SAMPLE}
    del made
    gc.collect()
    assert lerobot_hooks.installed() == before
    if not before:
        assert {hook: pkgutil.resolve_name(f"{hook.module}:{hook.name}") for hook in lerobot_hooks.there()} == places


def frames(seed: int = 0) -> tuple[list[int], list[int]]:
    """What LeRobot's sampler draws, plain and in an order of ours."""
    starts, tasks = np.array([5, 15]), np.repeat([0, 1], 10)
    plain = EpisodeAwareSampler([0, 10], [10, 20], drop_n_last_frames=SamplerSpec(starts, 1))
    ordered = EpisodeAwareSampler([0, 10], [10, 20], None, 0, SamplerSpec(starts, 2, tasks, np.ones(2)), True, seed)
    return list(plain), list(ordered)


@pytest.mark.parametrize("wraps", [True, False])
def test_a_foreign_decorator_changes_nothing(monkeypatch: pytest.MonkeyPatch, wraps: bool) -> None:
    """Whether it is there before ours or comes after it, and copies marks of ours or not."""
    expected = frames()
    assert expected[0] == [5, 6, 7, 8, 9, 15, 16, 17, 18, 19]
    assert set(expected[1]) <= set(expected[0])
    calls = []

    def foreign(function: Any) -> Any:
        def traced(*args: Any, **named: Any) -> Any:
            calls.append(function)
            return function(*args, **named)

        return functools.wraps(function)(traced) if wraps else traced

    kept = SamplerSpec(np.array([0]), 1)  # ours stands
    monkeypatch.setattr(EpisodeAwareSampler, "__init__", foreign(EpisodeAwareSampler.__init__))
    assert frames() == expected
    del kept  # ours goes
    gc.collect()
    assert frames() == expected
    monkeypatch.undo()
    monkeypatch.setattr(EpisodeAwareSampler, "__init__", foreign(EpisodeAwareSampler.__init__))
    assert frames() == expected
    assert len(calls) == 6
    monkeypatch.undo()
    assert frames() == expected


def test_a_sampler_that_is_not_ours_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    class Own(EpisodeAwareSampler):
        def __iter__(self) -> Iterator[int]:
            return iter(range(20))

    with pytest.raises(MemobenchError, match=r"not LeRobot's EpisodeAwareSampler.*execution frames"):
        Own([0, 10], [10, 20], drop_n_last_frames=SamplerSpec(np.array([5, 15]), 2))
    lerobots, drawn = inspect.unwrap(EpisodeAwareSampler.__init__), SamplerSpec(np.array([5, 15]), 1)
    monkeypatch.setattr(EpisodeAwareSampler, "__init__", lerobots)  # somebody puts it back
    with pytest.raises(MemobenchError, match=r"something has taken its place"):
        EpisodeAwareSampler([0, 10], [10, 20], drop_n_last_frames=drawn)
    with pytest.raises(MemobenchError, match="not LeRobot's"):
        np.array([10, 20]) - drawn


def test_a_function_that_takes_something_else_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EpisodeAwareSampler, "__init__", lambda self, begin, end: None)
    with pytest.raises(MemobenchError, match=r"takes \(self, begin, end\) and not .*lerobot 0\.6\.1.*make setup"):
        SamplerSpec(np.array([0]), 1)


def test_a_foreign_reader_is_kept(root: Path, encoders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """The other place that was marked by what a decorator copies."""
    calls: list[str] = []
    theirs = DatasetReader.get_item

    @functools.wraps(theirs)
    def traced(*args: Any, **named: Any) -> Any:
        calls.append("get_item")
        return theirs(*args, **named)

    monkeypatch.setattr(DatasetReader, "get_item", traced)
    policy, before, _, dataset = made_for_training(root, **SEEING | {"visual_encoder": str(encoders[0])})
    batch = batch_of(dataset, INDICES)
    assert "observation.images.image" not in batch
    policy.train().forward(before(batch))
    assert not calls, "what ours makes out of memory reads nothing"


def replaced_in(tree: ast.AST) -> list[str]:
    """What a file puts in the place of something of LeRobot's or transformers'."""
    theirs = {
        (alias.asname or alias.name).partition(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import | ast.ImportFrom)
        for alias in node.names
        if (getattr(node, "module", None) or alias.name).partition(".")[0] in ("lerobot", "transformers")
    }
    found = []
    for node in ast.walk(tree):
        targets = node.targets if isinstance(node, ast.Assign) else []
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "setattr":
            targets = [ast.Attribute(node.args[0], "any")]
        parts = [part for target in targets for part in getattr(target, "elts", [target])]
        replaced = [ast.unparse(part) for part in parts if isinstance(part, ast.Attribute)]
        found += [name for name in replaced if name.partition(".")[0] in theirs]
    return found


def test_nothing_else_of_lerobots_is_replaced() -> None:
    assert replaced_in(ast.parse("from lerobot.scripts import x\nx.y, a = 1, 2\nsetattr(x, 'b', 1)")) == [
        "x.y",
        "x.any",
    ]
    source = Path(lerobot_hooks.__file__).parent
    found = {path.name: replaced_in(ast.parse(path.read_text())) for path in source.rglob("*.py")}
    assert {name: replaced for name, replaced in found.items() if replaced} == {}


def test_every_hook_is_listed_in_the_docs() -> None:
    text = (Path(__file__).parents[2] / "docs" / "develop.md").read_text()
    assert lerobot_hooks.table() in text, "print it anew: python -m lerobot_memobench.lerobot_hooks"
    assert all(hook.does and hook.why and hook.read for hook in lerobot_hooks.HOOKS)


def test_every_function_that_is_hooked_is_the_one_that_was_read() -> None:
    for hook in lerobot_hooks.there():
        found = inspect.signature(inspect.unwrap(pkgutil.resolve_name(f"{hook.module}:{hook.name}"))).parameters
        assert set(hook.parameters) <= set(found), hook
        installed = metadata.version(hook.package)
        assert installed in hook.read, f"read {hook.module} of {hook.package} {installed}, and {hook.name}"
    there = [*inspect.signature(inspect.unwrap(EpisodeAwareSampler.__init__)).parameters]
    assert list(DRAW_FRAMES.parameters) == there, "they may be handed over by place"
