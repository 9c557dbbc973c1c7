"""Baselines without weights: the scripted expert, the published routine replayed blindly, and random actions."""
