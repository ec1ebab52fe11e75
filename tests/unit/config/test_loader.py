"""A configuration is read strictly or refused with file, key and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from controller.config.loader import StrictModel, load_toml, read_toml, validate
from controller.domain import Shape
from controller.errors import ConfigError


class Item(StrictModel):
    name: str
    center_mm: tuple[float, float] = (0.0, 0.0)
    shape: Shape = Shape.SQUARE


class Root(StrictModel):
    speed: float = Field(1.0, gt=0, le=10)
    items: tuple[Item, ...] = ()


def refuse(tmp_path: Path, text: str) -> ConfigError:
    path = tmp_path / "cell.toml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_toml(path, Root)
    assert str(path) in caught.value.cause
    return caught.value


def test_values_arrive_as_tuples_and_enums(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text('speed = 2\n[[items]]\nname = "a"\ncenter_mm = [1, 2.5]\nshape = "circle"\n')
    assert load_toml(path, Root) == Root(speed=2.0, items=(Item(name="a", center_mm=(1.0, 2.5), shape=Shape.CIRCLE),))


@pytest.mark.parametrize(
    ("text", "key", "word"),
    [
        ("sped = 1", "sped", "did you mean speed?"),
        ("speed = 11", "speed", "mend"),
        ("speed = true", "speed", "mend"),
        ("speed = nan", "speed", "mend"),
        ("speed = inf", "speed", "mend"),
        ('speed = "1"', "speed", "mend"),
        ("[[items]]\ncenter_mm = [1, 2]", "items[0].name", "add this key"),
        ('[[items]]\nname = "a"\nshap = "circle"', "items[0].shap", "did you mean shape?"),
        ('[[items]]\nname = "a"\nshape = "circel"', "items[0].shape", "'circle'"),
        ('[[items]]\nname = "a"\ncenter_mm = [1]', "items[0].center_mm[1]", "add this key"),
    ],
)
@pytest.mark.safety("SR-04")
def test_a_mistake_is_named_with_its_key_and_remedy(tmp_path: Path, text: str, key: str, word: str) -> None:
    error = refuse(tmp_path, text)
    assert f"{key}:" in error.cause
    assert word in error.remedy


def test_a_typo_is_named_before_what_it_causes(tmp_path: Path) -> None:
    error = refuse(tmp_path, '[[items]]\nnam = "a"')
    assert "items[0].nam: unknown key (and 1 more)" in error.cause


def test_a_file_that_is_no_toml_is_named_with_its_line(tmp_path: Path) -> None:
    assert "line 2" in refuse(tmp_path, "speed = 1\nspeed == 2\n").cause


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        read_toml(tmp_path / "none.toml")


def test_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="directory"):
        read_toml(tmp_path)


def test_a_huge_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "huge.toml"
    path.write_bytes(b"#" * 1_000_001)
    with pytest.raises(ConfigError, match="larger than"):
        read_toml(path)


@given(st.binary(max_size=300))
@pytest.mark.safety("SR-43")
def test_no_bytes_raise_anything_else(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "x.toml"
    path.write_bytes(data)
    try:
        read_toml(path)
    except ConfigError as error:
        assert error.exit_code == 78


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@given(ANYTHING)
@pytest.mark.safety("SR-43")
def test_no_value_raises_anything_else(value: object) -> None:
    try:
        validate({"items": value}, Root, "fuzz")
    except ConfigError as error:
        assert error.cause.startswith("fuzz: ")
