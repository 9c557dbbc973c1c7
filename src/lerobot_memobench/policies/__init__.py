"""The memory policy, policies in servers and baselines as LeRobot policies; checkpoints and their checks."""
