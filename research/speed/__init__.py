"""Speed of the simulator and of evaluation, beside stock robosuite 1.4.1."""
