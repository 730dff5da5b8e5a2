"""Tile lists, and the same bytes for any number of threads."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from gdpro_sim import device
from gdpro_sim.errors import RequestError
from gdpro_sim.splatting import RasterOptions, rasterization
from gdpro_sim.splatting import tiles as tiles_module
from gdpro_sim.splatting.tiles import count_and_fill, expand_and_sort
from tests.splatting.scenes import cameras, cloud, features, harmonics


@pytest.fixture(autouse=True)
def restored_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(tiles_module, "PART", 64)
    before = device.thread_count()
    yield
    device.set_thread_count(before)


def test_threads_do_not_change_a_bit() -> None:
    scene, views = cloud(5000, 0, size=0.04), cameras(2, 250, 190)
    results = []
    for threads in (1, 2, 8):
        device.set_thread_count(threads)
        results.append(
            rasterization(**scene, colors=harmonics(5000, 2, 0), **views, sh_degree=2, render_mode="RGB+ED")
        )
    for image, alpha, meta in results[1:]:
        assert torch.equal(image, results[0][0])
        assert torch.equal(alpha, results[0][1])
        for key in ("flatten_ids", "isect_offsets", "means2d", "transmittance"):
            assert torch.equal(meta[key], results[0][2][key])


def test_lists_hold_what_touches_each_tile_by_depth() -> None:
    device.set_thread_count(3)
    scene, views = cloud(400, 1), cameras(2, 70, 50)
    _, _, meta = rasterization(**scene, colors=features(400, 3, 1), **views)
    offsets, ids = meta["tile_lists"].offsets, meta["flatten_ids"]
    radii, means2d, depths = (meta[k].reshape(800, -1) for k in ("radii", "means2d", "depths"))
    touching = 0
    for camera in range(2):
        for row in range(meta["tile_height"]):
            for column in range(meta["tile_width"]):
                tile = (camera * meta["tile_height"] + row) * meta["tile_width"] + column
                got = ids[offsets[tile] : offsets[tile + 1]].tolist()
                assert got == sorted(got, key=lambda g: depths[g].item())
                low = torch.tensor([column, row]) * 16 + 0.5
                high = torch.minimum(low + 15, torch.tensor([69.5, 49.5]))
                near = ((means2d + radii >= low) & (means2d - radii <= high)).all(1) & (radii > 0).all(1)
                mine = torch.arange(800) // 400 == camera
                wanted = set(torch.nonzero(near & mine).flatten().tolist())
                # Radii are rounded up to whole pixels, so the true box may miss a tile that they reach.
                tight = ((means2d + radii - 1 >= low) & (means2d - radii + 1 <= high)).all(1) & (
                    radii > 0
                ).all(1)
                assert set(torch.nonzero(tight & mine).flatten().tolist()) <= set(got) <= wanted
                touching += len(got)
    assert touching == len(ids) > 1000


def test_counting_sort_and_expansion_agree() -> None:
    scene, views = cloud(700, 2), cameras(3, 83, 47)
    _, _, meta = rasterization(**scene, colors=features(700, 3, 2), **views)
    with pytest.raises(ValueError, match="its tile lists are made already"):
        count_and_fill(meta["projection"], meta["weigh"].args[3])
    from gdpro_sim.splatting.projection import View, project

    view = View(views["viewmats"], views["Ks"], 83, 47, 0.01, 1e10, 0.0, 0.3, False)
    gaussians = (scene["means"], scene["quats"], scene["scales"], scene["opacities"])
    projection = project(gaussians, features(700, 3, 2), None, view)
    for threads in (1, 4):
        device.set_thread_count(threads)
        counted, expanded = count_and_fill(projection, view), expand_and_sort(projection, view)
        assert torch.equal(counted.offsets, expanded.offsets)
        assert torch.equal(counted.ids, expanded.ids)
        assert torch.equal(counted.ids, meta["flatten_ids"])


@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_too_many_entries_are_refused(method: str) -> None:
    scene, views = cloud(100, 3), cameras(1, 64, 64)
    options = RasterOptions(method=method, max_tile_entries=50)
    with pytest.raises(RequestError, match=r"tile list entries come to \d+, past the limit of 50"):
        rasterization(**scene, colors=features(100, 3, 3), **views, options=options)
