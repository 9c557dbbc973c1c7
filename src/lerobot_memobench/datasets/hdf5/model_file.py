"""Read the scene of a demonstration from the MJCF of its attribute ``model_file``, which strangers write.

Only what a state needs is taken: bodies and joints, as numbers that were checked. They are compiled as a text of our
own, so that nothing in a file names another file, a plugin or more than there is room for.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.hdf5.reading import Unusable, first_line

LONGEST_TEXT = 8 * 2**20
"""Characters of a model file; LIBERO's have some 70,000."""
MOST_ELEMENTS, DEEPEST = 20_000, 60
"""Elements of a model file, and how deep they may lie; LIBERO's have up to 500, 16 deep."""
LONGEST_NAME = 200
LARGEST_NUMBER = 1e6

PLACE = {"pos": 3, "quat": 4, "euler": 3, "axisangle": 4, "xyaxes": 6, "zaxis": 3}
KEPT: dict[str, dict[str, int]] = {
    "body": PLACE,
    "joint": {"pos": 3, "axis": 3, "ref": 1},
    "freejoint": {},
}
"""Element -> attribute -> most numbers that it may have."""
LEFT_OUT = ("inertial", "camera", "light", "geom", "site")
BY_DEFAULTS = ("class", "childclass")
"""Attributes that point to defaults elsewhere in the file; MuJoCo leaves them out of scenes that it saves."""
JOINT_TYPES = ("free", "ball", "slide", "hinge")
"""In MuJoCo's order."""
WIDTHS = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}
"""Type of a joint -> how many positions and velocities it has."""

Pose = NDArray[np.float64]
"""Position and quaternion wxyz, (7,)."""


def parse(text: str) -> ElementTree.Element:
    """Return the root of an MJCF text.

    Raises:
        Unusable: it is no XML, or is larger than any scene.
    """
    if len(text) > LONGEST_TEXT:
        raise Unusable(f"model_file has {len(text):,} characters, more than the {LONGEST_TEXT:,} that a scene may have")
    if "<!DOCTYPE" in text:
        raise Unusable("model_file declares a document type, which no scene has; it is not read")
    parser: Any = ElementTree.XMLPullParser(events=("start", "end"))
    depth = count = 0
    root: ElementTree.Element | None = None
    try:
        for start in range(0, len(text), 2**16):
            parser.feed(text[start : start + 2**16])
            for event, element in parser.read_events():
                root = element if root is None else root
                depth += 1 if event == "start" else -1
                count += event == "start"
                if count > MOST_ELEMENTS or depth > DEEPEST:
                    raise Unusable(f"model_file has more than {MOST_ELEMENTS:,} elements, or some {DEEPEST} deep")
        parser.close()
    except ElementTree.ParseError as error:
        raise Unusable(f"model_file is no XML ({error})") from None
    if root is None:
        raise Unusable("model_file is empty")
    return root


@dataclass(frozen=True)
class Joint:
    """A joint of a scene: its type, and the places of its positions and velocities in a state.

    ``body``: the name of the body that it moves.
    """

    kind: str
    body: str
    position: slice
    velocity: slice


def joints_of(model: mujoco.MjModel) -> dict[str, Joint]:
    """Return a model's joints by name, in the order of its states."""
    found = {}
    for index in range(model.njnt):
        joint = model.joint(index)
        kind = JOINT_TYPES[int(joint.type[0])]
        at, speed = 1 + int(joint.qposadr[0]), 1 + model.nq + int(joint.dofadr[0])
        wide, fast = WIDTHS[kind]
        body = model.body(int(joint.bodyid[0])).name
        found[joint.name] = Joint(kind, body, slice(at, at + wide), slice(speed, speed + fast))
    return found


