"""Plan, run, resume, divide, merge and repeat an evaluation."""
