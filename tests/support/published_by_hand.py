"""The published HDF5 layout, written with h5py and nothing of this package, from the paper's description of it.

``python published_by_hand.py OUT.hdf5 ARRAYS.npz TASK.bddl TASK.json SCENE.xml`` writes the arrays states, actions,
image and wrist_image as demo_0.
"""

import json
import sys
from pathlib import Path

import h5py
import numpy as np


def write(path, bddl_path, bddl_text, demos):
    """``demos``: dicts of states, actions, image, wrist_image, meta_data (a dict) and model_file."""
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs["bddl_file_name"] = bddl_path
        data.attrs["bddl_file_content"] = bddl_text
        data.attrs["env_info"] = json.dumps({"env_name": "Libero_Kitchen_Tabletop_Manipulation"})
        data.attrs["problem_info"] = json.dumps({"language_instruction": "as in the task"})
        for number, demo in enumerate(demos):
            group = data.create_group(f"demo_{number}")
            group.attrs["num_samples"] = len(demo["states"])
            group.attrs["model_file"] = demo["model_file"]
            group.attrs["meta_data"] = json.dumps(demo["meta_data"])
            group.create_dataset("states", data=demo["states"])
            group.create_dataset("actions", data=demo["actions"])
            group.create_dataset("obs/agentview_image", data=demo["image"])
            group.create_dataset("obs/robot0_eye_in_hand_image", data=demo["wrist_image"])


if __name__ == "__main__":
    out, arrays, bddl, metadata, scene = map(Path, sys.argv[1:])
    demo = dict(np.load(arrays)) | {"meta_data": json.loads(metadata.read_text()), "model_file": scene.read_text()}
    write(out, f"{bddl.parent.name}/{bddl.name}", bddl.read_text(), [demo])
