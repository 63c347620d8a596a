"""How the cells of a matrix are run: the keys of `execution:`, or of a file that `--on` names."""

import logging
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError, model_validator

from clsplat.errors import ConfigError, DeviceError, one_line
from clsplat.pipeline.explanation import explain, first_fault, place_text
from clsplat.pipeline.yaml_file import Document, read_yaml
from clsplat.settings import ReadPath, Settings

LOG = logging.getLogger("clsplat")
STORE = "runs/store"
LOOPBACK = ("127.0.0.1", "localhost")


class Placement(Settings):
    """Which devices may run which cells."""

    bits: Literal["same", "any"] = "same"
    """same: all cells on devices of one bits class, that of most devices; any: each cell within a class."""


class Tls(Settings):
    """The certificates of a scheduler elsewhere, PEM files."""

    ca: ReadPath
    """Certificate of the authority."""
    cert: ReadPath
    """Certificate of this side."""
    key: ReadPath
    """Its private key."""


class Execution(Settings):
    """Where the cells of a matrix run, and where they are kept."""

    engine: Annotated[str, Field(pattern=r"^(inline|local|(dask|tls)://[^/:\s]+:\d{1,5})$")] = "inline"
    """inline: one after the other in this process; local: one process a device of this machine; dask://HOST:PORT or
    tls://HOST:PORT: on the devices that `clsplat worker` offers to that scheduler."""
    store: ReadPath | None = None
    """Folder of cells and results, shared by all machines; without it runs/store, and inline runs without a store."""
    devices: Literal["auto"] | Annotated[list[str], Field(min_length=1)] = "auto"
    """Devices of this machine, as `--device` takes them; auto: every device that works; inline: the first."""
    placement: Placement = Placement()
    """Which devices may run which cells."""
    retries: Annotated[int, Field(ge=1)] = 3
    """Failures of a cell without a newer checkpoint after which it is given up."""
    insecure: bool = False
    """Whether a scheduler on another machine may be reached without TLS: whoever reaches its port can run code."""
    tls: Tls | None = None
    """Certificates for tls://."""

    @model_validator(mode="after")
    def _is_safe(self) -> "Execution":
        scheme = self.engine.partition("://")[0]
        if scheme == "dask" and not self.is_local and not self.insecure:
            raise ValueError(f"{self.engine}: expected tls:// for another machine, or insecure: true")
        if scheme == "tls" and self.tls is None:
            raise ValueError(f"{self.engine}: expected tls: {{ca: …, cert: …, key: …}}")
        return self

    @property
    def is_local(self) -> bool:
        """Whether the scheduler is on this machine."""
        return self.engine.partition("://")[2].rpartition(":")[0] in LOOPBACK

    @property
    def address(self) -> str:
        """The scheduler's address, as Dask has it."""
        return self.engine.replace("dask://", "tcp://")

    @property
    def keeps(self) -> Path | None:
        """The folder of the store; None: there is none."""
        if self.store is None:
            return None if self.engine == "inline" else Path(STORE)
        return Path(self.store)


def execution_of(values: dict[str, Any], path: Path, place: tuple[str, ...] = ("execution",)) -> Execution:
    """Check the keys of `execution` of a file.  place: where they stand in it.  Raises ConfigError, with the line."""
    try:
        return Execution.model_validate(values)
    except ValidationError as error:
        document = read_yaml(path)
        lines = {line[len(place) :]: n for line, n in document.lines.items() if line[: len(place)] == place}
        raise ConfigError(explain(error, Execution, path, Document(values, lines))) from error


def check_execution(file: Path) -> None:
    """Check the `execution` of a file, where it has one.  Raises ConfigError with the line."""
    data = read_yaml(file).data
    if isinstance(data, dict) and "execution" in data:
        execution_of(data["execution"], file)


def values_of(file: Path | None) -> dict[str, Any] | None:
    """Return the keys of an execution file as plain data, which were checked; None without.  Raises ConfigError."""
    if file is None:
        return None
    data = read_yaml(file).data
    if not isinstance(data, dict):
        raise ConfigError(f"{file}:1: expected keys such as engine and store")
    execution_of(data, file, ())
    return data


def options(values: dict[str, Any]) -> Execution:
    """Check keys that options of a command gave.  Raises ConfigError."""
    try:
        return Execution.model_validate(values)
    except ValidationError as error:
        place, complaint = first_fault(error, Execution)
        raise ConfigError(f"--scheduler: {place_text(place)}: {complaint}" if place else complaint) from error


def warn_of_open_port(execution: Execution) -> None:
    """Say so where a scheduler elsewhere is reached without TLS."""
    if execution.insecure:
        LOG.warning("%s: is not encrypted; whoever reaches the scheduler's port can run code", execution.engine)


def unanswered(execution: Execution, error: BaseException) -> DeviceError:
    """Return the error of a scheduler that cannot be reached."""
    reason = one_line(error.__cause__ or error) or "no answer"
    return DeviceError(f"{execution.engine}: cannot be worked with ({reason}); start it with `dask scheduler`")
