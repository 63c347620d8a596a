"""Training modules: independence of the loop, order, and addressing by `--set`."""

import json
from typing import Any

import pytest

from clsplat.core.errors import ConfigError
from clsplat.core.settings import variants
from clsplat.losses.base import LossValue
from clsplat.losses.image import L1, L2
from clsplat.pipeline.loading import load
from clsplat.training import checkpoint
from clsplat.training.modules.base import ModuleState, TrainingModule, check_list, implicit_modules, module_class
from tests.support.device_images import trainer_of
from tests.support.runs import FEW, killed, train
from tests.support.sources import PATHS, own_imports, room

MODULES = "clsplat.training.modules"
CHECKS = {f"clsplat.conformance.checks.{name}" for name in ("appearance", "images", "projection")}
ROOMS = {"api", "metrics", "runs", "stages", "training", "workflows"}  # in which no text is the name of a listed module


def types(*settings: str) -> list[str]:
    return [module.type for module in load("smoke", list(settings)).settings.training.modules]


def test_code_outside_its_check_names_no_module():
    """Trainer, checkpoint, memory plan, evaluation, writer and reader of side files go through the base."""
    listed = variants(TrainingModule)
    homes = {kind.__module__ for kind in (*listed.values(), *implicit_modules().values())}
    faults = {
        f"{module} imports {target}"
        for module, _, target in own_imports()
        if target in homes and not module.startswith(MODULES) and module not in CHECKS
    }
    for module in (module for module in PATHS if room(module) in ROOMS and module not in homes):
        text = PATHS[module].read_text()
        faults |= {f"{module} has '{name}'" for name in listed if f'"{name}"' in text}
    assert not faults, "\n".join(sorted(faults))


def test_modules_are_set_by_their_type():
    exposure, cameras = "optimize.modules.exposure={}", "optimize.modules.camera_optimizer.start=3"
    late = "optimize.modules.transients={start: 3}"
    assert types() == []
    assert types(late, exposure, cameras) == ["camera_optimizer", "exposure", "transients"], "each at its place"
    assert types(late, exposure, "optimize.modules.transients=null") == ["exposure"]
    assert types("optimize.modules.exposure=null") == [], "what is not there may be removed"
    (actual,) = load("smoke", [exposure, "optimize.modules.exposure.model=affine"]).settings.training.modules
    assert actual.model.type == "affine"


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        (["optimize.modules.expsure={}"], "unknown type 'expsure'; expected one of .*; did you mean exposure"),
        (["optimize.modules.exposure=gain"], "expected a mapping of keys to values"),
        (["optimize.modules=[{type: transients, start: 1}, exposure]"], "'exposure' is listed after 'transients'"),
        (["optimize.modules=[exposure, exposure]"], "'exposure' and 'exposure' cannot be combined"),
        (["optimize.modules=[exposure, bilateral_grid]"], "'bilateral_grid' and 'exposure' cannot be combined"),
        (["optimize.modules.camera_optimizer={}", "model.background=envmap"], "cannot be combined with sky"),
    ],
)
def test_incompatible_modules_are_refused(settings, fault):
    with pytest.raises(ConfigError, match=fault):
        load("smoke", settings)


class Order(ModuleState):
    """Notes the hooks of a step, and adds a loss."""

    def __init__(self, name: str, notes: list[str]) -> None:
        super().__init__()
        self.name, self.notes = name, notes

    def after_render(self, step) -> None:
        step.module_losses.append(LossValue(self.name, lambda: 2.0))
        self.notes.append(f"forward {self.name}")

    def backward(self, step) -> None:
        self.notes.append(f"backward {self.name}")

    def update(self, step) -> None:
        self.notes.append(f"update {self.name}")


def test_modules_run_in_order_and_backward_in_reverse(device, rng):
    trainer, photograph = trainer_of(device, rng, [L1(weight=0.5), L2()])
    alone, notes = trainer.compare(photograph, 1), []
    trainer.modules = [Order("a", notes), Order("b", notes)]
    view = trainer.step(photograph, 1)
    assert notes == ["forward a", "forward b", "backward b", "backward a", "update b", "update a"]
    assert view.loss == pytest.approx(alone.loss + 2 * 2.0), "each loss once"
    assert [item.name for item in view.losses[-2:]] == ["a", "b"]


def test_unknown_module_is_named():
    with pytest.raises(ConfigError, match="an unknown module 'nosuch'; load its plug-in"):
        module_class("nosuch")


NEEDED = {  # so that each acts within seven steps
    "camera_optimizer": {"start": 2, "focal": "auto"},
    "distractors": {"count": 30, "start": 2},
    "dropout": {"probability": 0.1},
    "transients": {"start": 2, "outlier_ratio": 1, "tail_ratio": 0},
}


def lists() -> list[list[dict[str, Any]]]:
    """Lists of all shipped modules, each in the first one with which it goes; the second run has a sky."""
    actual: list[list[TrainingModule]] = [[], []]
    shipped = [kind for kind in variants(TrainingModule).values() if kind.__module__.startswith("clsplat.")]
    for kind in sorted(shipped, key=lambda kind: kind.order):
        module = kind.model_validate({"type": (name := kind.model_fields["type"].default), **NEEDED.get(name, {})})
        for one, parts in zip(actual, ([], ["sky"]), strict=True):
            if not ({*parts} & module.conflicts.keys()) and not conflict([*one, module]):
                one.append(module)
                break
        else:
            pytest.fail(f"{name} goes with neither list: make another")
    return [[{"type": one.type, **NEEDED.get(one.type, {})} for one in modules] for modules in actual]


def conflict(modules: list[TrainingModule]) -> bool:
    try:
        check_list(modules)
    except ValueError:
        return True
    return False


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1], ids=["without a sky", "with a sky"])
def test_killed_run_resumes_to_the_same_bits(tiny_scene, tmp_path, number):
    """Of the model, of all tables and numbers of all modules, and of their side files."""
    settings = (*FEW, f"optimize.modules={json.dumps(lists()[number])}")
    settings += ("model.background={type: envmap, side: 16}",) if number else ()
    whole, again = tmp_path / "whole", tmp_path / "again"
    train(tiny_scene, whole, *settings)
    train(tiny_scene, killed(whole, again), *settings, resume=True)
    (one, tables), (other, resumed) = (checkpoint.load(checkpoint.list_files(out)[-1]) for out in (whole, again))
    assert one.modules == other.modules
    assert one.modules.keys() == {module["type"] for module in lists()[number]} | ({"sky"} if number else set())
    assert {name: table.tobytes() for name, table in tables.items()} == {
        name: table.tobytes() for name, table in resumed.items()
    }
    files = [path.name for path in whole.iterdir() if path.name.startswith(("view_", "point_cloud"))]
    assert len(files) > 1
    assert [(whole / name).read_bytes() for name in files] == [(again / name).read_bytes() for name in files]
