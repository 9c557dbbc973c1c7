"""Train and test the object detector on the simulator's own labels: ``python -m research.detector train|test``.

`labels` labels the objects of an image, `randomisation` adds distractors and moves objects and the arm, `data` makes
labelled images of the expert's episodes, `training` trains, `evaluation` measures.
"""
