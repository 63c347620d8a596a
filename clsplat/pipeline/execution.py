"""How the cells of a matrix are run: the keys of `execution:`, or of a file that `--on` names."""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator

from clsplat.core.errors import ConfigError
from clsplat.core.settings import InputPath, Settings
from clsplat.pipeline.explanation import explain, first_fault
from clsplat.pipeline.yaml_file import read_yaml

STORE = "runs/store"
ENGINE = r"^(inline|local|(dask|tls)://[^/:\s]+:(\d{1,5}))$"
LAST_PORT = 65_535
LOOPBACK = ("127.0.0.1", "localhost")
OF_A_STORE = ("devices", "placement", "retries")  # keys that only cells of a store obey


class Placement(Settings):
    """Which devices may run which cells."""

    bits: Literal["same", "any"] = "same"
    """same: all cells on devices of one bits class, that of most devices; any: each cell within a class."""


class Tls(Settings):
    """The certificates of a scheduler elsewhere, PEM files."""

    ca: InputPath
    """Certificate of the authority."""
    cert: InputPath
    """Certificate of this side."""
    key: InputPath
    """Its private key."""


def _engine(value: Any) -> Any:
    found = re.fullmatch(ENGINE, value) if isinstance(value, str) else None
    if isinstance(value, str) and (found is None or int(found[3] or 0) > LAST_PORT):
        scheduler = "dask://HOST:PORT (where Dask says tcp://) or tls://HOST:PORT"
        raise ValueError(f"expected inline, local, or the address of a scheduler, {scheduler}")
    return value


class Execution(Settings):
    """Where the cells of a matrix run, and where they are kept."""

    engine: Annotated[str, BeforeValidator(_engine), Field(pattern=ENGINE)] = "inline"
    """inline: one after the other in this process; local: one process a device of this machine; dask://HOST:PORT or
    tls://HOST:PORT: the devices that `clsplat worker` offers to that scheduler."""
    store: InputPath | None = None
    """Folder of cells and results, shared by all machines; without it runs/store, and inline runs without a store."""
    devices: Literal["auto"] | Annotated[list[str], Field(min_length=1)] = "auto"
    """Devices of this machine, as `--device` takes them; auto: every device that works; inline: the first."""
    placement: Placement = Placement()
    """Which devices may run which cells."""
    packing: Annotated[int, Field(ge=1)] = 1
    """Processes at once on each CPU of engine local, which share its cores."""
    retries: Annotated[int, Field(ge=1)] = 3
    """Failures of a cell without a newer checkpoint after which it is given up."""
    insecure: bool = False
    """Whether a scheduler on another machine may be reached without TLS: whoever reaches its port can run code."""
    tls: Tls | None = None
    """Certificates for tls://."""

    @field_validator("store")
    @classmethod
    def _names_a_folder(cls, store: str | None) -> str | None:
        if store == "":  # of a variable that was not set: it would be the working folder
            raise ValueError("expected the path of a folder")
        return store

    @model_validator(mode="after")
    def _is_meant(self) -> "Execution":
        """Refuse keys that nothing would obey, and a scheduler that anybody could reach."""
        scheme = self.engine.partition("://")[0]
        unused = {key: "expected a store too, without which cells run one after the other" for key in OF_A_STORE}
        unused = unused if self.keeps is None else {}
        if self.has_workers:
            unused["devices"] = "a scheduler has the devices that its workers offer"
        if scheme != "tls":
            unused["tls"] = "certificates are for an engine tls://HOST:PORT"
        if scheme != "local":
            unused["packing"] = "it is for engine local"
        if scheme != "dask":
            unused["insecure"] = "it is for an engine dask://HOST:PORT"
        for key, reason in unused.items():
            if getattr(self, key) != type(self).model_fields[key].default:
                raise ValueError(f"{key} has no effect with engine {self.engine}: {reason}; or leave it out")
        if scheme == "dask" and not self.is_local and not self.insecure:
            raise ValueError(f"{self.engine}: expected tls:// for another machine, or insecure: true (--insecure)")
        if scheme == "tls" and self.tls is None:
            raise ValueError(
                f"{self.engine}: expected tls: {{ca: …, cert: …, key: …}} (--tls-ca, --tls-cert and --tls-key)"
            )
        return self

    @property
    def has_workers(self) -> bool:
        """Whether cells run on the devices that workers offer to a scheduler."""
        return self.engine.startswith(("dask://", "tls://"))

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


def values_of(file: Path | None) -> dict[str, Any] | None:
    """Return the keys of an execution file as plain data, which were checked; None without.  Raises ConfigError."""
    if file is None:
        return None
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{file}:1: expected keys such as engine and store")
    try:
        Execution.model_validate(document.data)
    except ValidationError as error:
        raise ConfigError(explain(error, Execution, file, document)) from error
    return document.data


def options(values: dict[str, Any]) -> Execution:
    """Check keys that options of `clsplat worker` gave.  Raises ConfigError with the option."""
    try:
        return Execution.model_validate(values)
    except ValidationError as error:
        place, complaint = first_fault(error, Execution)
        option = "-".join(map(str, place)).replace("engine", "scheduler")
        raise ConfigError(f"--{option}: {complaint}" if place else complaint) from error
