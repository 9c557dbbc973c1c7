"""Generate the files of the objects that LIBERO lacks: ``python scripts/objects.py``.

``--check`` lists differing files. Visual meshes and textures are those of the Python-modelled objects in `sim.assets`;
contacts are one box of each class. When that package is deleted, delete this script too: its output,
`src/lerobot_memobench/sim/objects`, is then the source.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.io import write_file
from lerobot_memobench.sim.assets.builder import VISUAL_GROUP
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.sim.libero.files import OWN_OBJECTS

HALF_SIZES: dict[str, tuple[float, float, float]] = {
    "artichoke": (0.029, 0.029, 0.026),
    "bag_of_snacks": (0.023, 0.048, 0.060),
    "bean_curd": (0.025, 0.030, 0.018),
    "beefsteak_tomato__1": (0.031, 0.031, 0.026),
    "biscuit": (0.029, 0.029, 0.012),
    "bottle_of_coffee": (0.029, 0.029, 0.069),
    "bottle_of_detergent__1": (0.029, 0.044, 0.075),
    "bottle_of_fabric_softener": (0.027, 0.038, 0.078),
    "bottle_of_olive_oil__1": (0.027, 0.027, 0.086),
    "bottle_of_protein_powder__2": (0.033, 0.033, 0.060),
    "box_of_cereal__2": (0.021, 0.050, 0.072),
    "box_of_flour": (0.028, 0.043, 0.066),
    "box_of_oatmeal__3": (0.024, 0.048, 0.069),
    "broccoli": (0.032, 0.032, 0.026),
    "brussels_sprouts__2": (0.025, 0.025, 0.024),
    "cap__2": (0.026, 0.026, 0.015),
    "carton_of_milk__6": (0.031, 0.031, 0.079),
    "charger": (0.044, 0.027, 0.019),
    "chestnut__2": (0.020, 0.024, 0.018),
    "cork__3": (0.019, 0.019, 0.026),
}
"""Class -> half extents of its box, m, z up."""
CREASE_COSINE = 0.8
"""Smallest cosine between normals of neighbouring faces of a smooth edge."""
TEXTURE_SIDES = (64, 128)
"""Sides of textures, pixels: the second one for images of more than 64 pixels."""
CONTACTS = 'density="100" friction="0.95 0.3 0.1" solref="0.001 1" solimp="0.998 0.998 0.001"'
"""Contact parameters of LIBERO's objects."""
FILE = """\
<mujoco model="{name}">
  <asset>
    {assets}
  </asset>
  <worldbody>
    <body>
      <body name="object">
        {geoms}
        <geom type="box" size="{half}" group="0" rgba="0.62 0.66 0.42 1" {contacts}/>
      </body>
      <site name="bottom_site" pos="0 0 {bottom}" size="0.005" rgba="0 0 0 0"/>
      <site name="top_site" pos="0 0 {top}" size="0.005" rgba="0 0 0 0"/>
      <site name="horizontal_radius_site" pos="{radius} 0 0" size="0.005" rgba="0 0 0 0"/>
    </body>
  </worldbody>
</mujoco>
"""

Floats = NDArray[np.float64]
Pixels = NDArray[np.uint8]


def files_of(class_name: str) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of a class's files: one mesh, and one material or texture, of each visual geom."""
    half = HALF_SIZES[class_name]
    spec = mujoco.MjSpec()
    build_asset(spec, "object", class_name)
    visuals = [geom for geom in spec.body("object").geoms if geom.group == VISUAL_GROUP]
    points = [np.array(spec.mesh(geom.meshname).uservert).reshape(-1, 3) for geom in visuals]
    low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    offset = np.array([*-(low + high)[:2] / 2, -half[2] - low[2]])  # centred, standing on the underside of the box
    assets, geoms = [], []
    for geom, vertices in zip(visuals, points, strict=True):
        mesh, material = spec.mesh(geom.meshname), spec.material(geom.material)
        part, paint = geom.meshname.removeprefix("memobench_"), geom.material.removeprefix("memobench_")
        yield f"{part}.obj", _mesh_text(mesh, vertices + offset).encode()
        look = f'specular="{material.specular:g}" shininess="{material.shininess:g}"'
        image = material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB]
        if image:
            yield f"{paint}.png", _png(spec.texture(image))
            assets.append(f'<texture name="tex-{paint}" type="2d" file="{paint}.png"/>')
            assets.append(f'<material name="{paint}" texture="tex-{paint}" {look}/>')
        else:
            assets.append(f'<material name="{paint}" rgba="{_words(material.rgba)}" {look}/>')
        assets.append(f'<mesh name="{part}" file="{part}.obj" inertia="shell"/>')
        geoms.append(f'<geom type="mesh" mesh="{part}" material="{paint}" group="1" contype="0" conaffinity="0"/>')
    text = FILE.format(
        name=class_name,
        assets="\n    ".join(assets),
        geoms="\n        ".join(geoms),
        half=_words(half),
        contacts=CONTACTS,
        bottom=-half[2],
        top=half[2],
        radius=max(half[:2]),
    )
    yield f"{class_name}.xml", text.encode()


