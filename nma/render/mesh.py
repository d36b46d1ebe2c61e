"""Loads a mesh from a file, to show it in place of the shader ball."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nma.errors import NmaError, either, one_line
from nma.render.adapter_bsdf import load_once

KINDS = {".ply": "ply", ".obj": "obj"}
AXES = ("z", "y")
WIDTH, HEIGHT = 2.0, 2.12  # size of the shader ball; the mesh is scaled to this size
LIFT = 1e-3  # height of the mesh above the floor, so that flat meshes are visible
ATTRIBUTES = {"positions": 3, "normals": 3, "texcoords": 2}


class MeshError(NmaError, ValueError):
    """A mesh cannot be read, or cannot be shown; the message names the file and the fault."""


def mesh_shape(path: str | Path, *, up: str = "z", coordinates: bool = False) -> dict[str, Any]:
    """Mitsuba's dictionary of a mesh that is moved to the place of the shader ball and scaled to the ball's size.

    Normals and texture coordinates come from the file. Mitsuba computes the normals if the file has none.

    Args:
        path: a PLY or OBJ file.
        up: the mesh's axis that points up, "z" or "y".
        coordinates: whether texture coordinates are needed.

    Raises:
        MeshError: the file does not exist or is not a mesh, the axis is unknown, or the mesh has no triangles, no
            extent, values that are not finite, or no texture coordinates although they are needed.
    """
    import mitsuba as mi

    if up not in AXES:
        raise MeshError(f"the mesh's axis {up!r} cannot point up; choose {either(AXES)}")
    description = _description(Path(path))
    mesh = _load(description, path)
    if coordinates and not mesh.has_vertex_texcoords():
        raise MeshError(
            f"mesh {path} has no texture coordinates (UVs), which this material needs; UV-unwrap the mesh first"
        )
    to_world = mi.ScalarTransform4f().rotate([1.0, 0.0, 0.0], 90.0 if up == "y" else 0.0)
    points = _points(mesh, path) @ np.array(to_world.matrix)[:3, :3].T
    return description | {"to_world": _place(points, path) @ to_world}


def needs_coordinates(bsdf: Mapping[str, Any]) -> bool:
    """Whether a BSDF needs texture coordinates: its dictionary has a texture or an anisotropic adapter."""
    import mitsuba as mi

    if bsdf.get("type") == "nma" and "adapter" in bsdf and load_once(bsdf["adapter"]).anisotropic:
        return True
    plain = ("rgb", "spectrum", "uniform")
    values = [value for value in bsdf.values() if isinstance(value, Mapping | mi.Texture)]
    return any(not isinstance(value, Mapping) or value.get("type") not in plain for value in values)


def _description(path: Path) -> dict[str, Any]:
    kind = KINDS.get(path.suffix.lower())
    if kind is None:
        raise MeshError(f"mesh {path} must end in {either(KINDS)}")
    if not path.is_file():
        raise MeshError(f"there is no mesh {path}")
    return {"type": kind, "filename": str(path)}


def _load(description: dict[str, Any], path: str | Path) -> Any:
    import mitsuba as mi

    try:
        # When Mitsuba computes the normals of a mesh, Mitsuba fails if there are no triangles, and writes out of bounds
        # if a vertex index is wrong. Therefore, the faces are checked first, on a mesh with `face_normals`, for which
        # Mitsuba computes no normals.
        _check_faces(mi.load_dict(description | {"face_normals": True}), path)
        return mi.load_dict(description)
    except RuntimeError as error:
        raise MeshError(f"mesh {path} cannot be read: {one_line(str(error))}") from error


def _check_faces(mesh: Any, path: str | Path) -> None:
    import mitsuba as mi

    if mesh.face_count() == 0:
        raise MeshError(f"mesh {path} is empty: it has no triangles")
    corners = np.array(mi.traverse(mesh)["faces"], dtype=np.int64)
    beyond = corners >= mesh.vertex_count()
    if beyond.any():
        first = int(np.argmax(beyond))
        raise MeshError(
            f"mesh {path}: triangle {first // 3} refers to vertex {corners[first]}, "
            f"but the mesh has {mesh.vertex_count()} vertices, counted from 0; export the mesh again"
        )


def _points(mesh: Any, path: str | Path) -> NDArray[np.float64]:
    """The corners (n, 3) of all triangles, one triangle after another. Raises `MeshError` if a position, a normal or a
    texture coordinate is not finite."""
    import mitsuba as mi

    params = mi.traverse(mesh)
    for name, size in ATTRIBUTES.items():
        values = np.array(params[f"vertex_{name}"], dtype=np.float64).reshape(-1, size)
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise MeshError(
                f"mesh {path}: {name} of vertex {np.argmax(bad)} are NaN or infinite; export the mesh again"
            )
    faces = np.array(params["faces"], dtype=np.int64)
    return np.array(params["vertex_positions"], dtype=np.float64).reshape(-1, 3)[faces]


def _place(points: NDArray[np.float64], path: str | Path) -> Any:
    """The transform that scales a mesh to the shader ball's size and puts it on the middle of the floor."""
    import mitsuba as mi

    low, high = points.min(axis=0), points.max(axis=0)
    extent = high - low
    room = np.array([WIDTH, WIDTH, HEIGHT])
    if extent.max() <= 0.0:
        raise MeshError(f"mesh {path} has no extent: all its vertices are the same point")
    scale = float((room / np.maximum(extent, 1e-9 * extent.max())).min())
    middle = (low + high) / 2.0
    shift = [-scale * middle[0], -scale * middle[1], LIFT - scale * low[2]]
    return mi.ScalarTransform4f().translate([float(x) for x in shift]).scale(scale)
