"""The prims that an asset file and a simulation file share: mesh, splats, points, tets, material.

Viewers read the standard attributes; this package reads the exact parameters back from custom attributes
in the `gdpro:` namespace. Every array crosses through `Vt.*Array.FromNumpy`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from pxr import Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, UsdVol, Vt

from gdpro_sim.asset.stage import set_custom
from gdpro_sim.binding import BoundGaussians, vertex_normals
from gdpro_sim.errors import AssetError, MeshError
from gdpro_sim.gaussians import Gaussians, sh_to_rgb
from gdpro_sim.materials import Material
from gdpro_sim.meshing.color import srgb_to_linear
from gdpro_sim.meshing.convex import ConvexPieces
from gdpro_sim.meshing.tetmesh import TetMesh

Precision = Literal["float", "half"]
Time: TypeAlias = "Usd.TimeCode | float"

DEFAULT = Usd.TimeCode.Default()
T = Sdf.ValueTypeNames

_EXTENT_SIGMAS = 3.0


# ---- arrays ----


def to_numpy(tensor: torch.Tensor) -> np.ndarray:
    """The values of a tensor of any device as a C-contiguous array."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy())


def floats(a: np.ndarray) -> Vt.FloatArray:
    return Vt.FloatArray.FromNumpy(np.ascontiguousarray(a, np.float32).reshape(-1))


def ints(a: np.ndarray) -> Vt.IntArray:
    return Vt.IntArray.FromNumpy(np.ascontiguousarray(a, np.int32).reshape(-1))


def vec2f(a: np.ndarray) -> Vt.Vec2fArray:
    return Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(a, np.float32).reshape(-1, 2))


def vec3f(a: np.ndarray) -> Vt.Vec3fArray:
    return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(a, np.float32).reshape(-1, 3))


def vec4f(a: np.ndarray) -> Vt.Vec4fArray:
    return Vt.Vec4fArray.FromNumpy(np.ascontiguousarray(a, np.float32).reshape(-1, 4))


def _display(rgb: np.ndarray) -> Vt.Vec3fArray:
    """displayColor of sRGB values: linear light by USD's convention, clipped to [0, 1]."""
    return vec3f(srgb_to_linear(np.clip(rgb, 0.0, 1.0)))


def bounds(points: np.ndarray) -> Vt.Vec3fArray:
    """USD extent of points [M, 3]."""
    return _extent(points, 0.0)


def _extent(points: np.ndarray, reach: np.ndarray | float) -> Vt.Vec3fArray:
    """USD extent of balls of radius `reach` [M] around points [M, 3]."""
    columns = np.ascontiguousarray(points.T)  # reductions over rows of three are ten times slower
    return vec3f(np.stack([(columns - reach).min(1), (columns + reach).max(1)]))


# ---- splats and points ----


@dataclass(frozen=True)
class SplatSample:
    """The arrays of one set of Gaussians at one moment, shared by the splat prim and its points twin.

    Crate files store equal arrays once, so positions, orientations and scales cost nothing the second time.
    """

    positions: Vt.Vec3fArray
    orientations: Vt.QuatfArray | Vt.QuathArray
    scales: Vt.Vec3fArray | Vt.Vec3hArray
    point_scales: Vt.Vec3fArray | None
    widths: Vt.FloatArray
    splat_extent: Vt.Vec3fArray
    point_extent: Vt.Vec3fArray
    sh: Vt.Vec3fArray | None

    @staticmethod
    def of(g: Gaussians, precision: Precision = "float", *, sh: bool = False) -> SplatSample:
        means, scales = to_numpy(g.means), to_numpy(g.scales)
        quats = to_numpy(g.quats)[:, [1, 2, 3, 0]]  # memory order of Gf quaternions: x, y, z, w
        sx, sy, sz = scales.T
        reach = np.float32(_EXTENT_SIGMAS) * np.maximum(np.maximum(sx, sy), sz)
        # A ball of the same volume as the ellipsoid of one standard deviation.
        radius = np.cbrt(sx.astype(np.float64) * sy * sz).astype(np.float32)
        half = precision == "half"
        return SplatSample(
            positions=vec3f(means),
            orientations=Vt.QuathArray.FromNumpy(np.ascontiguousarray(quats, np.float16))
            if half
            else Vt.QuatfArray.FromNumpy(np.ascontiguousarray(quats)),
            scales=Vt.Vec3hArray.FromNumpy(scales.astype(np.float16)) if half else vec3f(scales),
            point_scales=None if half else vec3f(scales),
            widths=floats(2.0 * radius),
            splat_extent=_extent(means, reach),
            point_extent=_extent(means, radius),
            sh=vec3f(to_numpy(g.sh)) if sh else None,
        )


