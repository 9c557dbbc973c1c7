"""Baselines without weights: the scripted expert, the published routine repeated blindly, and random actions."""
