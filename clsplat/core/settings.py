"""Define settings, which are frozen pydantic models whose fields are the keys of a pipeline file, and their variants.

A variant is a subclass with a name, which is the `Literal` of its field `type`, or `stage` for stages.  A pipeline file
can use a variant as soon as its class is defined, in the package or in a plug-in.  There is no other list of variants.
"""

import ast
import functools
import importlib
import inspect
import itertools
import pkgutil
import textwrap
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    GetCoreSchemaHandler,
    GetJsonSchemaHandler,
    ValidationError,
    WrapValidator,
)
from pydantic_core import CoreSchema, core_schema

from clsplat.core.errors import ConfigError

TAGS = ("stage", "type")  # fields that contain a variant's name
Base = TypeVar("Base", bound="Settings")


class Settings(BaseModel):
    """Base of all settings in pipeline files: unknown keys and wrong types are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)
    subclasses: ClassVar[list[type["Settings"]]] = []  # all subclasses in order of definition
    output_keys: ClassVar[frozenset[str]] = frozenset()  # keys that may change on resume without changing the model
    training_keys: ClassVar[frozenset[str]] = frozenset()  # keys that may change on resume and then change the model
    step_keys: ClassVar[frozenset[str]] = frozenset()  # step numbers that scale with the length of training
    keyed_by_type: ClassVar[bool] = False  # lists contain each type at most once, and items are addressed by type
    rate_keys: ClassVar[frozenset[str]] = (
        frozenset()
    )  # schedules whose values are divided when training is longer, so that their sum over all steps stays the same
    family: ClassVar[str] = ""  # a second name, in addition to the type, for use in `conflicts` of other settings
    unavailable: ClassVar[Mapping[str, str]] = {}  # keys that are valid elsewhere but not here, each with advice
    conflicts: ClassVar[Mapping[str, str]] = {}
    """Types or families that may not occur in the same stage as these settings, or outside of all stages.

    Each value is `reason; advice`.
    """

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        Settings.subclasses.append(cls)

    def conflict_names(self) -> set[str]:
        """Return the names by which `conflicts` of other settings may refer to these settings."""
        return {self.family, *(str(getattr(self, tag)) for tag in TAGS if tag in type(self).model_fields)}

    def active_conflicts(self) -> Mapping[str, str]:
        """Return the `conflicts` that apply to these values."""
        return self.conflicts

    def check_pipeline(self, pipeline: Any) -> None:
        """Raise ConfigError if the pipeline (a PipelineFile) lacks something that these settings need."""

    def active_values(self) -> dict[str, Any]:
        """Return the values by key, except values without effect."""
        return {key: getattr(self, key) for key in type(self).model_fields}

    def input_path(self, key: str, scene: str | None) -> Path | None:
        """Return the path of an input file or folder in a key's value, or None.  `scene` is the dataset's folder."""
        value = getattr(self, key)
        return Path(value) if isinstance(value, str) and is_input_path(type(self), key) else None

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        json_schema = handler(schema)
        properties = handler.resolve_ref_schema(json_schema).get("properties", {})
        for name, text in descriptions(cls).items():
            properties.get(name, {}).setdefault("description", text)
        return json_schema


def iter_settings(value: Any, path: str = "") -> Iterator[tuple[str, Settings]]:
    """Yield all settings nested in a value, each with its key path, such as stages[1].optimize.losses[0]."""
    if isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from iter_settings(inner, f"{path}[{i}]")
    elif isinstance(value, dict):
        yield from iter_settings(list(value.values()), path)
    elif isinstance(value, Settings):
        path = f"{path}.{name}" if (name := getattr(value, "stage", None)) else path
        yield path, value
        for key, inner in value.active_values().items():
            yield from iter_settings(inner, f"{path}.{key}" if path else key)


@functools.cache
def descriptions(cls: type[BaseModel]) -> dict[str, str]:
    """Return the docstrings of a class's fields by name, except those whose source code cannot be read.

    The source is parsed on demand, because parsing all classes at startup would make it a third slower.
    """
    result: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not (issubclass(base, BaseModel) and base.__annotations__):
            continue
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):
            continue
        assert isinstance(tree, ast.ClassDef)
        for node, next_node in itertools.pairwise(tree.body):
            match node, next_node:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    result[name] = inspect.cleandoc(text)
    return {name: text for name, text in result.items() if name in cls.model_fields}


def variant_tag(cls: type[Settings]) -> tuple[str, str] | None:
    """Return the tag field of a variant and the variant's name, or None for a base class."""
    for tag in TAGS:
        if tag in cls.model_fields and (names := typing.get_args(cls.model_fields[tag].annotation)):
            return tag, str(names[0])
    return None


def resume_effect(cls: type[Settings], key: str) -> Literal["output", "training"] | None:
    """Return what changes if the value of a key differs on resume, or None if the value may not differ."""
    bases = [base for base in cls.__mro__ if issubclass(base, Settings)]
    if any(key in base.output_keys for base in bases):
        return "output"
    return "training" if any(key in base.training_keys for base in bases) else None


def variants(base: type[Base]) -> dict[str, type[Base]]:
    """Return the variants of `base` by name.  Raises ConfigError when two have the same name."""
    return dict(_variants_by_name(base, tuple(Settings.subclasses)))


