"""Scripted experts: closed-loop motions, plans derived from goals and checkpoints, demonstration prompts."""
