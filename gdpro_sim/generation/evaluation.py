"""Figures that a generation is judged by: its pictures and surface against those of a reference.

Lengths are in the unit frame. Against the built-in vocabulary's own objects these say how faithfully the
pipeline fits what it was given, not how good text-to-3D is.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation.cameras import held_out, ring
from gdpro_sim.generation.renders import MeshRenderer, Renders
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import face_areas, face_normals
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.splatting import losses, rasterization
from gdpro_sim.splatting.contributions import contributions

STRAY = 0.03
"""A Gaussian whose centre is further than this from the true surface is a stray, in the unit frame."""

EDGE = 0.08
"""Least step per pixel (grey, of 1) of the reference where sharpness is measured."""

COVISIBLE = 0.03
"""Most difference of depth, in the unit frame, at which two views see the same point."""

SAMPLES = 20_000
"""Points drawn on each surface."""

OPEN = 0.1
"""Share of the hemisphere over a point through which it must see out to count: pictures teach nothing of
what lies deep in a gap or between the layers of a closed thing."""

DILATION = 0.05
"""Screen-space dilation of the Gaussians that are judged, px^2: little, so that what is seen is their own
size and not that of the picture. Viewers dilate by 0.3 px^2, in pictures of more pixels."""

SUPERSAMPLE = 2
"""Gaussians are drawn this much larger and averaged down, as the stages that made them do."""


@dataclass(frozen=True)
class Figures:
    """What `evaluate` measures; None where there is nothing to measure it by.

    psnr:         dB, mean over held-out views of 10 log10(1 / mean squared difference), over white
    ssim:         mean over held-out views, in [-1, 1] (Wang et al. 2004)
    chamfer:      mean of the two mean distances between the surfaces, unit frame
    f_score:      F-score at 1 % of the true bounding box's diagonal, in [0, 1] (Knapitsch et al. 2017)
    normal_error: degrees, mean angle between normals at nearest points, both ways
    sharpness:    slope of the pictures over that of the reference, at the reference's edges; 1: as sharp
    strays:       share of what is seen that Gaussians off the true surface show, in [0, 1]
    inconsistency: mean colour difference (of 1) of points that two neighbouring views both see
    """

    psnr: float
    ssim: float
    chamfer: float | None
    f_score: float | None
    normal_error: float | None
    sharpness: float
    strays: float | None
    inconsistency: float

    def to_json(self) -> dict[str, float | None]:
        """Plain numbers by name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


class Reference(Protocol):
    """Something to compare with, in the unit frame."""

    def render(self, cameras: Cameras) -> Renders: ...


def evaluate(
    shown: Gaussians | SurfaceMesh,
    reference: Reference,
    *,
    surface: SurfaceMesh | None = None,
    truth: SurfaceMesh | None = None,
    views: int = 16,
    resolution: int = 192,
    seed: int = 0,
) -> Figures:
    """Every figure of `shown`, in the unit frame.

    surface: its mesh, where there is one (default: `shown` itself if it is a mesh)
    truth:   the reference's mesh; without it there is no geometry to compare
    views:   held-out cameras; as many in a ring for consistency
    seed:    of the points drawn on surfaces

    Raises RequestError for fewer than 2 views.
    """
    if views < 2:
        raise RequestError(f"views must be >= 2 to compare neighbours, got {views}")
    cameras, around = held_out(views, resolution), ring(views, resolution)
    drawn, true = render(shown, cameras), reference.render(cameras)
    white = torch.ones(views, 3)
    images, targets = drawn.over(white).cpu(), true.over(white).cpu()
    near = render(shown, around)
    if surface is None and isinstance(shown, SurfaceMesh):
        surface = shown
    geometry: tuple[float, float, float] | tuple[None, None, None] = (None, None, None)
    if surface is not None and truth is not None:
        geometry = surface_figures(surface, truth, np.random.default_rng(seed))
    strays = None
    if truth is not None and isinstance(shown, Gaussians):
        strays = visible_strays(shown, truth, cameras)
    return Figures(
        psnr=float(np.mean([float(losses.psnr(a, b)) for a, b in zip(images, targets, strict=True)])),
        ssim=float(losses.ssim(images, targets)),
        chamfer=geometry[0],
        f_score=geometry[1],
        normal_error=geometry[2],
        sharpness=sharpness(images, targets),
        strays=strays,
        inconsistency=inconsistency(near),
    )


