"""Simulate and render a task, and evaluate its predicates: scenes from files, the arm, states, object observations."""

from lerobot_memobench.io import choose_caches

choose_caches()  # before this package imports numba, in programs that use none of the commands
