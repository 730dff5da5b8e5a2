"""Rigid obstacles: as a scene describes them, and compiled. SI units, degrees for angles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import face_normals, validate
from gdpro_sim.simulation.conditions import FOREVER, Guide, Motion
from gdpro_sim.simulation.motions import Moving
from gdpro_sim.simulation.options import Number, Vector

ROOM = 0.9
"""Share of half an obstacle's thickness that a vertex may sink into."""

MESH_ROOM = 0.05
"""A vertex sinks no deeper into a mesh than this share of its size, however thick it is."""

BoundaryKind = Literal["sticky", "slip", "separate"]

Length = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

Kind = Literal["plane", "box", "sphere", "capsule", "cylinder", "mesh"]


class ColliderBase(Moving):
    """What all colliders share."""

    name: str = Field(default="", description="for messages; default: its kind")
    position: Vector = Field(default=(0.0, 0.0, 0.0), description="m, of the collider's origin")
    rotation: Vector = Field(default=(0.0, 0.0, 0.0), description="degrees about X, then Y, then Z")
    friction: float | None = Field(
        default=None,
        ge=0.0,
        le=10.0,
        description="Coulomb coefficient; combines with a body's by the geometric mean; default: the body's",
    )
    boundary: BoundaryKind = Field(
        default="separate",
        description="what touches it leaves freely and rubs by `friction` (separate), slides along it "
        "without friction and never leaves (slip), or moves with it (sticky). MPM; FEM knows only separate",
    )
    start: float = Field(default=0.0, ge=0.0, description="s, when it begins to be there. MPM")
    end: float | None = Field(default=None, gt=0.0, description="s, when it is gone; default: never. MPM")
    mass: float | None = Field(
        default=None, gt=0.0,
        description="kg, of a rigid body that moves by what touches it, and by gravity; default: it does "
        "not. MPM",
    )  # fmt: skip
    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="m/s at the start, of one with `mass`")
    angular_velocity: Vector = Field(
        default=(0.0, 0.0, 0.0), description="rad/s at the start, of one with `mass`"
    )
    visible: bool = Field(default=True, description="whether pictures show it")

    @model_validator(mode="after")
    def _driven_or_free(self) -> ColliderBase:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end must be after start ({self.start:g} s), got {self.end:g} s")
        if self.mass is None:
            if any(self.velocity) or any(self.angular_velocity):
                raise ValueError("a velocity needs a `mass`; give keyframes (`motion`) to what has none")
            return self
        if self.motion:
            raise ValueError("give either `mass` (it moves freely) or `motion` (it is moved), one of the two")
        if self.start or self.end is not None:
            raise ValueError("what has a `mass` is there all the time; leave out `start` and `end`")
        if isinstance(self, PlaneCollider | HeightfieldCollider):
            raise ValueError(f"a {self.kind} has no end and cannot move freely; leave out `mass`")
        return self

    def mpm_only(self) -> str | None:
        """The first key given that MPM alone knows, or None."""
        given = {
            "boundary": self.boundary != "separate",
            "start": self.start > 0.0,
            "end": self.end is not None,
            "mass": self.mass is not None,
        }
        return next((key for key, present in given.items() if present), None)


class PlaneCollider(ColliderBase):
    """Everything below a plane is solid."""

    kind: Literal["plane"] = "plane"
    normal: Vector = Field(default=(0.0, 0.0, 1.0), description="towards the free side, before `rotation`")

    @field_validator("normal")
    @classmethod
    def _some_way(cls, value: Vector) -> Vector:
        if not any(value):
            raise ValueError("must not be zero")
        return value


class BoxCollider(ColliderBase):
    """A box around `position`."""

    kind: Literal["box"] = "box"
    size: Annotated[tuple[Length, Length, Length], Field(description="m along X, Y and Z")]


class SphereCollider(ColliderBase):
    """A ball around `position`."""

    kind: Literal["sphere"] = "sphere"
    radius: float = Field(gt=0.0, description="m")


class CapsuleCollider(ColliderBase):
    """A rod with round ends along its Z axis, around `position`."""

    kind: Literal["capsule"] = "capsule"
    radius: float = Field(gt=0.0, description="m")
    length: float = Field(gt=0.0, description="m between the middles of its ends")


