"""A shader ball made by code: an open shell with a groove, a small ball inside the shell, and the ring on which the
shell stands.

Every part is a solid of revolution. Texture coordinate u runs around the axis, and v runs along the profile. At a pole
all values of u meet in one point, so the axes are chosen such that no pole faces the default camera.

The shell's outer radius is 1. The z axis points up, and the ring that carries the shell stands on the plane z = 0.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from nma.files import scratch_folder, write_bytes

Array = NDArray[np.float64]

SHELL_CENTRE = np.array([0.0, 0.0, 1.12])
SHELL_AXIS = np.array([0.56, -0.66, 0.50])  # from the shell's centre to the middle of its opening
SHELL_OPENING = np.radians(52.0)  # angle between SHELL_AXIS and the top of the lip around the opening
LIP_RADIUS = 0.07
CAVITY_OFFSET = 0.16  # from the shell's centre to the centre of the cavity's sphere, along SHELL_AXIS
GROOVE_ANGLE = np.radians(76.0)
GROOVE_HALF_WIDTH = np.radians(3.6)
GROOVE_DEPTH = 0.055
CORE_RADIUS = 0.41
CORE_AXIS = np.array([-0.75, 0.45, 0.35])
RING_RADII = (0.44, 0.74)
RING_HEIGHT = 0.215
TEXELS_PER_TURN = 2  # how often a texture repeats around the shell


class Mesh(NamedTuple):
    """A triangle mesh: vertices (n, 3), unit normals (n, 3), texture coordinates (n, 2), faces (m, 3)."""

    vertices: Array
    normals: Array
    uv: Array
    faces: NDArray[np.int32]


def shader_ball(detail: float = 1.0) -> Mesh:
    """The whole shader ball as one mesh.

    Args:
        detail: factor on the number of segments in both directions; 1 gives about 54,000 triangles.

    Returns:
        A closed mesh whose faces and smooth normals point outwards. Textures repeat with period 1 in u and v.
    """
    shell = revolve(
        _shell_profile(), round(200 * detail), round(100 * detail), SHELL_AXIS, repeats=TEXELS_PER_TURN
    )
    core = revolve(
        _arc(CORE_RADIUS, 0.0, np.pi), round(64 * detail), round(36 * detail), CORE_AXIS, repeats=1
    )
    ring = revolve(
        _ring_profile(), round(96 * detail), round(48 * detail), np.array([0.0, 0.0, 1.0]), repeats=2
    )
    return _merge([_translate(shell, SHELL_CENTRE), _translate(core, _core_centre()), ring])


def revolve(profile: Array, turns: int, steps: int, axis: Array, *, repeats: int) -> Mesh:
    """Turn a profile around an axis through the origin.

    Args:
        profile: (n, 2) points (radius, height) that lie close together. The outside of the surface is to the left of
            the direction from each point to the next.
        turns: number of segments around the axis.
        steps: number of segments along the profile. Segments are shorter where the profile turns.
        axis: direction of the axis of revolution, of any length.
        repeats: how often u runs from 0 to 1 in one turn. v is scaled so that textures are not stretched at the largest
            radius.

    Returns:
        The mesh, whose normals are perpendicular to the tangent of the profile.
    """
    radius, height, normal, length = _resample(profile, steps)
    phi = np.linspace(0.0, 2.0 * np.pi, turns + 1)
    frame = _frame(axis)
    ring = np.stack([np.cos(phi), np.sin(phi)], axis=-1)

    def place(r: Array, z: Array) -> Array:
        local = np.concatenate(
            [r[:, None, None] * ring, np.broadcast_to(z[:, None, None], (len(r), turns + 1, 1))], -1
        )
        return (local @ frame).reshape(-1, 3)

    v_scale = repeats / (2.0 * np.pi * radius.max())
    u, v = np.meshgrid(repeats * phi / (2.0 * np.pi), v_scale * length)
    uv = np.stack([u, v], axis=-1).reshape(-1, 2)
    faces = _grid_faces(len(radius), turns + 1, radius)
    return Mesh(place(radius, height), place(normal[:, 0], normal[:, 1]), uv, faces)


@lru_cache(maxsize=4)
def shader_ball_file(detail: float = 1.0) -> Path:
    """The path of a binary PLY file of the shader ball. The first call writes the file to this process's temporary
    folder."""
    path = scratch_folder() / f"shaderball-{detail:g}.ply"
    write_ply(path, shader_ball(detail))
    return path


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as little-endian binary PLY, with normals and texture coordinates."""
    names = ("x", "y", "z", "nx", "ny", "nz", "u", "v")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(mesh.vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header"]
    face = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    face["count"], face["index"] = 3, mesh.faces
    vertex = np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1).astype("<f4")
    write_bytes(path, "\n".join([*header, ""]).encode() + vertex.tobytes() + face.tobytes())


def _arc(radius: float | Array, start: float, stop: float, count: int = 2000) -> Array:
    """Returns the points of an arc as an array (count, 2) of pairs (radius, height).

    The polar angles of the points go from `start` to `stop`. `radius` may be an array.
    """
    theta = np.linspace(start, stop, count)
    return np.stack([radius * np.sin(theta), radius * np.cos(theta)], axis=-1)


