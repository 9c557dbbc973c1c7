"""Read triangle meshes and thin them out: a rendered face costs the same whether it is a pixel or not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError

Vertices = NDArray[np.float64]
"""(N, 3) points, m."""
Faces = NDArray[np.int32]
"""(M, 3) indices of vertices, counter-clockwise from outside."""


def read_mesh(path: Path) -> tuple[Vertices, Faces]:
    """Read the points and triangles of an OBJ or binary STL file, equal points merged.

    Raises:
        MemobenchError: for any other kind of file.
    """
    corners: NDArray[np.float64]
    faces: NDArray[np.integer]
    suffix = path.suffix.lower()
    if suffix == ".stl":
        raw = path.read_bytes()
        count = int.from_bytes(raw[80:84], "little")
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        corners = np.frombuffer(raw, record, count, offset=84)["corners"].reshape(-1, 3).astype(np.float64)
        faces = np.arange(3 * count).reshape(-1, 3)
    elif suffix == ".obj":
        lines = path.read_text().splitlines()
        corners = np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=np.float64)
        polygons = [[int(c.split("/")[0]) for c in line.split()[1:]] for line in lines if line.startswith("f ")]
        faces = np.array([[p[0], p[i], p[i + 1]] for p in polygons for i in range(1, len(p) - 1)])
        faces = np.where(faces > 0, faces - 1, faces + len(corners))
    else:
        raise MemobenchError(f"cannot read the mesh {path}: expected an .obj or binary .stl file")
    return weld(corners, faces.astype(np.int32), 1e-6)


def weld(vertices: Vertices, faces: Faces, cell: float) -> tuple[Vertices, Faces]:
    """Merge the points that share a cell of a grid, m, and drop the faces that collapse."""
    grid = np.round(vertices / cell).astype(np.int64)
    _, first, index = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1)[faces].astype(np.int32)
    whole = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return vertices[first], faces[whole]


def area(vertices: Vertices, faces: Faces) -> float:
    """Return the surface of a mesh, m²."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def simplify(vertices: Vertices, faces: Faces, target: int) -> tuple[Vertices, Faces]:
    """Reduce a mesh to about ``target`` faces by quadric edge collapse; smaller meshes come back as they are.

    CAD meshes are many loose shells, at whose seams no edge may collapse: points much nearer to each other than the
    faces to come are merged first.
    """
    if len(faces) <= target:
        return vertices, faces
    side = np.sqrt(2 * area(vertices, faces) / target)
    vertices, faces = weld(vertices, faces, side / 6)
    if len(faces) <= target:
        return vertices, faces
    import fast_simplification  # only the first scene on a machine needs it

    points, triangles = fast_simplification.simplify(vertices.astype(np.float32), faces, target_count=target, agg=5)
    return points.astype(np.float64), triangles.astype(np.int32)
