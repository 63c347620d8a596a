"""Define where the cells of a matrix run: the keys of `execution:` and of a file given by `--on`.

A pipeline file may come from a stranger, so it cannot name other machines or folders outside of the run folder.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field, ValidationError, field_validator, model_validator

from clsplat.core.errors import ConfigError
from clsplat.core.files import STORE
from clsplat.core.settings import InputPath, Settings
from clsplat.pipeline.explanation import explain, first_fault
from clsplat.pipeline.yaml_file import read_yaml

LOCAL_ENGINE = r"^(inline|local)$"
ENGINE = r"^(inline|local|(dask|tls)://[^/:\s]+:(\d{1,5}))$"
LAST_PORT = 65_535
LOOPBACK = ("127.0.0.1", "localhost")
STORE_KEYS = ("devices", "placement", "retries")  # have an effect only with a store
ONLY_IN_ON_FILE = "a pipeline file may not set this; set it in a file for --on"


class Placement(Settings):
    """Which devices may run which cells."""

    bits: Literal["same", "any"] = "same"
    """same: all cells on the largest group of devices with bit-identical results; any: each cell within one group."""


class Tls(Settings):
    """The certificates for a remote scheduler, as PEM files."""

    ca: InputPath
    """Certificate of the certificate authority (CA)."""
    cert: InputPath
    """Certificate of this machine."""
    key: InputPath
    """Private key of that certificate."""


def _check_engine(value: Any) -> Any:
    match = re.fullmatch(ENGINE, value) if isinstance(value, str) else None
    if isinstance(value, str) and (match is None or int(match[3] or 0) > LAST_PORT):
        scheduler = "dask://HOST:PORT (tcp:// in Dask) or tls://HOST:PORT"
        raise ValueError(f"expected inline, local, or the address of a scheduler, {scheduler}")
    return value


def _check_local_engine(value: Any) -> Any:
    if isinstance(value, str) and not re.fullmatch(LOCAL_ENGINE, value):
        raise ValueError("expected inline or local; set the address of a scheduler in a file for --on")
    return value


class LocalExecution(Settings):
    """How the cells of a matrix run on this machine."""

    unavailable: ClassVar[Mapping[str, str]] = dict.fromkeys(("store", "insecure", "tls"), ONLY_IN_ON_FILE)

    engine: Annotated[str, BeforeValidator(_check_local_engine), Field(pattern=LOCAL_ENGINE)] = "inline"
    """inline: one after another in this process; local: one process per device of this machine, with a store."""
    devices: Literal["auto"] | Annotated[list[str], Field(min_length=1)] = "auto"
    """Devices of this machine, named as for `--device`; auto: all working devices; engine inline uses the first."""
    placement: Placement = Placement()
    """Which devices may run which cells."""
    packing: Annotated[int, Field(ge=1)] = 1
    """With engine local: processes that run on each CPU device at the same time and share its cores."""
    retries: Annotated[int, Field(ge=1)] = 3
    """Number of failures in a row, without a newer checkpoint in between, after which a cell is not run again."""

    @model_validator(mode="after")
    def _refuse_unused_keys(self) -> "LocalExecution":
        """Raise ValueError for a key that has no effect but is not at its default."""
        for key, reason in self._unused_keys().items():
            if getattr(self, key) != type(self).model_fields[key].default:
                raise ValueError(f"{key} has no effect with engine {self.engine}: {reason}; omit it")
        return self

    def _unused_keys(self) -> dict[str, str]:
        """Return the keys that have no effect, each with a reason."""
        reasons = {} if self.has_store else dict.fromkeys(STORE_KEYS, "it needs a store")
        return reasons if self.engine == "local" else reasons | {"packing": "it applies only to engine local"}

    @property
    def has_store(self) -> bool:
        """Whether the results of cells go to a store."""
        return self.engine != "inline"


class Execution(LocalExecution):
    """Where the cells of a matrix run, and where they are stored."""

    engine: Annotated[str, BeforeValidator(_check_engine), Field(pattern=ENGINE)] = "inline"
    """inline: one after another in this process; local: one process per device of this machine; dask://HOST:PORT or
    tls://HOST:PORT: the devices that `clsplat worker` offers to that scheduler."""
    store: InputPath | None = None
    """Folder of cells and results, shared by all machines; default: `store` in the run folder, or no store with engine
    inline."""
    insecure: bool = False
    """Allow a scheduler on another machine without TLS.  Anyone who reaches its port can run code."""
    tls: Tls | None = None
    """Certificates for tls://."""

    @field_validator("store")
    @classmethod
    def _refuse_empty_store(cls, store: str | None) -> str | None:
        if store == "":  # from an unset variable; it would select the working folder
            raise ValueError("expected the path of a folder")
        return store

    @model_validator(mode="after")
    def _refuse_unsafe_scheduler(self) -> "Execution":
        """Raise ValueError for a scheduler that anyone could reach."""
        if self.engine.startswith("dask://") and not self.is_local and not self.insecure:
            raise ValueError(f"{self.engine}: expected tls:// for another machine, or insecure: true (--insecure)")
        if self.engine.startswith("tls://") and self.tls is None:
            raise ValueError(
                f"{self.engine}: expected tls: {{ca: …, cert: …, key: …}} (--tls-ca, --tls-cert, and --tls-key)"
            )
        return self

    def _unused_keys(self) -> dict[str, str]:
        reasons = super()._unused_keys()
        if self.has_workers:
            reasons["devices"] = "the workers choose the devices they offer"
        if not self.engine.startswith("tls://"):
            reasons["tls"] = "it applies only to engine tls://HOST:PORT"
        if not self.engine.startswith("dask://"):
            reasons["insecure"] = "it applies only to engine dask://HOST:PORT"
        return reasons

    @property
    def has_store(self) -> bool:
        """Whether the results of cells go to a store."""
        return self.store is not None or super().has_store

    @property
    def has_workers(self) -> bool:
        """Whether cells run on devices that workers offer to a scheduler."""
        return self.engine.startswith(("dask://", "tls://"))

    @property
    def is_local(self) -> bool:
        """Whether the scheduler is on this machine."""
        return self.engine.partition("://")[2].rpartition(":")[0] in LOOPBACK

    @property
    def address(self) -> str:
        """The scheduler's address in the notation of Dask."""
        return self.engine.replace("dask://", "tcp://")

    def store_folder(self, out: Path) -> Path:
        """Return the folder of the store, for cells whose results go to the folder `out`."""
        return Path(self.store) if self.store else out / STORE


def read_execution(file: Path | None) -> dict[str, Any] | None:
    """Read and check an execution file.  Return its keys as plain data, or None without a file.  Raises ConfigError."""
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


def from_options(values: dict[str, Any]) -> Execution:
    """Create an Execution from the options of `clsplat worker`.  Raises ConfigError with the name of the option."""
    try:
        return Execution.model_validate(values)
    except ValidationError as error:
        path, message = first_fault(error, Execution)
        option = "-".join(map(str, path)).replace("engine", "scheduler")
        raise ConfigError(f"--{option}: {message}" if path else message) from error