@dataclass(frozen=True)
class SplatPrims:
    """The splat prim and its UsdGeomPoints twin (Blender drops splats, and animates points)."""

    splats: Usd.Prim
    points: Usd.Prim
    precision: Precision

    @staticmethod
    def define(
        stage: Usd.Stage, parent: Sdf.Path, g: Gaussians, sample: SplatSample, precision: Precision = "float"
    ) -> SplatPrims:
        """Author everything that does not move, and `sample` as the default values."""
        k = g.sh.shape[1]
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, parent.AppendChild("Splats")).GetPrim()
        splats.GetAttribute("opacities").Set(floats(to_numpy(g.opacities)))
        splats.GetAttribute("radiance:sphericalHarmonicsDegree").Set(g.sh_degree)
        coefficients = splats.GetAttribute("radiance:sphericalHarmonicsCoefficients")
        coefficients.Set(vec3f(to_numpy(g.sh)))
        coefficients.SetMetadata("elementSize", k)
        coefficients.SetMetadata("interpolation", "vertex")
        coefficients.SetColorSpace("srgb_rec709_scene")

        points = UsdGeom.Points.Define(stage, parent.AppendChild("Points"))
        points.SetWidthsInterpolation(UsdGeom.Tokens.vertex)
        colors = points.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        colors.Set(_display(to_numpy(sh_to_rgb(g.sh[:, 0]))))
        primvars = UsdGeom.PrimvarsAPI(points)
        # Blender stops reading primvars at the first type it does not know (half3 is one).
        rot_type = T.QuathArray if precision == "half" else T.QuatfArray
        primvars.CreatePrimvar("rot", rot_type, UsdGeom.Tokens.vertex)
        primvars.CreatePrimvar("scale", T.Float3Array, UsdGeom.Tokens.vertex).Set(vec3f(to_numpy(g.scales)))
        primvars.CreatePrimvar("opacity", T.FloatArray, UsdGeom.Tokens.vertex).Set(
            floats(to_numpy(g.opacities))
        )
        prims = SplatPrims(splats, points.GetPrim(), precision)
        prims.set(sample)
        return prims

    def set(self, sample: SplatSample, time: Time = DEFAULT) -> None:
        """Author what moves at `time`."""
        for prim, name, value in self._values(sample):
            if value is not None:
                prim.GetAttribute(name).Set(value, time)

    def _values(self, s: SplatSample) -> Iterator[tuple[Usd.Prim, str, object]]:
        half = "h" if self.precision == "half" else ""
        yield self.splats, "positions", s.positions
        yield self.splats, "orientations" + half, s.orientations
        yield self.splats, "scales" + half, s.scales
        yield self.splats, "extent", s.splat_extent
        yield self.splats, "radiance:sphericalHarmonicsCoefficients", s.sh
        yield self.points, "points", s.positions
        yield self.points, "widths", s.widths
        yield self.points, "extent", s.point_extent
        yield self.points, "primvars:rot", s.orientations
        yield self.points, "primvars:scale", s.point_scales


def read_splats(prim: Usd.Prim, time: Time = DEFAULT) -> Gaussians:
    """Gaussians of a splat prim at `time`, as written (halves widened to float32).

    Raises AssetError where arrays are missing or do not fit together.
    """
    means = read(prim, "positions", np.float32, (-1, 3), time)
    n = len(means)
    half = not prim.GetAttribute("orientations").HasAuthoredValue()
    suffix, dtype = ("h", np.float16) if half else ("", np.float32)
    quats = read(prim, "orientations" + suffix, dtype, (n, 4), time)[:, [3, 0, 1, 2]]
    scales = read(prim, "scales" + suffix, dtype, (n, 3), time)
    degree = prim.GetAttribute("radiance:sphericalHarmonicsDegree").Get()
    if degree not in (0, 1, 2, 3):
        raise AssetError(f"{_where(prim)}: spherical-harmonics degree must be 0-3, got {degree}")
    return Gaussians(
        torch.from_numpy(means),
        torch.from_numpy(quats.astype(np.float32)),
        torch.from_numpy(scales.astype(np.float32)),
        torch.from_numpy(read(prim, "opacities", np.float32, (n,))),
        torch.from_numpy(
            read(
                prim, "radiance:sphericalHarmonicsCoefficients", np.float32, (n * (degree + 1) ** 2, 3), time
            )
        ).reshape(n, (degree + 1) ** 2, 3),
    )


