"""The visual hull of photos with opacity: where every photo that sees a point sees the object.

A point's distance from a silhouette, in the world, is its distance in the picture times depth over focal
length. The hull's distance is the largest over the photos, up to a few that may be wrong (Laurentini 1994,
with a share of outliers).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, map_coordinates

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.objects.isosurface import isosurface
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.priors.remeshing import mesh_of, neighbours_mean, smoothed, without_crumbs
from gdpro_sim.generation.protocols import CoarseMesh
from gdpro_sim.generation.renders import MeshRenderer
from gdpro_sim.meshing.repair import face_normals
from gdpro_sim.meshing.surface import SurfaceMesh

CELLS = 64
BOX = 1.1
"""Half the edge of the cube that is searched, in the unit frame."""

PROBES = 40
"""Points across the cube of which one must lie inside."""

SMOOTHING = 6
CRUMB = 0.02
"""Pieces of less than this share of the largest one's volume are dropped."""

PHOTOS = 64
"""More photos are thinned out evenly: they add time and little shape."""

COLOR_PHOTOS = 32
MASK_SIZE = 320
"""Longest side of a silhouette in pixels; larger ones are reduced."""

OUTLIERS = 0.05
"""Share of the photos that see a point and may say it is outside though it is not."""

LEAST_VIEWS = 2
"""Photos that must see a point for it to be inside."""

COLOR_SIZE = 200
"""Longest side in pixels of the depth pictures that tell which vertices a photo sees."""


