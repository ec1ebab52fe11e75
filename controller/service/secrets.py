"""Taking out of a text what its reader need not know: passwords, tokens, keys, addresses of people, their names.

It errs on the side of taking out too much: what is lost is a word of a log, what stays may be read by anybody.
"""

from __future__ import annotations

import re
from collections.abc import Callable

REMOVED = "[removed]"

# A name that says what follows is nobody's business, as part of a longer name too: `mqtt_password`, `X-Api-Key`.
_WORDS = (
    r"pass(?:word|wd|phrase|code)?", "secret", "token", r"api[_-]?key", "credential", r"private[_-]?key", "auth",
    "cookie", r"session[_-]?id",
)  # fmt: skip
_SECRET_NAME = rf"[\w.-]*(?:{'|'.join(_WORDS)})[\w.-]*"
# Quoted, quoted within a quotation, a list, or up to the next separator.
_VALUE = r"""(?:\\+"[^"\\\n]*|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|\[[^\]\n]*\]|[^\s,;}\]"']+)"""

_RULES: tuple[tuple[re.Pattern[str], str | Callable[[re.Match[str]], str]], ...] = (
    (re.compile(r"-----BEGIN [A-Z0-9 ]+-----.*?(?:-----END [A-Z0-9 ]+-----|\Z)", re.DOTALL), REMOVED),
    # user:password@ of an address
    (re.compile(r"(?<=://)[^/\s@]+@"), f"{REMOVED}@"),
    (re.compile(r"\b(bearer|basic|digest|negotiate)\s+[A-Za-z0-9+/=._~-]{6,}", re.IGNORECASE), rf"\1 {REMOVED}"),
    # name = value, name: value, "name": value
    (
        re.compile(rf"""(?P<name>["']?\b{_SECRET_NAME}\\*["']?\s*[=:]\s*){_VALUE}""", re.IGNORECASE),
        lambda match: f'{match["name"]}"{REMOVED}"',
    ),
    # --name value
    (re.compile(rf"(?P<name>--{_SECRET_NAME}\s+){_VALUE}", re.IGNORECASE), rf"\g<name>{REMOVED}"),
    # Tokens that well-known services begin with marks of their own, and JSON web tokens.
    (re.compile(r"\b(?:gh[pousr]_|github_pat_|glpat-|xox[abprs]-|sk-|AKIA|ASIA|AIza)[A-Za-z0-9_-]{10,}"), REMOVED),
    (re.compile(r"\beyJ[A-Za-z0-9_-]{5,}\.[A-Za-z0-9_-]{5,}(?:\.[A-Za-z0-9_-]*)?"), REMOVED),
    (re.compile(r"[\w.+-]+@[\w-]+(?:\.[\w-]+)+"), REMOVED),
    # The user's own name, in the path of his home.
    (re.compile(r"(?<=/home/)[^/\s\"':]+"), "user"),
    (re.compile(r"(?<=/Users/)[^/\s\"':]+"), "user"),
)

_ONLY_A_SECRET_NAME = re.compile(_SECRET_NAME, re.IGNORECASE)


def without_secrets(text: str, *names: str) -> tuple[str, int]:
    """A text without what looks like a secret, and how much was taken out.

    Args:
        text: Any text.
        names: Words to take out as well, such as the name of the machine, or the path of somebody's home.
    """
    removed = 0
    for pattern, instead in _RULES:
        text, count = pattern.subn(instead, text)
        removed += count
    for name in names:
        if len(name) > 2:
            text, count = re.subn(rf"(?<!\w){re.escape(name)}(?!\w)", REMOVED, text)
            removed += count
    return text, removed


def json_without_secrets(value: object, *names: str) -> tuple[object, int]:
    """Parsed JSON without secrets, still JSON: texts are cleaned, and what has a secret's name is taken out whole."""
    if isinstance(value, str):
        return without_secrets(value, *names)
    if isinstance(value, list):
        parts = [json_without_secrets(part, *names) for part in value]
        return [part for part, _ in parts], sum(count for _, count in parts)
    if isinstance(value, dict):
        cleaned: dict[str, object] = {}
        removed = 0
        for key, part in value.items():
            clean_key, in_key = without_secrets(str(key), *names)
            secret = _ONLY_A_SECRET_NAME.fullmatch(str(key)) is not None
            cleaned[clean_key], count = (REMOVED, 1) if secret else json_without_secrets(part, *names)
            removed += count + in_key
        return cleaned, removed
    return value, 0