# ---- mesh ----


def define_mesh(
    stage: Usd.Stage,
    parent: Sdf.Path,
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray | None,
    average_color: np.ndarray,
    welded: torch.Tensor | None = None,
) -> Usd.Prim:
    """A triangle mesh; `colors` [V, 3] sRGB per vertex, or `average_color` [3] where there are none."""
    mesh = UsdGeom.Mesh.Define(stage, parent.AppendChild("Mesh"))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateFaceVertexCountsAttr(ints(np.full(len(faces), 3)))
    mesh.CreateFaceVertexIndicesAttr(ints(faces))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    interpolation = UsdGeom.Tokens.vertex if colors is not None else UsdGeom.Tokens.constant
    shown = colors if colors is not None else average_color[None]
    mesh.CreateDisplayColorPrimvar(interpolation).Set(_display(shown))
    prim = mesh.GetPrim()
    if colors is not None:
        set_custom(prim, "gdpro:vertexColors", T.Float3Array, vec3f(colors))
    set_mesh(prim, vertices, faces, welded=welded)
    return prim


def set_mesh(
    prim: Usd.Prim,
    vertices: np.ndarray,
    faces: np.ndarray,
    time: Time = DEFAULT,
    *,
    welded: torch.Tensor | None = None,
) -> None:
    """Author a mesh's points, normals and extent at `time`; `welded` as in `BoundGaussians.welded`."""
    prim.GetAttribute("points").Set(vec3f(vertices), time)
    normals = vertex_normals(torch.from_numpy(vertices), torch.from_numpy(faces), welded)
    prim.GetAttribute("normals").Set(vec3f(to_numpy(normals)), time)
    prim.GetAttribute("extent").Set(bounds(vertices), time)


# ---- binding ----

_BINDING = "gdpro:binding:"


def write_binding(mesh: Usd.Prim, splats: Usd.Prim, bound: BoundGaussians) -> None:
    """Author the exact binding: rest vertices and faces on the mesh, per-Gaussian values on the splats."""
    set_custom(mesh, _BINDING + "vertices", T.Point3fArray, vec3f(to_numpy(bound.vertices)))
    set_custom(mesh, _BINDING + "faces", T.Int3Array, Vt.Vec3iArray.FromNumpy(to_numpy(bound.faces)))
    set_custom(splats, _BINDING + "faceIds", T.IntArray, ints(to_numpy(bound.face_ids)))
    set_custom(splats, _BINDING + "barycentrics", T.Float3Array, vec3f(to_numpy(bound.barycentrics)))
    set_custom(splats, _BINDING + "rotations", T.Float2Array, vec2f(to_numpy(bound.rotations)))
    set_custom(splats, _BINDING + "logScales", T.Float3Array, vec3f(to_numpy(bound.log_scales)))
    set_custom(splats, _BINDING + "opacityLogits", T.FloatArray, floats(to_numpy(bound.opacity_logits)))
    set_custom(splats, _BINDING + "sh", T.Float3Array, vec3f(to_numpy(bound.sh)))
    set_custom(splats, _BINDING + "shCount", T.Int, int(bound.sh.shape[1]))


def read_binding(mesh: Usd.Prim, splats: Usd.Prim) -> BoundGaussians:
    """The binding as written. Raises AssetError where arrays are missing or do not fit together."""
    face_ids = read(splats, _BINDING + "faceIds", np.int32, (-1,))
    n = len(face_ids)
    k = splats.GetAttribute(_BINDING + "shCount").Get()
    if k not in (1, 4, 9, 16):
        raise AssetError(f"{_where(splats)}: {_BINDING}shCount must be 1, 4, 9 or 16, got {k}")
    return BoundGaussians(
        *(
            torch.from_numpy(a)
            for a in (
                read(mesh, _BINDING + "vertices", np.float32, (-1, 3)),
                read(mesh, _BINDING + "faces", np.int32, (-1, 3)),
                face_ids,
                read(splats, _BINDING + "barycentrics", np.float32, (n, 3)),
                read(splats, _BINDING + "rotations", np.float32, (n, 2)),
                read(splats, _BINDING + "logScales", np.float32, (n, 3)),
                read(splats, _BINDING + "opacityLogits", np.float32, (n,)),
                read(splats, _BINDING + "sh", np.float32, (n * k, 3)).reshape(n, k, 3),
            )
        )
    )


