"""Read the MJCF of LIBERO's classes: bodies, assets and sites that define sizes.

As robosuite, which LIBERO uses, this module resolves default classes, keeps the first of several assets with one name,
and prefixes all names with the instance's name.
"""

from __future__ import annotations

import copy
import posixpath
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.io import file_name
from lerobot_memobench.sim import files
from lerobot_memobench.sim.asset import ALL_CLASSES, ARENAS, CLASSES, QUARTER, TABLE, Turn, split_class
from lerobot_memobench.tasks.task import STRICT
from lerobot_memobench.untrusted import refusing

SCAN_TURNS: tuple[Turn, ...] = (QUARTER,)
REFERENCES = ("mesh", "material", "texture")  # attributes that reference an asset
USER_TAGS = ("mujoco", "asset", "mesh", "texture", "material", "worldbody", "body", "geom", "site")
"""Elements of a user's object file."""
SIZE_SITES = ("bottom_site", "top_site", "horizontal_radius_site")
GUIDE = "docs/develop/add_an_object_class.md"


@dataclass(frozen=True)
class ClassFile:
    """Content of a class's files. Do not modify its elements."""

    body: ET.Element  # root body with default classes resolved
    assets: Callable[[], list[ET.Element]]  # returns meshes, textures and materials with absolute file paths
    radius: float  # horizontal radius that must be free of other objects, m
    bottom: float  # height of the underside above the origin, m
    top: float
    turns: tuple[Turn, ...]  # initial rotations, applied in order
    stand_in: bool = False  # whether this package's object replaces a missing scan

    @property
    def collides_by_mesh(self) -> bool:
        """Whether collision geometry uses meshes; only scans do."""
        return any("mesh" in geom.attrib and not is_visual(geom) for geom in self.body.iter("geom"))


def is_visual(element: ET.Element) -> bool:
    """Return whether an element is a geom without contacts."""
    return element.tag == "geom" and element.get("contype") == element.get("conaffinity") == "0"


def class_file(class_name: str, suite: str) -> ClassFile:
    """Return the content of a class's files: LIBERO's, this package's, the user's or a scan's."""
    own = own_objects()
    user_classes = files.user_objects({*ARENAS, *ALL_CLASSES, *own})
    if class_name in ALL_CLASSES:
        known = ALL_CLASSES[class_name]
        mjcf = known.mjcf(class_name)
        return _object_class(files.asset(mjcf), known.turns, posixpath.dirname(mjcf))
    if file_name(class_name, "the class of an object") in user_classes:
        return _user_class(user_classes[class_name])
    # Published tasks use the authors' scan if the user has it; strict tasks are equal for all users.
    scan = files.scan(class_name) if suite != STRICT else None
    if scan is not None:
        return _scanned_class(scan)
    if class_name not in own:
        near = nearest(class_name, {*ALL_CLASSES, *own, *user_classes})
        add = f"set {files.OBJECTS_VARIABLE} to a folder with {class_name}/{class_name}.xml, see {GUIDE}"
        raise MemobenchError(f"there is no class {class_name!r} ({near}); to add it, {add}")
    return replace(_object_class(own[class_name], SCAN_TURNS), stand_in=suite != STRICT)


@cache
def own_objects() -> dict[str, Path]:
    """Return class -> MJCF file of this package's objects."""
    return {folder.name: folder / f"{folder.name}.xml" for folder in files.OWN_OBJECTS.iterdir()}


def known_classes() -> list[str]:
    """Return the classes that scenes may contain, sorted, each family of variants (`split_class`) once."""
    return sorted({TABLE, *CLASSES, *(split_class(name)[0] for name in own_objects())})