class CylinderCollider(ColliderBase):
    """A cylinder along its Z axis, around `position`."""

    kind: Literal["cylinder"] = "cylinder"
    radius: float = Field(gt=0.0, description="m")
    length: float = Field(gt=0.0, description="m")


class MeshCollider(ColliderBase):
    """A closed triangle mesh from a file, its origin at `position`."""

    kind: Literal["mesh"] = "mesh"
    file: str = Field(min_length=1, description="mesh file, relative to the scene file")
    scale: float = Field(default=1.0, gt=0.0, description="uniform")
    up: Literal["auto", "y", "z"] = Field(default="auto", description="up axis of the file")


class HeightfieldCollider(ColliderBase):
    """Terrain over a rectangle around `position`, solid down to a flat base."""

    kind: Literal["heightfield"] = "heightfield"
    size: Annotated[tuple[Length, Length], Field(description="m along X and Y")]
    heights: tuple[tuple[Number, ...], ...] = Field(
        min_length=2,
        description="m above `position`, evenly spaced: rows along Y from -Y, each along X from -X",
    )

    @field_validator("heights")
    @classmethod
    def _rectangular(cls, value: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        lengths = {len(row) for row in value}
        if len(lengths) != 1 or lengths.pop() < 2:
            raise ValueError("rows must be equally long and hold at least 2 heights")
        return value


ColliderOptions = Annotated[
    PlaneCollider
    | BoxCollider
    | SphereCollider
    | CapsuleCollider
    | CylinderCollider
    | MeshCollider
    | HeightfieldCollider,
    Field(discriminator="kind"),
]


@dataclass(frozen=True)
class Collider:
    """A rigid obstacle, constant. World points are rotation q + position at the start, then `motion`'s.

    kind:     which signed distance, see `gdpro_sim.kernels.colliders`
    size:     m: box half extents; sphere radius; capsule and cylinder radius and half length; mesh reach
    room:     m, how deep a vertex may be inside before it could come out elsewhere; 0 for endless
    friction: Coulomb coefficient, combined with a vertex's by the geometric mean; None takes the vertex's
    boundary: what matter does that touches it (MPM)
    start, end: s, when it is there (MPM)
    mass:     kg of a rigid body that moves by what touches it (MPM); None: only by `motion`
    velocity, angular_velocity: m/s and rad/s at the start, of one with a mass
    visible:  whether pictures show it
    vertices, faces: [V, 3] float64 m and [F, 3] int32 of a closed mesh, in its own frame
    heights:  [NY, NX] m of the terrain that the mesh is, over the rectangle that it covers
    color:    sRGB in pictures; None: that of obstacles
    """

    name: str
    kind: Kind
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)
    room: float = 0.0
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    friction: float | None = None
    motion: Motion | Guide | None = None
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None
    boundary: BoundaryKind = "separate"
    start: float = 0.0
    end: float = FOREVER
    mass: float | None = None
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    visible: bool = True
    heights: np.ndarray | None = None
    color: tuple[float, float, float] | None = None

    @staticmethod
    def floor(height: float) -> Collider:
        """The half-space below z = height."""
        return Collider("ground", "plane", position=np.array([0.0, 0.0, height]))


def compile_collider(options: ColliderOptions, resolve: Callable[[str], Path] = Path) -> Collider:
    """A `Collider` from its description; `resolve` finds files.

    Raises MeshError for a mesh that cannot be read or is not closed.
    """
    rotation = Rotation.from_euler("xyz", options.rotation, degrees=True).as_matrix()
    common: dict[str, Any] = {
        "name": options.name or options.kind,
        "position": np.asarray(options.position, np.float64),
        "rotation": rotation,
        "friction": options.friction,
        "motion": options.compiled(np.asarray(options.position)) if options.motion else None,
        "end": FOREVER if options.end is None else options.end,
        **{
            key: getattr(options, key)
            for key in ("boundary", "start", "mass", "velocity", "angular_velocity", "visible")
        },
    }
    if isinstance(options, PlaneCollider):
        common["rotation"] = rotation @ _turned_to(np.asarray(options.normal))
        return Collider(kind="plane", **common)
    if isinstance(options, BoxCollider):
        return shape_collider("box", tuple(0.5 * edge for edge in options.size), **common)
    if isinstance(options, SphereCollider):
        return shape_collider("sphere", (options.radius,), **common)
    if isinstance(options, CapsuleCollider | CylinderCollider):
        return shape_collider(options.kind, (options.radius, 0.5 * options.length), **common)
    if isinstance(options, MeshCollider):
        mesh = load_mesh(resolve(options.file), up=options.up)
        vertices, faces = options.scale * mesh.vertices.astype(np.float64), mesh.faces
    else:
        common["heights"] = np.asarray(options.heights, np.float64)
        vertices, faces = _terrain(common["heights"], options.size)
    return mesh_collider(vertices, faces, **common)


