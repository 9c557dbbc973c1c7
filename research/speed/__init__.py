"""Speed of the simulator and of evaluation, against stock robosuite 1.4.1."""
