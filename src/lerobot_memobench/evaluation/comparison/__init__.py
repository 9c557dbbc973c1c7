"""Which of two evaluations is better, and what do the paper's controls tell?"""