@torch.no_grad()
def render(shown: Gaussians | SurfaceMesh, cameras: Cameras) -> Renders:
    """Pictures of Gaussians (drawn larger by `SUPERSAMPLE` and averaged down) or of a mesh, one by one."""
    if isinstance(shown, SurfaceMesh):
        return MeshRenderer(shown).render(cameras)
    g, s = shown, SUPERSAMPLE
    parts: list[tuple[torch.Tensor, torch.Tensor, torch.Tensor]] = []
    for index in range(len(cameras)):
        view = cameras.viewmats[index : index + 1].to(g.means)
        k = cameras.Ks[index : index + 1].to(g.means) * g.means.new_tensor([[s], [s], [1.0]])
        image, alpha, _ = rasterization(
            g.means, g.quats, g.scales, g.opacities, g.sh, view, k, s * cameras.width, s * cameras.height,
            sh_degree=g.sh_degree, render_mode="RGB+D", eps2d=DILATION,
        )  # fmt: skip
        pooled = torch.nn.functional.avg_pool2d(torch.cat([image, alpha], -1).movedim(-1, 1), s)
        rgb, depth, a = pooled.movedim(1, -1).split([3, 1, 1], -1)
        parts.append((torch.minimum(rgb, a), a, depth / a.clamp_min(1e-6)))
    rgb, alpha, depth = (torch.cat(p) for p in zip(*parts, strict=True))
    return Renders(cameras, rgb, alpha, depth)


def surface_figures(
    found: SurfaceMesh, truth: SurfaceMesh, generator: np.random.Generator, *, samples: int = SAMPLES
) -> tuple[float, float, float]:
    """Chamfer distance, F-score at 1 % of the diagonal of `truth`, and normal error in degrees.

    With distances d of points drawn on one surface to the nearest of the other: Chamfer = (mean d_found +
    mean d_truth) / 2; precision and recall are the shares of d_found and d_truth within the threshold,
    F = 2 P R / (P + R). Only points that see out (`OPEN`) are counted; they are compared with the whole of
    the other surface. Source: Knapitsch et al., "Tanks and Temples" (2017), section 3.2; visible points
    alone after Jensen et al., "Large Scale Multi-view Stereopsis Evaluation" (2014).

    Raises MeshError where nothing of a surface sees out.
    """
    threshold = 0.01 * truth.diagonal
    apart: list[np.ndarray] = []
    angles: list[np.ndarray] = []
    for a, b in ((found, truth), (truth, found)):
        points, normals = sample(a, samples, generator)
        out = SurfaceIndex(a.vertices, a.faces).openness(points, normals, reach=2.0 * a.diagonal) > OPEN
        if not out.any():
            raise MeshError(f"{a.source or 'surface'}: wound inside out, nothing of it can be seen")
        points, normals = points[out], normals[out]
        where, weights = SurfaceIndex(b.vertices, b.faces).closest(points, normals, reach=0.05)
        corners = b.vertices.astype(np.float64)[b.faces[where]]
        apart.append(np.linalg.norm(points - np.einsum("nc,ncd->nd", weights, corners), axis=1))
        other = _unit(face_normals(b.vertices, b.faces[where]))
        angles.append(np.degrees(np.arccos(np.clip((normals * other).sum(1), -1.0, 1.0))))
    precision, recall = (float((d <= threshold).mean()) for d in apart)
    f_score = 2.0 * precision * recall / (precision + recall) if precision + recall > 0.0 else 0.0
    chamfer = 0.5 * float(apart[0].mean() + apart[1].mean())
    return chamfer, f_score, 0.5 * float(angles[0].mean() + angles[1].mean())


