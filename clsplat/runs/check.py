"""What `clsplat check` was given: a pipeline, a matrix, the folder of a run, or a model."""

from pathlib import Path
from typing import Any

from clsplat.errors import ConfigError
from clsplat.files import is_there
from clsplat.gaussians.checkup import examine, is_model
from clsplat.pipeline.files import shipped
from clsplat.pipeline.loading import load
from clsplat.pipeline.matrix import load_experiment
from clsplat.runs.found import has_state
from clsplat.runs.verify import verify
from clsplat.training.field_file import is_field, load_field


def check(pipeline: str) -> dict[str, Any]:
    """Check a pipeline file, or a shipped one by name: its path, its name, its stages or cells.

    Of a run folder and of a model file return what `verify` and `examine` say, of the file of a field its parameters.
    Raises ConfigError; DataError for a folder without a run.
    """
    if is_field(Path(pipeline)) and is_there(Path(pipeline)):
        return {"path": pipeline, "name": Path(pipeline).name, "parameters": load_field(pipeline).shape.learned}
    if not has_state(Path(pipeline)) and pipeline not in shipped() and is_model(Path(pipeline)):
        return examine(Path(pipeline))
    if len(Path(pipeline).parts) > 1 and not is_there(Path(pipeline)):
        raise ConfigError(f"{pipeline}: no such file or folder; expected a pipeline, a model, or the folder of a run")
    if Path(pipeline).is_dir() and (has_state(Path(pipeline)) or pipeline not in shipped()):
        return verify(Path(pipeline))
    if found := load_experiment(pipeline):
        return {"path": str(found.path), "name": found.name, "cells": [cell.name for cell in found.cells]}
    checked = load(pipeline)
    return {"path": str(checked.path), "name": checked.settings.name, "stages": checked.names}
