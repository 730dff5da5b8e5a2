"""`gdpro generate`: a run in a folder, with checkpoints, pictures of every stage, and the asset at the end.

A run folder holds `run.json` (what was asked for), `NAME.safetensors` (checkpoints and finished stages),
`NAME.png` (a turntable of each stage), `log.jsonl` (figures of every iteration) and `timing.json`.
"""

from __future__ import annotations

import contextlib
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file, save_file

import gdpro_sim
from gdpro_sim.asset import Asset
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.device import resolve_device, serial_torch
from gdpro_sim.errors import GuidanceError, RequestError
from gdpro_sim.files import atomic_write, prepare_folder, remove_quietly, remove_stale
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation import pipeline
from gdpro_sim.generation.config import GenerationConfig, load_config
from gdpro_sim.generation.protocols import Stage, StepReport
from gdpro_sim.io.sources import Inputs, open_source
from gdpro_sim.io.turntable import write_turntable
from gdpro_sim.meshing.surface import SurfaceMesh

logger = logging.getLogger(__name__)

RUN_FORMAT = 1
"""Raise it when runs of an earlier version must not be continued."""

LOG = "log.jsonl"

Progress = Callable[[str, int, int, Mapping[str, Any]], None]
"""Called with (part, done, total, figures); total 0 means the length is not known. Figures of a step: loss,
psnr (dB or None), gaussians."""


@dataclass(frozen=True)
class Request:
    """What a run was asked for; kept in `run.json`, and enough to take the run up again."""

    inputs: Inputs
    config: GenerationConfig
    seed: int = 0

    def to_json(self) -> dict[str, Any]:
        """Plain data: inputs with the SHA-256 of their files, configuration, seed, format."""
        return {
            "format": RUN_FORMAT,
            "version": gdpro_sim.__version__,
            "inputs": self.inputs.to_json(),
            "config": self.config.model_dump(mode="json"),
            "seed": self.seed,
        }

    @staticmethod
    def read(folder: str | Path) -> Request:
        """The request kept in a run folder. Raises RequestError for a folder that holds no run of ours."""
        path = Path(folder) / "run.json"
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise RequestError(f"{folder} holds no run (no run.json); give the folder of --run") from None
        except (OSError, ValueError) as error:
            raise RequestError(f"{path}: cannot be read ({error})") from None
        if not isinstance(data, dict) or data.get("format") != RUN_FORMAT:
            raise RequestError(f"{path}: made by another version of gdpro-sim; start the run anew")
        config = load_config(base=data["config"])
        return Request(Inputs.from_json(data["inputs"]), config, int(data["seed"]))


@dataclass
class GenerationResult:
    """The asset, and how long each part took (seconds of this process; resumed parts count 0)."""

    asset: Asset
    seconds: dict[str, float] = field(default_factory=dict)
    iterations: dict[str, int] = field(default_factory=dict)


@serial_torch()
def generate_run(
    request: Request,
    folder: str | Path | None = None,
    *,
    device: str = "auto",
    anew: bool = False,
    accept_slow: bool = False,
    on_progress: Progress | None = None,
) -> GenerationResult:
    """Generate an asset; with `folder`, keep checkpoints and pictures there and go on from what it holds.

    anew:        where the folder holds a run of another request, replace it instead of refusing
    accept_slow: start even where a diffusion model on a CPU will take days

    Raises RequestError (also GuidanceError, MeshError) for a wrong request, OutputError for a full disk; the
    last checkpoint stays intact.
    """
    name = resolve_device(device)
    with _run_folder(request, folder, anew) as (store, pictures):
        observer = _Observer(on_progress, pictures, request.config)
        observer.phase("prepare")
        source = open_source(
            request.inputs, request.config, request.seed, device=name, accept_slow=accept_slow
        )
        asset = pipeline.run(source, request.config, request.seed, store=store, observer=observer)
        observer.close()
    return GenerationResult(asset, observer.seconds, observer.iterations)


def generate(
    prompt: str | None = None,
    *,
    mesh: str | Path | None = None,
    images: str | Path | None = None,
    splat: str | Path | None = None,
    quality: str = "default",
    config: GenerationConfig | None = None,
    seed: int = 0,
    ignore_unknown: bool = False,
    run: str | Path | None = None,
    device: str = "auto",
    on_progress: Progress | None = None,
) -> Asset:
    """An asset from a prompt, a mesh file, a folder of photos with cameras, or a splat cloud.

    quality: draft, default, high or paper; `config` takes its place
    seed:    of every random draw; the same seed gives the same bytes on a CPU
    ignore_unknown: go on where the built-in vocabulary does not know a word
    run:     folder for checkpoints and pictures; an interrupted run in it goes on

    >>> generate("a red mug with a blue handle").save("mug.usdc")  # doctest: +SKIP

    Raises RequestError, GuidanceError, MeshError, OutputError.
    """
    inputs = Inputs(
        prompt=prompt or "",
        mesh=None if mesh is None else str(mesh),
        images=None if images is None else str(images),
        splat=None if splat is None else str(splat),
        ignore_unknown=ignore_unknown,
    )
    request = Request(inputs, config or load_config(quality), seed)
    return generate_run(request, run, device=device, on_progress=on_progress).asset


