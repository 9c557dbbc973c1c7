"""Demonstrations: their labels, the LeRobot dataset, its generation and its replay.

An episode is a `demonstration`, with its labels. A finished one is kept on disk while others are made (`staging`) and
becomes part of a LeRobotDataset (`lerobot_format`). Episodes come from `recording` and `generation`, or from files in
the published layout (`hdf5`, `convert`); `replay` and `validate` play them again, `describe` and `push` publish them,
`frames` and `images` read frames for training.
"""
