"""Demonstrations as a LeRobotDataset v3.0.

`layout` names files, `columns` the columns of frames, `record` the fields of an episode. `tables` reads the tables,
`reading` the episodes in them; `damage` finds missing and damaged files. `card` and `manifest` describe a dataset.

:func:`assembling.assemble` takes episodes that workers have staged, already encoded; :func:`assembling.write_dataset`
stages demonstrations that are in memory first. LeRobot's own metadata writer and feature schema are used; its
frame-by-frame recording loop is not, because it writes every image as PNG first, copies a growing video again for every
episode, and drops language rows, which a second pass has to add. Here a table holds them from the start, so no dataset
ever lacks a column.
"""
