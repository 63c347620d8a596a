"""The public package: what its import loads, its names, and hand-made views."""

import ast
import importlib
import subprocess
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import clsplat
from clsplat.api.arguments import overrides
from clsplat.api.renderer import Renderer
from clsplat.conformance.scenes import random_case
from clsplat.core.errors import ConfigError, DataError
from clsplat.scene.scene import Scene, make_scene
from tests.support.devices import on_one_setting
from tests.support.models import model_of

ROOT = Path(__file__).parents[2]
CAMERA = clsplat.Camera(48, 32, 40.0, 42.0, 23.0, 17.0)


def loaded_after(code: str) -> set[str]:
    """Return the modules that a new process has loaded after running some Python code."""
    command = [sys.executable, "-c", f"{code}\nimport sys\nprint(*sys.modules)"]
    return set(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.split())


def test_import_loads_no_heavy_module():
    loaded = loaded_after("import clsplat")
    assert {name for name in loaded if name.startswith("clsplat")} == {"clsplat"}
    assert not loaded & {"numpy", "pyopencl", "cv2", "pydantic", "scipy", "jinja2", "typer", "rich", "torch"}


def test_models_and_scenes_open_no_device():
    assert "clsplat.opencl.device" in loaded_after("import clsplat; clsplat.load")
    code = "import clsplat; clsplat.load; clsplat.read_scene; clsplat.Renderer; clsplat.Trainer; clsplat.run\n"
    code += "from clsplat.api import renderer; assert renderer._open_default.cache_info().currsize == 0"
    assert "torch" not in loaded_after(code)


def test_lazy_names_match_those_for_type_checkers():
    tree = ast.parse(Path(clsplat.__file__).read_text())
    (block,) = [node for node in tree.body if isinstance(node, ast.If) and isinstance(node.test, ast.Name)]
    typed = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom)
        (alias,) = node.names
        assert alias.name == alias.asname, "`import X as X` makes a name public for type checkers"
        typed[alias.name] = node.module
    modules = {name: place.rpartition(".")[0] for name, place in clsplat._MODULES.items()}
    assert typed == {**clsplat._MODULE_OF, **modules}
    assert sorted(typed) == clsplat.__all__
    assert {*clsplat.__all__, "__version__"} == set(dir(clsplat))


def test_every_public_name_exists_and_is_documented():
    faults = [f"{name}: has no docstring" for name in clsplat.__all__ if not getattr(clsplat, name).__doc__]
    for name in set(clsplat.__all__) - set(clsplat._MODULES):
        if getattr(clsplat, name) is not getattr(importlib.import_module(clsplat._MODULE_OF[name]), name):
            faults.append(f"{name}: is another object")
        if any(place.exists() for place in (ROOT / "clsplat" / name, ROOT / "clsplat" / f"{name}.py")):
            faults.append(f"{name}: a module of that name would take its place when imported")
    assert not faults, "\n".join(faults)


def test_unknown_name_raises_attribute_error():
    with pytest.raises(AttributeError, match="module 'clsplat' has no attribute 'splat'"):
        _ = clsplat.splat


def test_wheel_contains_every_package_and_py_typed():
    setup = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    rooms = {path.parent.relative_to(ROOT).as_posix().replace("/", ".") for path in ROOT.glob("clsplat/**/*.py")}
    assert rooms - set(setup["packages"]) == set()
    assert "py.typed" in setup["package-data"]["clsplat"]
    assert (ROOT / "clsplat" / "py.typed").is_file()


def test_settings_match_the_command_line():
    assert overrides({"a.b": 1, "c": [True, None], "d": "x y", "e": {"f": 1e-5}}) == [
        *("a.b=1", "c=[true, null]", 'd="x y"', 'e={"f": 1e-05}'),
    ]
    assert overrides(["a=1", "b=2"]) == ["a=1", "b=2"]
    assert overrides("a=1") == ["a=1"]
    numpy = {"a": np.int64(3), "b": [np.float32(0.5), np.bool_(True)], "c": Path("x") / "y", "d": {"e": np.float64(2)}}
    assert overrides(numpy) == ["a=3", "b=[0.5, true]", 'c="x/y"', 'd={"e": 2.0}']
    with pytest.raises(ConfigError, match="set: Object of type ndarray is not JSON serializable; expected numbers"):
        overrides({"a": np.zeros(3)})


