"""How are many independent pieces of work run, here, on Slurm, on Ray, and found finished again?"""
