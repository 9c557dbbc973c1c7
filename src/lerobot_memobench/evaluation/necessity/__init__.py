"""Which tasks need a memory, and how far can a policy come without one?"""
