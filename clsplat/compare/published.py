"""Published figures beside measured ones: a file of tables, each with its source and its protocol.

They stand below the runs of a comparison, apart: no mean and no mark of the best mixes the two.
"""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from clsplat.errors import ConfigError
from clsplat.pipeline.explanation import explain
from clsplat.pipeline.yaml_file import read_yaml

Text = Annotated[str, Field(min_length=1, max_length=2000)]


class PublishedTable(BaseModel):
    """One table of a publication."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    title: Text
    source: Text  # the publication, and how the figures came from there
    protocol: Text  # data, sizes, steps
    columns: Annotated[list[Text], Field(min_length=1)]
    rows: Annotated[dict[Text, list[float | None]], Field(min_length=1)]  # method -> figure of each column; null: none

    @model_validator(mode="after")
    def _whole(self) -> "PublishedTable":
        for name, figures in self.rows.items():
            if len(figures) != len(self.columns):
                raise ValueError(f"expected {len(self.columns)} figures of '{name}', one a column; got {len(figures)}")
        if all(one is None for figures in self.rows.values() for one in figures):
            raise ValueError("expected a figure")
        return self

    @property
    def shown(self) -> dict[str, list[str]]:
        """The figures of each method as text, all with as many digits as the one that has most."""
        digits = max(
            len(f"{one:.10g}".partition(".")[2]) for row in self.rows.values() for one in row if one is not None
        )
        return {name: ["–" if one is None else f"{one:.{digits}f}" for one in row] for name, row in self.rows.items()}


class Published(BaseModel):
    """The contents of a file of published tables."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    tables: Annotated[list[PublishedTable], Field(min_length=1)]


def read_published(path: Path) -> list[PublishedTable]:
    """Read the tables of a YAML file.  Raises ConfigError with its line where it holds something else."""
    document = read_yaml(path)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{path}:1: expected the key tables")
    try:
        return Published.model_validate(document.data).tables
    except ValidationError as error:
        raise ConfigError(explain(error, Published, path, document)) from error
