"""Colours of points on a surface: base colour times texture times corner colour.

Stored colours are sRGB-encoded and stay so: a white base leaves texture bytes exactly as they are. Factors
multiply in linear light (glTF 2.0, section 3.9.2), as every renderer of these formats does.
"""

from __future__ import annotations

import numpy as np

from gdpro_sim.meshing.surface import SurfaceMesh


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Decode sRGB [0, 1] (IEC 61966-2-1)."""
    value = np.asarray(value, np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((np.maximum(value, 0.04045) + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(value: np.ndarray) -> np.ndarray:
    """Encode linear light [0, 1] as sRGB (IEC 61966-2-1); clips to [0, 1]."""
    value = np.clip(np.asarray(value, np.float64), 0.0, 1.0)
    return np.where(
        value <= 0.0031308, value * 12.92, 1.055 * np.maximum(value, 0.0031308) ** (1.0 / 2.4) - 0.055
    )


class Texture:
    """An image with box-filtered mip levels, sampled bilinearly with wrap-around. image: uint8 [H, W, C]."""

    def __init__(self, image: np.ndarray) -> None:
        self._levels = [image]

    def levels(self) -> list[np.ndarray]:
        """The image and its halvings down to one texel, each uint8 [H, W, C]."""
        while max(self._levels[-1].shape[:2]) > 1:
            image = self._levels[-1]
            height, width = image.shape[:2]
            # Odd sizes repeat the last row or column, size 1 stays.
            rows = (np.arange(0, height, 2), np.minimum(np.arange(1, height + 1, 2), height - 1))
            cols = (np.arange(0, width, 2), np.minimum(np.arange(1, width + 1, 2), width - 1))
            total = np.zeros((len(rows[0]), len(cols[0]), image.shape[2]), np.uint16)
            for row in rows:
                for col in cols:
                    total += image[row][:, col]
            self._levels.append(((total + 2) // 4).astype(np.uint8))
        return self._levels

    def sample(self, uv: np.ndarray, texels: np.ndarray | None = None) -> np.ndarray:
        """Colours in [0, 1] float32 [N, C] at `uv` [N, 2] (v up), averaged over about `texels` [N] texels
        each."""
        uv = np.where(np.isfinite(uv), uv, 0.0)
        if texels is None:
            return self._bilinear(0, uv)
        lod = np.maximum(0.5 * np.log2(np.maximum(texels, 1.0)), 0.0)
        out = np.zeros((len(uv), self._levels[0].shape[2]), np.float32)
        low = np.floor(lod).astype(np.int64)
        for level in np.unique(low):
            rows = np.flatnonzero(low == level)
            fraction = (lod[rows] - level)[:, None].astype(np.float32)
            value = self._bilinear(int(level), uv[rows])
            if fraction.any():
                value = value * (1.0 - fraction) + self._bilinear(int(level) + 1, uv[rows]) * fraction
            out[rows] = value
        return out

    def _bilinear(self, level: int, uv: np.ndarray) -> np.ndarray:
        levels = self.levels()
        image = levels[min(level, len(levels) - 1)]
        height, width = image.shape[:2]
        x = uv[:, 0] * width - 0.5
        y = (1.0 - uv[:, 1]) * height - 0.5
        x0, y0 = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        fx, fy = (x - x0)[:, None].astype(np.float32), (y - y0)[:, None].astype(np.float32)
        x0, x1, y0, y1 = x0 % width, (x0 + 1) % width, y0 % height, (y0 + 1) % height
        top = image[y0, x0] * (1.0 - fx) + image[y0, x1] * fx
        bottom = image[y1, x0] * (1.0 - fx) + image[y1, x1] * fx
        return np.asarray((top * (1.0 - fy) + bottom * fy) / np.float32(255.0), np.float32)


class SurfaceColors:
    """Colour lookups on one mesh; keeps the mip levels between calls."""

    def __init__(self, mesh: SurfaceMesh) -> None:
        self._mesh = mesh
        images: dict[int, Texture] = {}
        self._textures: list[Texture | None] = []
        for material in mesh.materials:
            image = material.texture
            if image is None or mesh.uv is None:
                self._textures.append(None)
            else:
                self._textures.append(images.setdefault(id(image), Texture(image)))

    @property
    def textured(self) -> bool:
        return any(texture is not None for texture in self._textures)

    def at(
        self, face_ids: np.ndarray, barycentrics: np.ndarray, area: np.ndarray | float = 0.0
    ) -> np.ndarray:
        """sRGB colour and opacity, float32 [N, 4] in [0, 1].

        face_ids [N], barycentrics [N, 3]; `area` (m^2, scalar or [N]) is the patch a texture is averaged
        over.
        """
        mesh = self._mesh
        face_ids = np.asarray(face_ids)
        weights = np.asarray(barycentrics, np.float32)
        out = np.empty((len(face_ids), 4), np.float32)
        material_of = mesh.material_ids[face_ids]
        areas = np.broadcast_to(np.asarray(area, np.float64), face_ids.shape)
        for index in np.unique(material_of):
            rows = np.flatnonzero(material_of == index)
            material, texture = mesh.materials[index], self._textures[index]
            factors = []
            if texture is not None and mesh.uv is not None:
                uv = np.einsum("nc,ncd->nd", weights[rows], mesh.uv[face_ids[rows]])
                value = texture.sample(uv, self._texels(face_ids[rows], areas[rows], material.texture))
                if not material.cutout:
                    value[:, 3] = 1.0
                factors.append(value)
            if mesh.colors is not None:
                corner = mesh.colors[face_ids[rows]].astype(np.float32) / 255.0
                if not (corner == 1.0).all():
                    factors.append(np.einsum("nc,ncd->nd", weights[rows], corner))
            base = np.asarray(material.base_color, np.float32)
            if not factors or not (base == 1.0).all():
                factors.append(np.broadcast_to(base, (len(rows), 4)))
            out[rows] = _product(factors)
        return out

    def _texels(self, face_ids: np.ndarray, areas: np.ndarray, image: np.ndarray | None) -> np.ndarray | None:
        mesh = self._mesh
        if image is None or mesh.uv is None or not areas.any():
            return None
        corner = mesh.vertices.astype(np.float64)[mesh.faces[face_ids]]
        edges = corner[:, 1:] - corner[:, :1]
        face_area = 0.5 * np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
        uv = mesh.uv[face_ids].astype(np.float64)
        d = uv[:, 1:] - uv[:, :1]
        uv_area = 0.5 * np.abs(d[:, 0, 0] * d[:, 1, 1] - d[:, 0, 1] * d[:, 1, 0])
        return uv_area * image.shape[0] * image.shape[1] * areas / np.maximum(face_area, 1e-30)


def _product(factors: list[np.ndarray]) -> np.ndarray:
    if len(factors) == 1:
        return np.clip(factors[0], 0.0, 1.0)
    out = np.ones_like(factors[0], dtype=np.float64)
    for factor in factors:
        out[:, :3] *= srgb_to_linear(factor[:, :3])
        out[:, 3] *= factor[:, 3]
    out[:, :3] = linear_to_srgb(out[:, :3])
    return out.astype(np.float32)


__all__ = ["SurfaceColors", "Texture", "linear_to_srgb", "srgb_to_linear"]
