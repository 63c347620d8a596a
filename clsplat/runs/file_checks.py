"""How each file of a run is looked at: what it is, or the DataError of what is wrong with it."""

import stat
from pathlib import Path
from typing import Any

from clsplat import plugins
from clsplat.compare.run_folder import read_metrics
from clsplat.errors import DataError, shortened
from clsplat.formats.table import endings
from clsplat.gaussians.model import load as load_model
from clsplat.names import METRICS, RECORDS, is_inside
from clsplat.pages.page import require_end
from clsplat.pipeline.loading import load as load_pipeline
from clsplat.pipeline.matrix import load_experiment
from clsplat.prepare.cache import noted
from clsplat.reading import KINDS, read_json, sha256
from clsplat.scene.identity import Identity
from clsplat.scene.images import read_image
from clsplat.training import archive, checkpoint
from clsplat.training.found import size_text
from clsplat.training.records import Records
from clsplat.training.status_schema import status_of


def require(path: Path, kind: int = stat.S_IFREG) -> None:
    """Raise DataError, with what is there instead, where there is no file, or nothing of another `kind`."""
    try:
        found = stat.S_IFMT(path.stat().st_mode)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise DataError("is a link that leads to nothing" if path.is_symlink() else "is missing") from error
    except OSError as error:
        raise DataError(f"cannot be read ({error.strerror})") from error
    if found != kind:
        raise DataError(f"is {KINDS.get(found, 'a file')}; expected {KINDS.get(kind, 'a file')}")


def require_sum(expected: str | None, path: Path) -> None:
    if expected is not None and sha256(path) != expected:
        raise DataError("differs from its checksum")


def settings_file(path: Path, settings: dict[str, Any], expected: str | None) -> str:
    require_sum(expected, path)
    if "matrix" in settings:
        load_experiment(str(path))
        return "of a matrix"
    recorded = settings.get("plugins")
    if isinstance(recorded, dict) and (faults := plugins.differences(recorded)):
        return f"not checked further: {faults[0]}"
    load_pipeline(str(path))
    return ""


def status_file(path: Path) -> str:
    content = read_json(path)
    status = status_of(content)
    return status.state if status else f"not checked further: format {content['format']}, of a newer clsplat"


def checkpoint_file(written: dict[str, str], path: Path) -> str:
    """Also note in `written` the checksums of models, where no training follows that may write them anew."""
    state, tables = checkpoint.load(path)
    if not any("optimize" in stage for stage in state.pipeline["stages"][state.cursor :]):
        written.update(state.written)
    gaussians = None if state.field else len(tables["gaussians/means"])
    return f"step {state.step}, {size_text(gaussians, state.field['parameters'] if state.field else None)}"


def failed_state(path: Path) -> str:
    return f"the state of a failure at step {archive.read(path)[0].get('step')}"


def inputs_file(path: Path) -> str:
    Identity.from_data(read_json(path))
    return ""


def note_file(path: Path) -> str:
    if noted(path.parent) is None:
        raise DataError("expected the hash and the folder of prepared photographs")
    return ""


def page(path: Path) -> str:
    require_end(path)
    return ""


def sums_file(expected: list[str], path: Path) -> str:
    sums = read_json(path)
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise DataError("expected the SHA-256 of each file")
    faults = [f"'{shortened(name)}' is no file of the run" for name in sums if not is_inside(name)]
    if absent := [f"'{name}'" for name in expected if name not in sums]:
        faults.append(f"lacks {', '.join(absent)}")
    if faults:
        raise DataError("; ".join(faults))
    return f"of {len(sums)} files"


def output(expected: str | None, path: Path) -> str:
    """Look at one output; return what it is.  Raises the errors of its reader, DataError where its bytes changed."""
    require_sum(expected, path)
    if path.name == METRICS:
        metrics = read_metrics(path)
        return size_text(metrics.gaussians, metrics.parameters)
    if path.name == RECORDS:
        return f"{len(Records(path.parent).read())} lines"
    if path.name.lower().endswith(tuple(endings(reads=True))):
        return f"{len(load_model(path)):,} Gaussians"
    if path.suffix == ".png":
        height, width = read_image(path).shape[:2]
        return f"{width} x {height} px"
    return ""


def folder(path: Path) -> str:
    """Look at a folder that stands for its files."""
    return f"{sum(one.is_file() for one in path.rglob('*'))} files"
