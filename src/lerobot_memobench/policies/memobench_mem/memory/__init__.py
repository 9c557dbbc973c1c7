"""What stays of the frames that were seen? One file per mechanism, the same in training and in a rollout."""
