"""How are a task's scene, instruction and goal written down? BDDL problems in LIBERO's dialect."""