def _cavity() -> tuple[Array, float]:
    """The centre (radius, height) of the rounded lip, and the radius of the cavity's sphere, which joins the lip
    smoothly."""
    middle = (1.0 - LIP_RADIUS) * np.array([np.sin(SHELL_OPENING), np.cos(SHELL_OPENING)])
    return middle, float(np.hypot(middle[0], middle[1] - CAVITY_OFFSET) - LIP_RADIUS)


def _core_centre() -> Array:
    """The centre of the small ball, which rests on the lowest point of the cavity."""
    down = np.array([0.0, 0.0, CORE_RADIUS - _cavity()[1]])
    return SHELL_CENTRE + CAVITY_OFFSET * SHELL_AXIS / np.linalg.norm(SHELL_AXIS) + down


def _shell_profile() -> Array:
    """The profile from the pole of the cavity over the lip and down the grooved outside to the outer pole."""
    middle, radius = _cavity()
    rim = np.arctan2(middle[0], middle[1] - CAVITY_OFFSET)
    inside = _arc(radius, np.pi, rim) + np.array([0.0, CAVITY_OFFSET])

    # The angles of the lip's arc around the lip's centre go from the direction of the cavity's centre to the outward
    # direction of the shell.
    turn = np.linspace(rim - np.pi, SHELL_OPENING, 400)
    lip = middle + LIP_RADIUS * np.stack([np.sin(turn), np.cos(turn)], axis=-1)

    theta = np.linspace(SHELL_OPENING, np.pi, 6000)
    across = np.clip(np.abs(theta - GROOVE_ANGLE) / GROOVE_HALF_WIDTH, 0.0, 1.0)
    outside = _arc(1.0 - GROOVE_DEPTH * (0.5 + 0.5 * np.cos(np.pi * across)), SHELL_OPENING, np.pi, 6000)
    return np.concatenate([inside[:-1], lip[:-1], outside])


def _ring_profile() -> Array:
    """The closed profile of the ring: a rectangle with rounded corners."""
    inner, outer = RING_RADII
    corner = 0.07
    angle = np.linspace(0.0, np.pi / 2.0, 200)
    corners = [
        (inner + corner, RING_HEIGHT - corner, np.pi),
        (outer - corner, RING_HEIGHT - corner, np.pi / 2.0),
        (outer - corner, corner, 0.0),
        (inner + corner, corner, -np.pi / 2.0),
    ]
    arcs = [
        np.stack([r + corner * np.cos(a - angle), z + corner * np.sin(a - angle)], -1) for r, z, a in corners
    ]
    points = np.concatenate([*arcs, arcs[0][:1]])

    # Add points along the straight sides, so that every segment is short.
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    fine = np.union1d(along, np.linspace(0.0, along[-1], 2000))
    return np.stack([np.interp(fine, along, points[:, axis]) for axis in (0, 1)], axis=-1)


def _resample(profile: Array, steps: int) -> tuple[Array, Array, Array, Array]:
    """Radius, height, outward normal (n, 2) and arc length at steps + 1 points, which lie closer together where the
    profile turns."""
    delta = np.diff(profile, axis=0)
    piece = np.linalg.norm(delta, axis=1)
    delta, start, piece = delta[piece > 1e-9], profile[:-1][piece > 1e-9], piece[piece > 1e-9]
    points = np.concatenate([start, profile[-1:]])
    length = np.concatenate([[0.0], np.cumsum(piece)])

    # The tangent's angle is known at the middle of each segment, and interpolated to the segments' ends.
    angle = np.unwrap(np.arctan2(delta[:, 1], delta[:, 0]))
    middles = (length[:-1] + length[1:]) / 2.0
    at_points = np.interp(length, middles, angle)
    density = piece / length[-1] + 1.5 * np.abs(np.diff(at_points)) / np.abs(np.diff(at_points)).sum()

    progress = np.concatenate([[0.0], np.cumsum(density)])
    where = np.interp(np.linspace(0.0, progress[-1], steps + 1), progress, length)
    radius, height = (np.interp(where, length, points[:, axis]) for axis in (0, 1))
    tangent = np.interp(where, length, at_points)
    return np.maximum(radius, 0.0), height, np.stack([-np.sin(tangent), np.cos(tangent)], -1), where


def _grid_faces(rows: int, columns: int, radius: Array) -> NDArray[np.int32]:
    """Two triangles (m, 3) for each cell of a grid of vertices, except for the triangles at a pole that have no
    area."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    lower, upper = np.stack([a, d, c], -1), np.stack([a, c, b], -1)
    keep_lower, keep_upper = radius[1:] > 1e-9, radius[:-1] > 1e-9
    return np.concatenate([lower[keep_lower].reshape(-1, 3), upper[keep_upper].reshape(-1, 3)]).astype(
        np.int32
    )


def _frame(axis: Array) -> Array:
    """A rotation matrix whose third row is the unit axis. The first two rows are directions perpendicular to the
    axis."""
    z = axis / np.linalg.norm(axis)
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _translate(mesh: Mesh, offset: Array) -> Mesh:
    return mesh._replace(vertices=mesh.vertices + offset)


def _merge(meshes: list[Mesh]) -> Mesh:
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + offset for mesh, offset in zip(meshes, first, strict=True)]
    vertices, normals, uv = (np.concatenate([mesh[part] for mesh in meshes]) for part in range(3))
    return Mesh(vertices, normals, uv, np.concatenate(faces).astype(np.int32))
