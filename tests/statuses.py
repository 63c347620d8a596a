"""A status.json as a run writes it, with other values."""

import json
from pathlib import Path
from typing import Any

from clsplat.training.status import StatusFile


def write_status(folder: Path, **values: Any) -> None:
    now = StatusFile(folder).now.model_copy(update=values)
    (folder / "status.json").write_text(json.dumps(now.model_dump(exclude_none=True)))
