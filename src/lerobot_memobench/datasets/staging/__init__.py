"""Finished episodes on disk while a dataset is being made.

Each episode is one folder, complete or absent: it is written under a temporary name and renamed when every
file has reached the disk, so a run killed at any moment leaves finished episodes and rubbish with a name of
its own. An episode's file names and bytes depend on the episode alone, never on the worker that made it.

::

    <staging>/episodes/000012/episode.json        identity, digest, statistics, hash of each file
                              arrays.npz          states, actions, proprio, label columns (no pickle)
                              image.mp4, wrist_image.mp4
                              demonstration.hdf5  in the published layout, when that was asked for

Frames go to the encoder while the episode is being made, so a worker's memory does not grow with its length.
"""
