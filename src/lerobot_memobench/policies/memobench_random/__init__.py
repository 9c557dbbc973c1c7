"""Uniform random actions, seen as a LeRobot policy: the floor that every result is read against."""
