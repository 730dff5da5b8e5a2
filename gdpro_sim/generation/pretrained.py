"""Pipelines of diffusers, from a local directory or the hub; every way it can fail is one clear line."""

from __future__ import annotations

import contextlib
import importlib
import json
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gdpro_sim.errors import GuidanceError

INDEX = "model_index.json"
"""The file by which a pipeline's directory is known."""

EXTRA = "pip install 'gdpro-sim[diffusion]'"


@dataclass(frozen=True)
class PipelineFolder:
    """Where a pipeline lies: `revision` is the hub's commit, None for a plain directory."""

    model: str
    path: Path
    kind: str
    revision: str | None


def find_pipeline(model: str | None, option: str) -> PipelineFolder:
    """The directory of a pipeline, downloaded into the hub's cache only where it is not there yet.

    model:  a directory that `save_pretrained` wrote, or a hub id
    option: what the user passes it by, for the error message

    Raises GuidanceError where there is no such pipeline, or diffusers is not installed.
    """
    if not model:
        raise GuidanceError(
            f"no diffusion model given: pass {option} with a directory that holds {INDEX}, or a hub id"
        )
    path = Path(model).expanduser()
    if path.is_file():
        raise GuidanceError(
            f"{model} is a file: pass {option} with a pipeline's directory (diffusers' from_single_file and "
            "save_pretrained make one of a checkpoint)"
        )
    revision = None
    if not path.is_dir():
        path = _from_hub(model, option)
        revision = path.name
    index = path / INDEX
    try:
        kind = json.loads(index.read_text(encoding="utf-8"))["_class_name"]
    except FileNotFoundError:
        raise GuidanceError(
            f"{model} holds no {INDEX}: pass {option} with the directory of a whole diffusers pipeline"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GuidanceError(
            f"{index} cannot be read ({first_line(error)}); download the model again"
        ) from error
    return PipelineFolder(model, path, str(kind), revision)


def load_pipeline(folder: PipelineFolder, option: str, **options: Any) -> Any:
    """diffusers' pipeline in `folder`, which asks the hub for nothing; `options` as for `from_pretrained`.

    Raises GuidanceError.
    """
    diffusers = import_diffusers()
    try:
        with quiet():
            return getattr(diffusers, folder.kind).from_pretrained(
                str(folder.path), local_files_only=True, **options
            )
    except Exception as error:  # missing or broken files surface as almost anything
        raise GuidanceError(
            f"{folder.model} cannot be loaded as a {folder.kind} ({first_line(error)}); "
            f"pass {option} with a complete directory or hub id"
        ) from error


def import_diffusers() -> Any:
    """The package, quietly. Raises GuidanceError where it, or transformers, is not installed."""
    try:
        with quiet():
            import diffusers
            import transformers  # noqa: F401
    except ImportError as error:
        raise GuidanceError(f"diffusion models need diffusers and transformers ({error}): {EXTRA}") from error
    return diffusers


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Hold back the progress bars and advice of diffusers and transformers inside the block."""
    with contextlib.ExitStack() as stack:
        for package in ("diffusers", "transformers"):
            try:
                logging = importlib.import_module(f"{package}.utils.logging")
            except ImportError:  # `import_diffusers` says so
                continue
            stack.callback(logging.set_verbosity, logging.get_verbosity())
            if logging.is_progress_bar_enabled():
                stack.callback(logging.enable_progress_bar)
            logging.set_verbosity_error()
            logging.disable_progress_bar()
        stack.enter_context(warnings.catch_warnings())
        # What diffusers would rather see in an old model, and what NumPy would rather see in diffusers.
        warnings.simplefilter("ignore", FutureWarning)
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


def refuse(folder: PipelineFolder, accepted: Mapping[str, str], refused: Mapping[str, str]) -> None:
    """Raise GuidanceError unless the pipeline's class is one of `accepted` (name to what it is).

    refused: why not, by the beginning of a class name
    """
    if folder.kind in accepted:
        return
    reason = next((why for start, why in refused.items() if folder.kind.startswith(start)), None)
    wanted = " or ".join(f"{what} ({name})" for name, what in accepted.items())
    raise GuidanceError(
        f"{folder.model} is a {folder.kind}{f', {reason}' if reason else ''}; pass a {wanted}"
    )


def first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0] if len(lines[0]) <= 200 else lines[0][:197] + "..."


def _from_hub(model: str, option: str) -> Path:
    diffusers = import_diffusers()
    reasons = []
    for local in (True, False):
        try:
            with quiet():
                return Path(diffusers.DiffusionPipeline.download(model, local_files_only=local))
        except (OSError, ValueError, RuntimeError) as error:
            reasons.append(error)
    raise GuidanceError(
        f"no directory {model!r}, and no such model in the hub's cache or on the hub "
        f"({first_line(reasons[-1])}); pass {option} with a directory that holds {INDEX}"
    ) from reasons[-1]


__all__ = [
    "EXTRA",
    "PipelineFolder",
    "find_pipeline",
    "first_line",
    "import_diffusers",
    "load_pipeline",
    "quiet",
    "refuse",
]
