"""Build objects and fixtures into a ``mujoco.MjSpec``.

An asset is a function of a `Builder` that adds visual geoms (group 1, without contacts or mass), invisible collision
geoms (group 0) and sites below one root body, and returns an `Asset`. For frames and units see `sim.assets.asset`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.assets.asset import Articulation, Asset, Grasp
from lerobot_memobench.sim.assets.meshes import MeshData
from lerobot_memobench.sim.assets.paint import Pixels

VISUAL_GROUP = 1
COLLISION_GROUP = 0
SITE_GROUP = 4

# Contacts are stiff enough to avoid visible sinking, and slow enough (5 physics steps) to be stable at 2 ms.
SOLREF = (0.01, 1.0)
SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
FRICTION = (1.0, 0.02, 0.0005)
GRIP_FRICTION = (1.8, 0.03, 0.0005)

Vector = Sequence[float] | NDArray[np.float64]

Primitive = Literal["box", "cylinder"]
_TYPES: dict[Primitive, mujoco.mjtGeom] = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}
ORIGIN = (0.0, 0.0, 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
"""Identity quaternion wxyz."""


class Builder:
    """Build one instance of an asset into a shared ``MjSpec``.

    Bodies, geoms, joints and sites are named ``f"{name}_{suffix}"``.
    """

    def __init__(self, spec: mujoco.MjSpec, name: str, class_name: str, variant: int = 0) -> None:
        """Add the root body ``name`` to the world; the scene sets its pose and adds free joints of objects."""
        self.spec, self.name, self.class_name, self.variant = spec, name, class_name, variant
        self.body: mujoco.MjsBody = spec.worldbody.add_body(name=name)
        self._counts: dict[str, int] = {}
        self._grasps: list[Grasp] = []

    # --- names

    def full(self, suffix: str) -> str:
        """Return the full element name of ``suffix``."""
        return f"{self.name}_{suffix}"

    def _fresh(self, kind: str) -> str:
        self._counts[kind] = self._counts.get(kind, -1) + 1
        return self.full(f"{kind}{self._counts[kind]}")

    # --- textures, materials and meshes: created once per key and scene

    def material(
        self,
        key: str,
        image: Callable[[], Pixels] | None = None,
        rgba: Vector = (1.0, 1.0, 1.0, 1.0),
        specular: float = 0.2,
        shininess: float = 0.3,
        emission: float = 0.0,
    ) -> str:
        """Return the name of the material ``key``, created on first use; ``image`` draws its texture."""
        name = f"memobench_{key}"
        if self.spec.material(name) is not None:
            return name
        made = self.spec.add_material(name=name, rgba=list(rgba), specular=specular, shininess=shininess)
        made.emission = emission
        if image is not None:
            pixels = np.ascontiguousarray(image(), dtype=np.uint8)
            height, width, _ = pixels.shape
            texture = self.spec.add_texture(
                name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, height=height, width=width, nchannel=3
            )
            texture.data = pixels.tobytes()
            made.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        return name

    def mesh(self, key: str, make: Callable[[], MeshData], smooth: bool = False) -> str:
        """Return the name of the mesh ``key``, created on first use; ``smooth`` shades sharp edges as round."""
        name = f"memobench_{key}"
        if self.spec.mesh(name) is not None:
            return name
        data = make()
        made = self.spec.add_mesh(
            name=name,
            uservert=data.vertices.astype(np.float32).ravel(),
            userface=data.faces.astype(np.int32).ravel(),
            smoothnormal=smooth,
        )
        made.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        if data.uv is not None:
            made.usertexcoord = data.uv.astype(np.float32).ravel()
            indices = data.faces if data.uv_faces is None else data.uv_faces
            made.userfacetexcoord = indices.astype(np.int32).ravel()
        return name

    # --- bodies and joints

    def child(self, suffix: str, pos: Vector = ORIGIN) -> mujoco.MjsBody:
        """Add a body below the root."""
        return self.body.add_body(name=self.full(suffix), pos=list(pos))

    def joint(
        self,
        body: mujoco.MjsBody,
        suffix: str,
        kind: Literal["slide", "hinge"],
        axis: Vector,
        limits: tuple[float, float],
        damping: float,
        frictionloss: float,
    ) -> str:
        """Add a joint limited to ``limits`` [m or rad] to ``body`` and return its full name."""
        name = self.full(suffix)
        kinds = {"slide": mujoco.mjtJoint.mjJNT_SLIDE, "hinge": mujoco.mjtJoint.mjJNT_HINGE}
        # The compiler option of the spec defines the unit of hinge limits.
        in_degrees = kind == "hinge" and self.spec.compiler.degree
        body.add_joint(
            name=name,
            type=kinds[kind],
            axis=list(axis),
            range=list(np.degrees(limits) if in_degrees else limits),
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            damping=damping,
            frictionloss=frictionloss,
            armature=0.001,
            solref_limit=[0.01, 1.0],
        )
        return name

    # --- geoms and sites

    def visual_mesh(self, mesh: str, material: str, body: mujoco.MjsBody | None = None) -> mujoco.MjsGeom:
        """Add a visual mesh without contacts."""
        return self._seen(body, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh, material=material)

    def textured_mesh(
        self,
        key: str,
        make: Callable[[], MeshData],
        image: Callable[[], Pixels],
        specular: float,
        shininess: float,
        smooth: bool = False,
    ) -> None:
        """Add a visual mesh with its texture; both are named ``key``."""
        mesh = self.mesh(key, make, smooth)
        self.visual_mesh(mesh, self.material(key, image, specular=specular, shininess=shininess))

    def visual(
        self, kind: Primitive, size: Vector, material: str, pos: Vector = ORIGIN, quat: Vector = UPRIGHT
    ) -> None:
        """Add a visual primitive without contacts; for round shapes meshes have fewer faces."""
        self._seen(None, type=_TYPES[kind], size=_size(size), material=material, pos=list(pos), quat=list(quat))

    def _seen(self, body: mujoco.MjsBody | None, **given: Any) -> mujoco.MjsGeom:
        seen = {"contype": 0, "conaffinity": 0, "group": VISUAL_GROUP, "mass": 0.0}
        return (body or self.body).add_geom(name=self._fresh("visual"), **seen, **given)

    def collision(
        self,
        kind: Primitive,
        size: Vector,
        mass: float,
        pos: Vector = ORIGIN,
        quat: Vector = UPRIGHT,
        body: mujoco.MjsBody | None = None,
        friction: Vector = FRICTION,
    ) -> mujoco.MjsGeom:
        """Add an invisible collision primitive of mass ``mass`` [kg]."""
        return (body or self.body).add_geom(
            name=self._fresh("collision"),
            type=_TYPES[kind],
            size=_size(size),
            pos=list(pos),
            quat=list(quat),
            mass=mass,
            group=COLLISION_GROUP,
            rgba=[0.2, 0.8, 0.2, 0.4],
            friction=list(friction),
            condim=4,
            solref=list(SOLREF),
            solimp=list(SOLIMP),
        )

    def ring(
        self,
        count: int,
        low: tuple[float, float],
        high: tuple[float, float],
        thickness: float,
        mass: float,
        friction: Vector = FRICTION,
    ) -> None:
        """Add tilted collision boxes around z; the wall's centre line runs from (radius, z) ``low`` to ``high``."""
        (r0, z0), (r1, z1) = low, high
        slant = np.hypot(r1 - r0, z1 - z0)
        along = np.array([(r1 - r0) / slant, 0.0, (z1 - z0) / slant])
        out = np.array([along[2], 0.0, -along[0]])
        middle = np.array([(r0 + r1) / 2, 0.0, (z0 + z1) / 2])
        half_width = max(r0, r1) * np.tan(np.pi / count)
        upright = np.stack([out, [0.0, 1.0, 0.0], along], axis=1)
        for k in range(count):
            angle = 2 * np.pi * k / count
            c, s = np.cos(angle), np.sin(angle)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            quat = np.zeros(4)
            mujoco.mju_mat2Quat(quat, (turn @ upright).ravel())
            half = (thickness / 2, half_width, slant / 2)
            self.collision("box", half, mass / count, turn @ middle, quat, friction=friction)

    def site(
        self,
        suffix: str,
        pos: Vector,
        size: Vector = (0.005, 0.005, 0.005),
        quat: Vector = UPRIGHT,
        body: mujoco.MjsBody | None = None,
        box: bool = False,
    ) -> str:
        """Add a site and return its full name; ``size`` holds half sizes when ``box``."""
        name = self.full(suffix)
        kind = mujoco.mjtGeom.mjGEOM_BOX if box else mujoco.mjtGeom.mjGEOM_SPHERE
        (body or self.body).add_site(
            name=name,
            pos=list(pos),
            quat=list(quat),
            size=_size(size),
            type=kind,
            group=SITE_GROUP,
            rgba=[0.2, 0.5, 1.0, 0.3],
        )
        return name

    # --- metadata

    def grasp(self, position: Vector, yaw: float, width: float, symmetric: bool = False) -> None:
        """Note a way to hold the object from above."""
        self._grasps.append(Grasp(_triple(position), yaw, float(width), symmetric))

    def object(
        self,
        low: Vector,
        high: Vector,
        round: bool = False,
        floor: float | None = None,
        clear: float | None = None,
    ) -> Asset:
        """Return the metadata of an object; ``floor`` and ``clear``: height and radius of a container's inside [m]."""
        x, y, top = _triple(high)
        return Asset(
            name=self.name,
            class_name=self.class_name,
            kind="object",
            low=_triple(low),
            high=(x, y, top),
            grasps=tuple(self._grasps),
            supports=top if floor is None else floor,
            clear_radius=min(x, y) if clear is None else clear,
            round=round,
        )

    def fixture(
        self,
        low: Vector,
        high: Vector,
        regions: Mapping[str, str],
        articulations: Mapping[str, Articulation] | None = None,
        supports: float | None = None,
        clear: float = 0.0,
        glow: tuple[str, ...] = (),
    ) -> Asset:
        """Return the metadata of a fixture; ``supports`` and ``clear``: height and radius of its top [m]."""
        return Asset(
            name=self.name,
            class_name=self.class_name,
            kind="fixture",
            low=_triple(low),
            high=_triple(high),
            articulations=MappingProxyType(dict(articulations or {})),
            regions=MappingProxyType(dict(regions)),
            supports=high[2] if supports is None else supports,
            clear_radius=clear,
            glow=glow,
        )


def _size(size: Vector) -> list[float]:
    values = [float(v) for v in size]
    return values + [0.0] * (3 - len(values))


def _triple(values: Vector) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return (x, y, z)


def axis_angle_quaternion(axis: Vector, angle: float) -> list[float]:
    """Return the quaternion (w, x, y, z) of a rotation by ``angle`` [rad] about ``axis``."""
    quat = np.zeros(4)
    mujoco.mju_axisAngle2Quat(quat, np.asarray(axis, dtype=np.float64), angle)
    return [float(v) for v in quat]
