"""TOML into strict models, with errors a person can act on: file, key, what is allowed, did you mean."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from controller.errors import ConfigError

MAX_BYTES = 1_000_000


class StrictModel(BaseModel):
    """Base of every configuration table: frozen, no unknown keys, no silent conversion, no nan or infinity.

    Field docstrings become the descriptions of `controller config schema`.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


M = TypeVar("M", bound=BaseModel)


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        ConfigError: The file is missing, too large, not UTF-8, or not TOML (with the line).
    """
    try:
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}", "name an existing file with --config") from error
    if len(raw) > MAX_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_BYTES} bytes", "this is no configuration file")
    try:
        return tomllib.loads(raw.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 at byte {error.start}", "save it as UTF-8 text") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not TOML: {error}", "mend the line named here") from error


def load_toml(path: Path, model: type[M]) -> M:
    """A TOML file as a validated, frozen model.

    Raises:
        ConfigError: See `read_toml`, or a key is unknown, missing, mistyped or out of range; the message
            names the file and the key, the remedy what is allowed.
    """
    return validate(read_toml(path), model, str(path))


def validate(tables: Mapping[str, Any], model: type[M], source: str) -> M:
    """Parsed tables as a validated, frozen model; `source` names them in messages.

    Raises:
        ConfigError: A key is unknown, missing, mistyped or out of range.
    """
    try:
        # TOML has arrays and strings where models have tuples, enums and paths: strict JSON allows just those.
        return model.model_validate_json(json.dumps(tables, default=str))
    except ValidationError as error:
        raise _as_config_error(error, model, source) from error


def _as_config_error(error: ValidationError, model: type[BaseModel], source: str) -> ConfigError:
    problems = error.errors(include_url=False)
    # An unknown key explains a missing one: say the typo first.
    problems.sort(key=lambda problem: problem["type"] != "extra_forbidden")
    first = problems[0]
    key = _dotted(first["loc"])
    cause, remedy = _explain(first, model)
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    where = f"{source}: {key}" if key else source
    return ConfigError(f"{where}: {cause}{more}", remedy)


def _dotted(location: Sequence[int | str]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text


def _explain(problem: ErrorDetails, model: type[BaseModel]) -> tuple[str, str]:
    kind = problem["type"]
    context = problem.get("ctx", {})
    if kind == "extra_forbidden":
        allowed = sorted(_fields_at(model, problem["loc"][:-1]))
        name = str(problem["loc"][-1])
        close = difflib.get_close_matches(name, allowed, n=1, cutoff=0.6)
        hint = f"did you mean {close[0]}? " if close else ""
        return "unknown key", f"{hint}allowed: {', '.join(allowed)}"
    if kind == "missing":
        return "missing", "add this key"
    if kind in ("literal_error", "enum"):
        return f"{_short(problem['input'])} is not allowed", f"use {context.get('expected', '')}"
    if kind == "value_error":
        cause = context.get("error")
        if isinstance(cause, ConfigError):
            return cause.cause, cause.remedy
    return f"{_short(problem['input'])}: {problem['msg'][:1].lower()}{problem['msg'][1:]}", "mend the value"


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _fields_at(model: type[BaseModel], location: Sequence[int | str]) -> set[str]:
    """Names allowed at a place inside a model, walking through lists, tuples, mappings and unions."""
    candidates: set[type[BaseModel]] = {model}
    for part in location:
        following: set[type[BaseModel]] = set()
        for candidate in candidates:
            field = candidate.model_fields.get(part) if isinstance(part, str) else None
            following |= _models_in(field.annotation) if field else {candidate}
        candidates = following
    return {field for candidate in candidates for field in candidate.model_fields}


def _models_in(annotation: Any) -> set[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {annotation}
    found: set[type[BaseModel]] = set()
    for argument in get_args(annotation):
        found |= _models_in(argument)
    return found
