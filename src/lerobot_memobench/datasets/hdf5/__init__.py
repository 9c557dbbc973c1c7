"""Demonstrations in the published HDF5 layout: one file per task (paper, appendix on data collection).

::

    data                       bddl_file_name, bddl_file_content, env_info, problem_info (attributes)
    data/demo_k                num_samples, model_file, meta_data (attributes)
    data/demo_k/states         (T, D) float64
    data/demo_k/actions        (T, 7)
    data/demo_k/obs/agentview_image, robot0_eye_in_hand_image    (T, 256, 256, 3) uint8

``meta_data`` is the task's metadata as JSON, with ``key_frame`` (for each checkpoint the frame at which it was
completed in order) and ``timestep_exec_start_idx`` (the frame at which execution starts) filled in. Frame t shows
the observation before ``actions[t]``.

`reading` reads and checks a file, `archive` takes files out of a zip, `model_file` reads a file's scene, and `restore`
makes a demonstration of a group. Files that earlier versions of this package wrote have further attributes: of ``data``
``task_metadata``; of a demonstration ``seed``, ``referent``, ``variant``, ``success``, ``fixture_poses``,
``scene_hash``, ``satisfied_intervals`` and ``digest``.
"""
