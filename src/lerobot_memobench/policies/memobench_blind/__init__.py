"""The published routine, repeated blindly, seen as a LeRobot policy."""
