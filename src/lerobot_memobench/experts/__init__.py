"""Scripted experts: closed-loop motions, plans from goals and checkpoints, prompts from plans."""