def shape_collider(kind: Kind, size: tuple[float, ...], **common: Any) -> Collider:
    """A `Collider` of a box, sphere, capsule or cylinder; `size` in m as in `Collider`."""
    room = ROOM * (size[0] if kind == "capsule" else min(size))
    return Collider(kind=kind, size=_three(*size), room=room, **common)


def mesh_collider(vertices: np.ndarray, faces: np.ndarray, *, name: str = "mesh", **common: Any) -> Collider:
    """A `Collider` of a closed mesh, [V, 3] m and [F, 3], normals outward. Raises MeshError if it is open."""
    report = validate(vertices, faces)
    if not report.watertight or report.volume <= 0.0:
        raise MeshError(
            f"collider {name!r}: the mesh is not closed with normals outward ({report.boundary_edges} open, "
            f"{report.non_manifold_edges} non-manifold, {report.flipped_edges} flipped edges, volume "
            f"{report.volume:.3g} m^3); close it, or use boxes"
        )
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    room = min(0.5 * ROOM * mesh_thickness(vertices, faces), MESH_ROOM * size)
    return Collider(
        name,
        "mesh",
        size=_three(1.1 * room),
        room=room,
        vertices=np.ascontiguousarray(vertices, np.float64),
        faces=np.ascontiguousarray(faces, np.int32),
        **common,
    )


def mesh_thickness(vertices: np.ndarray, faces: np.ndarray, share: float = 0.05) -> float:
    """How far the other side is straight behind a face, m; a share of the faces has less."""
    normals = face_normals(vertices, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    centres = vertices[faces].mean(axis=1)
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    origins = centres - 1e-5 * size * normals
    hit, weights = SurfaceIndex(vertices, faces).first_hit(origins, -normals)
    ends = np.einsum("fc,fci->fi", weights.astype(np.float64), vertices[faces[np.maximum(hit, 0)]])
    depth = np.linalg.norm(ends - centres, axis=1)[hit >= 0]
    return float(np.quantile(depth, share)) if len(depth) else size


def _terrain(heights: np.ndarray, size: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh under a height field [NY, NX]: its top, its walls, and a base as deep as it is wide."""
    rows, columns = heights.shape
    x, y = np.meshgrid(
        np.linspace(-0.5, 0.5, columns) * size[0], np.linspace(-0.5, 0.5, rows) * size[1], indexing="xy"
    )
    base = float(heights.min()) - 0.5 * max(size)
    top = np.stack([x, y, heights], axis=-1).reshape(-1, 3)
    bottom = np.stack([x, y, np.full_like(heights, base)], axis=-1).reshape(-1, 3)
    ids = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = ids[:-1, :-1].ravel(), ids[:-1, 1:].ravel(), ids[1:, 1:].ravel(), ids[1:, :-1].ravel()
    up = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([ids[0, :], ids[1:, -1], ids[-1, -2::-1], ids[-2:0:-1, 0]])
    after, count = np.roll(rim, -1), rows * columns
    walls = [np.stack([rim, rim + count, after], 1), np.stack([after, rim + count, after + count], 1)]
    faces = np.concatenate([up, up[:, ::-1] + count, *walls])
    return np.concatenate([top, bottom]), faces.astype(np.int32)


def _turned_to(normal: np.ndarray) -> np.ndarray:
    """A rotation that takes +Z to a direction."""
    z = normal / np.linalg.norm(normal)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _three(*values: float) -> tuple[float, float, float]:
    a, b, c = (*(float(v) for v in values), 0.0, 0.0)[:3]
    return a, b, c


__all__ = [
    "BoundaryKind",
    "BoxCollider",
    "CapsuleCollider",
    "Collider",
    "ColliderOptions",
    "CylinderCollider",
    "HeightfieldCollider",
    "MeshCollider",
    "PlaneCollider",
    "SphereCollider",
    "compile_collider",
    "mesh_collider",
    "mesh_thickness",
    "shape_collider",
]
