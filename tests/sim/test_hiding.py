"""The simulation is bit-identical between variants of a hiding task until a drawer with a hidden object is ajar."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.constants import CAMERAS
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.world import PARKING_HEIGHT
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom

ONE = "find_the_tomato_hidden_in_one_of_the_drawers"


def _begun(task: str, seed: int, variant: int) -> Episode:
    episode = Episode(get_task(task), demonstration_prompt=False)
    episode.reset(seed, variant=variant, keep_prompt=True)
    while not episode.action_has_effect:
        episode.step(np.zeros(7, np.float32))
    return episode


def _pull(episode: Episode, drawer: str) -> Iterator[NDArray[np.float32]]:
    expert = Expert(episode.task, episode.sim, np.random.default_rng(0))
    for action in expert.achieve(Atom("open", (drawer,))):
        yield np.clip(action, -1, 1).astype(np.float32)


def test_variants_are_equal_until_a_drawer_is_ajar() -> None:
    episodes = [_begun(ONE, 20_003, variant) for variant in range(3)]
    first, *others = episodes
    drawer = "wooden_cabinet_1_top_region"
    rng = np.random.default_rng(3)
    for steps, action in enumerate(_pull(first, drawer), start=1):
        action = np.clip(action + 0.03 * np.r_[rng.normal(size=6), 0], -1, 1).astype(np.float32)
        for episode in episodes:
            episode.step(action)
        if first.sim.holds(Atom("ajar", (drawer,))):
            break
        for episode in others:
            assert episode.sim.state().tobytes() == first.sim.state().tobytes()
            assert episode.objects().tobytes() == first.objects().tobytes()
            if steps % 20 == 0:
                for camera in CAMERAS.values():
                    np.testing.assert_array_equal(episode.sim.render(camera), first.sim.render(camera))
    assert first.sim.holds(Atom("ajar", (drawer,)))
    assert steps > 40
    inside = [drawer in dict(map(reversed, episode.task.prompt.places)) for episode in episodes]  # type: ignore[arg-type, union-attr]
    heights = [min(episode.sim.body_pose(name)[0][2] for name, _ in episode.task.prompt.places) for episode in episodes]  # type: ignore[union-attr]
    assert [height < PARKING_HEIGHT / 2 for height in heights] == inside
    assert 0 < sum(inside) < len(inside)


@pytest.mark.parametrize("joints", [(1.9, -0.3, 1.9, -3.0, -0.8, 0.3, 0.9), (1.3, -0.8, 0.0, -0.7, 1.2, 3.1, 0.3)])
def test_a_wrist_camera_that_looks_up_lists_no_absent_object(joints: tuple[float, ...]) -> None:
    episode = _begun(ONE, 20_000, 0)
    sim, slots = episode.sim, ObjectSlots(episode.sim)
    sim.data.qpos[:7] = joints
    mujoco.mj_step1(sim.model, sim.data)
    seen = slots.observe().reshape(SLOTS, WIDTH)
    assert not (seen[:, STARTS["position"] + 2] > PARKING_HEIGHT / 2).any()
    (hidden,) = sim.absent
    rays = slots.things[next(k for k, t in enumerate(slots.things) if t.body == sim.model.body(hidden).id)]
    camera = sim.data.cam("robot0_eye_in_hand")
    direction = camera.xmat.reshape(3, 3).T @ (slots.position(rays) - camera.xpos)
    assert np.hypot(*direction[:2]) < -direction[2]  # the camera's image contains the parking place


def test_an_object_appears_at_rest_in_its_drawer_and_leaves_when_the_scene_is_restored() -> None:
    episode = _begun(ONE, 20_003, 0)
    (name, drawer), *_ = episode.task.prompt.places  # type: ignore[union-attr]
    expert = Expert(episode.task, episode.sim, np.random.default_rng(0))
    assert episode.sim.body_pose(name)[0][2] > PARKING_HEIGHT / 2
    assert not episode.sim.holds(Atom("in", (name, drawer)))
    for atom in (Atom("open", (drawer,)), Atom("close", (drawer,))):
        for action in expert.achieve(atom):
            episode.step(np.clip(action, -1, 1))
            if episode.sim.body_pose(name)[0][2] < PARKING_HEIGHT / 2:
                assert episode.sim.holds(Atom("in", (name, drawer)))
                assert not episode.sim.holds(Atom("lifted", (name,)))
    assert episode.sim.body_pose(name)[0][2] < PARKING_HEIGHT / 2
    for action in expert.achieve(Atom("handhome", ())):
        episode.step(np.clip(action, -1, 1))
    if episode.sim.holds(Atom("asbegun", ())):
        assert episode.sim.body_pose(name)[0][2] > PARKING_HEIGHT / 2
