"""Can this machine run the benchmark, and if not, what mends it?"""