@functools.lru_cache(maxsize=256)
def _variants_by_name(base: type[Base], subclasses: tuple[type["Settings"], ...]) -> dict[str, type[Base]]:
    by_name: dict[str, type[Base]] = {}
    for cls in subclasses:
        if not issubclass(cls, base) or (tag := variant_tag(cls)) is None:
            continue
        if tag[1] in by_name:
            classes = " and ".join(f"{variant.__module__}.{variant.__name__}" for variant in (by_name[tag[1]], cls))
            raise ConfigError(f"two variants of {base.__name__} have the name '{tag[1]}': {classes}; rename one")
        by_name[tag[1]] = cls
    return by_name


def invalid_variant_reason(cls: type[Settings]) -> str | None:
    """Return the reason why a class that resembles a variant cannot be used in a pipeline file, or None."""
    if cls.__subclasses__():
        return None
    if missing_methods := sorted(getattr(cls, "__abstractmethods__", ())):
        return f"lacks {', '.join(missing_methods)}"
    bases = [base for base in cls.__mro__[1:] if issubclass(base, Settings) and base is not Settings]
    tags = [tag for base in bases for other in variants(base).values() if (tag := variant_tag(other))]
    if not tags:
        return None
    field = cls.model_fields.get(tags[0][0])
    names = typing.get_args(field.annotation) if field else ()
    if len(names) == 1 and isinstance(names[0], str):
        return None
    return f'expected one name, as in `{tags[0][0]}: Literal["{cls.__name__.lower()}"]`'


def needs_settings(cls: type[Settings]) -> bool:
    """Return whether a variant has required keys, so that its name alone is not enough."""
    return any(field.is_required() for name, field in cls.model_fields.items() if name not in TAGS)


class Variants:
    """An annotation of a field that accepts a variant of `base`: a mapping with its name, or only its name."""

    def __init__(self, base: type[Settings]) -> None:
        self.base = base

    @property
    def tag(self) -> str:
        """The field that contains a variant's name."""
        return next((tag[0] for cls in variants(self.base).values() if (tag := variant_tag(cls))), TAGS[-1])

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        tag = self.tag
        choices = {name: handler.generate_schema(cls) for name, cls in variants(self.base).items()}

        def with_tag(value: Any) -> Any:
            return {tag: value} if isinstance(value, str) else value

        union = core_schema.tagged_union_schema(choices, discriminator=tag)
        return core_schema.no_info_before_validator_function(with_tag, union)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        names = [name for name, cls in variants(self.base).items() if not needs_settings(cls)]
        mapping = {"required": [self.tag], **handler(schema)}
        return {"anyOf": [{"enum": names}, mapping]} if names else mapping


def _check_path(text: str) -> str:
    if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
        raise ValueError("expected a path without NUL characters and with valid Unicode")
    return text


def in_one_sentence(expected: str) -> WrapValidator:
    """Return a validator that reports an error in any notation of a field as one sentence.

    The sentence is the first message that a validator of the field raised, or `expected` if there is none.
    """

    def validate_any(value: Any, validate: Callable[[Any], Any]) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            messages = [e["msg"].removeprefix("Value error, ") for e in error.errors() if e["type"] == "value_error"]
            raise ValueError(next((text for text in messages if not expected.startswith(text)), expected)) from None

    return WrapValidator(validate_any)


InputPath = Annotated[str, AfterValidator(_check_path)]  # an input file or folder


def is_input_path(cls: type[Settings], key: str) -> bool:
    """Return whether the value of a key is the path of an input file or folder."""
    field = cls.model_fields[key]
    return InputPath in (field.annotation, *typing.get_args(field.annotation)) or any(
        isinstance(item, AfterValidator) and item.func is _check_path for item in field.metadata
    )


class VariantName:
    """An annotation of a field that accepts the name of a variant of `base` for which `accepts` returns True."""

    def __init__(self, base: type[Base], accepts: Callable[[type[Base]], bool] = lambda cls: True) -> None:
        self.base, self._accepts = base, accepts

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema([name for name, cls in variants(self.base).items() if self._accepts(cls)])


if TYPE_CHECKING:
    OneOf = Annotated[Base, ...]
else:

    class OneOf:
        """The type of a field that accepts any variant of a base, as in `OneOf[Rule]`."""

        def __class_getitem__(cls, base: type[Settings]) -> Any:
            return Annotated[base, Variants(base)]


def import_modules(package: str, path: Iterable[str]) -> None:
    """Import every module of a package, so that its variants are defined."""
    for module in pkgutil.iter_modules(path):
        importlib.import_module(f"{package}.{module.name}")


def rebuild_models() -> None:
    """Rebuild all models, so that their fields accept variants defined later, such as those of a plug-in."""
    built_models = [cls for cls in Settings.subclasses if cls.__pydantic_complete__]  # others: built on first use
    for cls in built_models:  # a schema contains the schemas of nested variants
        if "__pydantic_core_schema__" in vars(cls):
            del cls.__pydantic_core_schema__
    for cls in built_models:
        cls.model_rebuild(force=True)
