"""How LeRobot steps the benchmark: configuration, gym environment, episode, log."""