@contextlib.contextmanager
def _run_folder(
    request: Request, folder: str | Path | None, anew: bool
) -> Iterator[tuple[_FolderStore | None, Path | None]]:
    if folder is None:
        yield None, None
        return
    path = prepare_folder(folder, "run.json")
    remove_stale(path)
    marker, wanted = path / "run.json", request.to_json()
    if anew and marker.exists() and _kept(marker) != wanted:
        for old in [marker, *path.glob("*.safetensors"), *path.glob("*.png"), path / LOG]:
            remove_quietly(old)
    if marker.exists():
        kept = Request.read(path).to_json()
        if kept != wanted:
            different = [key for key in wanted if kept.get(key) != wanted[key]]
            raise RequestError(
                f"{path} holds another run (its {' and '.join(different)} differ); continue that one with "
                f"--resume {path}, or give an empty folder"
            )
    elif any(path.glob("*.safetensors")):
        raise RequestError(f"{path} holds checkpoints but no run.json; give an empty folder")
    else:
        with atomic_write(marker) as temporary:
            temporary.write_text(json.dumps(wanted, indent=1), encoding="utf-8")
    yield _FolderStore(path), path


def _kept(marker: Path) -> Any:
    try:
        return json.loads(marker.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None


class _FolderStore:
    """Tensors in `NAME.safetensors`, each file whole or not at all."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def load(self, name: str) -> dict[str, torch.Tensor] | None:
        path = self._folder / f"{name}.safetensors"
        if not path.exists():
            return None
        try:
            return load_file(path)
        except Exception as error:  # safetensors raises its own kind for damaged files
            raise GuidanceError(
                f"{path}: damaged checkpoint ({error}); delete it to redo that part"
            ) from error

    def save(self, name: str, tensors: Mapping[str, torch.Tensor]) -> None:
        plain = {key: value.detach().cpu().contiguous().clone() for key, value in tensors.items()}
        with atomic_write(self._folder / f"{name}.safetensors") as temporary:
            try:
                save_file(plain, temporary)
            except Exception as error:
                raise _as_os_error(error) from error


def _as_os_error(error: Exception) -> OSError:
    """safetensors hides the operating system's error number in its message."""
    import errno

    text = str(error)
    full = "No space left" in text or "os error 28" in text or "File too large" in text
    return error if isinstance(error, OSError) else OSError(errno.ENOSPC if full else errno.EIO, text)


class _Observer(pipeline.Observer):
    """Turns what happens into progress, pictures, a log and timings."""

    def __init__(self, report: Progress | None, folder: Path | None, config: GenerationConfig) -> None:
        self._report = report or (lambda part, done, total, figures: None)
        self._folder, self._config = folder, config
        self._part, self._begin = "", time.perf_counter()
        self._log = _read_log(folder)
        self.seconds: dict[str, float] = {}
        self.iterations: dict[str, int] = {}
        self._shares: dict[str, dict[str, float]] = {}

    def phase(self, name: str) -> None:
        self._enter(name)
        self._report(name, 0, 0, {})

    def stepped(self, stage: Stage, report: StepReport) -> None:
        self._enter(stage.name)
        self.iterations[stage.name] = self.iterations.get(stage.name, 0) + 1
        shares = self._shares.setdefault(stage.name, {})
        for part, value in report.seconds.items():
            shares[part] = shares.get(part, 0.0) + value
        figures = {"loss": report.loss, "psnr": report.psnr, "gaussians": report.gaussians}
        if self.iterations[stage.name] == 1:  # a resumed run does again what came after its checkpoint
            again = (stage.name, report.iteration)
            self._log = [r for r in self._log if r["stage"] != again[0] or r["iteration"] < again[1]]
        self._log.append({"stage": stage.name, "iteration": report.iteration, **figures})
        if stage.iteration % self._config.output.checkpoint_every == 0 or stage.iteration == stage.iterations:
            self._flush()
        self._report(stage.name, stage.iteration, stage.iterations, figures)

    def finished(
        self, name: str, shown: SurfaceMesh | Gaussians | BoundGaussians, figures: Mapping[str, Any]
    ) -> None:
        self._enter("pictures")
        self._flush()
        if self._folder is None or self._config.output.turntable_views == 0:
            return
        path = self._folder / f"{name}.png"
        if not path.exists():
            write_turntable(
                path, shown, self._config.output.turntable_views, self._config.output.picture_size
            )

    def close(self) -> None:
        """Write what is left of the log, and `timing.json`."""
        self._enter("")
        self._flush()
        if self._folder is not None:
            data = {"seconds": self.seconds, "iterations": self.iterations, "parts": self._shares}
            with atomic_write(self._folder / "timing.json") as temporary:
                temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")

    def _enter(self, part: str) -> None:
        if part == self._part:
            return
        now = time.perf_counter()
        if self._part:
            self.seconds[self._part] = round(self.seconds.get(self._part, 0.0) + now - self._begin, 3)
        self._part, self._begin = part, now

    def _flush(self) -> None:
        if self._folder is not None and self._log:
            with atomic_write(self._folder / LOG) as temporary:
                temporary.write_text("".join(json.dumps(row) + "\n" for row in self._log), encoding="utf-8")


def _read_log(folder: Path | None) -> list[dict[str, Any]]:
    """Figures of the iterations that an earlier process has done; none where they cannot be read."""
    if folder is None:
        return []
    try:
        lines = (folder / LOG).read_text(encoding="utf-8").splitlines()
        return [json.loads(line) for line in lines]
    except (OSError, ValueError):
        return []


__all__ = ["GenerationResult", "Progress", "Request", "generate", "generate_run"]
