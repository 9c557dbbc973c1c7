"""Demonstrations: their labels, the LeRobot dataset, its generation and its replay.

An episode is a `demonstration`, with its labels. It is written in the published layout (`hdf5`), waits finished on disk
while others are made (`staging`), and becomes part of a LeRobotDataset (`lerobot_format`). Episodes come from
`recording` and `generation`, or from files (`convert`); `replay` and `validate` play them again, `describe` and `push`
show them, `lookup` finds frames for training.
"""
