"""What changes under another version of MuJoCo: does the expert still solve every task, and how far do scenes drift?"""
