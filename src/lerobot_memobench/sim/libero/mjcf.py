"""Read the MJCF of LIBERO's classes: bodies, assets and sites that define sizes.

As robosuite, which LIBERO uses, this module resolves default classes, keeps the first of several assets with one name,
and prefixes all names with the instance's name.
"""

from __future__ import annotations

import copy
import posixpath
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.libero import files
from lerobot_memobench.sim.libero.classes import CLASSES, SCANS, Turn

ARENA = "scenes/libero_kitchen_tabletop_base_style.xml"
SCAN_TURNS: tuple[Turn, ...] = (("x", np.pi / 2),)
REFERENCES = ("mesh", "material", "texture")
"""Attributes that reference an asset."""


@dataclass(frozen=True)
class ClassFile:
    """Content of a class's files. Do not modify its elements.

    Attributes:
        body: root body with default classes resolved.
        assets: returns meshes, textures and materials with absolute file paths.
        radius: horizontal radius that must be free of other objects, m.
        bottom, top: heights of underside and top above the origin, m.
        turns: initial rotations, applied in order.
        stand_in: whether a box replaces a missing scan.
    """

    body: ET.Element
    assets: Callable[[], list[ET.Element]]
    radius: float
    bottom: float
    top: float
    turns: tuple[Turn, ...]
    stand_in: bool = False

    @property
    def collides_by_mesh(self) -> bool:
        """Whether collision geometry uses meshes; only scans do."""
        return any("mesh" in geom.attrib and not is_visual(geom) for geom in self.body.iter("geom"))


def is_visual(element: ET.Element) -> bool:
    """Return whether an element is a geom without contacts."""
    return element.tag == "geom" and element.get("contype") == element.get("conaffinity") == "0"


def class_file(class_name: str) -> ClassFile:
    """Return the content of a class's files; a missing scan is replaced by a box.

    Raises:
        MemobenchError: the class is unknown in LIBERO's world, or its files are missing or have unexpected content.
    """
    if class_name in CLASSES:
        return _libero_class(class_name, files.asset(CLASSES[class_name].mjcf))
    path = files.scan(class_name)
    if path is not None:
        return _scanned_class(path)
    if class_name not in SCANS:
        raise MemobenchError(
            f"the world 'libero' has no object of class {class_name!r}, and no size for a replacement box; "
            f"set {files.SCANS_VARIABLE} to the authors' folder new_objects"
        )
    return _box(class_name)


@cache
def _libero_class(class_name: str, path: Path) -> ClassFile:
    known = CLASSES[class_name]
    root = _read(path)
    outer = root.find("worldbody/body")
    body = outer.find("body[@name='object']") if outer is not None else None
    if outer is None or body is None:
        raise MemobenchError(f"{path} contains no body 'object'; expected an object file of LIBERO")
    place = {site.get("name"): parse_numbers(site.get("pos", "")) for site in outer.findall("site")}
    folder = posixpath.dirname(known.mjcf)
    return ClassFile(
        body=_with_defaults_resolved(body, _defaults(root)),
        assets=lambda: assets_of(root, folder),
        radius=place["horizontal_radius_site"][0],
        bottom=place["bottom_site"][2],
        top=place["top_site"][2],
        turns=known.turns,
    )


@cache
def _scanned_class(path: Path) -> ClassFile:
    """Read a scan; its size is computed from vertices because it has no sites."""
    root = _read(path)
    body = root.find("worldbody/body")
    points = [line.split()[1:4] for file in sorted(path.parent.glob("visuals/*.obj")) for line in _vertex_lines(file)]
    if body is None or not points:
        raise MemobenchError(f"the scan {path} lacks its body or its visuals/*.obj; download the scans again")
    vertices = np.array(points, dtype=np.float64)

    def inside(name: str) -> Path:
        file = (path.parent / name).resolve()
        if not file.is_relative_to(path.parent.resolve()) or not file.is_file():
            raise MemobenchError(f"the scan {path} references the file {name!r}, which is not in its folder")
        return file

    return ClassFile(
        body=_with_defaults_resolved(body, _defaults(root)),
        assets=lambda: list(_assets(root, inside)),
        radius=float(np.abs(vertices[:, :2]).max()),
        bottom=float(vertices[:, 2].min()),
        top=float(vertices[:, 2].max()),
        turns=SCAN_TURNS,
    )


