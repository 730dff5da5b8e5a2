"""Simulations as time-sampled USD: written frame by frame, read back exactly.

    /Simulation            Xform, default prim; frame times and solver figures as time samples
        /<body>            Xform (PhysicsDeformableBodyAPI where it has tets)
            Mesh           deformed surface: points, normals, extent per frame
            Splats         ParticleField3DGaussianSplat: positions, orientations, scales, extent per frame
            Points         the same Gaussians for programs that drop splats (Blender)
            Tets           rest tetrahedra, with PhysicsMaterial
        /Base, Obstacles   see `gdpro_sim.io.usd_links`
        Cameras, Lights    how the scene is seen, see `gdpro_sim.io.usd_views`

Positions are the solver's float32 values in world space. Colours, opacities, topology and the binding are
written once.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Any, get_args

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, Vt

from gdpro_sim.asset import Asset, prims, stage
from gdpro_sim.asset.prims import Precision, SplatPrims, SplatSample
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import AssetError, OutputError, RequestError
from gdpro_sim.files import check_writable, commit_file, output_error, remove_quietly, temporary_beside
from gdpro_sim.gaussians import Gaussians, sh_to_rgb
from gdpro_sim.io.staging import Shot
from gdpro_sim.io.usd_links import (
    BASE,
    OBSTACLES,
    define_links,
    define_obstacles,
    read_links,
    read_obstacles,
    set_links,
    set_obstacles,
)
from gdpro_sim.io.usd_views import ViewPrims
from gdpro_sim.materials import Material
from gdpro_sim.meshing.tetmesh import TetMesh
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.frame import BodyFrame, Frame
from gdpro_sim.simulation.model import Body, Diagnostics, Model

log = logging.getLogger(__name__)

_FLUSH_BYTES = 64 << 20  # samples kept in memory before they are appended to the file
_FIGURES = "gdpro:diagnostics:"


@dataclass(frozen=True)
class BodyRecord:
    """What a simulation file keeps of one body besides its frames.

    name:          unique within the file
    gaussians:     the binding, in the body's own frame and size
    vertex_colors: [V, 3] float32 sRGB, or None
    tets:          rest tetrahedra in world space, or None
    material:      or None
    """

    name: str
    gaussians: BoundGaussians
    vertex_colors: np.ndarray | None = None
    tets: TetMesh | None = None
    material: Material | None = None


def body_records(model: Model, assets: Mapping[str, Asset]) -> tuple[BodyRecord, ...]:
    """Records of a compiled scene's bodies: world-space tets of `model`, the rest of `assets` by name."""
    records = []
    for body in model.bodies:
        asset = assets[body.name]
        colors = asset.vertex_colors if body.patches is None else body.vertex_colors
        (v0, v1), (t0, t1) = body.vertex_range, body.tet_range
        tets = None
        if t1 > t0:
            method = asset.tets.method if asset.tets is not None else "tetwild"
            tets = TetMesh(model.vertices[v0:v1], model.tets[t0:t1] - np.int32(v0), model.fill[t0:t1], method)
        records.append(BodyRecord(body.name, body.gaussians, colors, tets, asset.material))
    return tuple(records)


