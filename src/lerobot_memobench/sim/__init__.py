"""How does a task move and look? The scene, the arm, pictures; predicates answered by physics."""

from lerobot_memobench.io import choose_caches

choose_caches()  # before this package imports numba, in programs that use none of the commands
