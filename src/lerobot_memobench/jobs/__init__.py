"""How are many independent pieces of work run, here or on Slurm, and found finished again?"""