def _words(values: NDArray[np.floating] | tuple[float, ...]) -> str:
    return " ".join(f"{float(value):g}" for value in values)


def _mesh_text(mesh: mujoco.MjsMesh, vertices: Floats) -> str:
    """Return a mesh as OBJ text: positions in steps of 0.1 mm, normals of 0.01, texture coordinates of 0.001."""
    points, point_of = _distinct(vertices, 4)
    corners = point_of[np.array(mesh.userface).reshape(-1, 3)]
    whole = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    corners = corners[whole]
    normals, normal_of = _distinct(_normals(points, corners, CREASE_COSINE if not mesh.smoothnormal else -1.0), 2)
    lines = [f"v {_words(point)}" for point in points] + [f"vn {_words(normal)}" for normal in normals]
    indices = [corners, normal_of.reshape(-1, 3)]
    if len(mesh.usertexcoord):
        flipped = np.array(mesh.usertexcoord).reshape(-1, 2) * [1, -1] + [0, 1]  # v points up in OBJ files
        uv, uv_of = _distinct(flipped, 3)
        lines += [f"vt {_words(place)}" for place in uv]
        indices.insert(1, uv_of[np.array(mesh.userfacetexcoord).reshape(-1, 3)[whole]])
    form = "/".join(["{}"] * 3) if len(indices) == 3 else "{}//{}"
    faces = np.stack(indices, axis=2) + 1
    lines += ["f " + " ".join(form.format(*corner) for corner in face) for face in faces]
    return "\n".join([*lines, ""])


def _distinct(rows: Floats, decimals: int) -> tuple[Floats, NDArray[np.int64]]:
    """Return the distinct rounded rows, without negative zeros, and the index of each row in them."""
    found, index = np.unique(np.round(rows, decimals) + 0.0, axis=0, return_inverse=True)
    return found, index.reshape(-1)


def _normals(points: Floats, corners: NDArray[np.int64], crease: float) -> Floats:
    """Return a normal for each corner (3 M, 3), the mean of the faces at its point within the crease angle."""
    a, b, c = (points[corners[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    flat = area / np.maximum(np.linalg.norm(area, axis=1, keepdims=True), 1e-12)
    normals = []
    for face, point in zip(np.repeat(np.arange(len(corners)), 3), corners.ravel(), strict=True):
        near = (corners == point).any(axis=1) & (flat @ flat[face] >= crease)
        total = area[near].sum(axis=0)
        normals.append(total / max(np.linalg.norm(total), 1e-12))
    return np.array(normals)


def _png(texture: mujoco.MjsTexture) -> bytes:
    """Return a texture as a square PNG file."""
    pixels = np.frombuffer(bytes(texture.data), np.uint8).reshape(texture.height, texture.width, 3)
    side = TEXTURE_SIDES[max(pixels.shape) > TEXTURE_SIDES[0]]
    buffer = io.BytesIO()
    Image.fromarray(pixels).resize((side, side), Image.Resampling.LANCZOS).save(buffer, "PNG", optimize=True)
    return buffer.getvalue()


def stale() -> list[str]:
    """Return the files that are missing, superfluous or of other content; of images the pixels are compared."""
    expected = {f"{name}/{file}": content for name in HALF_SIZES for file, content in files_of(name)}
    found = {path.relative_to(OWN_OBJECTS).as_posix(): path.read_bytes() for path in OWN_OBJECTS.glob("*/*")}
    names = sorted(expected.keys() | found.keys())
    return [name for name in names if not _equal(expected.get(name), found.get(name), name.endswith(".png"))]


def _equal(a: bytes | None, b: bytes | None, image: bool) -> bool:
    if image and a is not None and b is not None:
        return Image.open(io.BytesIO(a)).tobytes() == Image.open(io.BytesIO(b)).tobytes()
    return a == b


if __name__ == "__main__":
    if "--check" in sys.argv[1:]:
        sys.exit("\n".join(stale()) or 0)
    for name in HALF_SIZES:
        (OWN_OBJECTS / name).mkdir(parents=True, exist_ok=True)
        for file, content in files_of(name):
            write_file(OWN_OBJECTS / name / file, content)
        print(OWN_OBJECTS / name)
