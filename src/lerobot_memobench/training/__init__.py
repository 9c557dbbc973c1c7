"""Train memory policies, and prepare datasets for LeRobot's own trainer.

`command` is `lerobot train`; `loop` trains ``policy=memobench_mem``; `data` opens what it learns from; `features` holds
outputs of frozen encoders; `view` prepares datasets for the other policies, which LeRobot's own trainer trains.
"""
