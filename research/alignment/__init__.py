"""Does alignment help? Policies with every alignment, their success, and what their memory tells of subgoals."""