class SimulationWriter:
    """Write frames to a `.usdc`, `.usda` or `.usdz` file that appears, whole, on `close`.

        with SimulationWriter("fall.usdc", fps=30, bodies=[BodyRecord("bunny", asset.gaussians)]) as writer:
            for frame in run:
                writer.add(frame)

    Leaving the block writes the frames added so far, after an exception or Ctrl-C too; `abort` leaves none.

    fps:        frames per second; frame `i` stands at time code `i`
    precision:  "float" replays exactly (44 bytes per Gaussian and frame, mesh aside); "half" keeps positions
                exact and stores rotations and scales as halves, 5e-4 relative (30 bytes)
    animate_sh: write spherical harmonics per frame, turned with the body (12 bytes per coefficient);
                otherwise the first frame's serve for all. Without effect at degree 0.
    metadata:   JSON values kept in the file (scene, command, versions, seed)
    bodies:     in frame order; a compiled `Body` stands for its bare binding, `body_records` gives all
    gravity:    m/s^2, for other physics programs; None leaves it out
    ground:     height of the floor in m, for other physics programs; None leaves it out
    colliders:  the scene's
    links:      parts of a base; frames hold their poses after those of the colliders

    Raises RequestError where the path cannot be written, OutputError where writing fails.
    """

    def __init__(
        self,
        path: str | Path,
        fps: float,
        bodies: Sequence[BodyRecord | Body],
        *,
        precision: Precision = "float",
        animate_sh: bool = False,
        metadata: dict[str, Any] | None = None,
        gravity: Sequence[float] | None = None,
        ground: float | None = None,
        colliders: Sequence[Collider] = (),
        links: Sequence[Collider] = (),
    ) -> None:
        stage.check_suffix(path)
        if precision not in get_args(Precision):
            raise RequestError(f"precision must be 'float' or 'half', got {precision!r}")
        if not fps > 0:
            raise RequestError(f"fps must be > 0, got {fps}")
        names = [body.name for body in bodies]
        if not names or len(set(names)) != len(names):
            raise RequestError(f"a simulation needs bodies with unique names, got {names}")
        self.path = Path(path)
        self.frames = 0
        self._target = check_writable(path)
        self._records = tuple(
            b if isinstance(b, BodyRecord) else BodyRecord(b.name, b.gaussians) for b in bodies
        )
        self._precision = precision
        self._animate_sh = animate_sh
        self._gravity = gravity
        self._ground = ground
        self._colliders, self._links = tuple(colliders), tuple(links)
        self._ops: list[Any] = []
        self._obstacle_ops: dict[int, Any] = {}
        self._fps = float(fps)
        self._metadata = json.dumps(metadata or {}, allow_nan=False)
        self._prims: list[tuple[Usd.Prim, SplatPrims]] = []
        self._views: ViewPrims | None = None
        self._faces = [prims.to_numpy(body.gaussians.faces) for body in bodies]
        self._welded = [body.gaussians.to("cpu").welded for body in bodies]
        self._first = self._last = 0
        self._pending = 0
        self._open = True
        packed = self._target.suffix.lower() == ".usdz"
        self._temporary = temporary_beside(self._target.with_suffix(".usdc") if packed else self._target)
        with self._guard():
            self._layer = Sdf.Layer.CreateNew(str(self._temporary))
            self._stage = stage.new_stage(self._layer, "Simulation", "simulation")

    # ---- frames ----

    def add(self, frame: Frame, shot: Shot | None = None) -> None:
        """Append one frame; indices must increase. shot: how it is seen, of every frame or of none.

        Raises ValueError for a frame that does not fit the bodies, OutputError where writing fails (the
        temporary file is then gone and the writer closed).
        """
        if not self._open:
            raise ValueError(f"{self.path}: the writer is closed")
        self._check(frame)
        samples = [
            SplatSample.of(b.gaussians, self._precision, sh=self._animate_sh and b.gaussians.sh_degree > 0)
            for b in frame.bodies
        ]
        with self._guard():
            if self.frames == 0:
                self._define(frame, samples)
                if shot is not None:
                    root = self._stage.GetDefaultPrim().GetPath()
                    self._views = ViewPrims(self._stage, root, shot.cameras, shot.lights)
                self._first = frame.index
            with Sdf.ChangeBlock():
                self._sample(frame, samples)
                if self._views is not None and shot is not None:
                    self._views.set(shot.cameras, shot.lights, float(frame.index))
            self.frames += 1
            self._last = frame.index
            self._pending += sum(48 * len(b.gaussians) + 24 * len(b.vertices) for b in frame.bodies)
            if self._pending > _FLUSH_BYTES:
                self._save()

    def _check(self, frame: Frame) -> None:
        names = [body.name for body in frame.bodies]
        if names != [record.name for record in self._records]:
            raise ValueError(
                f"frame {frame.index} has bodies {names}, expected {[r.name for r in self._records]}"
            )
        if self.frames and frame.index <= self._last:
            raise ValueError(f"frame index must increase: {frame.index} after {self._last}")
        for body, record in zip(frame.bodies, self._records, strict=True):
            shape = tuple(record.gaussians.vertices.shape)
            if body.vertices.shape != shape or body.vertices.dtype != np.float32:
                raise ValueError(
                    f"body {body.name!r}: vertices must be float32 {list(shape)}, "
                    f"got {body.vertices.dtype} {list(body.vertices.shape)}"
                )
            if len(body.gaussians) != len(record.gaussians):
                raise ValueError(
                    f"body {body.name!r}: {len(body.gaussians)} Gaussians, expected {len(record.gaussians)}"
                )
            if not np.isfinite(body.vertices).all():
                raise ValueError(f"body {body.name!r}: vertices of frame {frame.index} are not finite")

    def _define(self, frame: Frame, samples: list[SplatSample]) -> None:
        """Author everything static, and the first frame as default values."""
        root = self._stage.GetDefaultPrim()
        self._stage.SetTimeCodesPerSecond(self._fps)
        self._stage.SetFramesPerSecond(self._fps)
        stage.set_custom(root, "gdpro:metadata", prims.T.String, self._metadata)
        stage.set_custom(root, "gdpro:precision", prims.T.String, self._precision)
        root.CreateAttribute("gdpro:time", prims.T.Double, True)
        if frame.colliders is not None:
            root.CreateAttribute("gdpro:colliders", prims.T.DoubleArray, True)
        for figure in fields(Diagnostics):
            root.CreateAttribute(_FIGURES + figure.name, _FIGURE_TYPES[str(figure.type)][0], True)
        taken = {BASE, OBSTACLES}
        self._ops = define_links(self._stage, root.GetPath(), self._links)
        self._obstacle_ops = define_obstacles(self._stage, root.GetPath(), self._colliders)
        paths = []
        for record, body, sample in zip(self._records, frame.bodies, samples, strict=True):
            path = root.GetPath().AppendChild(_identifier(record.name, taken))
            paths.append(str(path))
            self._prims.append(self._define_body(path, record, body, sample))
        stage.set_custom(root, "gdpro:bodies", prims.T.StringArray, paths)
        if self._gravity is not None:
            self._define_gravity(root.GetPath(), self._gravity)
        if self._ground is not None:
            plane = UsdGeom.Plane.Define(
                self._stage, root.GetPath().AppendChild(_identifier("Ground", taken))
            )
            plane.CreateAxisAttr(UsdGeom.Tokens.z)
            plane.CreatePurposeAttr(UsdGeom.Tokens.guide)
            plane.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, float(self._ground)))
            UsdPhysics.CollisionAPI.Apply(plane.GetPrim())

    def _define_body(
        self, path: Sdf.Path, record: BodyRecord, body: BodyFrame, sample: SplatSample
    ) -> tuple[Usd.Prim, SplatPrims]:
        xform = UsdGeom.Xform.Define(self._stage, path).GetPrim()
        Usd.ModelAPI(xform).SetKind("component")
        stage.set_custom(xform, "gdpro:name", prims.T.String, record.name)
        bound = record.gaussians
        average = prims.to_numpy(sh_to_rgb(bound.sh[:, 0])).mean(0, dtype=np.float64)
        mesh = prims.define_mesh(
            self._stage,
            path,
            body.vertices,
            prims.to_numpy(bound.faces),
            record.vertex_colors,
            average,
            bound.to("cpu").welded,
        )
        splats = SplatPrims.define(self._stage, path, body.gaussians, sample, self._precision)
        prims.write_binding(mesh, splats.splats, bound)
        tets = None
        if record.tets is not None:
            tets = prims.define_tets(self._stage, path, record.tets)
            xform.AddAppliedSchema("PhysicsDeformableBodyAPI")
        if record.material is not None:
            prims.define_material(self._stage, path, record.material, tets)
        return mesh, splats

    def _define_gravity(self, root: Sdf.Path, gravity: Sequence[float]) -> None:
        scene = UsdPhysics.Scene.Define(self._stage, root.AppendChild("PhysicsScene"))
        vector = np.asarray(gravity, np.float64)
        magnitude = float(np.linalg.norm(vector))
        direction = vector / magnitude if magnitude > 0 else np.array([0.0, 0.0, -1.0])
        scene.CreateGravityDirectionAttr(Gf.Vec3f(*(float(x) for x in direction)))
        scene.CreateGravityMagnitudeAttr(magnitude)

    def _sample(self, frame: Frame, samples: list[SplatSample]) -> None:
        code = Usd.TimeCode(float(frame.index))
        root = self._stage.GetDefaultPrim()
        root.GetAttribute("gdpro:time").Set(float(frame.time), code)
        if frame.colliders is not None:
            root.GetAttribute("gdpro:colliders").Set(Vt.DoubleArray.FromNumpy(frame.colliders.ravel()), code)
        if self._ops and frame.colliders is not None:
            set_links(self._ops, frame.colliders[-len(self._ops) :], code)
        set_obstacles(self._obstacle_ops, self._colliders, frame, code)
        for figure in fields(Diagnostics):
            to_usd = _FIGURE_TYPES[str(figure.type)][1]
            root.GetAttribute(_FIGURES + figure.name).Set(
                to_usd(getattr(frame.diagnostics, figure.name)), code
            )
        for body, sample, faces, welded, (mesh, splats) in zip(
            frame.bodies, samples, self._faces, self._welded, self._prims, strict=True
        ):
            prims.set_mesh(mesh, body.vertices, faces, code, welded=welded)
            splats.set(sample, code)

    # ---- ending ----

    def close(self) -> None:
        """Write what was added and put the file in place; with no frame at all, leave nothing.

        Raises OutputError where writing fails.
        """
        if not self._open:
            return
        if self.frames == 0:
            log.warning("%s was not written: the simulation produced no frame", self.path)
            self.abort()
            return
        with self._guard():
            self._layer.startTimeCode = float(self._first)
            self._layer.endTimeCode = float(self._last)
            self._save()
            self._release()
            finished = self._temporary
            if self._target.suffix.lower() == ".usdz":
                archive = temporary_beside(self._target)
                try:
                    stage.pack(finished, archive, self._target.stem, self.path)
                except BaseException:
                    remove_quietly(archive)
                    raise
                remove_quietly(finished)
                finished = archive
            commit_file(finished, self._target)
        log.info("wrote %d frames to %s", self.frames, self.path)

    def abort(self) -> None:
        """Stop and leave nothing behind; a file that `path` held before stays."""
        if self._open:
            self._release()
        remove_quietly(self._temporary)

    def __enter__(self) -> SimulationWriter:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _save(self) -> None:
        if not self._layer.Save():
            raise OutputError(f"cannot write {self.path}: USD could not write it (disk full?)")
        self._pending = 0

    def _release(self) -> None:
        self._open = False
        self._prims, self._ops = [], []
        self._views = None
        del self._stage, self._layer

    def _guard(self) -> _Guard:
        return _Guard(self)


