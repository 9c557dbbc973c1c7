"""Reinforcement learning on object state: a recurrent policy learns to turn on a stove, in minutes on one core.

    python examples/recurrent_ppo.py --out outputs/recurrent_ppo

It needs the extra `rl`. The task is "turn on the stove and turn it off"; its first memory checkpoint is that the stove
has been on. Training takes the scenes of seeds 10,000 on, the tests before and after it 20 validation scenes, 20,000
on. Given again, it goes on from where it was; with more `--decisions` it trains further.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.monitor import Monitor

import lerobot_memobench.envs  # noqa: F401  registers memobench/<task>-v0
from lerobot_memobench.constants import DEMONSTRATION_SEED, VALIDATION_SEED
from lerobot_memobench.sim.object_layout import SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import classes

TASK = "memobench/turn_on_the_stove_and_turn_it_off-v0"
HORIZON, REPEAT, SCENES = 200, 5, 20
"""Control steps of an episode (10 s) and of one decision; scenes of a test."""
KNOB = classes().index("knob")


class FirstCheckpoint(gymnasium.Wrapper[np.ndarray, np.ndarray, dict[str, Any], np.ndarray]):
    """Ends an episode at its first memory checkpoint; acts by displacement alone, with closed fingers.

    Observation (13,): the hand and the knob from it (dm), the knob's angle (rad) and rotation. While the hand hides the
    knob its numbers are 0, as in the environment's observation. Action (3,): displacement, for `REPEAT` control steps.
    Random actions do not reach the checkpoint, so the way to it is paid too: a hand that comes closer, a knob that
    turns. A gain that is lost again adds up to 0.
    """

    def __init__(self, env: gymnasium.Env[dict[str, Any], np.ndarray], first_seed: int) -> None:
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Box(-100, 100, (13,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
        self.next_seed = first_seed

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the next scene; a library's own seeds choose none."""
        self.next_seed += 1
        observation, info = self.env.reset(seed=self.next_seed - 1, options=options)
        return self._read(observation), info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Repeat an action; pay the checkpoint and the progress towards it."""
        before, reached = self._potential, False
        for k in range(REPEAT):
            self.unwrapped.need_observation(k == REPEAT - 1)  # the others are not read: faster by half
            observation, reward, _, truncated, info = self.env.step(np.array([*action, 0, 0, 0, 1], np.float32))
            reached = reached or reward > 0
        state = self._read(observation)
        return state, 5.0 * reached + self._potential - before, reached, truncated, {**info, "is_success": reached}

    def _read(self, observation: dict[str, Any]) -> np.ndarray:
        slots = observation["environment_state"].reshape(SLOTS, WIDTH)
        hand, knobs = observation["agent_pos"][:3], slots[field(slots, "class")[:, 0] == KNOB]
        self._knob = knobs[0] if len(knobs) else self._knob
        away, angle = field(self._knob, "position") - hand, field(self._knob, "joint")
        self._potential = float(2 * angle[0] - 3 * np.linalg.norm(away + np.array([0, 0, 0.05])))
        knob = np.concatenate([10 * away, angle, field(self._knob, "rotation")])
        return np.concatenate([10 * hand, knob * bool(len(knobs))]).astype(np.float32)


def make(first_seed: int) -> FirstCheckpoint:
    """Return the environment whose scenes are those of a seed and the following ones."""
    env = gymnasium.make(TASK, obs_type="environment_state_agent_pos", reward="checkpoints", horizon=HORIZON)
    return FirstCheckpoint(env, first_seed)


def reached(model: RecurrentPPO, deterministic: bool = False) -> int:
    """Return in how many validation scenes the checkpoint is reached, by actions drawn as in training or their mean."""
    env, count = make(VALIDATION_SEED), 0
    with torch.random.fork_rng():
        torch.manual_seed(0)
        for _ in range(SCENES):
            observation, _ = env.reset()
            memory, begins, done = None, True, False
            while not done:
                action, memory = model.predict(observation, memory, np.array([begins]), deterministic)
                observation, _, terminated, truncated, info = env.step(action)
                begins, done = False, terminated or truncated
            count += info["is_success"]
    env.close()
    return count


def main() -> None:
    """Test, train, test."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/recurrent_ppo"))
    parser.add_argument("--decisions", type=int, default=16_384, help=f"to train for, {REPEAT} control steps each")
    parser.add_argument("--seed", type=int, default=0, help="of the network and its exploration")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    file, draft = chosen.out / "model.zip", chosen.out / "draft.zip"
    env = Monitor(make(DEMONSTRATION_SEED))
    if file.exists():
        model = RecurrentPPO.load(file, env)
    else:
        model = RecurrentPPO(
            "MlpLstmPolicy", env, n_steps=512, batch_size=128, learning_rate=1e-3, gamma=0.97, seed=chosen.seed,
            policy_kwargs={"lstm_hidden_size": 64, "net_arch": [64]}, device="cpu",
        )  # fmt: skip
        print(f"before training: {reached(model)} of {SCENES} validation scenes", flush=True)
    while model.num_timesteps < chosen.decisions:
        model.learn(2 * model.n_steps, reset_num_timesteps=False)
        model.save(draft)
        draft.replace(file)  # whole, or as it was
        mean = np.mean([episode["r"] for episode in model.ep_info_buffer])
        print(f"{model.num_timesteps} decisions: mean reward {mean:.2f}", flush=True)
    print(f"after {model.num_timesteps} decisions: {reached(model)} of {SCENES} validation scenes")
    print(f"by the mean of its actions: {reached(model, deterministic=True)}")


if __name__ == "__main__":
    main()
