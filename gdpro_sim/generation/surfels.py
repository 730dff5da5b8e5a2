"""Stage 1: surfels (or 3D Gaussians) that start on a coarse mesh and follow a score of their pictures.

After GaussianDreamerPro (arXiv 2406.18462), its first stage, with the images of Huang et al., "2D Gaussian
Splatting" (2024). Gradients reach every parameter, rotation included, so that surfels turn to the surface.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
from scipy.spatial import cKDTree

from gdpro_sim.binding import surface_normals
from gdpro_sim.cameras import Cameras
from gdpro_sim.device import beside_torch
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians, Surfels, rgb_to_sh
from gdpro_sim.generation.config import GenerationConfig
from gdpro_sim.generation.densification import Densification
from gdpro_sim.generation.distillation import (
    Clock,
    Distillation,
    Shot,
    flat,
    harmonics,
    nested,
    rates,
    variation,
)
from gdpro_sim.generation.optimizer import Adam
from gdpro_sim.generation.protocols import Guidance, StepReport, step_generator
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.repair import face_areas
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.splatting import losses, rasterization, rasterization_2dgs

CANDIDATES, ROUNDS = 10, 2
"""Points drawn for each that is wanted, and rounds of moving the wanted ones apart."""

DARKEST = 1e-3
"""Least colour of the degree-0 band: at 0 and below a splat has no gradient to come back by."""


class SurfelStage:
    """Learns surfels from a guidance, starting on a mesh in the unit frame. Implements `protocols.Stage`.

    The device is the guidance's. On a CPU the same arguments give the same bytes, and so does a stage that
    goes on from another's `state_dict`. Raises MeshError for a mesh without area.
    """

    name = "surfels"

    def __init__(self, mesh: SurfaceMesh, guidance: Guidance, config: GenerationConfig, seed: int) -> None:
        self.config = config.surfels
        c = self.config
        self.iterations, self.iteration = c.iterations, 0
        self._distillation = Distillation(self.name, guidance, config, c, seed)
        device = self._distillation.device
        start = step_generator(seed, f"{self.name} start", 0)
        leaves = {k: v.to(device) for k, v in _leaves(mesh, config, start).items()}
        own = {**rates(c), "means": (c.lr_position, c.lr_position_final)}
        self._adam = Adam(leaves, {name: own[name] for name in leaves})
        self._densification = Densification(c, len(leaves["means"]), device)

    def step(self) -> StepReport:
        """One iteration: views, images, score, regularisers, Adam, densification."""
        with beside_torch(self._adam["means"]):
            return self._step()

    def _step(self) -> StepReport:
        c, clock, adam = self.config, Clock(), self._adam
        views, generator = self._distillation.look(self.iteration)
        with clock.part("render"):
            cameras, backgrounds = self._distillation.rendered(views)
            shot, regularisers, meta = self._render(cameras, backgrounds)
            images = self._distillation.pictures(shot, views)
        with clock.part("guidance"):
            score, psnr = self._distillation.judge(images, views, self.iteration, generator)
        loss = score + regularisers
        if c.tv > 0.0:
            loss = loss + c.tv * variation(shot)
        collects = self._densification.collects(self.iteration)
        if collects:
            meta["means2d"].retain_grad()
        with clock.part("backward"):
            loss.backward()
        with clock.part("optimizer"):
            if collects:
                shifts = meta["means2d"].grad
                assert shifts is not None
                self._densification.collect(shifts, meta["radii"], cameras.width, cameras.height)
            adam.step(self.iteration / max(1, self.iterations - 1))
            with torch.no_grad():
                adam["dc"].clamp_(min=float(rgb_to_sh(torch.tensor(DARKEST))))
            self.iteration += 1
            self._densification.update(adam, self.iteration, generator)
        return StepReport(self.iteration, float(loss.detach()), psnr, len(adam["means"]), clock.stop())

    def result(self) -> Surfels | Gaussians:
        """What was learned so far: surfels, or 3D Gaussians where `config.surfels.kind` says so."""
        a = {name: value.detach() for name, value in self._adam.parameters.items()}
        kind = Surfels if self.config.kind == "surfels" else Gaussians
        return kind(
            a["means"].clone(),
            torch.nn.functional.normalize(a["quats"], dim=1),
            a["log_scales"].exp(),
            a["logits"].sigmoid(),
            harmonics(a).clone(),
        )

    def gaussians(self) -> Gaussians:
        """What was learned so far; surfels as thin 3D Gaussians."""
        result = self.result()
        return result.gaussians() if isinstance(result, Surfels) else result

    def state_dict(self) -> dict[str, torch.Tensor]:
        parts = {
            "adam": self._adam.state_dict(),
            "densification": self._densification.state_dict(),
            "score": self._distillation.state_dict(),
        }
        return {"iteration": torch.tensor(self.iteration), **flat(parts)}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Raises KeyError or ValueError where the state is not that of such a stage."""
        rows = {len(state[f"adam.{name}"]) for name in self._adam.parameters}
        if len(rows | {len(state["densification.sums"])}) > 1:
            raise ValueError(f"every leaf must have as many rows, got {sorted(rows)}")
        self._adam.load_state_dict(nested(state, "adam"))
        self._densification.load_state_dict(nested(state, "densification"))
        self._distillation.load_state_dict(nested(state, "score"))
        self.iteration = int(state["iteration"])

    def _render(
        self, cameras: Cameras, backgrounds: torch.Tensor
    ) -> tuple[Shot, torch.Tensor, dict[str, torch.Tensor]]:
        """Images, what they cost beside the score, and the rasteriser's `meta`."""
        c, a = self.config, self._adam.parameters
        degree = min(c.sh_degree, self.iteration // c.sh_every)
        sh = harmonics(a)
        scene = (a["means"], a["quats"], a["log_scales"].exp(), a["logits"].sigmoid(), sh)
        view = (cameras.viewmats, cameras.Ks, cameras.width, cameras.height)
        cost = sh.new_zeros(())
        if c.kind == "gaussians":
            image, alphas, meta = rasterization(
                *scene, *view, sh_degree=degree, backgrounds=backgrounds, render_mode="RGB+ED"
            )
            return Shot(cameras, image[..., :3], image[..., 3:], alphas), cost, meta
        image, alphas, normals, from_depth, distort, _, meta = rasterization_2dgs(
            *scene, *view, sh_degree=degree, backgrounds=backgrounds, render_mode="RGB+ED"
        )
        if c.normal_consistency > 0.0 and self.iteration >= c.densify_until:
            assert from_depth is not None
            cost = cost + c.normal_consistency * losses.normal_consistency(normals, from_depth, alphas)
        if c.distortion > 0.0:
            cost = cost + c.distortion * losses.distortion(distort)
        return Shot(cameras, image[..., :3], image[..., 3:], alphas), cost, meta


def _leaves(
    mesh: SurfaceMesh, config: GenerationConfig, generator: torch.Generator
) -> dict[str, torch.Tensor]:
    """Start on the mesh: evenly spread, as wide as their neighbours are far, facing out, in its colours."""
    c = config.surfels
    faces, weights = sample_surface(mesh, c.initial, generator)
    corners = mesh.vertices[mesh.faces[faces]]
    means = torch.from_numpy(np.einsum("nc,ncd->nd", weights, corners).astype(np.float32))
    normals = surface_normals(
        torch.from_numpy(mesh.vertices),
        torch.from_numpy(mesh.faces),
        torch.from_numpy(faces),
        torch.from_numpy(weights),
    )
    near, _ = cKDTree(means.numpy()).query(means.numpy(), k=4)
    size = torch.from_numpy(np.sqrt((near[:, 1:] ** 2).mean(1)).astype(np.float32)).clamp(min=1e-4)
    colors = torch.from_numpy(SurfaceColors(mesh).at(faces, weights)[:, :3]).clamp(min=DARKEST)
    count = len(means)
    leaves = {
        "means": means,
        "quats": facing(normals),
        "log_scales": size.log()[:, None].repeat(1, 2 if c.kind == "surfels" else 3),
        "logits": torch.full((count,), math.log(c.initial_opacity / (1.0 - c.initial_opacity))),
        "dc": rgb_to_sh(colors)[:, None],
    }
    if c.sh_degree > 0:
        leaves["rest"] = torch.zeros(count, (c.sh_degree + 1) ** 2 - 1, 3)
    return leaves


def sample_surface(
    mesh: SurfaceMesh, count: int, generator: torch.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """`count` points spread evenly over a surface: faces [N] int32 and barycentrics [N, 3] float32.

    More points are drawn, one from each of equal shares of the area; the wanted ones move to the middle of
    those nearest to them (Lloyd's algorithm, a few rounds) and then onto one. Raises MeshError for a mesh
    without area.
    """
    areas = face_areas(mesh.vertices, mesh.faces)
    total = float(areas.sum())
    if not total > 0.0:
        raise MeshError(f"{mesh.source or 'mesh'}: its {len(mesh.faces)} faces have no area to start from")
    many = CANDIDATES * count
    draws = torch.rand(many, 3, generator=generator, dtype=torch.float64).numpy()
    at = (np.arange(many) + draws[:, 0]) / many * total
    faces = np.minimum(np.searchsorted(np.cumsum(areas), at), len(areas) - 1).astype(np.int32)
    root = np.sqrt(draws[:, 1])
    weights = np.stack([1.0 - root, root * (1.0 - draws[:, 2]), root * draws[:, 2]], 1)
    points = np.einsum("nc,ncd->nd", weights, mesh.vertices.astype(np.float64)[mesh.faces[faces]])
    seeds = points[CANDIDATES // 2 :: CANDIDATES]
    for _ in range(ROUNDS):
        owner = cKDTree(seeds).query(points)[1]
        sizes = np.bincount(owner, minlength=count)
        sums = np.stack([np.bincount(owner, points[:, k], count) for k in range(3)], 1)
        seeds = np.where(sizes[:, None] > 0, sums / np.maximum(sizes, 1)[:, None], seeds)
    chosen = cKDTree(points).query(seeds)[1]
    return faces[chosen], weights[chosen].astype(np.float32)


def facing(normals: torch.Tensor) -> torch.Tensor:
    """Unit quaternions [N, 4] wxyz that turn +z to unit vectors [N, 3] by the shortest way."""
    x, y, z = normals.unbind(1)
    quats = torch.stack([1.0 + z, -y, x, torch.zeros_like(z)], 1)
    opposite = quats.new_tensor([0.0, 1.0, 0.0, 0.0])
    return torch.nn.functional.normalize(torch.where((z > -0.999999)[:, None], quats, opposite), dim=1)


__all__ = ["SurfelStage", "facing", "sample_surface"]
