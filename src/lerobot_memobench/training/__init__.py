"""Train memory policies, and prepare datasets for LeRobot's own trainer.

`command` is `lerobot train`; `loop` trains ``policy=memobench_mem``; `data` opens its datasets, `sampler` draws their
frames; `features` caches the outputs of frozen encoders. `trainer` runs LeRobot's trainer for other policies, on
a view of a dataset.
"""
