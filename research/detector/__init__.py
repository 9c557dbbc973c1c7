"""Train and test the object detector on the simulator's own labels: ``python -m research.detector train|test``.

`labels` says what an image shows. `randomisation` adds distractors and moves things and the arm, `data` takes labelled
images of an expert's episodes and keeps them. `training` has targets, losses and the run; `evaluation` measures.
"""