@cache
def _user_class(path: Path) -> ClassFile:
    """Read a file of the user's folder after checking that it is complete and references its own folder only."""

    def expect(holds: bool, found: str, expected: str) -> None:
        if not holds:
            raise MemobenchError(f"{path}: found {found}, expected {expected}; see {GUIDE}")

    with refusing(lambda reason: MemobenchError(f"{path} is no object file ({reason}); see {GUIDE}")):
        root, real = ET.parse(path).getroot(), path.resolve()
        expect(real == path.parents[1].resolve() / path.parent.name / path.name, f"a link to {real}", "a file")
        for element in root.iter():
            expect(element.tag in USER_TAGS, f"the element <{element.tag}>", f"only {', '.join(USER_TAGS)}")
            for name in element.attrib:
                expect(name == "file" or not name.startswith("file"), f"the attribute {name!r}", "'file' only")
        have_names = all(asset.get("name") for asset in root.iterfind("asset/*"))
        expect(have_names, "an asset without a name", "a name for each")
        geoms, bodies = root.findall("worldbody/body/body[@name='object']//geom"), root.findall("worldbody/body")
        whole = len(geoms) == len(list(root.iter("geom"))) and len(bodies) == 1
        expect(whole, "another structure", "one body in <worldbody>, and in it a body 'object' with all geoms")
        missing = {*SIZE_SITES} - {site.get("name", "") for site in root.iterfind("worldbody/body/site[@pos]")}
        expect(
            not missing, f"no pos of {', '.join(sorted(missing))}", f"sites {', '.join(SIZE_SITES)} in the outer body"
        )
        list(_assets(root, _inside(path)))
        model = mujoco.MjSpec.from_file(str(path)).compile()
        touching = (model.geom_contype | model.geom_conaffinity) > 0
        expect(touching[model.geom_group == 0].any(), "no contact geom in group 0", "at least one")
        known = _object_class(path, SCAN_TURNS)
        heights = f"bottom_site at z={known.bottom:g} and top_site at z={known.top:g}"
        expect(-np.inf < known.bottom < known.top < np.inf, heights, "bottom_site below top_site, m")
        expect(0 < known.radius < np.inf, f"horizontal_radius_site at x={known.radius:g}", "a positive radius, m")
    return known


@cache
def _object_class(path: Path, turns: tuple[Turn, ...], folder: str | None = None) -> ClassFile:
    """Read a file in LIBERO's layout; its assets are verified if it is in ``folder`` below LIBERO's assets."""
    root = _read(path)
    outer = root.find("worldbody/body")
    body = outer.find("body[@name='object']") if outer is not None else None
    if outer is None or body is None:
        raise MemobenchError(f"{path} contains no body 'object'; expected an object file of LIBERO")
    positions = {site.get("name"): parse_numbers(site.get("pos", "")) for site in outer.findall("site")}
    return ClassFile(
        body=_resolved(body, root),
        assets=lambda: list(_assets(root, _inside(path))) if folder is None else assets_of(root, folder),
        radius=positions["horizontal_radius_site"][0],
        bottom=positions["bottom_site"][2],
        top=positions["top_site"][2],
        turns=turns,
    )


def _inside(path: Path) -> Callable[[str], Path]:
    def inside(name: str) -> Path:
        file = (path.parent / name).resolve()
        if not file.is_relative_to(path.parent.resolve()) or not file.is_file():
            raise MemobenchError(f"{path} references the file {name!r}, which is not in its folder")
        return file

    return inside


@cache
def _scanned_class(path: Path) -> ClassFile:
    """Read a scan; its size is computed from vertices because it has no sites."""
    root = _read(path)
    body = root.find("worldbody/body")
    lines = (line for file in sorted(path.parent.glob("visuals/*.obj")) for line in file.read_text().splitlines())
    points = [line.split()[1:4] for line in lines if line.startswith("v ")]
    if body is None or not points:
        raise MemobenchError(f"the scan {path} lacks its body or its visuals/*.obj; download the scans again")
    vertices = np.array(points, dtype=np.float64)
    return ClassFile(
        body=_resolved(body, root),
        assets=lambda: list(_assets(root, _inside(path))),
        radius=float(np.abs(vertices[:, :2]).max()),
        bottom=float(vertices[:, 2].min()),
        top=float(vertices[:, 2].max()),
        turns=SCAN_TURNS,
    )


# --- MJCF ---


def arena(file: str) -> ET.Element:
    """Return the MJCF of an arena, a path below LIBERO's assets folder."""
    return _read(files.asset(file))


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


def _resolved(body: ET.Element, root: ET.Element) -> ET.Element:
    defaults = {
        (default.get("class", ""), element.tag): element.attrib
        for default in root.iter("default")
        for element in default
        if element.tag != "default"
    }
    body = copy.deepcopy(body)
    for element in body.iter():
        default_class = element.attrib.pop("class", None)
        if default_class is not None:
            element.attrib.update({**defaults.get((default_class, element.tag), {}), **element.attrib})
    return body


def assets_of(root: ET.Element, folder: str) -> list[ET.Element]:
    """Return the assets of a LIBERO file in ``folder`` below the assets folder."""
    paths = files.verified()
    return list(_assets(root, lambda name: paths[posixpath.normpath(posixpath.join(folder, name))]))


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
    assets = []
    for element in known.assets():
        element.set("name", f"{class_name}_{element.get('name')}")
        if "texture" in element.attrib:
            element.set("texture", f"{class_name}_{element.attrib['texture']}")
        assets.append(element)
    return assets
