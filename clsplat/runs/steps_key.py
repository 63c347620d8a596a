"""The key of the steps of a run, by the stage that trains in its pipeline."""

from pathlib import Path

from clsplat.core.errors import ClsplatError
from clsplat.core.files import PIPELINE
from clsplat.core.settings import variants
from clsplat.pipeline.yaml_file import read_yaml
from clsplat.stages.optimize import Optimize
from clsplat.stages.train_field import TrainField
from clsplat.training.stage import Stage, Training

TRAINERS = (Optimize, TrainField)  # imported, so that their names are known


def steps_key(folder: Path) -> str:
    """Return the key of the steps in a run folder, such as optimize.steps; this one too where the file tells none."""
    try:
        data = read_yaml(folder / PIPELINE).data
    except ClsplatError:  # told when the run is resumed
        data = None
    stages = data.get("stages") if isinstance(data, dict) else None
    known = variants(Stage)
    for stage in stages if isinstance(stages, list) else ():
        name = stage.get("stage", next(iter(stage), "")) if isinstance(stage, dict) else stage
        if isinstance(name, str) and issubclass(known.get(name, Stage), Training):
            return f"{name}.steps"
    return f"{Optimize.model_fields['stage'].default}.steps"
