"""Commands over meshes, assets and simulations: import, convert, simulate, render, export, info, scenes."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from gdpro_sim.cli.common import (
    AsJson,
    Color,
    Debug,
    Device,
    Quiet,
    Seed,
    app,
    check_choice,
    check_exists,
    check_suffix,
    first_line,
    progress,
    setup,
    show,
    table,
)
from gdpro_sim.errors import RequestError


@app.command("import")
def import_command(
    mesh: Annotated[
        Path,
        typer.Argument(help="Mesh: OBJ, PLY, STL, glTF/GLB, OFF, DAE, USD …; or a splat cloud: PLY, SPLAT."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Asset to write: .usdc, .usda or .usdz.")],
    budget: Annotated[
        int, typer.Option("--budget", min=100, max=5_000_000, help="Gaussians to aim for.")
    ] = 50_000,
    color: Color = None,
    texture: Annotated[Path | None, typer.Option("--texture", help="Texture image of the mesh.")] = None,
    up: Annotated[
        str, typer.Option("--up", help="Up axis of the file: auto, y or z; of a cloud also x, -x, -y, -z.")
    ] = "auto",
    scale: Annotated[
        float | None, typer.Option("--scale", help="Multiply lengths, e.g. 0.001 for mm.")
    ] = None,
    material: Annotated[
        str | None, typer.Option("--material", help="Material preset stored in the asset.")
    ] = None,
    tets: Annotated[
        int, typer.Option("--tets", min=0, max=500_000, help="Tetrahedra to aim for, roughly; 0 for none.")
    ] = 6_000,
    mask: Annotated[
        list[str] | None,
        typer.Option("--mask", help="NAME=IMAGE over the UV map: what it paints white is a vertex group."),
    ] = None,
    license: Annotated[
        str | None, typer.Option("--license", help="The mesh's licence, kept in the asset.")
    ] = None,
    seed: Seed = None,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Turn a mesh into a Gaussian asset: bound Gaussians, tetrahedra, one USD file.

    A splat cloud becomes one as it is, without mesh and tetrahedra: MPM can simulate it. For an asset with a
    mesh made of it, see `gdpro generate --from-splat`.
    """
    setup(quiet, debug)
    check_exists(mesh)
    check_suffix(output, (".usdc", ".usda", ".usdz"))
    from gdpro_sim.asset import import_mesh
    from gdpro_sim.files import check_writable
    from gdpro_sim.io.cloud import import_cloud, is_cloud
    from gdpro_sim.materials import Material

    cloud = is_cloud(mesh)
    check_choice("--up", up, ("auto", "y", "z", "x", "-x", "-y", "-z") if cloud else ("auto", "y", "z"))
    if cloud and (color is not None or texture is not None or mask or license is not None):
        raise RequestError(
            f"--color, --texture, --mask and --license are for meshes, but {mesh} is a splat cloud"
        )
    masks = {}
    for given in mask or []:
        name, _, image = given.partition("=")
        if not name or not image:
            raise RequestError(f"--mask must be NAME=IMAGE, got {given!r}")
        check_exists(Path(image))
        masks[name] = Path(image)

    check_writable(output)
    chosen = None
    if material is not None:
        try:
            chosen = Material.model_validate(material)
        except ValueError as error:
            raise RequestError(f"--material: {first_line(error)}") from None
    begin = time.perf_counter()
    with progress(quiet) as report:
        asset = (
            import_cloud(mesh, up=up, scale=scale, material=chosen)
            if cloud
            else import_mesh(
                mesh,
                budget=budget,
                color=color,
                texture=texture,
                up=up,
                scale=scale,
                material=chosen,
                tets=tets > 0,
                target_tets=tets or 6_000,
                seed=seed or 0,
                masks=masks,
                license=license,
                on_progress=lambda phase: report(phase, 0, 0),
            )
        )
        asset.save(output)
    summary = {"asset": str(output), **asset.summary(), "seconds": round(time.perf_counter() - begin, 2)}
    show(summary, f"Asset {output}", json_output, quiet)