def test_view_looking_at_a_point_centers_it_with_up_upwards(rng):
    position, target, up = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    view = clsplat.View.looking_at(position, target, up, CAMERA, "by hand")
    rotation, translation = view.world_to_camera[:, :3], view.world_to_camera[:, 3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(view.position, position, atol=1e-12)
    distance = np.linalg.norm(target - position)
    np.testing.assert_allclose(rotation @ target + translation, [0, 0, distance], atol=1e-12)
    across, down, _ = rotation @ up
    assert across == pytest.approx(0, abs=1e-12)
    assert down < 0
    assert view.name == "by hand"


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (([1, 2, 3], [1, 2, 3], [0, 0, 1]), "expected a target away from the position"),
        (([0, 0, 0], [0, 0, 5], [0, 0, 1]), "not in the direction of `up`"),
        (([0, 0], [0, 0, 5], [0, 1, 0]), "of 3 numbers each"),
    ],
)
def test_view_without_a_direction_is_refused(place, message):
    with pytest.raises(ValueError, match=f"^'view': .*{message}"):
        clsplat.View.looking_at(*place, CAMERA)


def test_pose_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"the pose of 'front' has shape \(4, 4\); expected \(3, 4\)"):
        clsplat.View("front", CAMERA, np.eye(4))
    assert clsplat.View("front", CAMERA, np.eye(4)[:3].tolist()).position.shape == (3,)


def test_views_are_comparable_and_hashable():
    first, other = (clsplat.View("front", CAMERA, np.eye(4)[:3]) for _ in range(2))
    assert first == first
    assert first != other
    assert len({first, other}) == 2
    assert first in [other, first]


@on_one_setting
def test_hand_made_view_renders(device, rng):
    model = model_of(random_case(rng, 30))
    middle = np.median(model.means, axis=0)
    view = clsplat.View.looking_at(middle - (0, 4, -1), middle, [0, 0, 1], CAMERA)
    same = clsplat.View("front", CAMERA, view.world_to_camera)
    renderer = Renderer(model, device)
    assert renderer.render(view).alpha.max() > 0.5
    np.testing.assert_array_equal(renderer.render(view).image, renderer.render(same).image)
    with pytest.raises(DataError, match="the view 'front' has no photo"):
        same.photograph()


def hand_made_scene() -> Scene:
    views = [clsplat.View.looking_at([np.cos(a), np.sin(a), 1], [0, 0, 0], [0, 0, 1], CAMERA, str(a)) for a in range(3)]
    return make_scene(Path("by hand"), views, {0}, None)


@on_one_setting
def test_hand_made_scene_is_for_rendering_only(device, rng):
    scene, model = hand_made_scene(), model_of(random_case(rng, 30))
    renderer = Renderer(model, device)
    assert [renderer.render(view).image.shape for view in scene.split("all")] == [(32, 48, 3)] * 3
    assert "<img" not in scene._repr_html_()
    with pytest.raises(DataError, match="by hand: the view '1' has no image; training needs one per view"):
        clsplat.Trainer(scene, "smoke", device=device)


def test_unknown_split_is_refused():
    with pytest.raises(ValueError, match="no split 'tset'; expected train, test, validation or all"):
        hand_made_scene().split("tset")


@on_one_setting
def test_device_is_a_name_or_an_open_device(device, rng, tiny_scene, tmp_path):
    case = random_case(rng, 5)
    assert Renderer(model_of(case), device).device is device
    name, schedule = device.info.name, {"rasterizer.schedule": device.schedule}
    assert Renderer(model_of(case), name).device.info.name == name
    model_of(case).save(tmp_path / "m.ply")
    assert clsplat.render_views(tmp_path / "m.ply", tiny_scene, tmp_path / "views", device=device) == 2
    assert clsplat.Trainer(tiny_scene, "smoke", device=name, set=schedule).evaluate("train")["views"] == 8
    with pytest.raises(ConfigError, match="device: expected part of a device name, or a Device, got int"):
        Renderer(model_of(case), 0)


