"""How is it taught? Demonstrations, their labels, the LeRobot dataset, its generation and its replay."""
