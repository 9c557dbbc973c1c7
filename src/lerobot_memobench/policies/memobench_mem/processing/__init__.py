"""What is done to a sample or an observation before the policy sees it? The pipeline's steps of our own."""
