"""One table and one contact sheet, and a run that goes on where it was stopped."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from gdpro_sim.errors import RequestError
from gdpro_sim.generation.config import load_config
from gdpro_sim.io.ablation import ablate, to_markdown
from gdpro_sim.io.images import read_png

TINY = load_config(
    "draft",
    overrides=[
        "surfels.iterations=3", "surfels.initial=1500", "surfels.maximum=1600", "surfels.resolution=32",
        "surfels.supersample=1", "surfels.batch=1", "surfels.initial_opacity=0.6", "surfels.densify_until=0",
        "refinement.iterations=2", "refinement.resolution=32", "refinement.supersample=1",
        "refinement.batch=1", "refinement.per_triangle=1", "extraction.cameras=8",
        "extraction.resolution=64", "extraction.depth=5", "extraction.triangles=400",
        "guidance.resolution=64",
    ],
)  # fmt: skip


def test_a_stopped_ablation_goes_on_with_the_next_case(tmp_path: Path) -> None:
    class Stop(Exception):
        pass

    def stop(row: str, done: int, total: int, figures: dict[str, object]) -> None:
        if row == "bound":
            raise Stop

    arguments = {"rows": ["prior", "surfels", "bound"], "config": TINY, "views": 2, "resolution": 32}
    with pytest.raises(Stop):
        ablate(["a red ball"], tmp_path / "out", on_progress=stop, **arguments)  # type: ignore[arg-type]
    assert len(list((tmp_path / "out" / "records").glob("*.json"))) == 2
    assert not (tmp_path / "out" / "ablation.csv").exists(), "no table until all is there"
    went_on = ablate(["a red ball"], tmp_path / "out", **arguments)  # type: ignore[arg-type]
    assert went_on.resumed == 2
    whole = ablate(["a red ball"], tmp_path / "whole", **arguments)  # type: ignore[arg-type]
    for a, b in zip(went_on.records, whole.records, strict=True):
        assert {k: v for k, v in a.items() if "seconds" not in k} == {
            k: v for k, v in b.items() if "seconds" not in k
        }
    rows = list(csv.DictReader(went_on.csv.open()))
    assert [r["row"] for r in rows] == ["prior", "surfels", "bound"]
    assert float(rows[2]["psnr"]) == went_on.records[2]["psnr"], "nothing is rounded"
    text = went_on.markdown.read_text()
    assert "| bound | 1 |" in text and "fidelity to the built-in prior" in text
    sheet = read_png(went_on.contact_sheet)
    assert sheet.shape[1] >= 4 * 256 and sheet.std() > 5.0
    again = ablate(["a red ball"], tmp_path / "out", **arguments)  # type: ignore[arg-type]
    assert again.resumed == 3 and again.records == went_on.records
    with pytest.raises(RequestError, match="another configuration or version; give an empty folder"):
        ablate(["a red ball"], tmp_path / "out", **{**arguments, "views": 3})  # type: ignore[arg-type]
    broken = next((tmp_path / "out" / "records").glob("bound-*.json"))
    broken.write_text("{")
    with pytest.raises(RequestError, match="delete it to run that case again"):
        ablate(["a red ball"], tmp_path / "out", **arguments)  # type: ignore[arg-type]


def test_the_table_shows_means_deviations_and_gaps() -> None:
    base = {
        "prompt": "a", "jitter": 0.0, "row": "bound", "ssim": 0.9, "chamfer": None, "f_score": None,
        "normal_error": None, "sharpness": 1.0, "strays": 0.0, "inconsistency": 0.0, "gaussians": 10,
        "iterations": 1, "seconds": 1.0, "seconds_all": 2.0,
    }  # fmt: skip
    text = to_markdown([{**base, "seed": 0, "psnr": 20.0}, {**base, "seed": 1, "psnr": 22.0}], TINY)
    assert "| bound | 2 | 21.00 ± 1.41 | 0.900 ± 0.000 | – |" in text


def test_wrong_requests_stop_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="row 'x' is not known"):
        ablate(["a red ball"], tmp_path / "out", rows=["x"], config=TINY)
    assert not (tmp_path / "out").exists()
