"""Compute the best success rate of a policy that knows the elapsed control steps alone: the ceiling with a clock.

    python -m research.necessity.clock

After each hold such a policy chooses from the elapsed steps what to begin next, or to wait, because the observation
is always the same. It waits near home, where no rest is counted, as long as the horizon allows. Holds of random
length (`constants.HOLD_MEAN`) blur the steps, but elapsed time grows with each event, so no law makes it worthless.
The steps are divided into bins; each has one choice or the wait. A random choice could not be better: a bin is
shorter than an event, so an episode uses it once. Changes of random intervals of bins are kept unless the rate falls.
The best plan of several starts is rated on other sampled episodes: on its own sample its rate is up to six points
higher. The rate is a lower bound of what such a policy can reach. Idle trips are not held, so they are waits; waits
at an open fixture are not among the choices.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import HOLD_MEAN, HOLD_SHAPE, HORIZON, LONGEST_HOLD

Array = NDArray[np.float64]
Plan = NDArray[np.int64]
"""Choice (BINS,) per bin of elapsed steps; `WAIT` is the wait for the next choice."""
Holds = Callable[[np.random.Generator, int], Array]
"""Return lengths of holds (`EPISODES`, count), control steps."""

EVENT_STEPS, EVENT_SPREAD = 250.0, 30.0
"""Control steps of an event of the scripted expert with its way home: mean and standard deviation over tasks."""
REST_STEPS = 45
"""Control steps of the rest that ends a count."""
EPISODES, BINS, WIDTH = 4_000, 300, 40
"""Sampled episodes; number of bins and their width, control steps. Later steps belong to the last bin."""
WAIT = -1
CHANGES, STARTS = 4_000, 3
"""Changes tried from each start."""


def holds(rng: np.random.Generator, count: int) -> Array:
    """Draw lengths of holds by the law of the protocol, for tasks without a prompt."""
    drawn = np.minimum(rng.gamma(HOLD_SHAPE, HOLD_MEAN / HOLD_SHAPE, (EPISODES, count)), LONGEST_HOLD)
    drawn[:, 0] = rng.uniform(0, LONGEST_HOLD, EPISODES)
    return drawn


def bin_of(elapsed: float) -> int:
    """Return the bin of elapsed control steps."""
    return min(int(elapsed // WIDTH), BINS - 1)


class Clock:
    """A task, for a policy that knows the elapsed steps alone.

    Args:
        wanted: right choices in order, from 0.
        last: control steps of the last choice.
        law: draws the holds before the choices.
        seed: of the sampled episodes.
    """

    def __init__(self, wanted: Sequence[int], last: float, law: Holds = holds, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        self._wanted, self._choices = tuple(wanted), max(wanted) + 1
        self._holds = law(rng, len(wanted))
        self._events = np.maximum(rng.normal(EVENT_STEPS, EVENT_SPREAD, (EPISODES, len(wanted))), WIDTH)
        self._budget = HORIZON - self._events[:, :-1].sum(axis=1) - last

    def rate(self, plan: Plan) -> float:
        """Return the rate of episodes in which each choice is right and the waits are within the horizon."""
        places = np.arange(BINS)
        after = np.minimum.accumulate(np.where(plan == WAIT, BINS - 1, places)[::-1])[::-1]
        time, waited, right = np.zeros(EPISODES), np.zeros(EPISODES), np.ones(EPISODES, bool)
        for k, choice in enumerate(self._wanted):
            time += self._holds[:, k]
            chosen = after[np.minimum(time // WIDTH, BINS - 1).astype(int)]
            begun = np.maximum(time, chosen * WIDTH)
            waited += begun - time
            right &= plan[chosen] == choice
            time = begun + self._events[:, k]
        return float(np.mean(right & (waited <= self._budget)))

    def best(self) -> tuple[float, Plan]:
        """Return the best rate that was found, and its plan."""
        rng = np.random.default_rng(1)
        return max((self._climb(start, rng) for start in self._starts(rng)), key=lambda found: found[0])

    def _starts(self, rng: np.random.Generator) -> Iterator[Plan]:
        for _ in range(STARTS):
            plan, at = np.full(BINS, self._wanted[-1]), 0
            for choice in self._wanted[:-1]:
                until = at + int(rng.integers(4, 18))
                plan[at:until], plan[until] = WAIT, choice
                at = until + 1
            yield plan

    def _climb(self, plan: Plan, rng: np.random.Generator) -> tuple[float, Plan]:
        best = self.rate(plan)
        for _ in range(CHANGES):
            first, value = int(BINS * rng.random() ** 2), int(rng.integers(WAIT, self._choices))
            changed = plan.copy()
            changed[first : first + int(rng.geometric(0.2))] = value
            changed[-1] = max(changed[-1], 0)
            found = self.rate(changed)
            if found >= best:
                best, plan = found, changed
        return best, plan


def counting(number: int, law: Holds = holds, seed: int = 0) -> Clock:
    """Return the task to do an event (0) ``number`` times and then rest (1)."""
    return Clock([0] * number + [1], REST_STEPS, law, seed)


def ordering(events: int, law: Holds = holds, seed: int = 0) -> Clock:
    """Return the task to do ``events`` different things in order."""
    return Clock(range(events), EVENT_STEPS, law, seed)


@cache
def best_plan(events: int, counts: bool) -> Plan:
    """Return the best plan found of counting ``events`` or of ordering as many things."""
    return (counting(events) if counts else ordering(events)).best()[1]


def main() -> None:
    """Print the rates for the law of the protocol, and without holds."""
    laws: dict[str, Holds] = {"holds": holds, "no holds": lambda rng, count: np.zeros((EPISODES, count))}
    for name, law in laws.items():
        counts = [_fresh(counting, number, law) for number in (1, 2, 3)]
        print(f"{name}: counting {_percent(counts)}, mean {_percent([float(np.mean(counts))])}", flush=True)
        orders = [_fresh(ordering, number, law) for number in (2, 3)]
        print(f"{name}: ordering of two and three {_percent(orders)}", flush=True)


def _fresh(task: Callable[..., Clock], number: int, law: Holds) -> float:
    """Return the rate of the best plan that was found, on samples that the search did not see."""
    plan = task(number, law).best()[1]
    return float(np.mean([task(number, law, seed).rate(plan) for seed in range(1, 11)]))


def _percent(rates: Sequence[float]) -> str:
    return ", ".join(f"{100 * rate:.1f} %" for rate in rates)


if __name__ == "__main__":
    main()