class _Guard:
    """Turns what goes wrong while writing into OutputError, after removing the temporary file."""

    def __init__(self, writer: SimulationWriter) -> None:
        self._writer = writer

    def __enter__(self) -> None:
        return None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not isinstance(error, OutputError | OSError | Tf.ErrorException | MemoryError):
            return
        writer = self._writer
        writer._open = False
        writer._prims, writer._ops = [], []
        writer._views = None
        writer.__dict__.pop("_stage", None)
        writer.__dict__.pop("_layer", None)
        remove_quietly(writer._temporary)
        if isinstance(error, OSError):
            raise output_error(writer.path, error) from error
        if isinstance(error, Tf.ErrorException):
            raise OutputError(f"cannot write {writer.path}: {stage.usd_message(error)}") from error


def _identifier(name: str, taken: set[str]) -> str:
    """A prim name for `name` that is not in `taken`, which it joins."""
    base = Tf.MakeValidIdentifier(name) or "Body"
    chosen, number = base, 1
    while chosen in taken or chosen in ("PhysicsScene", "Cameras", "Lights"):
        number += 1
        chosen = f"{base}_{number}"
    taken.add(chosen)
    return chosen


# annotation in Diagnostics -> USD type, value to USD, value from USD
_FIGURE_TYPES: dict[str, tuple[Any, Any, Any]] = {
    "float": (prims.T.Double, float, float),
    "int": (prims.T.Int64, int, int),
    "bool": (prims.T.Bool, bool, bool),
    "tuple[float, float, float]": (
        prims.T.Double3,
        lambda v: Gf.Vec3d(*(float(x) for x in v)),
        lambda v: (float(v[0]), float(v[1]), float(v[2])),
    ),
}


