"""Bodies of a scene that are prompts: generated before the scene runs, and kept beside its results."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from gdpro_sim.asset import Asset
from gdpro_sim.errors import AssetError
from gdpro_sim.files import prepare_folder
from gdpro_sim.generation.config import load_config
from gdpro_sim.io.generate import Request, generate_run
from gdpro_sim.io.sources import Inputs
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody


def with_generated(
    scene: Scene,
    output: str | Path,
    *,
    device: str = "auto",
    on_progress: Callable[[str, int, int], None] | None = None,
) -> Scene:
    """The scene with an asset file in place of every prompt.

    Body NAME's asset becomes `output`/generated/NAME.usdc, its run `output`/generated/NAME/; what an earlier
    call made there for the same prompt, quality and seed is used again, and bodies of one prompt and quality
    share what the first of them is called. Raises GuidanceError, OutputError.
    """
    bodies = []
    made: dict[tuple[str, str], Path] = {}
    for body in scene.bodies:
        if body.prompt is None:
            bodies.append(body)
            continue
        key = body.prompt, body.quality
        if key not in made:
            report = on_progress or (lambda *_: None)
            made[key] = _generate(body, scene.seed, Path(output), device, report)
        bodies.append(body.model_copy(update={"prompt": None, "asset": str(made[key].resolve())}))
    return scene.model_copy(update={"bodies": tuple(bodies)})


def _generate(
    body: SceneBody, seed: int, output: Path, device: str, report: Callable[[str, int, int], None]
) -> Path:
    config = load_config(body.quality)
    folder = prepare_folder(output / "generated" / body.source, "run.json")
    path = folder.with_suffix(".usdc")
    request = Request(Inputs(prompt=body.prompt or "").pinned(), config, seed)
    if path.exists():
        try:
            made = Asset.load(path).provenance
            if made.get("config") == request.to_json()["config"] and made.get("seed") == seed:
                if made.get("prompt") == body.prompt:
                    return path
        except AssetError:
            pass
    result = generate_run(
        request,
        folder,
        device=device,
        anew=True,
        on_progress=lambda part, done, total, figures: report(part, done, total),
    )
    result.asset.save(path)
    return path


__all__ = ["with_generated"]
