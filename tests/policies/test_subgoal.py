"""The narrow channel: the chosen text is all that the action expert reads of the prefix."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.fusion import Prefix
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Query
from lerobot_memobench.policies.memobench_mem.memory.subgoal import SCORES, NarrowPass
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, Observation
from lerobot_memobench.policies.memobench_mem.objects import HAND_DIM
from lerobot_memobench.policies.memobench_mem.texts import choices
from lerobot_memobench.sim.object_layout import SIZE, SLOTS
from lerobot_memobench.tasks.memory_text import with_memory
from tests.support.small_policy import histories

OF_TASKS = {"the drawer": ["close it", "open it"], "the bowl": ["open it", "put it into the top drawer"]}
CHUNK, B, TEXTS = 4, 2, 3


@pytest.fixture(params=["objects", "pixels"])
def model(request: pytest.FixtureRequest) -> MemoryPI05:
    """With a token of the state (objects), and with the state in the text prompt (pixels)."""
    size = "small" if request.param == "objects" else "tiny"
    fields = {"size": size, "perception": request.param, "memory": "subgoal", "subgoals": OF_TASKS}
    config = MemobenchMemConfig(
        device="cpu", chunk_size=CHUNK, n_action_steps=CHUNK, num_inference_steps=1, objective="flow_matching", **fields
    )
    torch.manual_seed(0)
    made = MemoryPI05(config)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))  # zeros would hide errors
    return made.eval()


def test_choices_are_the_tasks_texts_with_or_without_oracle_memory() -> None:
    texts = [with_memory(task, memory) for task, memory in zip(OF_TASKS, ("", "opened it"), strict=True)]
    own = [[True, True, False], [False, True, True]]
    assert choices(OF_TASKS, [*OF_TASKS]).tolist() == choices(OF_TASKS, texts).tolist() == own
    assert choices(OF_TASKS, "an unknown task").all()


def inputs_of(model: MemoryPI05, seed: int = 1) -> Observation:
    """Return the present of two rows."""
    chance = torch.Generator().manual_seed(seed)
    real = torch.ones(B, 7, dtype=torch.bool)
    real[1, 4:] = False
    if model.state_token is None:
        side = model.config.image_size[0]
        seen = [torch.rand(B, 3, side, side, generator=chance) * 2 - 1]
        shown = [torch.ones(B, dtype=torch.bool)]
    else:
        seen = [torch.randn(B, width, generator=chance) for width in (SIZE + HAND_DIM, model.config.max_state_dim)]
        shown = [torch.ones(B, SLOTS, dtype=torch.bool), torch.ones(B, dtype=torch.bool)]
    words = torch.randint(4, 200, (B, 7), generator=chance)
    return Observation(seen, shown, words, real)


def remember(model: MemoryPI05, seed: int = 2, subgoal: list[int] | None = None) -> NarrowPass:
    """Begin a pass over a history of three frames, with or without true texts."""
    memory, chance = model.memory, torch.Generator().manual_seed(seed)
    frames = torch.randn(B, 3, memory.spec.tokens, memory.spec.dim, generator=chance)
    memory.pool = torch.nn.Identity()
    choices = torch.tensor([[True, True, False], [False, True, True]])
    query = Query(choices=choices, subgoal=None if subgoal is None else torch.tensor(subgoal))
    read = memory.replay(histories(frames, torch.arange(3).repeat(B, 1), torch.ones(B, 3, dtype=torch.bool)), query)
    memory_pass = model.memory_pass(read._replace(each=read.each.detach()))
    return memory_pass


def passed(model: MemoryPI05, seen: Observation, actions: Tensor, memory_pass: NarrowPass) -> Tensor:
    """Return the losses of a training's pass at time 1, from zero noise to these actions."""
    return model.forward(seen, actions, torch.zeros_like(actions), torch.ones(B), memory_pass)


def planned(model: MemoryPI05, seen: Observation, memory_pass: NarrowPass) -> Tensor:
    return model.sample_actions(seen, torch.zeros(B, CHUNK, model.config.max_action_dim), memory_pass)


def test_actions_read_only_the_text(model: MemoryPI05) -> None:
    """If the text does not attend to the prefix, other observations, instructions and histories change no action."""
    actions = torch.randn(B, CHUNK, model.config.max_action_dim)
    state = inputs_of(model).images[1:]  # empty without a state token

    def both(seed: int, text: list[int], state: list[Tensor]) -> Tensor:
        seen = inputs_of(model, seed)
        seen = seen._replace(images=[seen.images[0], *state])
        with torch.no_grad():
            losses = passed(model, seen, actions, remember(model, seed, text))
            return torch.stack([losses, planned(model, seen, remember(model, seed, text))])

    attends = NarrowPass.attends

    def narrowed(memory_pass: NarrowPass, prefix: Prefix, unread: int, copies: int) -> Tensor:
        attended = attends(memory_pass, prefix, unread, copies).clone()
        attended[:, unread:, :unread] = False  # the text attends only to itself
        return attended

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(NarrowPass, "attends", narrowed)
        found = both(1, [0, 2], state)
        assert torch.equal(found, both(5, [0, 2], state))
        assert (found != both(1, [1, 2], state))[:, 0].any(-1).all()
        if state:
            assert (found != both(1, [0, 2], [state[0] + 1])).any(-1).all()
    assert (both(1, [0, 2], state) != both(5, [0, 2], state)).any(-1).all()


def test_acting_equals_training(model: MemoryPI05) -> None:
    """One step of denoising ends at actions for which a training pass with the same text has no error."""
    memory_pass = remember(model)
    actions = planned(model, inputs_of(model), memory_pass)
    true = remember(model, subgoal=memory_pass.chosen.tolist())
    assert passed(model, inputs_of(model), actions, true).max() < 1e-8


def test_choice_is_independent_of_the_true_text(model: MemoryPI05) -> None:
    inputs, scores = inputs_of(model), []
    for subgoal in ([0, 2], [1, 1], [-1, -1]):
        memory_pass = remember(model, subgoal=subgoal)
        with torch.no_grad():
            passed(model, inputs, torch.zeros(B, CHUNK, model.config.max_action_dim), memory_pass)
        assert memory_pass.chosen.tolist() == [TEXTS if text < 0 else text for text in subgoal]
        scores.append(memory_pass.outputs[SCORES])
    memory_pass = remember(model)
    planned(model, inputs, memory_pass)
    for other in scores:
        torch.testing.assert_close(other, memory_pass.outputs[SCORES])
    first, second = memory_pass.outputs[SCORES].argmax(dim=1).tolist()
    assert memory_pass.chosen.tolist() == [first, second]
    assert first in (0, 1)
    assert second in (1, 2)