# ---- tets and material ----


def define_tets(stage: Usd.Stage, parent: Sdf.Path, tets: TetMesh) -> Usd.Prim:
    """A simulation tet mesh as `UsdGeom.TetMesh`, with the names of the AOUSD deformable proposal."""
    mesh = UsdGeom.TetMesh.Define(stage, parent.AppendChild("Tets"))
    points = vec3f(tets.vertices)
    mesh.CreatePointsAttr(points)
    mesh.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(np.ascontiguousarray(tets.tets)))
    mesh.CreateSurfaceFaceVertexIndicesAttr(UsdGeom.TetMesh.ComputeSurfaceFaces(mesh))
    mesh.CreateExtentAttr(bounds(tets.vertices))
    mesh.CreatePurposeAttr(UsdGeom.Tokens.guide)  # it would hide the surface it encloses
    prim = mesh.GetPrim()
    prim.AddAppliedSchema("PhysicsVolumeDeformableSimAPI")
    prim.CreateAttribute("physics:restShapePoints", T.Point3fArray, True).Set(points)
    set_custom(prim, "gdpro:fill", T.FloatArray, floats(tets.fill))
    set_custom(prim, "gdpro:method", T.String, tets.method)
    return prim


def read_tets(prim: Usd.Prim) -> TetMesh:
    """The tet mesh as written. Raises AssetError."""
    tets = read(prim, "tetVertexIndices", np.int32, (-1, 4))
    try:
        return TetMesh(
            read(prim, "points", np.float32, (-1, 3)),
            tets,
            read(prim, "gdpro:fill", np.float32, (len(tets),)),
            str(prim.GetAttribute("gdpro:method").Get()),
        )
    except MeshError as error:
        raise AssetError(f"{_where(prim)}: {error}") from error


def define_material(
    stage: Usd.Stage, parent: Sdf.Path, material: Material, tets: Usd.Prim | None
) -> Usd.Prim:
    """A physics material: proposal names for deformables, core names for density and friction, exact JSON."""
    shade = UsdShade.Material.Define(stage, parent.AppendChild("PhysicsMaterial"))
    prim = shade.GetPrim()
    core = UsdPhysics.MaterialAPI.Apply(prim)
    core.CreateDensityAttr(material.density)
    core.CreateStaticFrictionAttr(material.friction)
    core.CreateDynamicFrictionAttr(material.friction)
    prim.AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
    prim.CreateAttribute("physics:youngsModulus", T.Float, True).Set(material.young)
    prim.CreateAttribute("physics:poissonsRatio", T.Float, True).Set(material.poisson)
    set_custom(prim, "gdpro:material", T.String, material.model_dump_json())
    if tets is not None:
        UsdShade.MaterialBindingAPI.Apply(tets).Bind(shade, UsdShade.Tokens.weakerThanDescendants, "physics")
    return prim


def read_material(prim: Usd.Prim) -> Material:
    """The material as written. Raises AssetError."""
    text = prim.GetAttribute("gdpro:material").Get()
    try:
        return Material.model_validate_json(text or "")
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise AssetError(f"{_where(prim)}: gdpro:material is not a material: {reason}") from error


# ---- convex pieces ----


def define_pieces(stage: Usd.Stage, parent: Sdf.Path, pieces: ConvexPieces) -> Usd.Prim:
    """The convex pieces that stand for the mesh in rigid contact."""
    prim = UsdGeom.Scope.Define(stage, parent.AppendChild("Pieces")).GetPrim()
    set_custom(prim, "gdpro:pieces:vertices", T.Point3fArray, vec3f(pieces.vertices))
    set_custom(prim, "gdpro:pieces:faces", T.IntArray, ints(pieces.faces))
    set_custom(prim, "gdpro:pieces:counts", T.IntArray, ints(pieces.counts))
    set_custom(prim, "gdpro:pieces:concavity", T.Double, pieces.concavity)
    return prim