@app.command()
def convert(
    config: Annotated[Path, typer.Argument(help="PhysGaussian configuration: .json.")],
    asset: Annotated[
        Path, typer.Option("--asset", help="What it simulates: a splat cloud, an asset or a mesh.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="Scene to write: .yaml.")],
    particles: Annotated[
        int | None, typer.Option("--particles", min=100, help="To aim for, in place of its n_grid.")
    ] = None,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Turn a PhysGaussian configuration into a scene; each thing the scene does not follow is named."""
    setup(quiet, debug)
    check_exists(config)
    check_exists(asset)
    from gdpro_sim.io.physgaussian import convert as run

    made = run(config, asset, output, particles=particles)
    summary = {"scene": str(output), "notes": list(made.messages)}
    if json_output:
        print(json.dumps(summary))
    elif not quiet:
        table(f"Scene {output}", [("scene", str(output)), *(("note", line) for line in made.messages)])


@app.command()
def simulate(
    scene: Annotated[str, typer.Argument(help="Scene file (.yaml) or the name of a shipped scene.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")],
    device: Device = "auto",
    seed: Seed = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start again instead of continuing a stopped run.")
    ] = False,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Run the Python files that the scene names.")
    ] = False,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Simulate a scene and write asset, time-sampled USD, video, contact sheet and metrics.

    A run that was stopped continues where it was when the same command is given again.
    """
    setup(quiet, debug)
    from gdpro_sim.simulation.scene import load_scene

    checked = load_scene(scene, seed=seed)
    from gdpro_sim.io.record import record

    with progress(quiet) as report:
        recording = record(
            checked, output, device=device, fresh=fresh, allow_code=allow_code, on_progress=report
        )
    if json_output:
        print(json.dumps(recording.to_json()))
    elif not quiet:
        sizes = {
            "Gaussians": recording.gaussians,
            "tetrahedra": recording.tets,
            "particles": recording.particles,
        }
        rows = [("asset", str(path)) for path in recording.assets]
        rows += [
            ("simulation", str(recording.simulation)),
            ("video", str(recording.video)),
            ("contact sheet", str(recording.contact_sheet)),
            ("metrics", str(recording.metrics)),
            (
                "frames",
                f"{recording.frames}  ({recording.frame_count}, {recording.resumed_frames} of them resumed)",
            ),
            ("size", ", ".join(f"{count:,} {kind}" for kind, count in sizes.items() if count)),
            ("seconds", "  ".join(f"{phase} {value:.1f}" for phase, value in recording.seconds.items())),
        ]
        table(f"Simulation of {checked.name}", rows)


@app.command()
def render(
    file: Annotated[Path, typer.Argument(help="Asset or simulation (.usdc, .usda, .usdz).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the pictures.")],
    frames: Annotated[
        int, typer.Option("--frames", min=1, max=10_000, help="Views of an asset's turntable.")
    ] = 24,
    camera: Annotated[str, typer.Option("--camera", help="Which of the scene's cameras.")] = "main",
    width: Annotated[int | None, typer.Option("--width", min=16, max=8192)] = None,
    height: Annotated[int | None, typer.Option("--height", min=16, max=8192)] = None,
    azimuth: Annotated[float | None, typer.Option("--azimuth", help="Degrees from +X.")] = None,
    elevation: Annotated[
        float | None, typer.Option("--elevation", min=-89.0, max=89.0, help="Degrees.")
    ] = None,
    distance: Annotated[float | None, typer.Option("--distance", help="From the target, m.")] = None,
    fov: Annotated[float | None, typer.Option("--fov", min=1.0, max=150.0, help="Vertical, degrees.")] = None,
    orbit: Annotated[
        float | None, typer.Option("--orbit", help="Turns of the camera about its target.")
    ] = None,
    lights: Annotated[
        str | None,
        typer.Option("--lights", help="studio, overcast, noon, sunset, moonlight or three-point."),
    ] = None,
    exposure: Annotated[float | None, typer.Option("--exposure", help="Stops; 1 doubles the light.")] = None,
    shading: Annotated[str | None, typer.Option("--shading", help="studio or none.")] = None,
    background: Annotated[
        str | None, typer.Option("--background", help="studio, transparent, #rrggbb or a CSS colour.")
    ] = None,
    catch_shadows: Annotated[
        bool, typer.Option("--catch-shadows", help="Show the shadows on the floor without the floor.")
    ] = False,
    view: Annotated[
        Path | None,
        typer.Option("--view", help="YAML with `camera`, `lights`, `render` as in a scene, in its place."),
    ] = None,
    passes: Annotated[
        str, typer.Option("--passes", help="Also write depth, normal, alpha: a list with commas.")
    ] = "",
    pass_format: Annotated[str, typer.Option("--pass-format", help="exr or npz.")] = "exr",
    video: Annotated[bool, typer.Option("--video", help="Also write preview.mp4.")] = False,
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second of the video.")] = None,
    device: Device = "auto",
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Render an asset as a turntable, or every frame of a simulation, to PNG pictures.

    A simulation is seen through its scene's camera under its lights, unless the options say otherwise.
    """
    setup(quiet, debug)
    if shading is not None:
        check_choice("--shading", shading, ("studio", "none"))
    check_choice("--pass-format", pass_format, ("exr", "npz"))
    check_exists(file)
    if view is not None:
        check_exists(view)
    from gdpro_sim.io.views import Look, read_view, render_file

    changes = {
        "azimuth": azimuth,
        "elevation": elevation,
        "distance": distance,
        "fov": fov,
        "width": width,
        "height": height,
    }
    surroundings = {
        "shading": shading,
        "background": background,
        "exposure": exposure,
        "catch_shadows": catch_shadows or None,
    }
    look = Look(
        camera=camera,
        view={} if view is None else read_view(view),
        changes={key: value for key, value in changes.items() if value is not None},
        orbit=orbit,
        lights=lights,
        render={key: value for key, value in surroundings.items() if value is not None},
    )
    with progress(quiet) as report:
        pictures = render_file(
            file,
            output,
            views=frames,
            look=look,
            passes=[name.strip() for name in passes.split(",") if name.strip()],
            pass_format=pass_format,
            video=video or fps is not None,
            fps=fps,
            device=device,
            on_progress=report,
        )
    show({"frames": str(output), "count": len(pictures)}, f"Pictures of {file.name}", json_output, quiet)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(help="Asset or simulation (.usdc, .usda, .usdz).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Gaussian splats to write: .ply.")],
    frame: Annotated[int, typer.Option("--frame", min=0, help="Frame of a simulation.")] = 0,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write the Gaussians as a 3DGS PLY, the file that splat viewers read."""
    setup(quiet, debug)
    check_exists(file)
    check_suffix(output, (".ply",))
    from gdpro_sim.io.ply import write_ply
    from gdpro_sim.io.views import gaussians_of

    gaussians = gaussians_of(file, frame)
    write_ply(output, gaussians)
    show({"ply": str(output), "gaussians": len(gaussians)}, f"Gaussians of {file.name}", json_output, quiet)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(help="Asset, simulation, mesh or splat cloud.")],
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Say what a file holds; with --quiet, only whether it can be read."""
    setup(quiet, debug)
    check_exists(file)
    from gdpro_sim.io.describe import describe

    show(describe(file), str(file), json_output, quiet)


@app.command()
def scenes(
    reference: Annotated[
        bool, typer.Option("--reference", help="Print every key a scene may have, as Markdown.")
    ] = False,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """List the scenes shipped with the package; with --quiet, their names alone."""
    setup(quiet, debug)
    if reference:
        from gdpro_sim.simulation.reference import reference as written

        print(written(), end="")
        return
    from gdpro_sim.simulation.scene import load_scene, scene_names

    listing = {name: load_scene(name).description for name in scene_names()}
    if json_output:
        print(json.dumps(listing))
    elif quiet:
        print("\n".join(listing))
    else:
        table("Shipped scenes", list(listing.items()))
