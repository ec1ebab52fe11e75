"""Hostile documents: valid ones with a few things wrong, and bytes of any kind."""

from __future__ import annotations

import copy
import math
from typing import Any

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

# 25 examples by default, 2000 with `--hypothesis-profile=study`. Files lie in one folder for all examples of a test.
HOSTILE = settings(
    max_examples=2000 if settings.get_current_profile_name() == "study" else 25,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)

DEEP: list[Any] = []
for _ in range(200):
    DEEP = [DEEP]

SCALARS = st.one_of(
    st.sampled_from([
        None, True, False, 0, -1, 1, 2**31, 2**63, -(2**70), 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf, "",
        "x" * 5000, "\x00", "../../../etc/passwd", "/dev/zero", "nan", "1e999", "ü\u202e", [], {}, [[]], DEEP, {"": {}},
    ]),
    st.floats(),
    st.integers(),
    st.text(max_size=20),
)  # fmt: skip


def places(document: Any, where: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The way to every value of a document."""
    found = [where] if where else []
    if isinstance(document, dict):
        for key, value in document.items():
            found += places(value, (*where, key))
    elif isinstance(document, list):
        for index, value in enumerate(document[:8]):
            found += places(value, (*where, index))
    return found


@st.composite
def mutated(draw: st.DrawFn, document: Any) -> Any:
    """The document with one to four things wrong: a value replaced, taken away, doubled, or under another name."""
    changed = copy.deepcopy(document)
    for _ in range(draw(st.integers(1, 4))):
        ways = places(changed)
        if not ways:
            return changed
        *way, last = draw(st.sampled_from(ways))
        parent = changed
        for key in way:
            parent = parent[key]
        action = draw(st.sampled_from(["replace", "replace", "replace", "remove", "double", "rename"]))
        if action == "replace":
            parent[last] = copy.deepcopy(draw(SCALARS))
        elif action == "remove":
            del parent[last]
        elif isinstance(parent, list):
            parent.insert(last, copy.deepcopy(parent[last]))
        else:
            parent[draw(st.text(max_size=8)) if action == "rename" else f"{last}_"] = parent.pop(last)
    return changed


_EDITS = st.lists(
    st.tuples(
        st.sampled_from(["flip", "overwrite", "cut", "insert", "repeat"]),
        st.integers(0, 2**20),
        st.binary(min_size=1, max_size=64),
    ),
    min_size=1,
    max_size=4,
)


def spoiled(data: bytes) -> st.SearchStrategy[bytes]:
    """The bytes with a few flipped, overwritten, cut off, inserted or repeated."""
    return _EDITS.map(lambda edits: _edited(data, edits))


def _edited(data: bytes, edits: list[tuple[str, int, bytes]]) -> bytes:
    changed = bytearray(data)
    for action, place, piece in edits:
        at = place % (len(changed) + 1)
        if action == "flip" and at < len(changed):
            changed[at] ^= 1 << piece[0] % 8
        elif action == "overwrite":
            changed[at : at + len(piece)] = piece
        elif action == "cut":
            del changed[at:]
        elif action == "insert":
            changed[at:at] = piece
        else:
            changed[at:at] = changed[at : at + 512]
    return bytes(changed)


def as_toml(value: Any, name: str = "") -> str:
    """A document as TOML, as far as TOML can say it; what it cannot say is left out."""
    lines, tables = [], []
    for key, part in value.items():
        if isinstance(part, dict):
            tables.append(as_toml_table(f"{name}{_key(key)}", part))
        elif isinstance(part, list) and part and all(isinstance(one, dict) for one in part):
            for one in part:
                tables.append(f"[[{name}{_key(key)}]]\n" + as_toml(one, f"{name}{_key(key)}."))
        else:
            text = _toml_value(part)
            lines += [f"{_key(key)} = {text}"] if text is not None else []
    return "\n".join([*lines, *tables]) + "\n"


def as_toml_table(name: str, value: dict[str, Any]) -> str:
    """One table."""
    return f"[{name}]\n" + as_toml(value, f"{name}.")


def _key(key: Any) -> str:
    text = str(key)
    return text if text.isidentifier() and text.isascii() else _quoted(text)


def _quoted(text: str) -> str:
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\U{ord(c):08x}" for c in text) + '"'


def _toml_value(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, list):
        parts = [_toml_value(part) for part in value]
        return "[" + ", ".join(part for part in parts if part is not None) + "]"
    pairs = [(key, _toml_value(part)) for key, part in value.items()]
    return "{" + ", ".join(f"{_key(key)} = {text}" for key, text in pairs if text is not None) + "}"
