"""Images of surfels known in closed form; degenerate scenes; malformed arguments."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gdpro_sim import device
from gdpro_sim.errors import RequestError
from gdpro_sim.splatting import RasterOptions, contributions, rasterization_2dgs
from gdpro_sim.splatting.depth import depth_to_normals
from tests.conditions import needs_gpu
from tests.splatting.scenes import cameras, cloud, features, frontal, harmonics

SIZE = 64
FOCAL = 100.0
METHODS = ["tile", "pixel"]
NAMES = ("colors", "alphas", "normals", "normals_from_depth", "distortion", "median", "meta")
VALUES = [0.0, -0.0, 1.0, -1.0, 0.5, 1e-30, 1e30, -1e30, 3e38, 1e-45, math.nan, math.inf, -math.inf]


def turned(angle: float, axis: tuple[float, float, float] = (1.0, 0.0, 0.0)) -> list[float]:
    """Quaternion wxyz of a rotation in degrees about a unit axis."""
    half = math.radians(angle) / 2
    return [math.cos(half), *(math.sin(half) * a for a in axis)]


def render(
    surfels: list[dict[str, object]], size: int = SIZE, method: str = "tile", **options: object
) -> dict[str, Tensor]:
    """Surfels (mean, quat, scale, opacity) before a camera of 100 pixels focal length; white unless told."""
    colors = options.pop("colors", torch.ones(len(surfels), 3))
    outputs = rasterization_2dgs(
        torch.tensor([s["mean"] for s in surfels]),
        torch.tensor([s.get("quat", [1.0, 0.0, 0.0, 0.0]) for s in surfels]),
        torch.tensor([s.get("scale", [0.1, 0.1]) for s in surfels]),
        torch.tensor([s.get("opacity", 0.9) for s in surfels]),
        colors,
        **frontal(2.0, FOCAL, size, size),
        **{"render_mode": "RGB+ED", "options": RasterOptions(method=method), **options},
    )
    return dict(zip(NAMES, outputs, strict=True))


def offsets(size: int = SIZE) -> tuple[Tensor, Tensor]:
    """Pixel centres from the middle of the image: x, y [H, W]."""
    line = torch.arange(size, dtype=torch.float64) + 0.5 - size / 2
    return line.expand(size, size), line[:, None].expand(size, size)


@pytest.mark.parametrize("method", METHODS)
def test_facing_the_camera_a_surfel_is_a_2d_gaussian(method: str) -> None:
    scales, opacity = (0.12, 0.06), 0.8
    turn = turned(30.0, (0.0, 0.0, 1.0))
    got = render(
        [{"mean": [0.0, 0.0, 2.0], "quat": turn, "scale": scales, "opacity": opacity}], method=method
    )
    x, y = (o * 2.0 / FOCAL for o in offsets())
    c, s = math.cos(math.radians(30)), math.sin(math.radians(30))
    u, v = (c * x + s * y) / scales[0], (c * y - s * x) / scales[1]
    alpha = opacity * torch.exp(-0.5 * (u * u + v * v))
    alpha = torch.where(alpha >= 1 / 255, alpha, 0.0)
    near_cut = (opacity * torch.exp(-0.5 * (u * u + v * v)) * 255 - 1).abs() < 1e-4
    assert (got["alphas"][0, ..., 0] - alpha)[~near_cut].abs().max() < 1e-6
    seen = alpha > 0.01
    assert (got["colors"][0, ..., 3] - 2.0)[seen].abs().max() < 1e-5
    expected = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64) * alpha[..., None]
    assert (got["normals"][0] - expected)[~near_cut].abs().max() < 1e-6
    inner = seen.double()[None, None]
    inner = -torch.nn.functional.max_pool2d(-inner, 3, 1, 1)[0, 0] > 0
    from_depth = got["normals_from_depth"][0] / got["alphas"][0]
    assert (from_depth - torch.tensor([0.0, 0.0, -1.0]))[inner].abs().max() < 1e-3
    assert got["distortion"].abs().max() < 1e-6
    assert (got["median"][0, ..., 0] - 2.0)[seen].abs().max() < 1e-5
    assert (got["median"][0, ..., 0][alpha == 0] == 0).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("angle", [-70.0, 20.0, 60.0, 160.0])
def test_a_tilted_surfel_has_the_depth_and_normal_of_its_plane(angle: float, method: str) -> None:
    got = render(
        [{"mean": [0.1, 0.0, 2.0], "quat": turned(angle, (0.0, 1.0, 0.0)), "scale": [0.3, 0.2]}],
        method=method,
    )
    n = torch.tensor([math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))], dtype=torch.float64)
    n = n * -math.copysign(1.0, n @ torch.tensor([0.1, 0.0, 2.0], dtype=torch.float64))
    x, _ = offsets()
    depth = (n[0] * 0.1 + n[2] * 2.0) / (n[0] * x / FOCAL + n[2])
    solid = got["alphas"][0, ..., 0] > 0.05
    assert solid.sum() > 30
    # Far from the low-pass, which shows the centre's depth.
    far = solid & ((x - 0.1 / 2 * FOCAL).abs() > 3.0)
    assert (got["colors"][0, ..., 3] / depth - 1)[far].abs().max() < 1e-5
    assert (got["median"][0, ..., 0] / depth - 1)[far].abs().max() < 1e-5
    normals = got["normals"][0] / got["alphas"][0]
    assert (normals - n)[solid].abs().max() < 1e-4


def test_means_are_the_middles_of_ellipses() -> None:
    quat = turned(60.0, (0.0, 1.0, 0.0))
    got = render([{"mean": [0.1, 0.0, 2.0], "quat": quat, "scale": [0.3, 0.2]}])
    edge = torch.tensor([math.cos(math.radians(60)), 0.0, -math.sin(math.radians(60))]) * 0.3
    ends = [torch.tensor([0.1, 0.0, 2.0]) + sign * edge for sign in (1, -1)]
    middle = sum((FOCAL * end[0] / end[2] + SIZE / 2).item() for end in ends) / 2
    assert got["meta"]["means2d"][0, 0, 0].item() == pytest.approx(middle, abs=1e-4)
    assert got["meta"]["means2d"][0, 0, 1].item() == pytest.approx(SIZE / 2, abs=1e-4)
    assert got["meta"]["depths"].item() == 2.0


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("angle", [90.0, 89.9999, 90.001])
def test_from_its_edge_a_surfel_is_drawn_by_the_low_pass(angle: float, method: str) -> None:
    surfel = {"mean": [0.0, 0.0, 2.0], "quat": turned(angle, (0.0, 1.0, 0.0)), "opacity": 0.7}
    got = render([surfel], method=method)
    x, y = offsets()
    alpha = 0.7 * torch.exp(-(x * x + y * y))
    assert (got["alphas"][0, ..., 0] - torch.where(alpha > 1 / 255, alpha, 0)).abs().max() < 1e-4
    for image in ("colors", "normals", "distortion", "median"):
        assert torch.isfinite(got[image]).all()


@pytest.mark.parametrize("method", METHODS)
def test_distortion_and_median_of_two(method: str) -> None:
    """Distortion 2 w_1 w_2 (z_2 - z_1); the median changes where the first lets less than half through."""
    front = {"mean": [0.01, 0.01, 2.0], "scale": [0.3, 0.3], "opacity": 0.7}
    back = {"mean": [0.0125, 0.0125, 2.5], "scale": [5.0, 5.0], "opacity": 0.8}
    both = render([back, front], method=method, colors=torch.tensor([[0.0] * 3, [1.0] * 3]))
    first = both["colors"][0, ..., 0].double()
    second = both["alphas"][0, ..., 0].double() - first
    assert (both["distortion"][0, ..., 0] - 2 * first * second * 0.5).abs().max() < 1e-6
    covered = (first - 0.5).abs() > 1e-4
    expected = torch.where(first >= 0.5, 2.0, 2.5)
    assert (both["median"][0, ..., 0] - expected)[covered].abs().max() < 1e-5
    assert (first >= 0.5).any()


def test_expected_depth_and_its_normals_do_not_depend_on_the_mode() -> None:
    scene, views = cloud(80, 1, size=0.2), cameras(1, 40, 30)
    colors = features(80, 3, 1)
    summed = dict(
        zip(NAMES, rasterization_2dgs(**scene, colors=colors, **views, render_mode="RGB+D"), strict=True)
    )
    mean = dict(
        zip(NAMES, rasterization_2dgs(**scene, colors=colors, **views, render_mode="RGB+ED"), strict=True)
    )
    quotient = summed["colors"][..., 3:] / summed["alphas"].clamp(min=1e-10)
    assert (quotient - mean["colors"][..., 3:]).abs().max() < 1e-6
    assert (summed["normals_from_depth"] - mean["normals_from_depth"]).abs().max() < 1e-3
    for mode in ("RGB", "D", "ED"):
        alone = rasterization_2dgs(**scene, colors=colors, **views, render_mode=mode)
        assert alone[3] is None
        assert torch.equal(alone[1], mean["alphas"])
        for i in (2, 4, 5):
            assert torch.equal(alone[i], mean[NAMES[i]])


def test_behind_the_camera_and_through_it() -> None:
    behind = render([{"mean": [0.0, 0.0, -2.0]}, {"mean": [0.0, 0.0, 0.005]}])
    assert behind["alphas"].max() == 0
    # A floor below the camera that reaches behind it: seen up to the horizon, with the depth of the floor.
    floor = render(
        [{"mean": [0.0, 0.5, 1.0], "quat": turned(90.0), "scale": [3.0, 3.0], "opacity": 0.9}], size=80
    )
    _, y = offsets(80)
    alpha, depth = floor["alphas"][0, ..., 0], floor["colors"][0, ..., 3]
    assert (alpha[y < 0] == 0).all()
    below = (y > 8) & (offsets(80)[0].abs() < 40)
    assert (alpha[below] > 0.1).all()
    assert (depth / (0.5 * FOCAL / y) - 1)[below].abs().max() < 1e-4
    assert (floor["normals"][0] / alpha[..., None] - torch.tensor([0.0, -1.0, 0.0]))[below].abs().max() < 1e-4


def test_permutation_quaternion_length_and_third_scale_do_not_matter() -> None:
    scene, views = cloud(150, 3), cameras(1, 48, 40)
    colors = features(150, 3, 3)
    expected = rasterization_2dgs(**scene, colors=colors, **views)
    order = torch.randperm(150, generator=torch.Generator().manual_seed(1))
    shuffled = {k: v[order] for k, v in scene.items()}
    got = rasterization_2dgs(**shuffled, colors=colors[order], **views)
    flat = {**scene, "scales": scene["scales"][:, :2] * torch.tensor([-1.0, 1.0])}
    for other in (got, rasterization_2dgs(**flat, colors=colors, **views)):
        for i in (0, 1, 2, 4, 5):
            assert torch.equal(other[i], expected[i])
    longer = rasterization_2dgs(**{**scene, "quats": scene["quats"] * -1e20}, colors=colors, **views)
    assert (longer[0] - expected[0]).abs().max() < 1e-4


def test_radius_clip_and_planes() -> None:
    surfel = {"mean": [0.0, 0.0, 2.0], "scale": [0.02, 0.02]}
    radii = render([surfel])["meta"]["radii"]
    assert radii.tolist() == [[[4, 4]]]
    assert render([surfel], radius_clip=2.0)["alphas"].max() > 0.5
    for options in ({"radius_clip": 4.0}, {"near_plane": 2.1}, {"far_plane": 1.9}):
        nothing = render([surfel], **options)
        assert nothing["alphas"].max() == 0
        assert nothing["meta"]["radii"].tolist() == [[[0, 0]]]


def test_backgrounds_and_nothing_to_draw() -> None:
    background = torch.tensor([[0.1, 0.2, 0.3]])
    for count in (0, 5):
        outputs = rasterization_2dgs(
            **cloud(count, 0),
            colors=torch.zeros(count, 3),
            **cameras(1, 9, 7),
            backgrounds=background,
            render_mode="RGB+ED",
            near_plane=1e5,
            far_plane=1e6,
        )
        assert torch.equal(outputs[0], torch.tensor([0.1, 0.2, 0.3, 0.0]).expand(1, 7, 9, 4))
        for image, channels in zip(outputs[1:6], (1, 3, 3, 1, 1), strict=True):
            assert torch.equal(image, torch.zeros(1, 7, 9, channels))
        assert outputs[6]["means2d"].shape == (1, count, 2)
    none = {**cameras(1, 9, 7), "viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}
    outputs = rasterization_2dgs(**cloud(5, 0), colors=features(5, 3, 0), **none, render_mode="RGB+D")
    assert [list(image.shape) for image in outputs[:6]] == [[0, 7, 9, d] for d in (4, 1, 3, 3, 1, 1)]


def test_no_gaussians_and_no_cameras_have_gradients() -> None:
    for count, views in ((0, 1), (5, 0)):
        made = cameras(1, 9, 7)
        made = {**made, "viewmats": made["viewmats"][:views], "Ks": made["Ks"][:views]}
        given = {k: v.requires_grad_() for k, v in cloud(count, 0).items()}
        background = torch.rand(views, 5).requires_grad_()
        outputs = rasterization_2dgs(
            **given, colors=torch.zeros(count, 5), **made, backgrounds=background, render_mode="RGB+D"
        )
        loss = sum(image.sum() for image in outputs[:6]) + background.sum()
        loss.backward()
        for tensor in given.values():
            assert tensor.grad is None or torch.equal(tensor.grad, torch.zeros_like(tensor))
        assert torch.equal(background.grad, torch.full((views, 5), 64.0))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "sh"])
def test_not_finite_is_not_drawn(name: str, bad: float) -> None:
    scene, views = cloud(30, 1), cameras(1, 30, 30)
    key = "colors" if name == "sh" else name
    scene["colors"] = harmonics(30, 1, 1) if name == "sh" else features(30, 3, 1)
    degree = {"sh_degree": 1} if name == "sh" else {}
    rest = {k: torch.cat([v[:4], v[5:]]) for k, v in scene.items()}
    scene[key] = scene[key].clone()
    scene[key][4].view(-1)[0] = bad
    got = rasterization_2dgs(**scene, **views, **degree)
    expected = rasterization_2dgs(**rest, **views, **degree)
    for i in (0, 1, 2, 4, 5):
        assert torch.equal(got[i], expected[i])
    assert (got[6]["radii"][0, 4] == 0).all()


def test_zero_scales_are_drawn_by_the_low_pass() -> None:
    got = render([{"mean": [0.01, 0.01, 2.0], "scale": [0.0, 0.0], "opacity": 0.6}])
    x, y = (o - 0.5 for o in offsets())
    alpha = 0.6 * torch.exp(-(x * x + y * y))
    assert (got["alphas"][0, ..., 0] - torch.where(alpha > 1 / 255, alpha, 0)).abs().max() < 1e-6


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_numbers_give_finite_images_and_gradients(method: str, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 4))
    value = st.sampled_from(VALUES) | st.floats(width=32)

    def numbers(*shape: int) -> Tensor:
        n = math.prod(shape)
        return torch.tensor(data.draw(st.lists(value, min_size=n, max_size=n))).reshape(shape)

    views = frontal(2.0, 20.0, data.draw(st.integers(1, 40)), data.draw(st.integers(1, 40)))
    if data.draw(st.booleans()):
        views["viewmats"] = numbers(1, 4, 4)
    if data.draw(st.booleans()):
        views["Ks"] = numbers(1, 3, 3)
    given_ = [numbers(count, 3), numbers(count, 4), numbers(count, 3), numbers(count), torch.rand(count, 3)]
    given_ = [tensor.requires_grad_() for tensor in given_]
    options = RasterOptions(method=method)
    outputs = rasterization_2dgs(*given_, **views, render_mode="RGB+D", options=options)
    used = [outputs[i] for i in (0, 1, 2, 4, 5)]
    for image in used:
        assert torch.isfinite(image).all()
    assert ((outputs[1] >= 0) & (outputs[1] <= 1)).all()
    assert (outputs[6]["radii"] >= 0).all()
    found = torch.autograd.grad(used, given_, [torch.ones_like(image) for image in used])
    for gradient in found:
        assert torch.isfinite(gradient).all()
    assert all((gradient[(outputs[6]["radii"][0] == 0).all(-1)] == 0).all() for gradient in found)


@pytest.mark.parametrize(
    ("count", "height", "width"), [(1, 64, 64), (2, 29, 37), (1, 3, 3), (2, 5, 4), (1, 20, 17)]
)
def test_normals_from_depth_in_single_precision(count: int, height: int, width: int) -> None:
    """Kernels against torch in double precision, holes included."""
    g = torch.Generator().manual_seed(width)
    depth = 1.0 + torch.rand(count, height, width, 1, generator=g)
    depth *= torch.rand(count, height, width, 1, generator=g) > 0.2
    weights = torch.rand(depth.shape, generator=g)
    viewmats = torch.eye(4).repeat(count, 1, 1) + 0.1 * torch.randn(count, 4, 4, generator=g)
    Ks = torch.tensor([[[50.0, 3.0, width / 2], [0.0, 60.0, height / 2], [0.0, 0.0, 1.0]]]).repeat(
        count, 1, 1
    )
    found = []
    for dtype in (torch.float32, torch.float64):
        given_ = [tensor.to(dtype).requires_grad_() for tensor in (depth, viewmats, Ks)]
        normals = depth_to_normals(*given_, weights.to(dtype))
        upstream = torch.randn(normals.shape, generator=torch.Generator().manual_seed(1)).to(dtype)
        found.append([normals, *torch.autograd.grad(normals, given_, upstream)])
    for single, double in zip(*found, strict=True):
        assert (single - double).norm() <= 1e-6 * double.norm()


@pytest.fixture
def threads() -> Iterator[None]:
    before = device.thread_count()
    yield
    device.set_thread_count(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("degree", [None, 3])
def test_threads_do_not_change_a_bit(degree: int | None) -> None:
    scene, views = cloud(4000, 8, size=0.03), cameras(2, 130, 90)
    scene["colors"] = features(4000, 4, 8) if degree is None else harmonics(4000, degree, 8)
    results = []
    for count in (1, 2, 8):
        device.set_thread_count(count)
        given = {k: v.clone().requires_grad_() for k, v in scene.items()}
        outputs = rasterization_2dgs(**given, **views, sh_degree=degree, render_mode="RGB+ED")
        loss = sum((image * image).sum() for image in outputs[:6])
        gradients = torch.autograd.grad(loss, list(given.values()))
        results.append([*outputs[:6], *gradients, contributions(outputs[6])])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
def test_methods_agree(mode: str) -> None:
    scene, views = cloud(400, 9, size=0.06), cameras(2, 70, 50)
    images = [
        rasterization_2dgs(
            **scene,
            colors=features(400, 5, 9),
            **views,
            render_mode=mode,
            options=RasterOptions(method=method),
        )
        for method in METHODS
    ]
    for i in (0, 1, 2, 4, 5):
        error = (images[0][i] - images[1][i]).abs()
        assert error.median() < 1e-7
        assert (error > 1e-5).float().mean() < 1e-3
    assert torch.equal(images[0][6]["flatten_ids"], images[1][6]["flatten_ids"])


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("degree", [None, 3])
def test_cuda_equals_cpu(mode: str, degree: int | None) -> None:
    scene, views = cloud(2000, 0, size=0.06), cameras(2, 200, 150)
    scene["colors"] = features(2000, 5, 0) if degree is None else harmonics(2000, degree, 0)
    found = []
    for where in ("cpu", "cuda"):
        given_ = {k: v.to(where).requires_grad_() for k, v in scene.items()}
        moved = {k: v.to(where) if isinstance(v, Tensor) else v for k, v in views.items()}
        outputs = rasterization_2dgs(**given_, **moved, sh_degree=degree, render_mode=mode)
        images = [image for image in outputs[:6] if image is not None]
        loss = sum((image * image).mean() for image in images)
        gradients = torch.autograd.grad(loss, list(given_.values()))
        found.append([[t.detach().cpu() for t in images], [t.cpu() for t in gradients]])
    # Rounding differs, so a few pixels at a threshold may move by 1/255.
    for cpu, cuda in zip(found[0][0], found[1][0], strict=True):
        assert ((cuda - cpu).abs() > 1e-3).float().mean() < 2e-3
        assert (cuda - cpu).abs().median() < 1e-6
    for cpu, cuda in zip(found[0][1], found[1][1], strict=True):
        assert (cuda - cpu).norm() < 2e-2 * cpu.norm()


def call(**changes: object) -> None:
    arguments = {**cloud(4, 0), "colors": features(4, 3, 0), **cameras(1, 8, 8), **changes}
    rasterization_2dgs(**arguments)


def test_gsplat_arguments() -> None:
    call(packed=False, tile_size=16, sparse_grad=False, absgrad=True, eps2d=0.5, depth_mode="median")
    with pytest.raises(ValueError, match="packed must be False"):
        call(packed=True)
    with pytest.raises(TypeError, match="unexpected argument 'rays'"):
        call(rays=1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": torch.zeros(4, 2)}, r"means must have shape \[N, 3\], got \[4, 2\]"),
        ({"scales": torch.zeros(4, 4)}, r"scales must have shape \[4, 3\], got \[4, 4\]"),
        ({"scales": torch.zeros(3, 2)}, r"scales must have shape \[4, 2\], got \[3, 2\]"),
        (
            {"quats": torch.zeros(4, 4, dtype=torch.float64)},
            r"quats must be torch.float32, got torch.float64",
        ),
        ({"colors": torch.zeros(4, 3, 3), "sh_degree": 1}, r"at least 4 coefficients for sh_degree 1"),
        ({"Ks": torch.zeros(2, 3, 3)}, r"Ks must have shape \[1, 3, 3\], got \[2, 3, 3\]"),
        ({"width": 0}, r"width must be a whole number of pixels >= 1, got 0"),
        ({"eps2d": math.nan}, r"eps2d must be a number >= 0, got nan"),
        ({"backgrounds": torch.zeros(1, 4)}, r"backgrounds must have shape \[1, 3\], got \[1, 4\]"),
        ({"render_mode": "depth"}, r"render_mode must be one of RGB, D, ED, RGB\+D, RGB\+ED, got 'depth'"),
        ({"depth_mode": "mean"}, r"depth_mode must be one of expected, median, got 'mean'"),
        ({"distloss": True}, r"distloss=True needs a render_mode with depth"),
    ],
)
def test_malformed_arguments(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(**changes)


def test_counts_past_the_limits_are_refused() -> None:
    with pytest.raises(RequestError, match=r"image values .* come to 3000000000000"):
        call(width=1_000_000, height=1_000_000)
    with pytest.raises(RequestError, match="tile list entries come to"):
        call(options=RasterOptions(max_tile_entries=1))
