"""What did it learn? Metrics, failures, comparisons, documents, from the episode log. No simulator, no torch."""
