"""Is it memory, or a clock? How well decisions of strict tasks can be taken from the present and the step."""
