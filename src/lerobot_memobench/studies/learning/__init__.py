"""Does a memory solve the tasks? From no data to policies and their rollouts, each part timed; see `study`."""
