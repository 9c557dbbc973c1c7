"""Run many independent jobs in processes of this machine, and find finished jobs."""
