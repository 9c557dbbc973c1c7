"""What did it learn? Metrics, failures and reports from the episode log. No simulator, no torch."""
