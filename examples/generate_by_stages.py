"""Every stage of generation by hand: prior, surfels, extraction, bound Gaussians.

python examples/generate_by_stages.py ["a red mug with a blue handle"] [--quality draft] [-o OUT]

`gdpro_sim.generate(prompt)` does the same in one call. Here each stage's result is at hand, to be replaced by
something of your own: a prior, a guidance, a mesh. Writes OUT/asset.usdc and a turntable of each stage.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import torch

from gdpro_sim import Asset
from gdpro_sim.device import serial_torch
from gdpro_sim.errors import GdproError
from gdpro_sim.files import prepare_folder
from gdpro_sim.generation import objects
from gdpro_sim.generation.config import GenerationConfig, load_config
from gdpro_sim.generation.extraction import extract
from gdpro_sim.generation.guidance.procedural import ProceduralGuidance
from gdpro_sim.generation.priors.procedural import ProceduralPrior
from gdpro_sim.generation.protocols import Stage
from gdpro_sim.generation.refinement import RefinementStage
from gdpro_sim.generation.surfels import SurfelStage
from gdpro_sim.io.turntable import write_turntable
from gdpro_sim.materials import Material


def run(stage: Stage) -> None:
    """Step until done, saying now and then how it goes."""
    while stage.iteration < stage.iterations:
        report = stage.step()
        if stage.iteration % 50 == 0 or stage.iteration == stage.iterations:
            psnr = "" if report.psnr is None else f"  {report.psnr:5.1f} dB"
            print(f"{stage.name} {stage.iteration:4d}  {report.gaussians:6d} Gaussians{psnr}", flush=True)


@serial_torch()
def generate(prompt: str, config: GenerationConfig, out: Path, seed: int) -> None:
    guidance = ProceduralGuidance(objects.parse(prompt), config.guidance, seed)  # what is right
    frame = guidance.frame  # from metres to the unit sphere in which everything below works
    coarse = ProceduralPrior(config.prior).mesh(prompt, seed)  # where to start; any closed mesh will do
    mesh = frame.to_unit(coarse.surface)
    write_turntable(out / "prior.png", mesh, 6, 256)

    first = SurfelStage(mesh, guidance, config, seed)
    run(first)
    write_turntable(out / "surfels.png", first.gaussians(), 6, 256)

    basic = extract(first.result(), config.extraction)
    print(f"extracted {len(basic.faces)} triangles")
    write_turntable(out / "extraction.png", basic, 6, 256)

    second = RefinementStage(basic, guidance, config, seed)
    run(second)
    bound = second.result()
    write_turntable(out / "refinement.png", bound, 6, 256)

    metres = bound.scaled(frame.radius)
    metres = replace(metres, vertices=metres.vertices + torch.tensor(frame.centre))
    material = None if coarse.material is None else Material.model_validate({"preset": coarse.material})
    asset = Asset("generated", metres, second.vertex_colors(), material=material)
    asset.save(out / "asset.usdc")
    print(f"wrote {out / 'asset.usdc'}: {len(bound)} Gaussians; drop it: gdpro simulate {out / 'asset.usdc'}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("prompt", nargs="?", default="a red mug with a blue handle")
    parser.add_argument("--quality", default="draft", help="draft, default or high")
    parser.add_argument("--set", action="append", default=[], help="PART.FIELD=VALUE over the preset")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", default="out/generate_by_stages")
    options = parser.parse_args()
    config = load_config(options.quality, overrides=options.set)
    generate(options.prompt, config, prepare_folder(options.out, "asset.usdc"), options.seed)


if __name__ == "__main__":
    try:
        main()
    except (GdproError, OSError) as error:
        raise SystemExit(f"generate_by_stages: {error}") from None