def _vertex_lines(file: Path) -> Iterator[str]:
    return (line for line in file.read_text().splitlines() if line.startswith("v "))


@cache
def _box(class_name: str) -> ClassFile:
    """Return a box with the size of this package's object of the class and the contacts of LIBERO's objects."""
    half = SCANS[class_name]
    body = ET.Element("body")
    contact = {"density": "100", "friction": "0.95 0.3 0.1", "solref": "0.001 1", "solimp": "0.998 0.998 0.001"}
    shape = {"type": "box", "size": format_numbers(half), "rgba": "0.62 0.66 0.42 1"}
    ET.SubElement(body, "geom", {**shape, **contact, "group": "0"})
    ET.SubElement(body, "geom", {**shape, "group": "1", "contype": "0", "conaffinity": "0"})
    return ClassFile(body, list, max(half[:2]), -half[2], half[2], SCAN_TURNS, stand_in=True)


# --- MJCF ---


def arena() -> ET.Element:
    """Return the MJCF of LIBERO's kitchen."""
    return _read(files.asset(ARENA))


def _read(path: Path) -> ET.Element:
    try:
        return ET.parse(path).getroot()
    except ET.ParseError as error:
        raise MemobenchError(f"{path} is not a valid XML file ({error})") from None


def parse_numbers(text: str) -> list[float]:
    """Return the numbers of an attribute."""
    return [float(word) for word in text.split()]


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers as an attribute, without loss of precision."""
    return " ".join(repr(float(value)) for value in values)


def _defaults(root: ET.Element) -> dict[tuple[str, str], dict[str, str]]:
    """Return class and tag -> attributes."""
    return {
        (default.get("class", ""), element.tag): dict(element.attrib)
        for default in root.iter("default")
        for element in default
        if element.tag != "default"
    }


def _with_defaults_resolved(body: ET.Element, defaults: dict[tuple[str, str], dict[str, str]]) -> ET.Element:
    """Return a copy of a body with default classes resolved."""
    body = copy.deepcopy(body)
    for element in body.iter():
        named = element.attrib.pop("class", None)
        if named is not None:
            element.attrib.update({**defaults.get((named, element.tag), {}), **element.attrib})
    return body


def assets_of(root: ET.Element, folder: str) -> list[ET.Element]:
    """Return the assets of a LIBERO file in ``folder`` below the assets folder."""
    return list(_assets(root, lambda name: files.asset(posixpath.normpath(posixpath.join(folder, name)))))


def _assets(root: ET.Element, locate: Callable[[str], Path]) -> Iterator[ET.Element]:
    """Yield meshes, textures and materials with absolute file paths, the first of each name."""
    seen = set()
    for element in root.iterfind("asset/*"):
        key = element.tag, element.get("name")
        if key in seen:
            continue
        seen.add(key)
        element = copy.deepcopy(element)
        if "file" in element.attrib:
            element.set("file", str(locate(element.attrib["file"])))
        yield element


def instance(class_name: str, name: str, known: ClassFile) -> ET.Element:
    """Return the body of an instance with prefixed names; assets are shared by the class."""
    body = copy.deepcopy(known.body)
    for element in body.iter():
        if "name" in element.attrib:
            element.set("name", f"{name}_{element.attrib['name']}")
        for attribute in element.attrib.keys() & REFERENCES:
            element.set(attribute, f"{class_name}_{element.attrib[attribute]}")
    body.set("name", name)
    return body


def shared_assets(class_name: str, known: ClassFile) -> list[ET.Element]:
    """Return a class's assets, prefixed with its name."""
    named = []
    for element in known.assets():
        element.set("name", f"{class_name}_{element.get('name')}")
        if "texture" in element.attrib:
            element.set("texture", f"{class_name}_{element.attrib['texture']}")
        named.append(element)
    return named
