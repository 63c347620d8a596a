"""The field as a file."""

import logging
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from clsplat.errors import DataError, OutputError
from clsplat.gaussians.model import Rendering
from clsplat.reading import sha256
from clsplat.stages.base import Stage, path_in_run
from clsplat.training.field import LearnedField
from clsplat.training.field_file import ENDING, FILE, FieldModel, load_field
from clsplat.training.run import Run

LOG = logging.getLogger("clsplat")


class ExportField(Stage):
    """Write the field that `train_field` has trained, and read it back: a file that clsplat alone reads.

    `clsplat render` and `clsplat evaluate` take it, or the run folder that holds it.
    """

    stage: Literal["export_field"] = "export_field"
    needs: ClassVar[frozenset[str]] = frozenset({"field"})
    output_keys: ClassVar[frozenset[str]] = frozenset({"file"})

    file: Annotated[str, path_in_run(ENDING)] = FILE
    """Path inside the run folder; .npz."""

    def run(self, run: Run) -> None:
        assert isinstance(run.learned_field, LearnedField)
        field, file = run.learned_field.field, run.out / self.file
        rendering = Rendering(background=run.photographs.background_name, alpha=run.original.views[0].alpha)
        run.written[self.file] = FieldModel(field.shape, field.parameters.get(), rendering).save(file)
        try:
            load_field(file)
        except DataError as error:
            raise OutputError(f"{error}; it was written just now: check the disk and its space") from error
        LOG.info("a field of %s parameters written to %s", f"{field.shape.learned:,}", file)

    def verify(self, run: Run) -> None:
        file: Path = run.out / self.file
        if self.file not in run.written:
            raise DataError(f"{file}: this run has no record of writing it; move it away, and use --restart")
        if not file.is_file() or sha256(file) != run.written[self.file]:
            raise DataError(f"{file}: differs from what was written; `clsplat resume` writes it again")
