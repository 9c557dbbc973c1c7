"""The commands: ``lerobot`` (LeRobot's own commands with key=value) and ``memobench`` (everything else)."""
