"""Stage 2: 3D Gaussians bound to a mesh whose vertices learn, from the same score.

After GaussianDreamerPro (arXiv 2406.18462), its second stage: Gaussians sit at frozen barycentric weights of
triangles and ride on their vertices; turned in the plane, stretched along three axes, faded and coloured as
the score asks. Their count and order never change. The other modes are the paper's ablations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from gdpro_sim.asset.from_mesh import barycentric_table
from gdpro_sim.binding import BoundGaussians, TriangleBinding
from gdpro_sim.cameras import Cameras
from gdpro_sim.device import beside_torch
from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.gaussians import SH_C0, Gaussians, Surfels, rgb_to_sh, sh_to_rgb
from gdpro_sim.generation.config import GenerationConfig, RefinementConfig
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
from gdpro_sim.generation.mesh_descent import MeshDescent
from gdpro_sim.generation.optimizer import Adam
from gdpro_sim.generation.protocols import Guidance, StepReport
from gdpro_sim.generation.surfels import DARKEST
from gdpro_sim.generation.textured import TexturedMesh
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh
from gdpro_sim.splatting import rasterization


class RefinementStage:
    """Refines a mesh in the unit frame and the Gaussians bound to it. Implements `protocols.Stage`.

    Modes (`config.refinement.mode`):
        bound          vertices learn, Gaussians ride
        frozen         vertices, and so the Gaussians' means, stay
        unbound        Gaussians are set free: those of `start`, or the bound ones where there is none
        textured-mesh  no Gaussians: the mesh stays, colours of its vertices learn

    The device is the guidance's. On a CPU the same arguments give the same bytes, and so does a stage that
    goes on from another's `state_dict`. Raises MeshError for a mesh without faces or a count of Gaussians
    for which there is no table.
    """

    name = "refinement"

    def __init__(
        self,
        mesh: SurfaceMesh,
        guidance: Guidance,
        config: GenerationConfig,
        seed: int,
        *,
        start: Gaussians | Surfels | None = None,
    ) -> None:
        self.config = config.refinement
        c = self.config
        self.iterations, self.iteration = c.iterations, 0
        if not len(mesh.faces):
            raise MeshError(f"{mesh.source or 'mesh'} has no faces to bind Gaussians to")
        if start is not None and c.mode != "unbound":
            raise RequestError(f"refinement.mode {c.mode!r} starts on the mesh; only unbound takes `start`")
        textured = c.mode == "textured-mesh"
        if textured:  # depth has no gradient there
            config = config.model_copy(
                update={"score": config.score.model_copy(update={"depth_probability": 0.0})}
            )
        self._distillation = Distillation(self.name, guidance, config, c, seed)
        device = self._distillation.device
        self._start = bound_start(mesh, c).to(device)
        b = self._start
        self._descent = MeshDescent(b.faces, len(b.vertices), c.smoothing if c.mode == "bound" else 0.0)
        self._binding = TriangleBinding(b.faces, b.face_ids, b.barycentrics, len(b.vertices))
        self._textured = TexturedMesh(mesh, device, 2 if c.supersample == 1 else 1) if textured else None
        leaves = self._leaves(start)
        own = rates(c)
        own["vertices"] = own["means"] = (c.lr_vertex, c.lr_vertex_final)
        own["rotations"] = own["quats"]
        own["colors"] = (SH_C0 * own["dc"][0], SH_C0 * own["dc"][1])
        self._adam = Adam(leaves, {name: own[name] for name in leaves})

    def step(self) -> StepReport:
        """One iteration: views, images, score, regularisers, Adam."""
        with beside_torch(self._start.vertices):
            return self._step()

    def _step(self) -> StepReport:
        c, clock = self.config, Clock()
        views, generator = self._distillation.look(self.iteration)
        with clock.part("render"):
            cameras, backgrounds = self._distillation.rendered(views)
            deep = views.kind == "disparity" or c.tv > 0.0
            shot, regularisers, count = self._render(cameras, backgrounds, deep)
            images = self._distillation.pictures(shot, views)
        with clock.part("guidance"):
            score, psnr = self._distillation.judge(images, views, self.iteration, generator)
        loss = score + regularisers
        if c.tv > 0.0:
            loss = loss + c.tv * variation(shot)
        with clock.part("backward"):
            loss.backward()
        with clock.part("optimizer"):
            self._descend(self.iteration / max(1, self.iterations - 1))
        self.iteration += 1
        return StepReport(self.iteration, float(loss.detach()), psnr, count, clock.stop())

    @torch.no_grad()
    def _descend(self, share: float) -> None:
        """One step of Adam; vertices take theirs smoothed, and only as far as the mesh allows."""
        adam, gradient = self._adam, None
        if "vertices" in adam.parameters:
            gradient, adam["vertices"].grad = adam["vertices"].grad, None
        adam.step(share)
        if gradient is not None:
            step = adam.direction("vertices", self._descent.smooth(gradient), share)
            adam["vertices"].copy_(self._descent.moved(adam["vertices"], self._descent.smooth(step)))
        if "dc" in adam.parameters:
            adam["dc"].clamp_(min=float(rgb_to_sh(torch.tensor(DARKEST))))
        if "colors" in adam.parameters:
            adam["colors"].clamp_(0.0, 1.0)

    def result(self) -> BoundGaussians:
        """The refined mesh and its Gaussians in the unit frame; textured-mesh: opaque ones in its colours.

        Raises RequestError for unbound Gaussians, which ride no mesh.
        """
        a = {name: value.detach().clone() for name, value in self._adam.parameters.items()}
        if self.config.mode == "unbound":
            raise RequestError(
                "unbound Gaussians ride no mesh: take gaussians(), or set refinement.mode=bound"
            )
        if "colors" in a:
            corners = a["colors"][self._start.faces.long()][self._start.face_ids.long()]
            colors = (corners * self._start.barycentrics[:, :, None]).sum(1)
            sh = torch.zeros_like(self._start.sh)
            sh[:, 0] = rgb_to_sh(colors)
            return replace(self._start, sh=sh)
        return replace(
            self._start,
            vertices=a.get("vertices", self._start.vertices),
            rotations=a["rotations"],
            log_scales=a["log_scales"],
            opacity_logits=a["logits"],
            sh=harmonics(a),
        )

    def gaussians(self) -> Gaussians:
        """What there is now, as 3D Gaussians in the unit frame."""
        if self.config.mode != "unbound":
            return self.result().gaussians()
        a = {name: value.detach() for name, value in self._adam.parameters.items()}
        return Gaussians(
            a["means"].clone(),
            torch.nn.functional.normalize(a["quats"], dim=1),
            a["log_scales"].exp(),
            a["logits"].sigmoid(),
            harmonics(a).clone(),
        )

    def vertex_colors(self) -> np.ndarray:
        """sRGB colours in [0, 1] of the refined mesh's vertices, float32 [V, 3].

        The mean of the Gaussians on the faces around a vertex, by opacity and barycentric weight.
        """
        if "colors" in self._adam.parameters:
            return self._adam["colors"].detach().cpu().numpy().copy()
        bound = self.result().to("cpu")
        weights = bound.barycentrics * bound.opacity_logits.sigmoid()[:, None]
        colors = sh_to_rgb(bound.sh[:, 0]).clamp(0.0, 1.0)
        corners = bound.faces.long()[bound.face_ids.long()].ravel().numpy()
        count = len(bound.vertices)
        total = np.bincount(corners, weights.ravel().double().numpy(), count)
        values = (weights[:, :, None] * colors[:, None]).reshape(-1, 3).double().numpy()
        sums = np.stack([np.bincount(corners, values[:, k], count) for k in range(3)], 1)
        return (sums / np.maximum(total, 1e-12)[:, None]).astype(np.float32)

    def mesh(self) -> SurfaceMesh:
        """The refined mesh in the colours of its vertices. Raises RequestError for unbound Gaussians."""
        bound = self.result().to("cpu")
        faces = bound.faces.numpy()
        rgba = np.concatenate([self.vertex_colors(), np.ones((len(bound.vertices), 1), np.float32)], 1)
        return SurfaceMesh(
            bound.vertices.numpy(),
            faces,
            None,
            (rgba.clip(0.0, 1.0)[faces] * 255.0 + 0.5).astype(np.uint8),
            np.zeros(len(faces), np.int32),
            (MeshMaterial("refined", (1.0, 1.0, 1.0, 1.0)),),
        )

    def state_dict(self) -> dict[str, torch.Tensor]:
        parts = {"adam": self._adam.state_dict(), "score": self._distillation.state_dict()}
        return {"iteration": torch.tensor(self.iteration), **flat(parts)}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Raises KeyError or ValueError where the state is not that of such a stage."""
        entries = nested(state, "adam")
        for name, value in self._adam.parameters.items():
            if len(entries[name]) != len(value):
                raise ValueError(f"{name} must have {len(value)} rows, got {len(entries[name])}")
        self._adam.load_state_dict(entries)
        self._distillation.load_state_dict(nested(state, "score"))
        self.iteration = int(state["iteration"])

    def _leaves(self, start: Gaussians | Surfels | None) -> dict[str, torch.Tensor]:
        """What learns in this mode."""
        b, mode = self._start, self.config.mode
        if self._textured is not None:
            return {"colors": self._textured.start}
        own = {"log_scales": b.log_scales, "logits": b.opacity_logits}
        sh = b.sh
        if mode == "unbound":
            free = b.gaussians() if start is None else start.to(b.device)
            free = free.gaussians() if isinstance(free, Surfels) else free
            own = {
                "means": free.means,
                "quats": free.quats,
                "log_scales": free.scales.log(),
                "logits": torch.logit(free.opacities.clamp(1e-4, 1.0 - 1e-4)),
            }
            missing = sh.shape[1] - free.sh.shape[1]
            sh = torch.nn.functional.pad(free.sh, (0, 0, 0, max(0, missing)))[:, : sh.shape[1]]
        else:
            own["rotations"] = b.rotations
            if mode == "bound":
                own["vertices"] = b.vertices
        own["dc"] = sh[:, :1]
        return {**own, "rest": sh[:, 1:]} if sh.shape[1] > 1 else own

    def _render(
        self, cameras: Cameras, backgrounds: torch.Tensor, deep: bool
    ) -> tuple[Shot, torch.Tensor, int]:
        """Images, what the shape costs beside the score, and how many Gaussians there are.

        Without `deep` the depths are left out, [C, H, W, 0]: a channel less to blend.
        """
        c, a = self.config, self._adam.parameters
        if self._textured is not None:
            return self._textured.render(a["colors"], cameras, backgrounds), backgrounds.new_zeros(()), 0
        cost = a["logits"].new_zeros(())
        if c.mode == "unbound":
            means, quats, scales = a["means"], a["quats"], a["log_scales"].exp()
        else:
            vertices = a.get("vertices", self._start.vertices)
            means, quats, scales = self._binding(vertices, a["rotations"], a["log_scales"])
        if "vertices" in a and c.normal_consistency > 0.0:
            cost = cost + c.normal_consistency * self._descent.normal_consistency(a["vertices"])
        if "vertices" in a and c.laplacian > 0.0:
            cost = cost + c.laplacian * self._descent.laplacian(a["vertices"])
        if c.scale > 0.0:
            cost = cost + c.scale * scales.mean()
        sh = harmonics(a)
        image, alphas, _ = rasterization(
            means,
            quats,
            scales,
            a["logits"].sigmoid(),
            sh,
            cameras.viewmats,
            cameras.Ks,
            cameras.width,
            cameras.height,
            sh_degree=c.sh_degree,
            eps2d=c.eps2d,
            backgrounds=backgrounds,
            render_mode="RGB+ED" if deep else "RGB",
        )
        return Shot(cameras, image[..., :3], image[..., 3:], alphas), cost, len(means)


