"""Demonstrations as a LeRobotDataset v3.0.

Two ways in: :func:`write_dataset` takes demonstrations; :func:`assemble` takes episodes that workers have
staged, already encoded. Both give the same bytes for the same episodes. LeRobot's own metadata writer and
feature schema are used; its frame-by-frame recording loop is not, because it writes every image as PNG first
and copies a growing video again for every episode, and because it drops language rows, which a second pass
has to add. Here a table holds them from the start, so there is no state in which a dataset lacks a column.
"""