def read_pieces(prim: Usd.Prim) -> ConvexPieces:
    """The pieces as written. Raises AssetError."""
    counts = read(prim, "gdpro:pieces:counts", np.int32, (-1,))
    vertices = read(prim, "gdpro:pieces:vertices", np.float32, (-1, 3))
    faces = read(prim, "gdpro:pieces:faces", np.int32, (-1,))
    concavity = prim.GetAttribute("gdpro:pieces:concavity").Get()
    if len(counts) % 2 or len(faces) % 3 or concavity is None:
        raise AssetError(f"{_where(prim)}: the convex pieces are damaged")
    return ConvexPieces(vertices, faces.reshape(-1, 3), counts.reshape(-1, 2), float(concavity))


# ---- vertex groups ----

_FAMILY = "gdproGroups"


def define_groups(
    stage: Usd.Stage, mesh: Usd.Prim, groups: dict[str, np.ndarray], materials: dict[str, Material]
) -> None:
    """Named sets of a mesh's vertices as point subsets, in order, with what they are made of."""
    for number, (name, ids) in enumerate(groups.items()):
        subset = UsdGeom.Subset.Define(stage, mesh.GetPath().AppendChild(f"Group{number}"))
        subset.CreateElementTypeAttr(UsdGeom.Tokens.point)
        subset.CreateFamilyNameAttr(_FAMILY)
        subset.CreateIndicesAttr(ints(ids))
        prim = subset.GetPrim()
        set_custom(prim, "gdpro:name", T.String, name)
        if name in materials:
            set_custom(prim, "gdpro:material", T.String, materials[name].model_dump_json())


def read_groups(mesh: Usd.Prim) -> tuple[dict[str, np.ndarray], dict[str, Material]]:
    """Vertex groups as written, and the materials of those that have one. Raises AssetError."""
    groups, materials = {}, {}
    for prim in mesh.GetChildren():
        subset = UsdGeom.Subset(prim)
        if subset and subset.GetFamilyNameAttr().Get() == _FAMILY:
            name = str(prim.GetAttribute("gdpro:name").Get())
            groups[name] = read(prim, "indices", np.int32, (-1,))
            if prim.GetAttribute("gdpro:material"):
                materials[name] = read_material(prim)
    return groups, materials


# ---- reading ----


def read(prim: Usd.Prim, name: str, dtype: type, shape: tuple[int, ...], time: Time = DEFAULT) -> np.ndarray:
    """A copy of one array attribute, checked for type and shape; -1 accepts any length. Raises AssetError."""
    attribute = prim.GetAttribute(name) if prim else None
    value = attribute.Get(time) if attribute else None
    if value is None:
        raise AssetError(
            f"{_where(prim)}: attribute {name} is missing; the file is damaged or was not made here"
        )
    array = np.array(value)
    if array.size == 0:
        array = np.zeros([0 if s == -1 else s for s in shape], dtype) if 0 in shape or -1 in shape else array
    wanted = tuple(a if s == -1 else s for s, a in zip(shape, array.shape, strict=False))
    if array.dtype != dtype or array.ndim != len(shape) or array.shape != wanted:
        raise AssetError(
            f"{_where(prim)}: attribute {name} must be {np.dtype(dtype).name} {list(shape)}, "
            f"got {array.dtype} {list(array.shape)}"
        )
    return array


def _where(prim: Usd.Prim) -> str:
    if not prim:
        return "a required prim is missing"
    layers = prim.GetPrimStack()
    file = Path(layers[0].layer.realPath).name if layers and layers[0].layer.realPath else ""
    return f"{file}{prim.GetPath()}"


__all__ = [
    "DEFAULT",
    "Precision",
    "SplatPrims",
    "SplatSample",
    "T",
    "Time",
    "bounds",
    "define_groups",
    "define_material",
    "define_mesh",
    "define_pieces",
    "define_tets",
    "floats",
    "ints",
    "read",
    "read_binding",
    "read_groups",
    "read_material",
    "read_pieces",
    "read_splats",
    "read_tets",
    "set_mesh",
    "to_numpy",
    "vec3f",
    "vec4f",
    "write_binding",
]
