"""Which test shows which requirement of controller/SAFETY.md: `python -m tests.safety` prints it."""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_REQUIREMENT = re.compile(r"^- \*\*(SR-\d{2})\*\* (.+?)(?=\n- |\n\n|\Z)", re.MULTILINE | re.DOTALL)


def requirements(text: str) -> dict[str, str]:
    """Every requirement by its number.

    Raises:
        ValueError: A number was given twice.
    """
    found = _REQUIREMENT.findall(text)
    numbers = [number for number, _ in found]
    if len(set(numbers)) != len(numbers):
        raise ValueError(f"a number was given twice: {numbers}")
    return {number: " ".join(words.split()) for number, words in found}


def marks(source: str, path: str) -> list[tuple[str, str]]:
    """(requirement, test) of every mark in a module of tests."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name.startswith(("test_", "Test")):
            for decorator in node.decorator_list:
                if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.safety":
                    found += [(str(ast.literal_eval(part)), f"{path}::{node.name}") for part in decorator.args]
    return found


def links(folder: Path = ROOT / "tests") -> dict[str, list[str]]:
    """Tests by the requirement they show; longer studies, which do not run by themselves, do not count."""
    found: dict[str, list[str]] = defaultdict(list)
    for path in sorted(folder.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "pytest.mark.safety" in source:
            for number, test in marks(source, str(path.relative_to(folder.parent))):
                found[number].append(test)
    return dict(found)


def main() -> None:
    """Print the requirements with their tests."""
    tests = links()
    for number, words in requirements((ROOT / "controller" / "SAFETY.md").read_text(encoding="utf-8")).items():
        print(f"{number} {words}")
        for test in tests.get(number, ()):
            print(f"      {test}")


if __name__ == "__main__":
    main()