class SimulationReader:
    """Frames of a simulation file, read from the file when asked for.

    fps:      frames per second
    times:    seconds of each frame
    bodies:   the `BodyRecord` of each body (binding, faces, colours, rest tets, material)
    links:    parts of a base as they are at the start
    obstacles: surfaces of the scene's colliders as they are at the start, by number
    metadata: as given to the writer

    Raises AssetError for a missing, corrupt or foreign file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        layer = stage.open_layer(path, lazy=True)
        self._stage, self._root = stage.open_root(layer, path, "simulation")
        with stage.reading(path):
            times = self._root.GetAttribute("gdpro:time")
            self.fps = float(self._stage.GetTimeCodesPerSecond())
            self._codes = [float(code) for code in times.GetTimeSamples()]
            self.times = [float(times.Get(code)) for code in self._codes]
            self.precision = str(self._root.GetAttribute("gdpro:precision").Get())
            try:
                metadata = json.loads(self._root.GetAttribute("gdpro:metadata").Get() or "{}")
            except ValueError as error:
                raise AssetError(f"gdpro:metadata is not JSON: {error}") from error
            self.metadata: dict[str, Any] = metadata
            self._paths = [Sdf.Path(p) for p in self._root.GetAttribute("gdpro:bodies").Get() or []]
            self.bodies = tuple(self._body(p) for p in self._paths)
            self.links = read_links(self._stage, self._root.GetPath())
            self.obstacles = read_obstacles(self._stage, self._root.GetPath())

    def __len__(self) -> int:
        return len(self._codes)

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(i) for i in range(len(self)))

    @property
    def body_names(self) -> tuple[str, ...]:
        return tuple(body.name for body in self.bodies)

    def frame(self, index: int) -> Frame:
        """The `index`-th frame (from 0), Gaussians on the CPU; positions are the written bits.

        Raises IndexError beyond the end, AssetError where the file is damaged.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"{self.path} has frames 0-{len(self) - 1}, got {index}")
        code = self._codes[index]
        with stage.reading(f"{self.path}, frame {index}"):
            bodies = tuple(
                BodyFrame(body.name, self._vertices(p, code), self._gaussians(p, code))
                for body, p in zip(self.bodies, self._paths, strict=True)
            )
            figures = {}
            for figure in fields(Diagnostics):
                value = self._root.GetAttribute(_FIGURES + figure.name).Get(code)
                if value is None and figure.default is MISSING:
                    raise AssetError(f"{_FIGURES}{figure.name} is missing")
                if value is None:  # written before there was such a figure
                    continue
                figures[figure.name] = _FIGURE_TYPES[str(figure.type)][2](value)
            poses = self._root.GetAttribute("gdpro:colliders").Get(code)
        colliders = None if poses is None else np.array(poses).reshape(-1, 3, 4)
        return Frame(int(code), self.times[index], bodies, Diagnostics(**figures), colliders)

    def _vertices(self, path: Sdf.Path, code: float) -> np.ndarray:
        return prims.read(self._child(path, "Mesh"), "points", np.float32, (-1, 3), code)

    def _gaussians(self, path: Sdf.Path, code: float) -> Gaussians:
        return prims.read_splats(self._child(path, "Splats"), code)

    def _child(self, path: Sdf.Path, name: str) -> Usd.Prim:
        prim = self._stage.GetPrimAtPath(path.AppendChild(name))
        if not prim:
            raise AssetError(f"prim {path.AppendChild(name)} is missing; the file is damaged")
        return prim

    def _body(self, path: Sdf.Path) -> BodyRecord:
        mesh, splats = self._child(path, "Mesh"), self._child(path, "Splats")
        bound = prims.read_binding(mesh, splats)
        colors = None
        if mesh.GetAttribute("gdpro:vertexColors"):
            colors = prims.read(mesh, "gdpro:vertexColors", np.float32, (len(bound.vertices), 3))
        tets = self._stage.GetPrimAtPath(path.AppendChild("Tets"))
        material = self._stage.GetPrimAtPath(path.AppendChild("PhysicsMaterial"))
        name = self._stage.GetPrimAtPath(path).GetAttribute("gdpro:name").Get()
        return BodyRecord(
            str(name),
            bound,
            colors,
            prims.read_tets(tets) if tets else None,
            prims.read_material(material) if material else None,
        )


def is_simulation(path: str | Path) -> bool:
    """Whether a file is one of our simulations. Raises AssetError for a missing or corrupt file."""
    return stage.kind(path) == "simulation"


__all__ = ["BodyRecord", "SimulationReader", "SimulationWriter", "body_records", "is_simulation"]
