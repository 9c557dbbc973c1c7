"""Which tasks need a memory, and how far can a policy come without one?

`settings` is what is asked of a task, `study` answers it scene by scene, in several processes, and `report` writes the
answers down. In the demonstrated order: `demonstrations` photographs the expert's decisions, `scene` finds those that
look the same, `memoryless` says how far a policy without memory comes. In any order: `exploration` tries all answers in
the simulator and makes a `graph`, on which the best policies without memory are looked for.
"""
