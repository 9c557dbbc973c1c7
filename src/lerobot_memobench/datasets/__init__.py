"""Demonstrations: their labels, the LeRobot dataset, its generation and its replay.

An episode is a `demonstration`, with its labels. Episodes come from `generate`, or from files in the published
layout (`hdf5`, `restore`, `convert`). A finished one is kept on disk while others are made (`stage`), and
`write` assembles them to a LeRobotDataset: `layout` names its files and columns, `video` encodes and decodes images,
`statistics` measures columns, `card` describes and publishes it. `episodes` reads it, `validate` plays its episodes
again, `frames` holds it in memory for training.
"""
