"""The update interval: one policy at several plan intervals, its memory fed at each control step or at each plan."""
