"""3D Gaussian Splatting on any OpenCL device.

    import clsplat
    scene = clsplat.read_scene("data/fox")
    trainer = clsplat.Trainer(scene, "splat_7k", set={"optimize.steps": 2000})
    trainer.run()
    result = clsplat.Renderer(trainer.model).render(scene.split("test")[0])

Names are imported on first use.  `import clsplat` opens no device.
"""

import importlib
import sys
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from clsplat import metrics as metrics
    from clsplat.api.commands import align as align
    from clsplat.api.commands import cancel as cancel
    from clsplat.api.commands import check as check
    from clsplat.api.commands import compare_runs as compare_runs
    from clsplat.api.commands import compress_model as compress_model
    from clsplat.api.commands import convert as convert
    from clsplat.api.commands import copy_pipeline as copy_pipeline
    from clsplat.api.commands import describe_run as describe_run
    from clsplat.api.commands import evaluate as evaluate
    from clsplat.api.commands import pipeline_schema as pipeline_schema
    from clsplat.api.commands import pipelines as pipelines
    from clsplat.api.commands import plan_in_blocks as plan_in_blocks
    from clsplat.api.commands import resume as resume
    from clsplat.api.commands import run as run
    from clsplat.api.commands import run_cell as run_cell
    from clsplat.api.commands import run_worker as run_worker
    from clsplat.api.commands import status as status
    from clsplat.api.commands import status_schema as status_schema
    from clsplat.api.commands import train_in_blocks as train_in_blocks
    from clsplat.api.commands import view as view
    from clsplat.api.commands import write_levels as write_levels
    from clsplat.api.commands import write_mesh as write_mesh
    from clsplat.api.renderer import FieldRenderer as FieldRenderer
    from clsplat.api.renderer import Gradients as Gradients
    from clsplat.api.renderer import Renderer as Renderer
    from clsplat.api.renderer import RenderResult as RenderResult
    from clsplat.api.rendering import camera_path as camera_path
    from clsplat.api.rendering import render_path as render_path
    from clsplat.api.rendering import render_views as render_views
    from clsplat.api.rendering import write_cameras as write_cameras
    from clsplat.api.rendering import write_video as write_video
    from clsplat.api.tools import devices as devices
    from clsplat.api.tools import doctor as doctor
    from clsplat.api.tools import inspect_scene as inspect_scene
    from clsplat.api.tools import load_plugin as load_plugin
    from clsplat.api.tools import measure_speed as measure_speed
    from clsplat.api.tools import read_measurement as read_measurement
    from clsplat.api.trainer import Report as Report
    from clsplat.api.trainer import Trainer as Trainer
    from clsplat.core import errors as errors
    from clsplat.core.resources import __version__ as __version__
    from clsplat.formats.splats import ReadOptions as ReadOptions
    from clsplat.formats.splats import WriteOptions as WriteOptions
    from clsplat.gaussians.model import Model as Model
    from clsplat.gaussians.model import Rendering as Rendering
    from clsplat.gaussians.model import load as load
    from clsplat.nerf.files import FieldModel as FieldModel
    from clsplat.nerf.files import load_field as load_field
    from clsplat.opencl.device import Device as Device
    from clsplat.scene.camera import Camera as Camera
    from clsplat.scene.detect import read_scene as read_scene
    from clsplat.scene.scene import PointCloud as PointCloud
    from clsplat.scene.scene import Scene as Scene
    from clsplat.scene.view import View as View
    from clsplat.scene.view_selection import Split as Split
    from clsplat.scene.view_selection import ViewSelection as ViewSelection


class _CheckoutFinder:
    """An import finder for `clsplat.data_tools` in a source checkout, where `data_tools` is next to the package."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        folder = Path(__file__).resolve().parents[1] / "data_tools"
        if name != "clsplat.data_tools" or not folder.is_dir():
            return None
        file = str(folder / "__init__.py")
        spec = ModuleSpec(name, SourceFileLoader(name, file), origin=file, is_package=True)
        spec.submodule_search_locations = [str(folder)]
        return spec


sys.meta_path.append(_CheckoutFinder)
_EXPORTS = {  # modules that define the names; `import clsplat` does not import them
    "clsplat.api.commands": "align cancel check compare_runs compress_model convert copy_pipeline describe_run evaluate"
    " pipeline_schema pipelines plan_in_blocks resume run run_cell status status_schema"
    " run_worker train_in_blocks view write_levels write_mesh",
    "clsplat.api.rendering": "camera_path render_path render_views write_cameras write_video",
    "clsplat.api.renderer": "FieldRenderer Gradients RenderResult Renderer",
    "clsplat.api.tools": "devices doctor inspect_scene load_plugin measure_speed read_measurement",
    "clsplat.api.trainer": "Report Trainer",
    "clsplat.core.resources": "__version__",
    "clsplat.formats.splats": "ReadOptions WriteOptions",
    "clsplat.gaussians.model": "load Model Rendering",
    "clsplat.nerf.files": "FieldModel load_field",
    "clsplat.opencl.device": "Device",
    "clsplat.scene.camera": "Camera",
    "clsplat.scene.detect": "read_scene",
    "clsplat.scene.scene": "PointCloud Scene",
    "clsplat.scene.view": "View",
    "clsplat.scene.view_selection": "Split ViewSelection",
}
_MODULE_OF = {name: module for module, names in _EXPORTS.items() for name in names.split()}
_MODULES = {"errors": "clsplat.core.errors", "metrics": "clsplat.metrics"}
__all__ = sorted([*_MODULE_OF, *_MODULES])


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return importlib.import_module(_MODULES[name])
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'clsplat' has no attribute '{name}'")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
