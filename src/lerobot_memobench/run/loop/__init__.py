"""LeRobot's evaluation loop, steered.

``steering`` puts what is ours in LeRobot's place, seeds batches and runs parts of a task; ``rollout`` is the loop over
control steps, in which nobody's pictures are drawn or converted; ``looking`` knows who looks.
"""
