"""Settings: frozen models whose fields are the keys of a pipeline file, and the variants that a key chooses from.

A variant is a subclass with a name: the literal in its field `type`, or `stage` for stages.  A pipeline file can
name it as soon as its class is defined, in the package or in a plug-in; there is no other list of variants.
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

TAGS = ("stage", "type")  # fields that hold a variant's name
Base = TypeVar("Base", bound="Settings")


class Settings(BaseModel):
    """Base of all settings in pipeline files: unknown keys and wrong types are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True)
    defined: ClassVar[list[type["Settings"]]] = []  # every subclass, in the order of definition
    output_keys: ClassVar[frozenset[str]] = frozenset()  # the model does not depend on them: they may change on resume
    training_keys: ClassVar[frozenset[str]] = frozenset()  # they may change on resume; bits then no longer compare
    step_keys: ClassVar[frozenset[str]] = frozenset()  # steps that grow with the length of the training
    keyed_by_type: ClassVar[bool] = False  # in a list each type is there once, and addressed by it
    rate_keys: ClassVar[frozenset[str]] = frozenset()  # schedules by step whose values fall as much, so that sums stay
    family: ClassVar[str] = ""  # by which `conflicts` of others may name it, next to its type
    conflicts: ClassVar[Mapping[str, str]] = {}
    """What it does not go together with, by type or family, in the same stage or outside of stages: why; what to do."""

    @classmethod
    def __pydantic_init_subclass__(cls, **options: Any) -> None:
        Settings.defined.append(cls)

    def conflict_names(self) -> set[str]:
        """Return the names by which the `conflicts` of others mean it."""
        return {self.family, *(str(getattr(self, tag)) for tag in TAGS if tag in type(self).model_fields)}

    def excluded(self) -> Mapping[str, str]:
        """Return its `conflicts`, as its values make them."""
        return self.conflicts

    def check_pipeline(self, pipeline: Any) -> None:
        """Raise ConfigError where the pipeline file around it (PipelineFile) lacks what it needs."""

    def parts(self) -> dict[str, Any]:
        """Return its values by key, without those that do not count."""
        return {key: getattr(self, key) for key in type(self).model_fields}

    def input_path(self, key: str, scene: str | None) -> Path | None:
        """Return the file or folder that is read where a key names one, else None.  scene: folder of the dataset."""
        value = getattr(self, key)
        return Path(value) if isinstance(value, str) and is_input_path(type(self), key) else None

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        found = handler(schema)
        properties = handler.resolve_ref_schema(found).get("properties", {})
        for name, text in descriptions(cls).items():
            properties.get(name, {}).setdefault("description", text)
        return found


def iter_settings(value: Any, place: str = "") -> Iterator[tuple[str, Settings]]:
    """Yield all settings inside of settings or a list, each with its place, such as stages[1].optimize.losses[0]."""
    if isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from iter_settings(inner, f"{place}[{i}]")
    elif isinstance(value, dict):
        yield from iter_settings(list(value.values()), place)
    elif isinstance(value, Settings):
        place = f"{place}.{name}" if (name := getattr(value, "stage", None)) else place
        yield place, value
        for key, inner in value.parts().items():
            yield from iter_settings(inner, f"{place}.{key}" if place else key)


@functools.cache
def descriptions(kind: type[BaseModel]) -> dict[str, str]:
    """Return the docstrings of a class's fields, by name; none where its source cannot be read.

    They are read from the source when they are asked for: for all classes at each start it would take a third of it.
    """
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not (issubclass(base, BaseModel) and base.__annotations__):
            continue
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError):
            continue
        assert isinstance(tree, ast.ClassDef)
        for field, below in itertools.pairwise(tree.body):
            match field, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = inspect.cleandoc(text)
    return {name: text for name, text in found.items() if name in kind.model_fields}


def tag_of(kind: type[Settings]) -> tuple[str, str] | None:
    """Return the field that names a variant, and its name; None for a class that is only a base of variants."""
    for tag in TAGS:
        if tag in kind.model_fields and (names := typing.get_args(kind.model_fields[tag].annotation)):
            return tag, str(names[0])
    return None


def resume_effect(kind: type[Settings], key: str) -> Literal["output", "training"] | None:
    """Return what a change of a key means when a run goes on; None where it cannot.  Subclasses add to their bases."""
    bases = [base for base in kind.__mro__ if issubclass(base, Settings)]
    if any(key in base.output_keys for base in bases):
        return "output"
    return "training" if any(key in base.training_keys for base in bases) else None


def variants(base: type[Base]) -> dict[str, type[Base]]:
    """Return the subclasses of `base` that have a name, by name.  Raises ConfigError when two have the same one."""
    return dict(_named(base, tuple(Settings.defined)))


