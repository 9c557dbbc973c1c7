"""Learning experiments: from no data to policies with and without a memory, and their success."""
