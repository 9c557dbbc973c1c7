"""How is an evaluation run, gone on with, shared out, merged, repeated?"""