def sample(mesh: SurfaceMesh, count: int, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over a surface and the unit normals of their faces, [count, 3] each."""
    area = face_areas(mesh.vertices, mesh.faces)
    face = generator.choice(len(area), count, p=area / area.sum())
    a, b = generator.random((2, count))
    root = np.sqrt(a)
    weights = np.stack([1.0 - root, root * (1.0 - b), root * b], 1)
    corners = mesh.vertices.astype(np.float64)[mesh.faces[face]]
    return np.einsum("nc,ncd->nd", weights, corners), _unit(face_normals(mesh.vertices, mesh.faces[face]))


def sharpness(images: torch.Tensor, targets: torch.Tensor) -> float:
    """Slope of `images` along that of `targets`, over the latter's, where it is steep; [C, H, W, 3] both.

    Grey values, central differences: sum (grad I . grad T / |grad T|) / sum |grad T| over pixels with
    |grad T| >= EDGE. 1 for the reference itself, 0.5 where every edge has half its contrast, less where
    edges are blurred or not where they should be; 1 where the reference has no edges. (ours)
    """
    slopes = []
    for pictures in (images, targets):
        grey = pictures.double().mean(-1)
        x = 0.5 * (grey[:, 1:-1, 2:] - grey[:, 1:-1, :-2])
        y = 0.5 * (grey[:, 2:, 1:-1] - grey[:, :-2, 1:-1])
        slopes.append(torch.stack([x, y], -1))
    given, wanted = slopes
    steep = torch.linalg.vector_norm(wanted, dim=-1)
    edge = steep >= EDGE
    if not edge.any():
        return 1.0
    along = (given[edge] * wanted[edge]).sum(-1) / steep[edge]
    return float(along.sum() / steep[edge].sum())


def visible_strays(gaussians: Gaussians, truth: SurfaceMesh, cameras: Cameras) -> float:
    """Share of all blending weight, over all pixels of C cameras, of Gaussians further than STRAY from truth.

    What is hidden or transparent does not count; distance alone says nothing about what is seen. (ours)
    """
    means = gaussians.means.detach().double().cpu().numpy()
    usable = np.isfinite(means).all(1)
    points = np.where(usable[:, None], means, 0.0)
    where, weights = SurfaceIndex(truth.vertices, truth.faces).closest(points)
    nearest = np.einsum("nc,ncd->nd", weights, truth.vertices.astype(np.float64)[truth.faces[where]])
    stray = torch.from_numpy(np.linalg.norm(points - nearest, axis=1) > STRAY)
    total = off = 0.0
    for index in range(len(cameras)):
        seen = _weights(gaussians, cameras, index)
        total += float(seen.sum())
        off += float(seen[stray].sum())
    return off / total if total > 0.0 else 0.0


@torch.no_grad()
def _weights(gaussians: Gaussians, cameras: Cameras, index: int) -> torch.Tensor:
    """Blending weight of each Gaussian over the pixels of one camera, [N] float64 on the CPU."""
    g = gaussians
    view, k = (m[index : index + 1].to(g.means) for m in (cameras.viewmats, cameras.Ks))
    ones = torch.ones((len(g), 1), device=g.means.device)
    arguments = (g.means, g.quats, g.scales, g.opacities, ones, view, k, cameras.width, cameras.height)
    return contributions(rasterization(*arguments)[2])[0].double().cpu()


def inconsistency(renders: Renders) -> float:
    """Mean absolute colour difference (of 1) between each view and the next, at points both see.

    Every pixel that is opaque (alpha > 0.9) is carried to the next camera by its depth, looked up there
    bilinearly, and counted where that camera sees an opaque point at the same depth within COVISIBLE.
    0 for a surface that looks the same from all sides; 0 too where no two views share a point.
    Source: warping error of Lai et al., "Learning Blind Video Temporal Consistency" (2018), with rendered
    depth in place of optical flow.
    """
    cameras = renders.cameras
    count = len(cameras)
    device = renders.rgb.device
    colors = renders.rgb / renders.alphas.clamp_min(1e-6)
    total, pixels = 0.0, 0
    for i in range(count):
        j = (i + 1) % count
        to_world = torch.linalg.inv(cameras.viewmats[i].double()).to(device)
        inverse = torch.linalg.inv(cameras.Ks[i].double()).to(device)
        opaque = renders.alphas[i, ..., 0] > 0.9
        row, column = torch.nonzero(opaque, as_tuple=True)
        screen = torch.stack([column + 0.5, row + 0.5, torch.ones_like(row)], 1).double()
        points = screen @ inverse.T * renders.depths[i, row, column].double()
        seen = (points @ to_world[:3, :3].T + to_world[:3, 3]) @ cameras.viewmats[j, :3, :3].double().to(
            device
        ).T + cameras.viewmats[j, :3, 3].double().to(device)
        there = seen @ cameras.Ks[j].double().to(device).T
        uv = there[:, :2] / there[:, 2:].clamp_min(1e-6)
        grid = 2.0 * uv / uv.new_tensor([cameras.width, cameras.height]) - 1.0
        field = torch.cat([colors[j], renders.depths[j], renders.alphas[j]], -1).double().movedim(-1, 0)
        found = torch.nn.functional.grid_sample(field[None], grid[None, None], align_corners=False)[0, :, 0].T
        same = (found[:, 4] > 0.9) & ((found[:, 3] - seen[:, 2]).abs() < COVISIBLE) & (seen[:, 2] > 0.0)
        difference = (colors[i, row, column].double() - found[:, :3]).abs().mean(1)
        total += float(difference[same].sum())
        pixels += int(same.sum())
    return total / pixels if pixels else 0.0


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


__all__ = [
    "Figures",
    "Reference",
    "evaluate",
    "inconsistency",
    "render",
    "sample",
    "sharpness",
    "surface_figures",
    "visible_strays",
]