class Silhouettes:
    """Signed distances to the silhouettes of photos, in the frame the photos' cameras are in."""

    def __init__(self, photos: Photos) -> None:
        self.views, self.ks, self.maps = [], [], []
        for index in _thinned(len(photos), PHOTOS):
            alpha = photos.pictures[index][..., 3]
            factor = max(1, -(-max(alpha.shape) // MASK_SIZE))
            mask = _reduced(alpha, factor) > 0.5
            if not mask.any():
                continue  # the object is not in this photo; what it sees says nothing about the others
            inside, outside = distance_transform_edt(mask), distance_transform_edt(~mask)
            # From the pixel's border, where the silhouette runs, not from the next pixel's centre.
            self.maps.append((np.where(mask, 0.5 - inside, outside - 0.5) * factor).astype(np.float32))
            self.views.append(photos.viewmats[index])
            self.ks.append((photos.Ks[index], factor))

    def distance(self, points: np.ndarray) -> np.ndarray:
        """About the signed distance of points [3, N] from the hull, negative inside; float32 [N]."""
        count = points.shape[1]
        found = np.full((len(self.maps), count), -np.inf, np.float32)
        for row, (view, (k, factor), picture) in enumerate(zip(self.views, self.ks, self.maps, strict=True)):
            x = view[:3, :3] @ points + view[:3, 3:]
            z = np.maximum(x[2], 1e-9)
            u, v = k[0, 0] * x[0] / z + k[0, 2], k[1, 1] * x[1] / z + k[1, 2]
            height, width = picture.shape[0] * factor, picture.shape[1] * factor
            seen = (x[2] > 1e-6) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
            where = np.stack([v[seen] / factor - 0.5, u[seen] / factor - 0.5])
            pixels = map_coordinates(picture, where, order=1, mode="nearest")
            found[row, seen] = pixels * z[seen] / (0.5 * (k[0, 0] + k[1, 1]))
        views = np.isfinite(found).sum(0)
        skipped = np.floor(OUTLIERS * views).astype(np.int64)
        ordered = np.sort(found, axis=0)[::-1]  # the largest first, photos that do not see it last
        out = ordered[np.minimum(skipped, len(found) - 1), np.arange(count)]
        return np.where(views >= min(LEAST_VIEWS, len(found)), out, FAR).astype(np.float32)


FAR = np.float32(1e3)


class HullPrior:
    """The visual hull of photos given in the unit frame, coloured by them."""

    def __init__(self, photos: Photos) -> None:
        self.photos = photos

    def mesh(self, prompt: str, seed: int) -> CoarseMesh:
        """The hull in the unit frame: photos know no size. Raises GuidanceError where there is none."""
        vertices, faces = hull(self.photos)
        colors = np.full((len(vertices), 4), 255, np.uint8)
        colors[:, :3] = vertex_colors(vertices, faces, self.photos) * 255.0 + 0.5
        surface = mesh_of(vertices, faces, colors[faces], messages=("visual hull of photos",))
        return CoarseMesh(surface, None, {**self.describe(), "faces": len(faces)})

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""
        return {
            "kind": "hull",
            "label": "visual hull of the given photos: hollows that no outline shows are filled",
            "photos": len(self.photos),
            "cells": CELLS,
            "metric": False,
        }


def hull(photos: Photos, cells: int = CELLS) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] float32 and faces [F, 3] int32 of the visual hull, closed and smoothed.

    photos: in the unit frame. Raises GuidanceError where no point is inside every photo's silhouette.
    """
    silhouettes = Silhouettes(photos)
    corner = np.full(3, BOX)

    def field(points: np.ndarray) -> np.ndarray:
        # Closed at the cube's sides, whatever lies beyond.
        return np.maximum(silhouettes.distance(points), np.abs(points).max(0) - np.float32(BOX))

    steps = BOX * np.linspace(-1.0, 1.0, PROBES)
    if not (silhouettes.distance(np.stack(np.meshgrid(steps, steps, steps)).reshape(3, -1)) < 0.0).any():
        raise GuidanceError(
            "the photos' silhouettes have no point in common: check that cameras and photos belong together, "
            "and that alpha or the masks show the object"
        )
    vertices, faces = isosurface(field, -corner, corner, cells)
    vertices, faces, _ = without_crumbs(vertices, faces, CRUMB)
    return smoothed(vertices, faces, SMOOTHING), faces


def vertex_colors(vertices: np.ndarray, faces: np.ndarray, photos: Photos) -> np.ndarray:
    """sRGB colours [V, 3] in [0, 1] of a surface's vertices, from the photos that see them face on.

    Vertices that no photo sees take their neighbours' colour.
    """
    normals = np.zeros((len(vertices), 3))
    flat = face_normals(vertices, faces)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], flat)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    renderer = MeshRenderer(SurfaceMesh.from_arrays(vertices, faces))
    total, weight = np.zeros((len(vertices), 3)), np.zeros(len(vertices))
    slack = 2.0 * float(np.sqrt(np.median(np.linalg.norm(flat, axis=1))))
    for index in _thinned(len(photos), COLOR_PHOTOS):
        picture, view = photos.pictures[index], photos.viewmats[index]
        camera = photos.camera(index)
        scale = min(1.0, COLOR_SIZE / max(camera.width, camera.height))
        small = Cameras(
            camera.viewmats,
            camera.Ks * torch.tensor([[scale], [scale], [1.0]]),
            max(1, round(camera.width * scale)),
            max(1, round(camera.height * scale)),
        )
        depth = renderer.render(small, rays=1).depths[0, ..., 0].numpy()
        x = vertices.astype(np.float64) @ view[:3, :3].T + view[:3, 3]
        z = np.maximum(x[:, 2], 1e-9)
        uv = x[:, :2] / z[:, None] * photos.Ks[index][[0, 1], [0, 1]] + photos.Ks[index][:2, 2]
        facing = -np.einsum("vc,vc->v", normals, vertices - photos.centres[index])
        facing /= np.maximum(np.linalg.norm(vertices - photos.centres[index], axis=1), 1e-9)
        pixel = np.floor(uv).astype(np.int64)
        seen = (x[:, 2] > 1e-6) & (facing > 0.1) & (pixel >= 0).all(1)
        seen &= (pixel < [picture.shape[1], picture.shape[0]]).all(1)
        rows = np.flatnonzero(seen)
        place = np.minimum((uv[rows] * scale).astype(np.int64), [small.width - 1, small.height - 1])
        nearest = depth[place[:, 1], place[:, 0]]
        rows = rows[(nearest > 0.0) & (z[rows] < nearest + slack)]
        rgba = picture[pixel[rows, 1], pixel[rows, 0]].astype(np.float64) / 255.0
        share = rgba[:, 3] * facing[rows] ** 3
        share[rgba[:, 3] < 0.5] = 0.0
        total[rows] += share[:, None] * rgba[:, :3]
        weight[rows] += share
    known = weight > 1e-6
    if not known.any():
        return np.full((len(vertices), 3), 0.5)
    colors = np.where(known[:, None], total / np.maximum(weight, 1e-6)[:, None], 0.0)
    return _filled(colors, known, faces)


def _filled(colors: np.ndarray, known: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Colours with the unknown ones spread in from known neighbours, ring by ring; grey where none lead."""
    mean = neighbours_mean(faces, len(colors))
    known = known.copy()
    while not known.all():
        share = mean @ known.astype(np.float64)
        reached = ~known & (share > 0.0)
        if not reached.any():
            colors[~known] = 0.5
            break
        colors[reached] = (mean @ np.where(known[:, None], colors, 0.0))[reached] / share[reached, None]
        known |= reached
    return np.clip(colors, 0.0, 1.0)


def _thinned(count: int, most: int) -> np.ndarray:
    """At most `most` numbers spread over range(count)."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _reduced(alpha: np.ndarray, factor: int) -> np.ndarray:
    """Opacity in [0, 1] averaged over squares of `factor` pixels, the last ones repeated where needed."""
    if factor == 1:
        return alpha / 255.0
    height, width = (-(-n // factor) * factor for n in alpha.shape)
    padded = np.pad(alpha, ((0, height - alpha.shape[0]), (0, width - alpha.shape[1])), mode="edge")
    return padded.reshape(height // factor, factor, width // factor, factor).mean((1, 3)) / 255.0


__all__ = ["HullPrior", "Silhouettes", "hull", "vertex_colors"]
