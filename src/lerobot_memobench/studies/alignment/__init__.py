"""What does each alignment do to a memory?"""