@pytest.mark.parametrize("function", [clsplat.Trainer, clsplat.describe_run])
def test_open_device_of_another_schedule_is_refused(function, device, tiny_scene):
    arguments = {"Trainer": (tiny_scene, "smoke"), "describe_run": ("smoke", tiny_scene)}[function.__name__]
    other = "simt" if device.schedule == "wide" else "wide"
    with pytest.raises(ConfigError, match=f"the settings need {other}"):
        function(*arguments, device=device, set={"rasterizer.schedule": other})


@pytest.mark.parametrize(
    ("metric", "kind"),
    [(clsplat.metrics.psnr, np.uint16), (clsplat.metrics.ssim, np.int64), (clsplat.metrics.psnr, np.bool_)],
)
def test_metrics_refuse_images_of_unsupported_integers(metric, kind):
    image = np.full((12, 12, 3), 1, np.uint8)
    assert metric(image, image) == metric(np.float64(image), np.float64(image))
    with pytest.raises(ValueError, match=f"values of type {np.dtype(kind)}; expected uint8, or floats in"):
        metric(image.astype(kind), image)


def test_devices_are_context_managers():
    with clsplat.Device() as device:
        assert repr(device).startswith("Device('")
    assert any(item["fault"] is None and item["schedule"] in ("wide", "simt") for item in clsplat.devices())


@pytest.mark.parametrize("metric", [clsplat.metrics.psnr, clsplat.metrics.ssim])
def test_metrics_refuse_incomparable_images(metric):
    black = np.zeros((5, 6, 3))
    for value in (np.nan, np.inf):
        broken = black.copy()
        broken[1, 2, 0] = value
        with pytest.raises(ValueError, match=r"^the image has values that are not finite"):
            metric(broken, black)
        with pytest.raises(ValueError, match=r"^the photo has values that are not finite"):
            metric(black, broken)
    with pytest.raises(ValueError, match=r"shape \(5, 6, 3\), the photo \(6, 5, 3\); expected the same"):
        metric(black, np.zeros((6, 5, 3)))
    with pytest.raises(ValueError, match=r"shape \(0, 6, 3\), the photo \(0, 6, 3\); .* at least one pixel"):
        metric(black[:0], black[:0])
    for mask in (np.zeros((5, 6), bool), np.ones((6, 5), bool), np.ones((5, 6))):
        with pytest.raises(ValueError, match=r"^the mask has shape .*; expected bool of shape \(5, 6\)"):
            metric(black, black, mask)


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (np.zeros((3, 4)), "has no rotation"),
        (np.full((3, 4), np.nan), "has values that are not finite"),
        (2 * np.eye(3, 4), "has no rotation"),
        (np.diag([1, 1, -1]) @ np.eye(3, 4), "has no rotation .* without reflection"),
    ],
)
def test_invalid_pose_is_refused(pose, message):
    with pytest.raises(ValueError, match=f"^the pose of 'front' {message}"):
        clsplat.View("front", CAMERA, pose)


def test_low_precision_pose_is_accepted():
    turned = clsplat.View.looking_at([1, 2, 3], [0, 0, 0], [0, 0, 1], CAMERA).world_to_camera
    clsplat.View("front", CAMERA, np.round(turned, 3))


@pytest.mark.parametrize("downscale", [0, -1, np.nan, np.inf])
def test_view_of_size_zero_is_refused(downscale):
    with pytest.raises(ValueError, match=r"^the downscale of 'front' is .*; expected a divisor above 0"):
        clsplat.View("front", CAMERA, np.eye(3, 4)).resized(downscale)


@on_one_setting
@pytest.mark.parametrize("changes", [{"width": 50.5}, {"height": 32.0}])
def test_fractional_image_size_is_refused(changes, device, rng):
    view = clsplat.View("front", replace(CAMERA, **changes), np.eye(3, 4))
    with pytest.raises(ValueError, match=r"^the camera is .*; expected an integer width and height"):
        Renderer(model_of(random_case(rng, 5)), device).render(view)


@on_one_setting
@pytest.mark.parametrize("background", [np.nan, 5, -1, "white", [0, 0.5, 2]])
def test_background_that_is_not_a_color_is_refused(background, device, rng):
    view = clsplat.View("front", CAMERA, np.eye(3, 4))
    for paint in (Renderer(model_of(random_case(rng, 5)), device).render, lambda view, color: view.photograph(color)):
        with pytest.raises(ValueError, match=r"^the background is .*; expected one number or three in \[0, 1\]$"):
            paint(view, background)
