"""Train memory policies, and prepare datasets for LeRobot's own trainer.

`command` is `lerobot train`; `loop` trains ``policy=memobench_mem``; `data` opens its datasets; `features` caches the
outputs of frozen encoders; `view` prepares datasets for other policies, which LeRobot's trainer trains; `samples` runs
it, with samples in memory for policies without pictures.
"""