def bound_start(mesh: SurfaceMesh, config: RefinementConfig) -> BoundGaussians:
    """`config.per_triangle` Gaussians on every face, in its colours: where stage 2 starts.

    Barycentric weights of `barycentric_table`; scales in the plane the face's shortest edge times
    sqrt(3) / (3 sqrt(N)), along the normal `config.flatness` times that: a thick start fills the outline by
    itself, and the mesh stays inside. Raises MeshError for a count without a table.
    """
    per_triangle, opacity = config.per_triangle, config.initial_opacity
    table = barycentric_table(per_triangle)
    faces = mesh.faces
    face_ids = np.repeat(np.arange(len(faces), dtype=np.int32), per_triangle)
    weights = np.tile(table, (len(faces), 1)).astype(np.float32)
    corners = mesh.vertices.astype(np.float64)[faces]
    shortest = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2).min(1)
    size = np.maximum(shortest, 1e-6) * math.sqrt(3.0) / (3.0 * math.sqrt(per_triangle))
    count = len(face_ids)
    colors = SurfaceColors(mesh).at(face_ids, weights)[:, :3].clip(DARKEST, 1.0)
    sh = torch.zeros(count, (config.sh_degree + 1) ** 2, 3)
    sh[:, 0] = rgb_to_sh(torch.from_numpy(colors))
    return BoundGaussians(
        vertices=torch.from_numpy(mesh.vertices.copy()),
        faces=torch.from_numpy(faces.copy()),
        face_ids=torch.from_numpy(face_ids),
        barycentrics=torch.from_numpy(weights),
        rotations=torch.tensor([[1.0, 0.0]]).repeat(count, 1),
        log_scales=torch.from_numpy(np.log(size[face_ids, None] * [config.flatness, 1.0, 1.0])).float(),
        opacity_logits=torch.full((count,), math.log(opacity / (1.0 - opacity))),
        sh=sh,
    )


__all__ = ["RefinementStage", "bound_start"]
