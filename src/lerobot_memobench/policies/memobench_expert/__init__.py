"""The scripted expert, seen as a LeRobot policy."""