@functools.lru_cache(maxsize=256)
def _named(base: type[Base], defined: tuple[type["Settings"], ...]) -> dict[str, type[Base]]:
    found: dict[str, type[Base]] = {}
    for kind in defined:
        if not issubclass(kind, base) or (tag := tag_of(kind)) is None:
            continue
        if tag[1] in found:
            places = " and ".join(f"{one.__module__}.{one.__name__}" for one in (found[tag[1]], kind))
            raise ConfigError(f"two variants of {base.__name__} have the name '{tag[1]}': {places}; rename one")
        found[tag[1]] = kind
    return found


def invalid_variant_reason(kind: type[Settings]) -> str | None:
    """Return why no pipeline file can name a class that is meant as a variant, or None."""
    if kind.__subclasses__():
        return None
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        return f"lacks {', '.join(missing)}"
    bases = [base for base in kind.__mro__[1:] if issubclass(base, Settings) and base is not Settings]
    tags = [tag for base in bases for other in variants(base).values() if (tag := tag_of(other))]
    if not tags:
        return None
    field = kind.model_fields.get(tags[0][0])
    names = typing.get_args(field.annotation) if field else ()
    if len(names) == 1 and isinstance(names[0], str):
        return None
    return f'expected one name, as in `{tags[0][0]}: Literal["{kind.__name__.lower()}"]`'


def needs_settings(kind: type[Settings]) -> bool:
    """Return whether the name of a variant alone is too little: it has keys without a default."""
    return any(field.is_required() for name, field in kind.model_fields.items() if name not in TAGS)


class Variants:
    """Marks a field that accepts one of the variants of a base: a mapping with its name, or the name alone."""

    def __init__(self, base: type[Settings]) -> None:
        self.base = base

    @property
    def tag(self) -> str:
        """The field that names the variants."""
        return next((tag[0] for kind in variants(self.base).values() if (tag := tag_of(kind))), TAGS[-1])

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        tag = self.tag
        choices = {name: handler.generate_schema(kind) for name, kind in variants(self.base).items()}

        def with_tag(value: Any) -> Any:
            return {tag: value} if isinstance(value, str) else value

        union = core_schema.tagged_union_schema(choices, discriminator=tag)
        return core_schema.no_info_before_validator_function(with_tag, union)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        alone = [name for name, kind in variants(self.base).items() if not needs_settings(kind)]
        mapping = {"required": [self.tag], **handler(schema)}
        return {"anyOf": [{"enum": alone}, mapping]} if alone else mapping


def _readable(text: str) -> str:
    if "\0" in text or any("\ud800" <= letter <= "\udfff" for letter in text):
        raise ValueError("expected a path: no name of a file holds such a character")
    return text


def in_one_sentence(expected: str) -> WrapValidator:
    """Make one sentence of the errors of a field's notations: the first that one of them says itself, or `expected`."""

    def validated(value: Any, validate: Callable[[Any], Any]) -> Any:
        try:
            return validate(value)
        except ValidationError as error:
            own = [one["msg"].removeprefix("Value error, ") for one in error.errors() if one["type"] == "value_error"]
            raise ValueError(next((text for text in own if not expected.startswith(text)), expected)) from None

    return WrapValidator(validated)


InputPath = Annotated[str, AfterValidator(_readable)]  # a file or folder that is read


def is_input_path(kind: type[Settings], key: str) -> bool:
    """Return whether a key holds the path of a file or folder that is read."""
    field = kind.model_fields[key]
    return InputPath in (field.annotation, *typing.get_args(field.annotation)) or any(
        isinstance(one, AfterValidator) and one.func is _readable for one in field.metadata
    )


class VariantName:
    """Marks a field that accepts the name of one of the variants of a base, or of those that `accepts` is true of."""

    def __init__(self, base: type[Base], accepts: Callable[[type[Base]], bool] = lambda kind: True) -> None:
        self.base, self._accepts = base, accepts

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.literal_schema([name for name, kind in variants(self.base).items() if self._accepts(kind)])


if TYPE_CHECKING:
    OneOf = Annotated[Base, ...]
else:

    class OneOf:
        """`OneOf[Rule]`: any variant of Rule."""

        def __class_getitem__(cls, base: type[Settings]) -> Any:
            return Annotated[base, Variants(base)]


def import_modules(package: str, path: Iterable[str]) -> None:
    """Import every module of a package, so that the variants in them are defined."""
    for module in pkgutil.iter_modules(path):
        importlib.import_module(f"{package}.{module.name}")


def rebuild_models() -> None:
    """Rebuild all models, so that their fields accept variants defined since, such as those of a plug-in."""
    complete = [kind for kind in Settings.defined if kind.__pydantic_complete__]  # others are built at their first use
    for kind in complete:  # a schema holds those of its variants, and theirs
        if "__pydantic_core_schema__" in vars(kind):
            del kind.__pydantic_core_schema__
    for kind in complete:
        kind.model_rebuild(force=True)
