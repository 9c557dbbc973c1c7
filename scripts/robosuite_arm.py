"""Write the arm in sim/panda from the wheel of robosuite that LIBERO uses.

    pip download --no-deps robosuite==1.4.0
    python scripts/robosuite_arm.py robosuite-1.4.0-py3-none-any.whl            # --check compares the files instead

robosuite composes the MJCF: Panda, RethinkMount, PandaGripper. OBJ files of the drawn meshes lose what images do not
depend on: texture coordinates, for which no material of the arm has a texture, repeated vertices and trailing zeros.
Everything else is copied.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
import tempfile
import zipfile
from pathlib import Path

from lerobot_memobench.sim.robot import BASE_POSITION, FOLDER

WHEEL_SHA256 = "aba065e7b36745738cede259457b2cb349427f3608728d867ef3a2034cb62994"


def main() -> None:
    """Write the files, or compare them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--check", action="store_true", help="compare the files, write nothing")
    given = parser.parse_args()
    if hashlib.sha256(given.wheel.read_bytes()).hexdigest() != WHEEL_SHA256:
        sys.exit(f"{given.wheel} is not the wheel of robosuite 1.4.0 (its hash differs)")
    with tempfile.TemporaryDirectory() as folder:
        with zipfile.ZipFile(given.wheel) as wheel:
            wheel.extractall(folder)
            licence = wheel.read("robosuite-1.4.0.dist-info/LICENSE")
        sys.path.insert(0, folder)
        files = {"LICENSE": licence, **arm_files()}
    if given.check:
        found = {path.name: path.read_bytes() for path in FOLDER.iterdir()}
        different = sorted(name for name in found.keys() | files if found.get(name) != files.get(name))
        sys.exit(f"different: {', '.join(different)}" if different else 0)
    FOLDER.mkdir(exist_ok=True)
    for name, content in files.items():
        (FOLDER / name).write_bytes(content)
    print(f"{FOLDER}: {len(files)} files, {sum(map(len, files.values())):,} bytes")


def arm_files() -> dict[str, bytes]:
    """Return name -> content of the composed MJCF and its meshes."""
    from robosuite.models.grippers import gripper_factory
    from robosuite.models.mounts import mount_factory
    from robosuite.models.robots import Panda
    from robosuite.models.world import MujocoWorldBase

    arm = Panda(idn=0)
    arm.add_mount(mount_factory("RethinkMount", idn=0))
    arm.add_gripper(gripper_factory("PandaGripper", idn=0))
    arm.set_base_xpos(BASE_POSITION)
    world = MujocoWorldBase()
    world.merge(arm)
    paths = [Path(path) for path in re.findall(r'file="([^"]+)"', world.get_xml())]
    meshes = {path.name: path.read_bytes() for path in paths}
    assert len(meshes) == len(paths)
    xml = re.sub(r'file="[^"]*/', 'file="', world.get_xml())
    return {"panda.xml": xml.encode(), **{name: slim(name, content) for name, content in meshes.items()}}


def slim(name: str, content: bytes) -> bytes:
    """Return an OBJ file with each position and normal once, in the order of the faces; other files as they are."""
    if not name.endswith(".obj"):
        return content
    rows: dict[str, list[str]] = {"v": [], "vn": [], "f": []}
    for line in content.decode().splitlines():
        kind, _, rest = line.partition(" ")
        rows.get(kind, []).append(rest)
    points, normals, faces = dict[str, int](), dict[str, int](), list[str]()
    for face in rows["f"]:
        corners = []
        for corner in face.split():
            point, _, normal = map(int, corner.split("/"))
            a = points.setdefault(trimmed(rows["v"][point - 1]), len(points) + 1)
            b = normals.setdefault(trimmed(rows["vn"][normal - 1]), len(normals) + 1)
            corners.append(f"{a}/1/{b}")
        faces.append(f"f {' '.join(corners)}")
    # With a texture coordinate, MuJoCo takes the normals of the file for all corners.
    lines = [*(f"v {point}" for point in points), "vt 0 0", *(f"vn {normal}" for normal in normals), *faces]
    return "\n".join([*lines, ""]).encode()


def trimmed(numbers: str) -> str:
    """Return decimal numbers without trailing zeros."""
    return " ".join(number.rstrip("0").rstrip(".") for number in numbers.split())


if __name__ == "__main__":
    main()