class ModelFile:
    """The bodies and joints that a model file describes.

    Attributes:
        joints: by name, in the order of the state.
        state_dim: length of a state: 1 + nq + nv.
        model: the scene compiled; inertias are invented.

    Raises:
        Unusable: the text is no scene, or a place in it is not understood.
    """

    def __init__(self, text: str) -> None:
        root = parse(text)
        world = root.find("worldbody")
        if root.tag != "mujoco" or world is None:
            raise Unusable("model_file is no MJCF: it has no <mujoco> with a <worldbody>")
        self.model = self._compiled(world, _angles(root))
        self.joints = joints_of(self.model)
        self.state_dim = 1 + self.model.nq + self.model.nv

    # --- reading ---

    def _compiled(self, world: ElementTree.Element, angles: dict[str, str]) -> mujoco.MjModel:
        scene = ElementTree.Element("mujoco")
        ElementTree.SubElement(scene, "compiler", {"inertiafromgeom": "false", "autolimits": "false", **angles})
        copy = ElementTree.SubElement(scene, "worldbody")
        waiting = [(world, copy)]
        while waiting:
            source, target = waiting.pop()
            for element in source:
                made = self._copied(element)
                if made is None:
                    continue
                target.append(made)
                if element.tag == "body":
                    ElementTree.SubElement(made, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
                    waiting.append((element, made))
        try:
            return mujoco.MjModel.from_xml_string(ElementTree.tostring(scene, encoding="unicode"))
        except (ValueError, mujoco.FatalError) as error:
            raise Unusable(f"model_file is no scene that MuJoCo takes ({first_line(error)})") from None

    def _copied(self, element: ElementTree.Element) -> ElementTree.Element | None:
        """Return the kept part of an element, None for one that is left out."""
        tag, name = element.tag, element.get("name", "")
        if tag in LEFT_OUT:
            return None
        if tag not in KEPT:
            raise Unusable(f"model_file has a <{str(tag)[:40]}> in its worldbody, which is not understood there")
        what = f"model_file's {tag} {name[:LONGEST_NAME]!r}"
        if len(name) > LONGEST_NAME:
            raise Unusable(f"{what}… has a name of {len(name):,} characters")
        kind = element.get("type", "hinge")
        if tag == "joint" and kind not in JOINT_TYPES:
            raise Unusable(f"{what} is of type {kind[:40]!r}, expected one of {', '.join(JOINT_TYPES)}")
        unread = next((key for key in BY_DEFAULTS if key in element.attrib), None)
        if unread is not None:
            raise Unusable(
                f"{what} has the attribute {unread!r}, which is not read; store the scene as MuJoCo saves it"
            )
        kept = {key: _numbers_text(element.attrib[key], most, f"{what}: {key}") for key, most in KEPT[tag].items()
                if key in element.attrib}  # fmt: skip
        if tag == "joint":
            kept["type"] = kind
        return ElementTree.Element(tag, {**kept, **({"name": name} if name else {})})

    # --- asking ---

    def body_of(self, instance: str) -> str:
        """Return the name of the body of an object or fixture: its own, or with robosuite's suffix ``_main``.

        Raises:
            Unusable: there is none.
        """
        for name in (f"{instance}_main", instance):
            if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, name) >= 0:
                return name
        raise Unusable(f"model_file has no body {instance!r}, which its task has")

    def rest_pose(self, instance: str) -> Pose:
        """Return where the scene has the body of an instance before anything moves."""
        body = self.model.body(self.body_of(instance))
        return np.concatenate([body.pos, body.quat])


def _angles(root: ElementTree.Element) -> dict[str, str]:
    """Return the attributes of a scene's <compiler> that give the unit and order of angles."""
    angles = {"angle": "degree", "eulerseq": "xyz"}
    for compiler in root.iterfind("compiler"):
        angles.update((key, value) for key, value in compiler.attrib.items() if key in angles)
    if angles["angle"] not in ("degree", "radian") or not re.fullmatch("[xyzXYZ]{3}", angles["eulerseq"]):
        raise Unusable(f"model_file states angles by {angles}, which is not understood")
    return angles


def _numbers_text(text: str, most: int, what: str) -> str:
    """Return one to ``most`` finite numbers as the text that they were."""
    words = text.split()
    if not 1 <= len(words) <= most or not all(map(_is_number, words)):
        raise Unusable(f"{what} is {text[:60]!r}, expected {most} numbers")
    return " ".join(words)


def _is_number(word: str) -> bool:
    try:
        return math.isfinite(value := float(word)) and abs(value) <= LARGEST_NUMBER
    except ValueError:
        return False
