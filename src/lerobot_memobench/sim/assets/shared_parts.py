"""Textures, materials and meshes of a scene, made once and shared: nine cartons have one of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.assets.meshes import MeshData
from lerobot_memobench.sim.assets.paint import Pixels

Vector = Sequence[float] | NDArray[np.float64]


class SharedParts:
    """What one ``MjSpec`` holds once, by key."""

    def __init__(self, spec: mujoco.MjSpec) -> None:
        self.spec = spec

    def material(
        self,
        key: str,
        image: Callable[[], Pixels] | None = None,
        rgba: Vector = (1.0, 1.0, 1.0, 1.0),
        specular: float = 0.2,
        shininess: float = 0.3,
        reflectance: float = 0.0,
        emission: float = 0.0,
    ) -> str:
        """Return the name of the material ``key``, made on first use; ``image`` draws its texture."""
        name = f"memobench_{key}"
        if self.spec.material(name) is not None:
            return name
        made = self.spec.add_material(name=name, rgba=list(rgba), specular=specular, shininess=shininess)
        made.reflectance = reflectance
        made.emission = emission
        if image is not None:
            self._texture(name, np.ascontiguousarray(image(), dtype=np.uint8))
            made.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
        return name

    def _texture(self, name: str, pixels: Pixels) -> None:
        texture = self.spec.add_texture(
            name=name,
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            height=pixels.shape[0],
            width=pixels.shape[1],
            nchannel=3,
        )
        texture.data = pixels.tobytes()

    def mesh(self, key: str, make: Callable[[], MeshData], smooth: bool = False) -> str:
        """Return the name of the mesh ``key``, made on first use; ``smooth`` shades sharp edges as round."""
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
