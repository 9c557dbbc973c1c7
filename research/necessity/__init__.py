"""Which tasks need a memory, and how far can a policy come without one?

`settings` are the questions about a task, `study` answers them scene by scene, in several processes, and `report`
writes the answers. In the demonstrated order: `demonstrations` photographs the expert's decisions, `scene` finds
decisions that look the same, `memoryless` computes the best policy without memory. In any order: `exploration` tries
all answers in the simulator and makes a `graph`, on which the best policies without memory are searched.
"""
