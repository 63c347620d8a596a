"""Settings: frozen models whose fields are the keys of a pipeline file."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Base of everything that a pipeline file can say: unknown keys and wrong types are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)
